"""Metrics on disk: `metrics.csv` (only what a rerun repeats bit for bit), `timing.csv` (the clock)
and TensorBoard events.

Only the first is worth an error. Each checkpoint seals the rows up to its own (`seal`, `verify`):
a file that was cut, reordered or damaged is refused by name before a number in it is used. An error
of the other two is a warning, once, and training goes on without them.
"""

import contextlib
import csv
import hashlib
import io
import os
import pathlib
import stat
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from . import files

METRICS, TIMING = "metrics.csv", "timing.csv"
CLOCK = ["generation", "seconds", "generations_per_second"]
MOST = 2**30  # bytes of a table

Row = dict[str, float | int]


class DamagedLog(ValueError):
    """A table is not as it was written; the message names the file and says what to do."""


class Log:
    """Appends rows. A run that is resumed is cut back to its checkpoint, so that generations are
    strictly increasing and equal to those of an undisturbed run.

    `elapsed`: seconds of training before, as far as `timing.csv` tells. `size`, `digest`: bytes and
    running SHA-256 of `metrics.csv`, as it was written. `clock`: whether `timing.csv` is written.
    """

    def __init__(self, directory: pathlib.Path, generation: int):
        """`generation`: how many are done; rows of later ones are removed.

        Raises `DamagedLog` if `metrics.csv` lacks the row of `generation`, and `OSError` if it
        cannot be written.
        """
        self.metrics, self.timing = directory / METRICS, directory / TIMING
        self.clock, self.elapsed = True, 0.0
        with _explained():
            kept = _cut(self.metrics, generation)
        self.size, self.digest = len(kept), hashlib.sha256(kept)
        self._spare(self._wind, generation)

    def append(self, rows: Sequence[Row], seconds: float, elapsed: float):
        """`rows`: one per generation, in order; `seconds` they took together; `elapsed` so far.

        Raises `ValueError` if their names are not those of the rows before, and `OSError`, with
        what to do, if `metrics.csv` cannot be written: it then has none of the rows.
        """
        with _explained():
            data = _append(self.metrics, rows)
        self.size += len(data)
        self.digest.update(data)
        pace = len(rows) / max(seconds, 1e-9)
        row = dict(zip(CLOCK, [rows[-1]["generation"], elapsed, pace], strict=True))
        self._spare(_append, self.timing, [row])

    def sync(self):
        """Put the rows on the disk: a checkpoint must never be ahead of them. Raises `OSError`, and
        `DamagedLog` if the file was shortened or lengthened from outside."""
        if self.size:
            with _explained():
                files.sync(self.metrics)
                files.sync(self.metrics.parent)
            if os.stat(self.metrics).st_size != self.size:
                raise DamagedLog(f"{self.metrics} was changed while the run went on: {HELP}")
        if self.timing.exists():
            self._spare(files.sync, self.timing)

    def seal(self) -> dict[str, Any]:
        """Length and SHA-256 of all rows, as they were written, for `verify`; as JSON."""
        return {"bytes": self.size, "sha256": self.digest.hexdigest()}

    def _wind(self, generation: int):
        """Go on with the clock's file, or begin a new one if it is not as we write it."""
        try:
            _cut(self.timing, generation, every=False)
            seconds = read(self.timing).get("seconds", np.zeros(1))
            if _header(self.timing) not in (None, CLOCK) or not np.isfinite(seconds).all():
                raise DamagedLog(f"{self.timing} is not the clock of a run")
            self.elapsed = float(seconds[-1])
        except ValueError as error:
            why = str(error).removesuffix(f"; {HELP}")
            _warn(f"{why}; {TIMING} is begun anew: past times are lost, no result is")
            files.remove(self.timing)

    def _spare(self, action: Callable[..., Any], *arguments: Any):
        """Do something to the clock's file, as long as that works: training can do without."""
        try:
            if self.clock:
                action(*arguments)
        except OSError as error:
            _warn(f"{TIMING} is no longer written: {error}; training goes on")
            self.clock = False


def verify(directory: pathlib.Path, seal: dict[str, Any]) -> None:
    """Raises `DamagedLog` if the rows that `seal` was made of are not in `metrics.csv` in
    `directory`, bit for bit; what comes after them may be anything."""
    path, size = directory / METRICS, seal["bytes"]
    digest, left = hashlib.sha256(), size
    try:
        with files.reading(path) as file:
            while left and (data := file.read(min(left, 2**20))):
                digest.update(data)
                left -= len(data)
    except OSError as error:
        if size == 0 and isinstance(error, FileNotFoundError):
            return
        raise DamagedLog(f"{path} cannot be read ({error}): {HELP}") from error
    if left:
        raise DamagedLog(
            f"{path} was cut: it has {size - left:,} of the {size:,} bytes that a checkpoint "
            f"stands on; {HELP}"
        )
    if digest.hexdigest() != seal["sha256"]:
        raise DamagedLog(
            f"{path} was changed: the SHA-256 of its first {size:,} bytes is not the one that a "
            f"checkpoint says; {HELP}"
        )


