"""A replay buffer on disk: files of rows, shared by all checkpoints that hold these rows.

Rows are numbered in the order in which they were written to the buffer, and cut at multiples of a
fixed number, 16 MB of them. What the buffer holds of each part is a file in a checkpoint's folder:

    replay0-000000131072-000000262144-1c291ca3.safetensors

named by the buffer, the range of rows and their CRC-32. A buffer is only ever appended to, so all
parts but the oldest and the newest are the same at the next checkpoint. They then have the same
name, and the new checkpoint gets a hard link to a file that is there, but never to one of the
checkpoint just before: it links to the one before that. So each part is written twice, whatever
happens to one file leaves one of two neighbours whole, every checkpoint is complete in itself, and
a part goes with the last checkpoint that has it. Where only one checkpoint is kept there is no
neighbour, and each part is written once.

The CRC-32 is that of the rows in memory, read at every checkpoint (4 GB/s): a buffer that is
changed in any other way than by appending costs time, never rows.
"""

import json
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey, keystr, tree_flatten_with_path
from jaxtyping import PyTree
from safetensors import safe_open

from ..replay import Replay

BYTES = 16 * 2**20  # of a part, at most, unless one row is larger
NAME = re.compile(r"replay(\d+)-(\d{12,})-(\d{12,})-[0-9a-f]{8}\.safetensors")


class Rows(NamedTuple):
    """Rows `start` to `stop`, counted since the first ever written, of one leaf of a buffer."""

    leaf: Any  # [capacity, ...], JAX or NumPy
    start: int
    stop: int
    block: int  # rows that leave a device at a time: one shape, so one program

    @property
    def dtype(self) -> np.dtype:
        return self.leaf.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.stop - self.start, *self.leaf.shape[1:])

    @property
    def nbytes(self) -> int:
        return self.leaf.nbytes // self.leaf.shape[0] * (self.stop - self.start)

    def pieces(self) -> Iterator[memoryview]:
        """Their bytes in order; two pieces where the ring closes, none if there are none."""
        capacity = self.leaf.shape[0]
        at = self.start
        while at < self.stop and self.nbytes:
            slot = at % capacity
            n = min(self.stop - at, capacity - slot)
            rows = np.ascontiguousarray(self._on_host(slot, slot + n))
            yield rows.reshape(-1).view(np.uint8).data
            at += n

    def _on_host(self, first: int, last: int) -> np.ndarray:
        """Rows `first` to `last` of the ring as NumPy."""
        if isinstance(self.leaf, np.ndarray) or _is_on_cpu(self.leaf):
            return np.asarray(self.leaf)[first:last]  # a view: no copy
        at = min(first, self.leaf.shape[0] - self.block)
        block = jax.lax.dynamic_slice_in_dim(self.leaf, np.int32(at), self.block)
        return np.asarray(block)[first - at : last - at]


