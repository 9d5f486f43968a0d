"""What a person sees while a run goes on."""

import pathlib
import sys
import time
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from ..replay import Replay
from .budget import Budget, short


class Line:
    """How far something is: a bar on a terminal; where there is none (a log file) a line now and
    then."""

    def __init__(self, title: str, total: float, done: float, every: float):
        """`every`: seconds between two lines."""
        self.title, self.every, self.last = title, every, -every
        self.console = Console(file=sys.stderr)
        self.bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(bar_width=10),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            console=self.console,
            refresh_per_second=1,
        )
        self.task = self.bar.add_task(title, total=total, text="", start=False)
        self.bar.update(self.task, completed=done)

    def start(self, text: str) -> None:
        """Show the bar. Its clock runs, whatever it waits for: programs that compile, episodes of
        the first generation."""
        if self.console.is_terminal:
            self.bar.start_task(self.task)
            self.bar.update(self.task, text=text)
            self.bar.start()

    def stop(self) -> None:
        """The bar stays as it is."""
        if self.bar.live.is_started:
            self.bar.stop()

    def due(self) -> bool:
        """Whether it is time to say how far it is: a bar is drawn at any time."""
        return self.console.is_terminal or time.monotonic() - self.last > self.every

    def show(self, text: str, done: float) -> None:
        """`done` of the total is done; `text` says more."""
        self.last = time.monotonic()
        if self.console.is_terminal:
            self.bar.update(self.task, completed=done, text=text, refresh=True)
        else:
            print(f"{self.title}: {text}", file=sys.stderr, flush=True)


class Progress:
    """How far a run is, at which pace, and how long it still takes."""

    def __init__(
        self, path: pathlib.Path, generation: int, frames: int, budget: Budget, shown: bool = True
    ):
        """From `generation` and `frames` on, which are done already."""
        self.shown, self.path, self.budget = shown, path, budget
        self.generation, self.frames = generation, frames
        self.generation_rate, self.frame_rate, self.updates = 0.0, 0.0, 0  # per second
        self.line = Line(path.name, 1.0, budget.share(generation, frames), every=10.0)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.line.stop()

    def say(self, text: str) -> None:
        """A line that stays."""
        if self.shown:
            told = f"[dim]{self.path} {text}[/]"
            self.line.console.print(told, highlight=False, soft_wrap=True)

    def start(self, buffers: list[Replay]) -> None:
        """Training begins; replay buffers are told with their sizes."""
        for buffer in buffers:
            size = sum(leaf.nbytes for leaf in jax.tree.leaves(buffer.data))
            self.say(f"has a replay buffer of {buffer.capacity:,} frames, {size / 1e6:,.1f} MB")
        # True of a JAX task, whose first generation waits for it, and of any other, whose
        # episodes begin at once.
        self.say("is starting; programs compile when they are first needed, once per machine")
        if self.shown:
            self.line.start("compiling, then the first generation")

    def update(self, generation: int, row: dict[str, Any], seconds: float) -> None:
        """The generations up to this one, since the last call, took `seconds`; `row` holds the
        metrics of the last. Rates are averaged over some five calls, and the first does not count:
        programs compile in it."""
        frames, seconds = row["frames"], max(seconds, 1e-9)
        rates = (generation - self.generation) / seconds, (frames - self.frames) / seconds
        self.generation, self.frames = generation, frames
        first, self.updates = self.updates == 0, self.updates + 1
        old = 0.0 if self.updates <= 2 else 0.8
        self.generation_rate = old * self.generation_rate + (1 - old) * rates[0]
        self.frame_rate = old * self.frame_rate + (1 - old) * rates[1]
        share = self.budget.share(generation, frames)
        if not self.shown or not (self.line.due() or share >= 1):
            return
        best, value = best_of(row)
        text = (
            f"{self.budget.done(generation, frames)}  left {'…' if first else self.left()}  "
            f"champion {row['champion_score']:.4g}  {best} {value:.4g}  "
            f"{short(self.frame_rate)} frames/s"
        )
        self.line.show(text, share)

    def left(self) -> str:
        """Until the first limit of the budget, at the present pace."""
        limits = (
            (self.budget.generations, self.generation, self.generation_rate),
            (self.budget.frames, self.frames, self.frame_rate),
        )
        left = [max(n - done, 0) / max(pace, 1e-9) for n, done, pace in limits if n is not None]
        return clock(min(left))


def best_of(row: dict[str, Any]) -> tuple[str, float]:
    """What an algorithm improves, in words and its value: fitness, or where there is none a loss.
    `row`: the metrics of a generation."""
    return ("best fitness", row["fitness_max"]) if "fitness_max" in row else ("loss", row["loss"])


def clock(seconds: float) -> str:
    """3723 as `1:02:03`."""
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
