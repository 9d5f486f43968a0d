"""What a person sees while a run goes on."""

import pathlib
import sys
import time
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

from ..replay import Replay
from .budget import Budget, short


class Progress:
    """A bar on a terminal; a line every ten seconds where there is none (a log file)."""

    def __init__(
        self, path: pathlib.Path, generation: int, frames: int, budget: Budget, shown: bool = True
    ):
        """From `generation` and `frames` on, which are done already."""
        self.shown, self.path, self.budget = shown, path, budget
        self.generation, self.frames = generation, frames
        self.generation_rate, self.frame_rate, self.updates = 0.0, 0.0, 0  # per second
        self.console = Console(file=sys.stderr)
        self.bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(bar_width=10),
            TextColumn("{task.fields[text]}"),
            console=self.console,
            auto_refresh=False,
        )
        share = budget.share(generation, frames)
        self.task = self.bar.add_task(path.name, total=1.0, text="")
        self.bar.update(self.task, completed=share)
        self.last_line = 0.0

    def __enter__(self):
        return self

    def say(self, text: str) -> None:
        """A line that stays."""
        if self.shown:
            self.console.print(f"[dim]{self.path} {text}[/]", highlight=False, soft_wrap=True)

    def say_memory(self, buffers: list[Replay]) -> None:
        """How large replay buffers are."""
        for buffer in buffers:
            size = sum(leaf.nbytes for leaf in jax.tree.leaves(buffer.data))
            self.say(f"has a replay buffer of {buffer.capacity:,} frames, {size / 1e6:,.1f} MB")

    def start(self) -> None:
        # True of a JAX task, whose first generation waits for it, and of any other, whose
        # episodes begin at once.
        self.say("is starting; programs compile when they are first needed, once per machine")
        if self.shown and self.console.is_terminal:
            self.bar.start()

    def update(self, generation: int, row: dict, seconds: float) -> None:
        """The generations up to this one took `seconds`; `row` holds the metrics of the last."""
        frames, seconds = row["frames"], max(seconds, 1e-9)
        rates = (generation - self.generation) / seconds, (frames - self.frames) / seconds
        self.generation, self.frames = generation, frames
        # The first dispatch compiles: its rate says nothing about the time left.
        first, self.updates = self.updates == 0, self.updates + 1
        old = 0.0 if self.updates <= 2 else 0.8
        self.generation_rate = old * self.generation_rate + (1 - old) * rates[0]
        self.frame_rate = old * self.frame_rate + (1 - old) * rates[1]
        if not self.shown:
            return
        best, value = best_of(row)
        text = (
            f"{self.budget.done(generation, frames)}  left {'…' if first else self.left()}  "
            f"champion {row['champion_score']:.4g}  {best} {value:.4g}  "
            f"{short(self.frame_rate)} frames/s"
        )
        share = self.budget.share(generation, frames)
        if self.console.is_terminal:
            self.bar.update(self.task, completed=share, text=text, refresh=True)
        elif time.monotonic() - self.last_line > 10 or share >= 1:
            self.last_line = time.monotonic()
            print(f"{self.path.name}: {text}", file=sys.stderr, flush=True)

    def left(self) -> str:
        """Until the first limit of the budget, at the present pace."""
        limits = (
            (self.budget.generations, self.generation, self.generation_rate),
            (self.budget.frames, self.frames, self.frame_rate),
        )
        return clock(
            min(
                max(limit - done, 0) / max(rate, 1e-9)
                for limit, done, rate in limits
                if limit is not None
            )
        )

    def __exit__(self, *_):
        if self.bar.live.is_started:
            self.bar.stop()


def best_of(row: dict[str, Any]) -> tuple[str, float]:
    """What an algorithm improves, in words and its value: fitness, or where there is none a loss.
    `row`: the metrics of a generation."""
    return ("best fitness", row["fitness_max"]) if "fitness_max" in row else ("loss", row["loss"])


def clock(seconds: float) -> str:
    """3723 as `1:02:03`."""
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
