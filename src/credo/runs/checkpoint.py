"""Checkpoints: every bit of a run on disk, hashed, written whole or not at all.

A checkpoint is a folder named by its generation:

    checkpoints/00000120/
      state.safetensors   every array leaf, named by its path in the tree
      counters.json       plain numbers and strings
      replay0-….safetensors, …   rows of a replay buffer; unchanged ones are hard links
      COMMIT              size and SHA-256 of each; written last

It is written under another name and renamed when it is on the disk, so a process may be killed at
any moment. Nothing read here can execute code. `export_policy` and `import_policy` do the same
for one file.
"""

import contextlib
import errno
import functools
import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path
from jaxtyping import Array, PyTree
from safetensors import SafetensorError, safe_open

from . import segments

STATE, COUNTERS, COMMIT = "state.safetensors", "counters.json", "COMMIT"
# Our entries in a file's metadata.
KEYS, CHECKSUM, REPLAY = "credo.keys", "credo.sha256", "credo.replay"
DTYPES = {
    np.dtype(dtype): code
    for dtype, code in {
        jnp.bool_: "BOOL",
        jnp.int8: "I8",
        jnp.int16: "I16",
        jnp.int32: "I32",
        jnp.int64: "I64",
        jnp.uint8: "U8",
        jnp.uint16: "U16",
        jnp.uint32: "U32",
        jnp.uint64: "U64",
        jnp.float16: "F16",
        jnp.bfloat16: "BF16",
        jnp.float32: "F32",
        jnp.float64: "F64",
    }.items()
}


class CheckpointError(Exception):
    """A checkpoint could not be written, found, read or fitted to the run."""


class DamagedCheckpoint(UserWarning):
    """A checkpoint is not as it was written; an older one is used."""


class Checkpoint(eqx.Module):
    """What `load` found."""

    generation: int
    state: PyTree
    counters: dict[str, Any]
    path: Path


def save(
    directory: Path, generation: int, state: PyTree, counters: dict[str, Any], *, keep: int = 3
) -> Path:
    """Write `state` and `counters` as the checkpoint of `generation`; returns its folder.

    Array leaves (JAX or NumPy, typed PRNG keys too) are kept bit for bit. All other leaves are
    not written: `load` takes them from its `like`. `counters` holds numbers, strings, lists and
    dicts; integers of any size and floats come back exactly.

    The rows of a `credo.replay.Replay` that an older checkpoint has are not written again but
    linked (see `segments`).

    Of the older checkpoints the newest intact ones stay, `keep` with this one, and the rest are
    removed once this one is safe; to know them, those that stay are read once, without the rows
    that this process wrote or read before. An intact checkpoint of the same generation is left
    alone, a damaged one replaced.

    Raises `CheckpointError` if a leaf cannot be stored or the disk is full or fails; older
    checkpoints are then intact and no half-written one is left.
    """
    if generation < 0:
        raise ValueError(f"generation is {generation}: it must be at least 0")
    if keep < 1:
        raise ValueError(f"keep is {keep}: it must be at least 1")
    directory = Path(directory)
    folder = directory / f"{generation:08d}"
    leaves, keys = _leaves(state)
    rings = segments.rings(state)
    for name in [name for ring in rings for name in ring.leaves]:
        del leaves[name]  # it goes to files of its own
    metadata = {KEYS: json.dumps(keys)} | ({REPLAY: segments.describe(rings)} if rings else {})
    header = _header(leaves, metadata)
    text = _counters_text(counters)
    parts = segments.parts(rings)
    with _explained(f"cannot read {directory}", directory):
        there = _intact_parts(directory, parts)
    needed = len(header) + _size(leaves) + len(text)
    needed += sum(_size(rows) for name, rows in parts.items() if name not in there)
    with _explained(f"cannot save checkpoint {folder}", directory, needed):
        directory.mkdir(parents=True, exist_ok=True)
        _remove_unfinished(directory)
        if not folder.exists() or damage(folder, reread=False):
            _write_folder(folder, _chunks(header, leaves), text, parts, there)
    with _explained(f"{folder} is saved, but an older checkpoint cannot be removed", directory):
        _remove_beyond(keep, folder)
    return folder


