"""Checkpoints: every bit of a run on disk, hashed, written whole or not at all.

A checkpoint is a folder named by its generation:

    checkpoints/00000120/
      state.safetensors   every array leaf, named by its path in the tree
      counters.json       plain numbers and strings
      replay0-….safetensors, …   rows of a replay buffer; unchanged ones are hard links
      COMMIT              size and SHA-256 of each, and the caller's seals; written last

It is written under another name and renamed when it is on the disk, so a process may be killed at
any moment. Nothing read here can execute code. `export_policy` and `import_policy` do the same
for one file.
"""

import contextlib
import functools
import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path
from jaxtyping import Array, PyTree
from safetensors import SafetensorError, safe_open

from . import files, segments

STATE, COUNTERS, COMMIT = "state.safetensors", "counters.json", "COMMIT"
# Our entries in a file's metadata.
KEYS, CHECKSUM, REPLAY = "credo.keys", "credo.sha256", "credo.replay"
EXTRA = "extra"  # before the names of leaves besides the state's, which begin with "." or "["
CODES = {
    "bool": "BOOL",
    **{f"int{bits}": f"I{bits}" for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": f"U{bits}" for bits in (8, 16, 32, 64)},
    "float16": "F16",
    "bfloat16": "BF16",
    "float32": "F32",
    "float64": "F64",
}


class CheckpointError(Exception):
    """A checkpoint could not be written, found, read or fitted to the run."""


class DamagedCheckpoint(UserWarning):
    """A checkpoint is not as it was written; an older one is used."""


class Checkpoint(eqx.Module):
    """What `load` found: the state and the tree besides it as JAX arrays, counters and seals as
    they were given to `save`, and the folder they came from."""

    generation: int
    state: PyTree
    counters: dict[str, Any]
    path: Path
    seals: dict[str, Any]
    extra: PyTree = None


def save(
    directory: Path,
    generation: int,
    state: PyTree,
    counters: dict[str, Any],
    *,
    extra: PyTree = None,
    keep: int = 3,
    seals: Mapping[str, Any] = {},
) -> Path:
    """Write `state` and `counters` as the checkpoint of `generation`; returns its folder.

    Array leaves (JAX or NumPy, typed PRNG keys too) are kept bit for bit. All other leaves are
    not written: `load` takes them from its `like`. `counters` holds numbers, strings, lists and
    dicts; integers of any size and floats come back exactly. So do `seals`, which say what the
    checkpoint belongs to, hashes of other files say: `load` hands them to its `check`. `extra` is a
    tree besides the state, which other checkpoints may lack.

    The rows of a `credo.replay.Replay` that older checkpoints have are not written again but
    linked (see `segments`), if there is a copy besides that of the checkpoint just before: two in
    a row share no file, so that no damaged file spoils both. To have `keep=2` or more therefore
    takes the room of two buffers; where that is not free, files are shared, with a warning.

    Of the older checkpoints the newest intact ones stay, `keep` with this one, and the rest are
    removed once this one is safe; to know them, those that stay are read once, without the rows
    that this process wrote or read before. An intact checkpoint of the same generation is left
    alone but for its seals, a damaged one replaced. What cannot be removed is a warning.

    Raises `CheckpointError` if a leaf cannot be stored or the disk is full or fails; older
    checkpoints are then intact and no half-written one is left.
    """
    if generation < 0:
        raise ValueError(f"generation is {generation}: it must be at least 0")
    if keep < 1:
        raise ValueError(f"keep is {keep}: it must be at least 1")
    directory = Path(directory)
    folder = directory / f"{generation:08d}"
    leaves, keys = _leaves(state, extra)
    rings = segments.rings(state)
    for name in [name for ring in rings for name in ring.leaves]:
        del leaves[name]  # it goes to files of its own
    metadata = {KEYS: json.dumps(keys)} | ({REPLAY: segments.describe(rings)} if rings else {})
    header = _header(leaves, metadata)
    text, seals = _plain_text("counters", counters), dict(seals)
    _plain_text("seals", seals)
    parts = segments.parts(rings)
    needed = len(header) + _size(leaves) + len(text)
    with _explained(f"cannot read {directory}", directory):
        there, more = _linkable(folder, parts, needed, keep)
    with _explained(f"cannot save checkpoint {folder}", directory, needed + more):
        directory.mkdir(parents=True, exist_ok=True)
        _remove_unfinished(directory)
        if not folder.exists() or damage(folder, reread=False):
            _write_folder(folder, _chunks(header, leaves), text, parts, there, seals)
        elif (commit := _commit(folder))["seals"] != seals:
            text = _commit_text(generation, commit["files"], seals)
            files.write_whole(folder / COMMIT, [text])
    _remove_beyond(keep, folder)
    return folder


def load(
    directory: Path,
    like: PyTree,
    *,
    extra: PyTree = None,
    generation: int | None = None,
    without_replay: bool = False,
    check: Callable[[int, dict[str, Any]], str | None] | None = None,
) -> Checkpoint:
    """The newest intact checkpoint in `directory`, or the one of `generation`.

    `like` gives the structure: arrays or `jax.ShapeDtypeStruct`s where the checkpoint has arrays,
    e.g. `eqx.filter_eval_shape(algorithm.init, key=key)`; every other leaf is returned as it is.
    Arrays come back as JAX arrays of the same dtype and bits (never weakly typed). A replay buffer
    may have another capacity in `like` if it was never full, and all its rows fit.

    - `extra`: the same as `like` of the tree besides the state, which is None if the checkpoint has
      none.
    - `without_replay`: replay buffers come back empty, with a warning; their files may be damaged.
    - `check(generation, seals)`: what is wrong with a checkpoint of these seals, None if nothing
      is; such a checkpoint counts as damaged. Written without `seals` it has `{}`.

    Each damaged checkpoint newer than the one used is named in a `DamagedCheckpoint` warning.
    Raises `CheckpointError` if there is none, if all are damaged, if the one of `generation` is,
    or if a leaf's path, shape or dtype differs from `like`: that one never falls back.
    """
    directory = Path(directory)
    folders = everything = _checkpoints(directory)
    if generation is not None:
        folders = [folder for folder in everything if int(folder.name) == generation]
    if not folders:
        which = "no checkpoint" if generation is None else f"no checkpoint of {generation}"
        there = ", ".join(folder.name for folder in everything) or "nothing"
        raise CheckpointError(f"{which} in {directory}: there is {there}")
    damaged = {}
    for folder in folders:
        reason = damage(folder, replay=not without_replay)
        if reason is None and check is not None:
            reason = check(int(folder.name), _commit(folder)["seals"])
        if reason is None:
            _warn_of(damaged, folder, without_replay)
            return _loaded(folder, like, extra, without_replay)
        damaged[folder.name] = reason
    reasons = "".join(f"\n  {name}: {why}" for name, why in damaged.items())
    raise CheckpointError(
        f"no intact checkpoint in {directory}:{reasons}\n"
        "Restore one from a copy, or start a new run under another name."
    )


def _warn_of(damaged: Mapping[str, str], used: Path, without_replay: bool) -> None:
    """Name each checkpoint that was passed over, and a buffer that is left out."""
    for name, why in damaged.items():
        warnings.warn(
            f"checkpoint {used.with_name(name)} is damaged ({why}): using {used.name} instead",
            DamagedCheckpoint,
            stacklevel=3,
        )
    if without_replay:
        warnings.warn(
            f"the replay buffer of checkpoint {used} is left out: it is empty and fills again, so "
            "results will differ from those of a run that has it",
            stacklevel=3,
        )


def _loaded(folder: Path, like: PyTree, extra: PyTree, without_replay: bool) -> Checkpoint:
    """Read a checkpoint that was found whole. Raises `CheckpointError` if it does not fit
    `like`."""
    metadata, arrays = _read(folder / STATE)
    more = {name: arrays.pop(name) for name in list(arrays) if name.startswith(EXTRA)}
    empty = segments.names(like) if without_replay else set()
    with _explained(f"cannot read {folder}", folder):
        commit = _commit(folder)
        arrays |= segments.stored(folder, commit["files"], metadata.get(REPLAY, "[]"))
        state = _fit(folder / STATE, like, arrays, metadata, empty)
        more = {name.removeprefix(EXTRA): array for name, array in more.items()}
        extra = _fit(folder / STATE, extra, more, metadata) if more and extra is not None else None
        counters = json.loads(files.read_bytes(folder / COUNTERS))
    return Checkpoint(int(folder.name), state, counters, folder, commit["seals"], extra)


def damage(folder: Path, *, reread: bool = True, replay: bool = True) -> str | None:
    """What is wrong with the checkpoint in `folder`; None if every byte is as it was written.

    Without `reread`, rows of a replay buffer that this process wrote or read before are taken to
    be as they were if their file was not touched since; without `replay` they are not looked at.
    """
    try:
        names = os.listdir(folder)
        if not names:
            return "the folder is empty"
        if COMMIT not in names:
            return f"it has no {COMMIT}: writing it was never finished"
        then = _commit(folder)["files"]
        looked_at = [name for name in then if replay or not segments.NAME.fullmatch(name)]
        if missing := sorted(set(looked_at).difference(names)):
            return f"{' and '.join(missing)} is missing"
        differing = (_differs(folder / name, then[name], reread) for name in looked_at)
        return next(filter(None, differing), None)
    except CheckpointError as error:
        return str(error)
    except (OSError, ValueError) as error:
        return f"it cannot be read: {error}"


def seals_of(folder: Path) -> dict[str, Any]:
    """The seals of the checkpoint in `folder`; none if they cannot be read."""
    try:
        return _commit(folder)["seals"]
    except (OSError, ValueError, CheckpointError):
        return {}


def export_policy(path: Path, tree: PyTree, metadata: Mapping[str, str] | None = None) -> None:
    """Write the array leaves of `tree`, a policy say, to the single file `path`.

    The file is a standard safetensors file; leaves are named as in a checkpoint. `metadata` holds
    strings, such as the config as JSON. What was at `path` is replaced at once or not at all.
    Raises `CheckpointError` like `save`.
    """
    path = Path(path)
    leaves, keys = _leaves(tree)
    metadata = dict(metadata or {})
    for name, value in metadata.items():
        if name.startswith("credo.") or not isinstance(value, str):
            raise ValueError(
                f"metadata {name!r} is {value!r}: values must be strings, and names that start "
                "with 'credo.' are taken"
            )
    metadata[KEYS] = json.dumps(keys)
    header = _header(leaves, metadata | {CHECKSUM: _checksum(metadata, leaves)})
    needed = len(header) + _size(leaves)
    with _explained(f"cannot write {path}", path.parent, needed):
        files.write_whole(path, _chunks(header, leaves))


def import_policy(path: Path, like: PyTree) -> PyTree:
    """The tree that `export_policy` wrote to `path`, with the structure of `like` (see `load`).

    Raises `CheckpointError` if the file is missing or damaged, or if a leaf differs from `like`.
    """
    metadata, arrays = _read_export(Path(path))
    return _fit(Path(path), like, arrays, metadata)


def read_metadata(path: Path) -> dict[str, str]:
    """The metadata given to `export_policy`. Raises `CheckpointError` like `import_policy`."""
    metadata, _ = _read_export(Path(path))
    return {name: value for name, value in metadata.items() if name != KEYS}


# The tree and its leaves.


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _describe(leaf: Any) -> str:
    """A leaf as `float32[3, 2]`, by which two are the same; a typed key as `key<fry>[]`."""
    return f"{leaf.dtype}{list(leaf.shape)}"


def _leaves(tree: PyTree, extra: PyTree = None) -> tuple[dict[str, Any], dict[str, str]]:
    """Array leaves by name, typed keys as their data; and the generator of each typed key."""
    leaves, keys = {}, {}
    named = [(keystr(path), leaf) for path, leaf in tree_flatten_with_path(tree)[0]]
    more = [(EXTRA + keystr(path), leaf) for path, leaf in tree_flatten_with_path(extra)[0]]
    for name, leaf in named + more:
        if not _is_array(leaf):
            continue
        if name in leaves:
            raise CheckpointError(f"two leaves are named {name}: give them different names")
        if _is_key(leaf):
            keys[name], leaf = str(jax.random.key_impl(leaf)), jax.random.key_data(leaf)
        if str(leaf.dtype) not in CODES or jax.dtypes.canonicalize_dtype(leaf.dtype) != leaf.dtype:
            raise CheckpointError(
                f"leaf {name} is {_describe(leaf)}: stored are {', '.join(CODES)}, "
                "and 64 bits only where jax_enable_x64 is on; convert it"
            )
        leaves[name] = leaf
    # Larger items first, as the format's own library does, keeps every leaf aligned.
    order = sorted(leaves, key=lambda name: (-leaves[name].dtype.itemsize, name))
    return {name: leaves[name] for name in order}, keys


def _fit(
    path: Path,
    like: PyTree,
    arrays: dict[str, np.ndarray | segments.Stored],
    metadata: Mapping[str, str],
    empty: Collection[str] = (),
) -> PyTree:
    """`like` with the arrays of the file in the places of its own, and zeros in those that are to
    be `empty`; `arrays` is emptied."""
    keys = json.loads(metadata[KEYS])
    paths, structure = tree_flatten_with_path(like)
    wanted = {keystr(at): leaf for at, leaf in paths if _is_array(leaf)}
    expected = {name: _describe(leaf) for name, leaf in wanted.items() if name not in empty}
    for name in empty:
        arrays.pop(name, None)
    for name, data in arrays.items():
        if isinstance(data, segments.Stored) and name in wanted:
            arrays[name] = data.fitted(wanted[name].shape, wanted[name].dtype)
    found = {}
    for name, data in arrays.items():
        wrap = functools.partial(jax.random.wrap_key_data, impl=keys.get(name))
        found[name] = _describe(jax.eval_shape(wrap, data) if name in keys else data)
    _check_same(path, expected, found)

    def leaf(name: str) -> Array:
        if name in empty:
            return jnp.zeros(wanted[name].shape, wanted[name].dtype)
        data = arrays.pop(name)
        # One leaf at a time, copied once: a buffer may fill most of the memory.
        read = _read_rows(data) if isinstance(data, segments.Stored) else data
        array = jax.block_until_ready(jax.device_put(read, may_alias=False))
        if array.dtype != data.dtype:
            raise CheckpointError(f"{path}: {name} is {_describe(data)}: set jax_enable_x64")
        return jax.random.wrap_key_data(array, impl=keys[name]) if name in keys else array

    return jax.tree.unflatten(
        structure, [leaf(keystr(at)) if _is_array(old) else old for at, old in paths]
    )


def _check_same(path: Path, expected: dict[str, str], found: dict[str, str]) -> None:
    """Raise `CheckpointError`, which names the first ten, if leaves differ by name, shape or
    dtype."""
    differing = [
        f"\n  {name}: found {found.get(name, 'no array')}, "
        f"expected {expected.get(name, 'no array')}"
        for name in sorted(expected | found)
        if found.get(name) != expected.get(name)
    ]
    if differing:
        more = f"\n  and {len(differing) - 10} more" if len(differing) > 10 else ""
        raise CheckpointError(
            f"{path} does not fit: {len(differing)} leaves differ from what is expected"
            f"{''.join(differing[:10])}{more}\nUse the config that it was written with."
        )


# The bytes of a file. The format's library writes without fsync, reports a full disk without its
# error number, and hashes nothing; so writing is done here, reading by the library.


def _bytes(leaf: Any) -> memoryview:
    """All bytes of an array in C order; of one on a device a copy."""
    return np.ascontiguousarray(leaf).reshape(-1).view(np.uint8).data


def _size(leaves: Mapping[str, Any]) -> int:
    return sum(leaf.nbytes for leaf in leaves.values())


def _header(leaves: Mapping[str, Any], metadata: Mapping[str, str]) -> bytes:
    """What stands before the arrays: eight bytes of length, then JSON of dtypes, shapes and places.

    Its order is ours, so that equal states are equal bytes: the library orders metadata at random.
    """
    entries: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for name, leaf in leaves.items():
        start, end = end, end + leaf.nbytes
        code = CODES[str(leaf.dtype)]
        entries[name] = {"dtype": code, "shape": leaf.shape, "data_offsets": [start, end]}
    text = json.dumps(entries).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def _chunks(header: bytes, leaves: Mapping[str, Any]) -> Iterator[bytes | memoryview]:
    """A whole file, piece by piece: no second copy of an array is held."""
    yield header
    for leaf in leaves.values():
        yield from leaf.pieces() if isinstance(leaf, segments.Rows) else [_bytes(leaf)]


def _checksum(metadata: Mapping[str, str], leaves: Mapping[str, Any]) -> str:
    """SHA-256 of what an exported file says, whatever the order it says it in."""
    digest = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name in sorted(leaves):
        digest.update(f"{name} {_describe(leaves[name])}".encode())
        digest.update(_bytes(leaves[name]))
    return digest.hexdigest()


def _plain_text(what: str, values: dict[str, Any]) -> bytes:
    """Values as JSON. Raises `ValueError` if they would not come back as they are."""
    text = json.dumps(values, indent=2)
    # Python's text of a float is exact, and its comparison by text also holds for NaN.
    if repr(json.loads(text)) != repr(values):
        raise ValueError(
            f"{what} {values!r} would come back as {json.loads(text)!r}: use Python numbers, "
            "strings, lists, and dicts whose names are strings"
        )
    return text.encode()


def _read(path: Path) -> tuple[dict[str, str], dict[str, Any]]:
    """The metadata and the arrays of a file."""
    try:
        with _explained(f"cannot read {path}", path.parent):
            files.reading(path).close()  # the library waits for a pipe
            with safe_open(path, framework="numpy") as file:
                metadata, names = file.metadata() or {}, file.keys()
                return metadata, {name: file.get_tensor(name) for name in names}
    except SafetensorError as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error


def _read_rows(stored: segments.Stored) -> np.ndarray:
    """A whole leaf of a buffer. Raises `CheckpointError` if a part of it is not what its name
    says."""
    try:
        return stored.read()
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(f"the replay buffer's {stored.name} is damaged: {error}") from error


def _read_export(path: Path) -> tuple[dict[str, str], dict[str, Any]]:
    """Metadata and arrays of an exported policy, whose SHA-256 is right; raises
    `CheckpointError`."""
    metadata, arrays = _read(path)
    checksum = metadata.pop(CHECKSUM, None)
    if checksum is None or KEYS not in metadata:
        raise CheckpointError(f"{path} has no checksum: damaged, or not made by `export_policy`")
    if checksum != _checksum(metadata, arrays):
        raise CheckpointError(f"{path} is damaged: its SHA-256 is not the one it was written with")
    return metadata, arrays


# Folders, the commit marker, and what the operating system says.


def _checkpoints(directory: Path) -> list[Path]:
    """Whatever has a checkpoint's name, newest first."""
    if not directory.is_dir():
        return []
    folders = [path for path in directory.iterdir() if re.fullmatch(r"\d{8,}", path.name)]
    return sorted(folders, key=lambda path: int(path.name), reverse=True)


def _beside(folder: Path, what: str) -> Path:
    return folder.with_name(f".{folder.name}.{what}")


def _remove_unfinished(directory: Path) -> None:
    """What killed processes left."""
    for path in directory.iterdir():
        if re.fullmatch(r"\.\d{8,}\.(partial|removed)", path.name):
            with _spared(path):
                files.remove(path)


def _remove(folder: Path) -> None:
    """Remove a checkpoint. Raises `OSError` if it cannot even be renamed."""
    # Under another name first: killed half-way, it must not look like a damaged checkpoint.
    removed = _beside(folder, "removed")
    files.remove(removed)
    os.rename(folder, removed)
    with _spared(removed):
        files.remove(removed)


def _remove_beyond(keep: int, newest: Path) -> None:
    """Keep the `keep` newest intact checkpoints up to `newest`; later ones are not touched."""
    older = _older(newest)
    intact = 1
    for folder in older if len(older) >= keep else []:
        if intact == keep:
            with _spared(folder):
                _remove(folder)
        elif damage(folder, reread=False) is None:
            intact += 1


def _older(folder: Path) -> list[Path]:
    """Checkpoints before that in `folder`, newest first."""
    every = _checkpoints(folder.parent)
    return [path for path in every if int(path.name) < int(folder.name)]


@contextlib.contextmanager
def _spared(path: Path) -> Iterator[None]:
    """What is left in the folder takes room and does no other harm."""
    try:
        yield
    except OSError as error:
        warnings.warn(f"cannot remove {path}: {error}; remove it yourself", stacklevel=4)


def _write_folder(
    folder: Path,
    state: Iterable[bytes | memoryview],
    counters: bytes,
    parts: Mapping[str, Mapping[str, segments.Rows]],
    there: Mapping[str, Path],
    seals: Mapping[str, Any],
) -> None:
    """`parts` are the files of replay buffers, and `there` says which of them are written."""
    partial = _beside(folder, "partial")
    try:
        partial.mkdir()
        found = {
            STATE: _write(partial / STATE, state),
            COUNTERS: _write(partial / COUNTERS, [counters]),
        }
        for name, rows in parts.items():
            if not (name in there and _link(there[name], partial / name)):
                _write_part(partial / name, rows)
            found[name] = _known_fingerprint(partial / name, reread=False)
        _write(partial / COMMIT, [_commit_text(int(folder.name), found, seals)])
        files.sync(partial)
        if os.path.lexists(folder):
            _remove(folder)
        os.rename(partial, folder)
        files.sync(folder.parent)
    finally:
        with contextlib.suppress(OSError):  # the first error counts
            files.remove(partial)


# Files of a replay buffer's rows. They are never changed, so one look at each is enough.

_seen: dict[tuple[int, ...], dict[str, Any]] = {}  # fingerprints, by what tells files apart


def _identity(path: Path) -> tuple[int, ...]:
    """What tells a file from any other, and from itself after a write."""
    status = os.stat(path)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _known_fingerprint(path: Path, *, reread: bool) -> dict[str, Any]:
    """That of a file, which is read if this process has not seen it, or to `reread` it."""
    identity = _identity(path)
    if reread or identity not in _seen:
        _seen[identity] = _fingerprint(path)
    return _seen[identity]


def _write_part(path: Path, rows: Mapping[str, segments.Rows]) -> None:
    """Write a file of rows, of which the fingerprint is known from now on."""
    order = sorted(rows, key=lambda name: (-rows[name].dtype.itemsize, name))
    rows = {name: rows[name] for name in order}
    fingerprint = _write(path, _chunks(_header(rows, {}), rows))
    _seen[_identity(path)] = fingerprint


def _link(old: Path, new: Path) -> bool:
    """Whether `new` is now another name of `old`: not every file system has this."""
    try:
        os.link(old, new)
    except OSError:
        # A network may report failure of what it did: writing would then go through to `old`.
        new.unlink(missing_ok=True)
        return False
    return True


def _linkable(
    folder: Path, parts: Mapping[str, Mapping[str, segments.Rows]], needed: int, keep: int
) -> tuple[dict[str, Path], int]:
    """Where files of these parts are that the checkpoint in `folder` may share, and how many bytes
    the others take, besides the `needed` ones.

    None of the checkpoint just before, so that no damaged file spoils two in a row; unless only one
    checkpoint is kept, or so little is free that the next one might not fit: that is a warning.
    """

    def size(there: Mapping[str, Path]) -> int:
        return sum(_size(rows) for name, rows in parts.items() if name not in there)

    before = next(iter(_older(folder)), None)
    anywhere = _intact_parts(folder.parent, parts, None)
    apart = _intact_parts(folder.parent, parts, before) if keep > 1 and before else anywhere
    # A checkpoint that takes more than half of what is free would leave too little for the next.
    enough = 2 * (needed + size(apart))
    if size(apart) == size(anywhere) or shutil.disk_usage(folder.parent).free > enough:
        return apart, size(apart)
    warnings.warn(
        f"there is too little room in {folder.parent} for a second copy of the replay buffer: "
        "checkpoints share its files, and damage to one may be damage to all",
        stacklevel=3,
    )
    return anywhere, size(anywhere)


def _intact_parts(directory: Path, names: Iterable[str], but: Path | None) -> dict[str, Path]:
    """Where in the checkpoints in `directory` files of these names are, as they were written;
    none that the checkpoint `but` has, be it under another name."""
    wanted, there = set(names), {}
    taken = set() if but is None else _files_in(but)
    for folder in _checkpoints(directory) if wanted else []:
        try:
            written = _commit(folder)["files"]
            for name in wanted.intersection(written).difference(there):
                path = folder / name
                if _identity(path)[:2] in taken:
                    continue
                if _known_fingerprint(path, reread=False) == written[name]:
                    there[name] = path
        except (OSError, ValueError, CheckpointError):
            continue  # damaged: what only it has is written again
    return there


def _files_in(folder: Path) -> set[tuple[int, ...]]:
    """Device and inode of all files in a folder; none if it cannot be read."""
    with contextlib.suppress(OSError):
        return {_identity(folder / name)[:2] for name in os.listdir(folder)}
    return set()


def _write(path: Path, chunks: Iterable[bytes | memoryview]) -> dict[str, Any]:
    """Write `chunks` to the disk; returns the file's fingerprint."""
    digest, size = hashlib.sha256(), 0

    def hashed() -> Iterator[bytes | memoryview]:
        nonlocal size
        for chunk in chunks:
            digest.update(chunk)
            size += len(chunk)
            yield chunk

    files.write_new(path, hashed())
    return {"bytes": size, "sha256": digest.hexdigest()}


def _fingerprint(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file, read in pieces. Raises `OSError`."""
    with files.reading(path) as file:
        return {"sha256": hashlib.file_digest(file, "sha256").hexdigest(), "bytes": file.tell()}


def _differs(path: Path, then: Mapping[str, Any], reread: bool) -> str | None:
    """How a file differs from what COMMIT says of it."""
    size = os.stat(path).st_size
    if size != then["bytes"]:
        return f"{path.name} has {size} bytes, {COMMIT} says {then['bytes']}"
    reread = reread or not segments.NAME.fullmatch(path.name)
    if _known_fingerprint(path, reread=reread) != then:
        return f"the SHA-256 of {path.name} is not the one in {COMMIT}"
    return None


def _commit(folder: Path) -> dict[str, Any]:
    """The files and seals that COMMIT names. Raises `OSError`, `ValueError` if it is too large, and
    `CheckpointError` if it is not as it was written."""
    committed = files.read_bytes(folder / COMMIT)
    with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):
        said = json.loads(committed)
        found, seals = said["files"], dict(said.get("seals", {}))
        whole = {STATE, COUNTERS} <= found.keys() and all(
            f.keys() == {"bytes", "sha256"} for f in found.values()
        )
        if whole and committed == _commit_text(int(folder.name), found, seals):
            return {"files": found, "seals": seals}
    raise CheckpointError(f"{COMMIT} is not as it was written")


def _commit_text(generation: int, files: Mapping[str, Any], seals: Mapping[str, Any] = {}) -> bytes:
    """COMMIT as it is written, byte for byte. Seals are hashed too: no file stands for them."""
    commit: dict[str, Any] = {"generation": generation, "files": files}
    if seals:
        text = json.dumps(seals, sort_keys=True)
        commit |= {"seals": seals, "sha256 of seals": hashlib.sha256(text.encode()).hexdigest()}
    return json.dumps(commit, indent=2, sort_keys=True).encode()


@contextlib.contextmanager
def _explained(task: str, directory: Path, needed: int = 0) -> Iterator[None]:
    """Turn what the operating system says into a `CheckpointError`."""
    try:
        yield
    except OSError as error:
        message = f"{task}: {error}"
        if error.errno in files.FULL:
            there = directory.absolute()
            there = next(path for path in (there, *there.parents) if path.exists())
            advice = files.advice(error)
            message += (
                f"; it needs {needed:,} bytes, and {shutil.disk_usage(there).free:,} are free in "
                f"{there}. {advice[0].upper()}{advice[1:]}, then resume; older checkpoints are "
                "intact."
            )
        raise CheckpointError(message) from error
