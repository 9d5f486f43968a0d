"""What a person sees while a run goes on."""

import pathlib
import sys
import time

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar


class Progress:
    """A bar on a terminal; a line every ten seconds where there is none (a log file)."""

    def __init__(self, path: pathlib.Path, generation: int, budget: int, shown: bool = True):
        self.shown, self.path, self.budget = shown, path, budget
        self.generation, self.rate, self.updates = generation, 0.0, 0
        self.console = Console(file=sys.stderr)
        self.bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(bar_width=10),
            TextColumn("{task.fields[text]}"),
            console=self.console,
            auto_refresh=False,
        )
        self.task = self.bar.add_task(path.name, total=budget, completed=generation, text="")
        self.live: Live | None = None
        self.last_line = 0.0

    def __enter__(self):
        if self.shown:
            self.console.print(f"[dim]{self.path}: compiling, about ten seconds the first time[/]")
            if self.console.is_terminal:
                self.bar.start()
        return self

    def update(self, generation: int, row: dict, seconds: float, count: int) -> None:
        """`count` generations took `seconds`; `row` holds the metrics of the last."""
        if not self.shown:
            return
        rate = count / max(seconds, 1e-9)
        # The first dispatch compiles: its rate says nothing about the time left.
        first, self.updates = self.updates == 0, self.updates + 1
        self.rate = rate if self.updates <= 2 else 0.8 * self.rate + 0.2 * rate
        frames = row["frames"] / max(generation, 1) * self.rate
        left = "…" if first else _clock((self.budget - generation) / self.rate)
        text = (
            f"generation {generation}/{self.budget}  left {left}  champion "
            f"{row['champion_score']:.3f}  best fitness {row['fitness_max']:.4g}  "
            f"{_short(frames)} frames/s"
        )
        if self.console.is_terminal:
            self.bar.update(self.task, completed=generation, text=text, refresh=True)
        elif time.monotonic() - self.last_line > 10 or generation == self.budget:
            self.last_line = time.monotonic()
            print(f"{self.path.name}: {text}", file=sys.stderr, flush=True)

    def __exit__(self, *_):
        if self.shown and self.console.is_terminal:
            self.bar.stop()


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def _short(number: float) -> str:
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if number >= size:
            return f"{number / size:.3g}{unit}"
    return f"{number:.3g}"