class Ring(NamedTuple):
    """The leaves of one replay buffer by their path in the tree, `[capacity, ...]` each, and the
    rows it holds: from number `oldest` up to `written`, the next one to be written."""

    leaves: dict[str, Any]
    oldest: int
    written: int

    @property
    def capacity(self) -> int:
        return next(iter(self.leaves.values())).shape[0]

    def cut(self, start: int, stop: int) -> Iterator[dict[str, Rows]]:
        """These rows in parts, each by leaf."""
        size = max(1, sum(leaf.nbytes for leaf in self.leaves.values()) // self.capacity)
        length = max(1, BYTES // size)
        block = min(length, self.capacity)
        while start < stop:
            end = min(stop, (start // length + 1) * length)
            yield {name: Rows(leaf, start, end, block) for name, leaf in self.leaves.items()}
            start = end

    def is_zero_elsewhere(self) -> bool:
        """Whether every bit of the rows never written is zero, as it is in a new buffer."""
        empty = self.cut(self.written, self.capacity)
        pieces = (piece for part in empty for rows in part.values() for piece in rows.pieces())
        return not any(np.frombuffer(piece, np.uint8).any() for piece in pieces)


class Stored(NamedTuple):
    """One leaf of a buffer on disk: its whole `shape`, and of each part the first row, the one
    behind the last, and the file. Nothing is read before `read`."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    parts: list[tuple[int, int, Path]]
    old: tuple[np.dtype, tuple[int, ...]] | None = (
        None  # type and shape of a row on disk, if others
    )

    def fitted(self, shape: tuple[int, ...], dtype: np.dtype) -> "Stored":
        """The same rows in a buffer of another capacity, if it was never full and they fit; and in
        today's form, if an older version wrote them: one end for a whole team, which is each
        agent's, and bytes as floats."""
        written, row = max((stop for _, stop, _ in self.parts), default=0), self.shape[1:]
        shared = self.dtype == np.bool_ and row == () and len(shape) == 2
        whole = self.dtype == np.float32 and dtype == np.uint8 and row == shape[1:]
        changed = (shared and dtype == self.dtype) or whole
        if not changed and row != shape[1:]:
            return self
        if self.shape[0] != shape[0] and written > min(self.shape[0], shape[0]):
            return self
        if not changed:
            return self._replace(shape=tuple(shape))
        return self._replace(shape=tuple(shape), dtype=dtype, old=(self.dtype, row))

    def read(self) -> np.ndarray:
        """The whole leaf; rows never written are zero. Raises what `safetensors` raises, and
        `ValueError` if a part is not what its name says."""
        whole, capacity = np.zeros(self.shape, self.dtype), self.shape[0]
        dtype, row = self.old or (self.dtype, self.shape[1:])
        for start, stop, path in self.parts:
            with safe_open(path, framework="numpy") as file:
                rows = file.get_tensor(self.name)
            if rows.dtype != dtype or rows.shape != (stop - start, *row) or len(rows) > capacity:
                raise ValueError(f"{self.name} in {path.name} is {rows.dtype}{list(rows.shape)}")
            if self.old is not None:
                rows = rows if len(self.shape) == 1 + len(row) else rows[:, None]
                rows = rows.astype(self.dtype)
            slot = start % capacity
            n = min(len(rows), capacity - slot)
            whole[slot : slot + n] = rows[:n]
            whole[: len(rows) - n] = rows[n:]
        return whole


def buffers(tree: PyTree) -> list[tuple[tuple[Any, ...], Replay]]:
    """All replay buffers in `tree`, each behind its path."""
    nodes = tree_flatten_with_path(tree, is_leaf=lambda node: isinstance(node, Replay))[0]
    return [(path, node) for path, node in nodes if isinstance(node, Replay)]


def names(tree: PyTree) -> set[str]:
    """The paths of all numbers of all replay buffers in `tree`."""
    return {
        keystr((*path, *at))
        for path, buffer in buffers(tree)
        for at, leaf in tree_flatten_with_path(buffer)[0]
        if not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    }


def rings(tree: PyTree) -> list[Ring]:
    """The replay buffers in `tree` that can be stored in parts; others are leaves like any.

    Those others are stacked ones (of several seeds, say), and those with bits set in rows that
    were never written.
    """
    found = (_ring(path, buffer) for path, buffer in buffers(tree))
    return [ring for ring in found if ring is not None]


def parts(rings: list[Ring]) -> dict[str, dict[str, Rows]]:
    """All that the buffers hold: the rows of every file by leaf, by file name."""
    return {
        _file_name(index, rows): rows
        for index, ring in enumerate(rings)
        for rows in ring.cut(ring.oldest, ring.written)
    }


def describe(rings: list[Ring]) -> str:
    """Every buffer's leaves as JSON, for `stored`."""
    return json.dumps(
        [
            {name: [str(leaf.dtype), leaf.shape] for name, leaf in ring.leaves.items()}
            for ring in rings
        ]
    )


def stored(folder: Path, names: Iterable[str], description: str) -> dict[str, Stored]:
    """The leaves of all buffers in the checkpoint `folder`, whose files have these `names`, by
    name."""
    files = [(match, folder / match[0]) for match in map(NAME.fullmatch, names) if match]
    found = {}
    for index, leaves in enumerate(json.loads(description)):
        held = [(int(m[2]), int(m[3]), path) for m, path in files if int(m[1]) == index]
        for name, (dtype, shape) in leaves.items():
            found[name] = Stored(name, jnp.dtype(dtype), tuple(shape), held)
    return found


def _ring(path: tuple[Any, ...], replay: Replay) -> Ring | None:
    """A buffer as one that can be cut: unstacked, without keys, and zero where nothing was
    written."""
    data = tree_flatten_with_path(replay.data)[0]
    leaves = {keystr((*path, GetAttrKey("data"), *at)): leaf for at, leaf in data}
    capacities = {leaf.shape[:1] for leaf in leaves.values()}
    keys = any(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves.values())
    if keys or len(capacities) != 1 or capacities & {(), (0,)} or replay.written.shape != ():
        return None
    written = int(replay.written)
    (capacity,) = capacities.pop()
    ring = Ring(leaves, max(0, written - capacity), written)
    return ring if written >= 0 and ring.is_zero_elsewhere() else None


def _file_name(index: int, rows: Mapping[str, Rows]) -> str:
    """That of a part: number of the buffer, range of rows, and the CRC-32 of leaves and rows."""
    crc = 0
    for name, part in rows.items():
        crc = zlib.crc32(f"{name} {part.dtype}{list(part.shape)}".encode(), crc)
        for piece in part.pieces():
            crc = zlib.crc32(piece, crc)
    part = next(iter(rows.values()))
    return f"replay{index}-{part.start:012d}-{part.stop:012d}-{crc:08x}.safetensors"


def _is_on_cpu(leaf: jax.Array) -> bool:
    return {device.platform for device in leaf.devices()} == {"cpu"}