def load(directory: Path, like: PyTree, *, generation: int | None = None) -> Checkpoint:
    """The newest intact checkpoint in `directory`, or the one of `generation`.

    `like` gives the structure: arrays or `jax.ShapeDtypeStruct`s where the checkpoint has arrays,
    e.g. `eqx.filter_eval_shape(algorithm.init, key=key)`; every other leaf is returned as it is.
    Arrays come back as JAX arrays of the same dtype and bits (never weakly typed).

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
        if reason := damage(folder):
            damaged[folder.name] = reason
            continue
        for name, why in damaged.items():
            warnings.warn(
                f"checkpoint {directory / name} is damaged ({why}): using {folder.name} instead",
                DamagedCheckpoint,
                stacklevel=2,
            )
        metadata, arrays = _read(folder / STATE)
        with _explained(f"cannot read {folder}", folder):
            arrays |= segments.stored(folder, metadata.get(REPLAY, "[]"))
            state = _fit(folder / STATE, like, arrays, metadata)
            counters = json.loads((folder / COUNTERS).read_text())
        return Checkpoint(int(folder.name), state, counters, folder)
    reasons = "".join(f"\n  {name}: {why}" for name, why in damaged.items())
    raise CheckpointError(
        f"no intact checkpoint in {directory}:{reasons}\n"
        "Restore one from a copy, or start a new run under another name."
    )


def damage(folder: Path, *, reread: bool = True) -> str | None:
    """What is wrong with the checkpoint in `folder`; None if every byte is as it was written.

    Without `reread`, rows of a replay buffer that this process wrote or read before are taken to
    be as they were if their file was not touched since.
    """
    try:
        names = set(os.listdir(folder))
        if not names:
            return "the folder is empty"
        if COMMIT not in names:
            return f"it has no {COMMIT}: writing it was never finished"
        if missing := {STATE, COUNTERS} - names:
            return f"{' and '.join(sorted(missing))} is missing"
        committed = (folder / COMMIT).read_bytes()
        found = {name: _fingerprint(folder / name) for name in (STATE, COUNTERS)}
        for name in filter(segments.NAME.fullmatch, names):
            found[name] = _part_fingerprint(folder / name, reread=reread)
    except OSError as error:
        return f"it cannot be read: {error}"
    if committed == _commit_text(int(folder.name), found):
        return None
    return _difference(committed, found)


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
    partial = path.with_name(f".{path.name}.partial")
    with _explained(f"cannot write {path}", path.parent, needed):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            _write(partial, _chunks(header, leaves))
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
        _sync(path.parent)


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
    return f"{leaf.dtype}{list(leaf.shape)}"


def _leaves(tree: PyTree) -> tuple[dict[str, Any], dict[str, str]]:
    """Array leaves by name, typed keys as their data; and the generator of each typed key."""
    leaves, keys = {}, {}
    for path, leaf in tree_flatten_with_path(tree)[0]:
        if not _is_array(leaf):
            continue
        name = keystr(path)
        if name in leaves:
            raise CheckpointError(f"two leaves are named {name}: give them different names")
        if _is_key(leaf):
            keys[name], leaf = str(jax.random.key_impl(leaf)), jax.random.key_data(leaf)
        if leaf.dtype not in DTYPES or jax.dtypes.canonicalize_dtype(leaf.dtype) != leaf.dtype:
            raise CheckpointError(
                f"leaf {name} is {_describe(leaf)}: stored are {', '.join(map(str, DTYPES))}, "
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
) -> PyTree:
    """`like` with the arrays of the file in the places of its own; `arrays` is emptied."""
    keys = json.loads(metadata[KEYS])
    paths, structure = tree_flatten_with_path(like)
    expected = {keystr(at): _describe(leaf) for at, leaf in paths if _is_array(leaf)}
    found = {}
    for name, data in arrays.items():
        wrap = functools.partial(jax.random.wrap_key_data, impl=keys.get(name))
        found[name] = _describe(jax.eval_shape(wrap, data) if name in keys else data)
    _check_same(path, expected, found)

    def leaf(name: str) -> Array:
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
    return np.ascontiguousarray(leaf).reshape(-1).view(np.uint8).data


def _size(leaves: Mapping[str, Any]) -> int:
    return sum(leaf.nbytes for leaf in leaves.values())


def _header(leaves: Mapping[str, Any], metadata: Mapping[str, str]) -> bytes:
    entries: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for name, leaf in leaves.items():
        start, end = end, end + leaf.nbytes
        code = DTYPES[leaf.dtype]
        entries[name] = {"dtype": code, "shape": leaf.shape, "data_offsets": [start, end]}
    text = json.dumps(entries).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def _chunks(header: bytes, leaves: Mapping[str, Any]) -> Iterator[bytes | memoryview]:
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


def _counters_text(counters: dict[str, Any]) -> bytes:
    text = json.dumps(counters, indent=2)
    # Python's text of a float is exact, and its comparison by text also holds for NaN.
    if repr(json.loads(text)) != repr(counters):
        raise ValueError(
            f"counters {counters!r} would come back as {json.loads(text)!r}: use Python numbers, "
            "strings, lists, and dicts whose names are strings"
        )
    return text.encode()


def _read(path: Path) -> tuple[dict[str, str], dict[str, Any]]:
    """The metadata and the arrays of a file."""
    try:
        with (
            _explained(f"cannot read {path}", path.parent),
            safe_open(path, framework="numpy") as file,
        ):
            metadata = file.metadata() or {}
            return metadata, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error


def _read_rows(stored: segments.Stored) -> np.ndarray:
    try:
        return stored.read()
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(f"the replay buffer's {stored.name} is damaged: {error}") from error


def _read_export(path: Path) -> tuple[dict[str, str], dict[str, Any]]:
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
            shutil.rmtree(path)


def _remove(folder: Path) -> None:
    # Under another name first: killed half-way, it must not look like a damaged checkpoint.
    removed = _beside(folder, "removed")
    os.rename(folder, removed)
    shutil.rmtree(removed)


def _remove_beyond(keep: int, newest: Path) -> None:
    """Keep the `keep` newest intact checkpoints up to `newest`; later ones are not touched."""
    older = [path for path in _checkpoints(newest.parent) if int(path.name) < int(newest.name)]
    intact = 1
    for folder in older if len(older) >= keep else []:
        if intact == keep:
            _remove(folder)
        elif damage(folder, reread=False) is None:
            intact += 1


def _write_folder(
    folder: Path,
    state: Iterable[bytes | memoryview],
    counters: bytes,
    parts: Mapping[str, Mapping[str, segments.Rows]],
    there: Mapping[str, Path],
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
            found[name] = _part_fingerprint(partial / name, reread=False)
        _write(partial / COMMIT, [_commit_text(int(folder.name), found)])
        _sync(partial)
        if folder.exists():
            _remove(folder)
        os.rename(partial, folder)
        _sync(folder.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


# Files of a replay buffer's rows. They are never changed, so one look at each is enough.

_seen: dict[tuple[int, ...], dict[str, Any]] = {}  # fingerprints, by what tells files apart


def _identity(path: Path) -> tuple[int, ...]:
    status = os.stat(path)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _part_fingerprint(path: Path, *, reread: bool) -> dict[str, Any]:
    identity = _identity(path)
    if reread or identity not in _seen:
        _seen[identity] = _fingerprint(path)
    return _seen[identity]


def _write_part(path: Path, rows: Mapping[str, segments.Rows]) -> None:
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


def _intact_parts(directory: Path, names: Iterable[str]) -> dict[str, Path]:
    """Where in the checkpoints in `directory` files of these names are, as they were written."""
    wanted, there = set(names), {}
    for folder in _checkpoints(directory) if wanted else []:
        try:
            files = json.loads((folder / COMMIT).read_bytes())["files"]
            for name in wanted.intersection(files).difference(there):
                if _part_fingerprint(folder / name, reread=False) == files[name]:
                    there[name] = folder / name
        except (OSError, ValueError, KeyError, TypeError):
            continue  # damaged: what only it has is written again
    return there


def _write(path: Path, chunks: Iterable[bytes | memoryview]) -> dict[str, Any]:
    """Write `chunks` to the disk; returns the file's fingerprint."""
    digest, size = hashlib.sha256(), 0
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    try:
        for chunk in chunks:
            digest.update(chunk)
            size += len(chunk)
            rest = memoryview(chunk)
            while rest:
                rest = rest[os.write(descriptor, rest) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    return {"bytes": size, "sha256": digest.hexdigest()}


def _sync(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _fingerprint(path: Path) -> dict[str, Any]:
    with open(path, "rb") as file:
        return {"sha256": hashlib.file_digest(file, "sha256").hexdigest(), "bytes": file.tell()}


def _commit_text(generation: int, files: dict[str, dict[str, Any]]) -> bytes:
    commit = {"generation": generation, "files": files}
    return json.dumps(commit, indent=2, sort_keys=True).encode()


def _difference(committed: bytes, found: dict[str, dict[str, Any]]) -> str:
    """Which file is not as COMMIT says."""
    try:
        files = json.loads(committed)["files"]
        if missing := set(files).difference(found):
            return f"{' and '.join(sorted(missing))} is missing"
        for name, now in found.items():
            then = files[name]
            if now["bytes"] != then["bytes"]:
                return f"{name} has {now['bytes']} bytes, {COMMIT} says {then['bytes']}"
            if now["sha256"] != then["sha256"]:
                return f"the SHA-256 of {name} is not the one in {COMMIT}"
    except (ValueError, KeyError, TypeError):
        pass
    return f"{COMMIT} is not as it was written"


@contextlib.contextmanager
def _explained(task: str, directory: Path, needed: int = 0) -> Iterator[None]:
    """Turn what the operating system says into a `CheckpointError`."""
    try:
        yield
    except OSError as error:
        message = f"{task}: {error}"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            there = directory.absolute()
            there = next(path for path in (there, *there.parents) if path.exists())
            message += (
                f"; it needs {needed:,} bytes, and {shutil.disk_usage(there).free:,} are free in "
                f"{there}. Free some space, then resume; older checkpoints are intact."
            )
        raise CheckpointError(message) from error