HELP = "restore it from a copy"


# Tables.


def read(path: pathlib.Path) -> dict[str, np.ndarray]:
    """The columns of a metrics file; empty if there is none. A half-written line is left out.

    Raises `DamagedLog`, which names file and line, if it is no table of numbers.
    """
    lines = _lines(path)
    if not lines:
        return {}
    header, rows = _cells(path, lines[0]), []
    for number, line in enumerate(lines[1:], 2):
        try:
            rows.append([float(cell) for cell in line.split(b",")])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != len(header):
            raise DamagedLog(
                f"{path} is damaged: its line {number} is {line[:80]!r} where {len(header)} "
                f"numbers are expected; {HELP}"
            )
    columns = np.array(rows, float).reshape(len(rows), len(header)).T
    return {name: column.copy() for name, column in zip(header, columns, strict=True)}


def last(path: pathlib.Path) -> dict[str, str]:
    """The newest whole row of a metrics file, by column, however long the file; or nothing."""
    header = _header(path)
    if header is None:
        return {}
    with files.reading(path) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 2**16))
        whole = file.read().split(b"\n")[1:-1]  # the first may lack its beginning
    if not whole:
        return {}
    cells = _cells(path, whole[-1])
    if len(cells) != len(header):
        raise DamagedLog(
            f"{path} is damaged: its last line has {len(cells)} columns, its header {len(header)}; "
            f"{HELP}"
        )
    return dict(zip(header, cells, strict=True))


def _lines(path: pathlib.Path) -> list[bytes]:
    """The whole lines of a file, none if there is no file."""
    try:
        return files.read_bytes(path, MOST).split(b"\n")[:-1]
    except FileNotFoundError:
        return []


def _cells(path: pathlib.Path, line: bytes) -> list[str]:
    """A line as its cells. Raises `DamagedLog` if it is no text."""
    try:
        return next(csv.reader([line.decode()]), [])
    except (UnicodeDecodeError, csv.Error) as error:
        raise DamagedLog(f"{path} is damaged: {error} in {line[:80]!r}; {HELP}") from error


def _generation(line: bytes) -> int | None:
    """That of a row; None if it is no row."""
    start = line.partition(b",")[0]
    return int(start) if start.isdigit() and len(start) < 20 else None


def _header(path: pathlib.Path) -> list[str] | None:
    """The names of a table's columns; None if it has no whole first line."""
    try:
        with files.reading(path) as file:
            line = file.readline(2**20)
    except FileNotFoundError:
        return None
    return _cells(path, line[:-1]) if line.endswith(b"\n") else None


def _text(value: float | int) -> str:
    # Nine digits are enough for a float32 to come back as itself.
    return str(int(value)) if isinstance(value, int | np.integer) else f"{float(value):.9g}"


def _append(path: pathlib.Path, rows: Sequence[Row]) -> bytes:
    """Write rows behind a table, or as a new one; what was written."""
    header, text = _header(path), io.StringIO()
    names = header or list(rows[0])
    for row in rows:
        if list(row) != names:
            raise ValueError(
                f"a generation has the metrics {', '.join(row)}, but those before it, in {path}, "
                f"have {', '.join(names)}: they must be the same in every generation"
            )
    table = csv.writer(text, lineterminator="\n")
    table.writerows([] if header else [names])
    table.writerows(map(_text, row.values()) for row in rows)
    data = text.getvalue().encode()
    files.append(path, data)
    return data


def _cut(path: pathlib.Path, generation: int, *, every: bool = True) -> bytes:
    """Keep the header and the rows up to `generation`, at which they end if `every` one has a row;
    what a killed process left behind them goes. Returns what is kept."""
    lines, kept, at = _lines(path), [], 0
    for line in lines[1:]:
        found = _generation(line)
        if at == generation or found is None or found > generation:
            break
        kept.append(line)
        at = found
    if every and at != generation:
        raise DamagedLog(f"{path} has no row of generation {generation}, which is done: {HELP}")
    text = b"".join(line + b"\n" for line in (lines[:1] + kept if kept else []))
    if not text:
        files.remove(path)
        return text
    status = os.lstat(path)
    # A link, or another name of the same file, would be another user's.
    ours = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
    if not ours or status.st_size != len(text):
        files.write_whole(path, [text])
    return text


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    """Say what to do about an error of the disk."""
    try:
        yield
    except OSError as error:
        help = f"{error.strerror}: {files.advice(error)}, then resume; checkpoints are intact"
        raise OSError(error.errno, help, error.filename) from error


def _warn(message: str):
    warnings.warn(message, stacklevel=4)
