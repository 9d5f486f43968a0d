"""Metrics on disk: `metrics.csv` (only what a rerun repeats bit for bit), `timing.csv` (the clock)
and TensorBoard events."""

import csv
import os
import pathlib
from collections.abc import Sequence

import numpy as np


class Log:
    """Appends rows. A run that is resumed is cut back to its checkpoint, so that generations are
    strictly increasing and equal to those of an undisturbed run."""

    def __init__(self, directory: pathlib.Path, generation: int, *, tensorboard: bool = True):
        """`generation`: how many are done; rows of later ones are removed."""
        self.directory = directory
        for name in ("metrics.csv", "timing.csv"):
            _cut(directory / name, generation)
        self.events = None
        if tensorboard:
            from tensorboardX import SummaryWriter  # half a second that a closed log need not pay

            self.events = SummaryWriter(
                str(directory / "tensorboard"), purge_step=generation + 1, flush_secs=10
            )

    def append(self, rows: Sequence[dict[str, float | int]], seconds: float, elapsed: float):
        """`rows`: one per generation, in order; `seconds` they took together; `elapsed` so far.

        Raises `ValueError` if their names are not those of the rows before.
        """
        _append(self.directory / "metrics.csv", rows)
        last = {"generation": rows[-1]["generation"], "seconds": elapsed}
        last["generations_per_second"] = len(rows) / max(seconds, 1e-9)
        _append(self.directory / "timing.csv", [last])
        if self.events is not None:
            for row in rows:
                for name, value in row.items():
                    # tensorboardX would print a line about every NaN.
                    if name != "generation" and np.isfinite(value):
                        self.events.add_scalar(name, value, int(row["generation"]))

    def sync(self):
        """Put the rows on the disk: a checkpoint must never be ahead of them."""
        for name in ("metrics.csv", "timing.csv"):
            if (self.directory / name).exists():
                with (self.directory / name).open("rb") as file:
                    os.fsync(file.fileno())

    def close(self):
        if self.events is not None:
            self.events.close()


def read(path: pathlib.Path) -> dict[str, np.ndarray]:
    """The columns of a metrics file; empty if there is none. A half-written line is left out."""
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        rows = list(csv.reader(line for line in file if line.endswith("\n")))
    if not rows:
        return {}
    columns = zip(*rows[1:], strict=True) if rows[1:] else ([] for _ in rows[0])
    return {
        name: np.array([float(x) for x in column])
        for name, column in zip(rows[0], columns, strict=True)
    }


def last(path: pathlib.Path) -> dict[str, str]:
    """The newest whole row of a metrics file, by column, however long the file; or nothing."""
    header = _header(path)
    if header is None:
        return {}
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(0, file.tell() - 2**16))
        whole = file.read().decode().split("\n")[1:-1]  # the first may lack its beginning
    return dict(zip(header, whole[-1].split(","), strict=True)) if whole else {}


def _header(path: pathlib.Path) -> list[str] | None:
    if not path.exists():
        return None
    with path.open() as file:
        line = file.readline()
    return line[:-1].split(",") if line.endswith("\n") else None


def _text(value: float | int) -> str:
    # Nine digits are enough for a float32 to come back as itself.
    return str(int(value)) if isinstance(value, int | np.integer) else f"{float(value):.9g}"


def _append(path: pathlib.Path, rows: Sequence[dict[str, float | int]]):
    names = list(rows[0])
    header = _header(path) or names
    if header != names:
        raise ValueError(
            f"a generation has the metrics {', '.join(names)}, but {path} has "
            f"{', '.join(header)}: they must be the same in every generation"
        )
    try:
        with path.open("a", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            if file.tell() == 0:
                writer.writerow(names)
            writer.writerows([_text(value) for value in row.values()] for row in rows)
    except OSError as error:
        help = f"{error.strerror}: free some space, then resume; checkpoints are intact"
        raise OSError(error.errno, help, str(path)) from error


def _cut(path: pathlib.Path, generation: int):
    """Keep the header and the rows up to `generation`; a half-written line goes too."""
    if not path.exists():
        return
    lines = path.read_text().splitlines(keepends=True)
    kept = [
        line
        for line in lines[1:]
        if line.endswith("\n")
        and line.count(",") == lines[0].count(",")
        and int(line.split(",")[0]) <= generation
    ]
    draft = path.with_name(f".{path.name}.draft")
    draft.write_text("".join([lines[0], *kept]) if kept else "")
    if kept:
        os.replace(draft, path)
    else:
        draft.unlink()
        path.unlink()
