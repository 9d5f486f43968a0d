"""What a person sees while many runs are trained."""

import time
from collections.abc import Iterable

from ..runs.progress import Line, clock
from .jobs import Job

TOLD = 60.0  # seconds between two lines on the runs under way, where there is no terminal


class Board:
    """One bar for all runs, or a line now and then where there is no terminal: how many of `total`
    are `done`, well or not, how far the others are, and how long they take."""

    def __init__(self, title: str, total: int):
        self.total, self.done = total, 0
        self.line = Line(title, total, 0, TOLD)
        self.began = self.line.last = time.monotonic()

    def start(self) -> None:
        """Show the bar."""
        self.line.start(self.told())

    def stop(self) -> None:
        """The bar stays as it is."""
        self.line.stop()

    def over(self, job: Job) -> None:
        """A job ended."""
        self.done += 1
        self.line.show(f"{self.told()} {job.path}", self.done)

    def show(self, under_way: Iterable[Job]) -> None:
        """Say now and then how far these are."""
        if time.monotonic() - self.line.last > (1.0 if self.line.console.is_terminal else TOLD):
            states = ", ".join(job.state() for job in under_way)
            self.line.show(f"{self.told()} {states}", self.done)

    def told(self) -> str:
        """How many are done, and how long the others take."""
        if self.done == 0:
            return f"0/{self.total}"
        left = (time.monotonic() - self.began) / self.done * (self.total - self.done)
        return f"{self.done}/{self.total} left {clock(left)}"
