"""What all places have in common: which jobs are left, and how it is told what became of them."""

import importlib
from collections.abc import Sequence
from typing import Any

from .. import require
from ..runs import screen
from ..runs.loop import Interrupted
from ..runs.record import RunError
from .jobs import Job, Pending, RunsFailed
from .places import Place


@screen.calm()
def run(
    jobs: Sequence[Job],
    workers: int | None = None,
    *,
    on: str | Place = "local",
    title: str = "runs",
    again: str = "the same command",
    retry: bool = True,
) -> None:
    """Train every unfinished job.

    Says which runs a limit of the clock left unfinished, and how to go on with them.

    **Arguments:** `workers`: runs at a time, at least 1; None: as many as the place has room for,
    here one per core that this process may use. `on`: where (see `Place`). `title`: what stands
    before the line or bar that shows how far they are. `again`: what goes on with these jobs, in
    words; those that had not begun are among them. `retry`: whether a run is submitted again that
    failed when Slurm last tried it; if not, it has failed. Other places try every run.

    **Raises:** `ValueError` for a place that there is not; `RunError` if a folder holds another
    run, before anything is started; `RunsFailed` with all failures once every job was tried;
    `Interrupted` after a signal: what is trained is saved first; `Pending` where runs are trained
    later, by a cluster.
    """
    place = on if isinstance(on, Place) else Place(on)
    require.at_least("workers", workers, 1)
    waiting = [job for job in jobs if not job.finished()]
    for job in jobs:
        if job.again and job not in waiting:
            screen.say(f"{job.path} is finished: to go on give a larger --generations or --frames")
    if not waiting:
        return
    given = {"retry": retry} if place.kind == "slurm" else {}  # others remember no failures
    ending = _trainer(place)(waiting, workers, place, title, **given)
    if ending.signal:
        raise Interrupted(f"stopped and saved; {again} goes on where it was", 128 + ending.signal)
    if ending.lost:
        raise RunError(f"{ending.lost}; {again} goes on where they are")
    if ending.pending:
        raise Pending(
            f"{ending.pending}. Once these have ended, {again} submits what stopped, or goes on "
            "when every run is finished"
        )
    if ending.failures:
        raise RunsFailed(ending.failures, len(waiting))
    if left := [job for job in waiting if not job.finished()]:
        names = ", ".join(job.state() for job in left)
        screen.say(
            f"credo: {len(left)} of {len(jobs)} runs are not finished for want of time ({names}): "
            f"go on with {again}"
        )


def _trainer(place: Place) -> Any:
    """`train(jobs, workers, place, title)` of a place, which returns an `Ending`."""
    return importlib.import_module(f".{place.kind}", __package__).train
