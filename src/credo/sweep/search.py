"""Rounds of trials: drawn, trained seed by seed, pruned, told.

A sweep is a folder:

    sweep.toml         what is searched and how
    journal.log        the trials, as Optuna records them
    trial-007/seed-3/  a run; those of trials that have ended may be removed
    slurm/             job arrays, if runs are trained by Slurm
    report.html        the page

What a trial draws, and whether it is pruned, follows from the plan and the trials before it. So a
sweep that was killed and called again ends as one that was left alone: a trial that had begun keeps
its parameters, and its runs go on where they were.
"""

import dataclasses
import pathlib
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .. import executors
from ..executors import Job, Place, RunsFailed
from ..runs import files, screen
from ..runs.lock import RunLocked, lock
from ..runs.options import RunOptions
from ..runs.record import RunError
from ..runs.store import Run
from .journal import COMPLETE, FAILED, PRUNED, RUNNING, Journal, Trial, best
from .plan import Plan
from .space import Drawn

PATIENCE = 0.2  # seconds between two looks at a run that another process still saves
AGAIN = ".again"  # behind the name of a run: a file that says why it is tried once more
FEW = 4  # trials in a row that fail are no accident


@dataclasses.dataclass(frozen=True)
class Setup:
    """What a trial trains. `seed`: of its first run."""

    algorithm: Any
    options: RunOptions
    seed: int
    warm_start: str | None = None


class Search:
    """The search of a sweep, in a folder that this process owns.

    - `make`: the setup of a trial from what it drew; it raises `ValueError` for values that do not
      go together.
    - `on`: where runs are trained. `workers`: runs at a time; None: as many as there is room for.
    - `again`: what goes on with the sweep, in words.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        journal: Journal,
        make: Callable[[Drawn], Setup],
        *,
        on: Place = Place(),  # noqa: B008
        workers: int | None = None,
        again: str = "the same command",
    ):
        self.folder, self.journal, self.plan = folder, journal, journal.plan
        self.make, self.on, self.workers, self.again = make, on, workers, again

    def run(self, after: Callable[[], Any] = lambda: None) -> None:
        """Do all trials that have not ended, and call `after` behind each round.

        **Raises:** `RunError` if a whole round fails and, with those before it, `FEW` trials at
        least: then the round is not told, and is tried again when the sweep goes on; `Interrupted`
        after a signal: runs are saved first; `Pending` where runs are trained later, by a cluster.
        """
        number = 0
        while number < self.plan.trials:
            numbers = self.plan.round_of(number)
            trials = [self.journal.begin(number) for number in numbers]
            if any(trial.state == RUNNING for trial in trials):
                ended = _Round(self, trials).ended()
                self._forget_tries(trials)
                self._require_some(ended)
                self._tell(trials, ended)
                after()
            number = numbers.stop

    def _forget_tries(self, trials: Sequence[Trial]) -> None:
        """Remove what says which runs were tried once more."""
        for mark in [x for trial in trials for x in self._home(trial).glob(f"*{AGAIN}")]:
            files.remove(mark)

    def _require_some(self, ended: Sequence[Trial]) -> None:
        """Raise if all of a round have failed, and enough before them."""
        before = self.journal.trials[: ended[0].number]
        failed = [trial.state == FAILED for trial in (*before, *ended)]
        most = min(max(FEW, len(ended)), self.plan.trials)
        if len(failed) >= most and all(failed[-most:]) and all(failed[len(before) :]):
            last = "\n".join(f"trial {trial.number}: {trial.why}" for trial in ended)
            raise RunError(
                f"{most} trials in a row failed, the last ones:\n{last}\nmend what is wrong, and "
                f"{self.again} tries these again; other ranges are a sweep of their own"
            )

    def _tell(self, before: Sequence[Trial], ended: Sequence[Trial]) -> None:
        """Write in order what became of the trials of a round that had not ended."""
        for old, new in zip(before, ended, strict=True):
            if old.state == RUNNING:
                self.journal.end(new)
                screen.say(told(new, best(self.journal.trials, self.plan)))

    def jobs(self, trial: Trial) -> list[Job]:
        """The runs of a trial, one for each seed. Raises what `make` raises."""
        setup, folder = self.make(trial.drawn), self._home(trial)
        seeds = range(setup.seed, setup.seed + self.plan.seeds)
        how = setup.options, setup.warm_start
        return [Job(folder / f"seed-{seed}", setup.algorithm, seed, *how) for seed in seeds]

    def _home(self, trial: Trial) -> pathlib.Path:
        """The folder of a trial."""
        return self.folder / f"trial-{trial.number:03}"

    def train(self, jobs: Sequence[Job], title: str) -> Mapping[pathlib.Path, str]:
        """Train unfinished jobs; why some of them failed, by their folders.

        What fails is tried once more, since its process may have been short of memory, say. That it
        was is said by a file beside the run: the second try may be another command's.
        """
        failed = dict(self._train(jobs, title, retry=False))
        marks = {job.path: job.path.with_name(job.path.name + AGAIN) for job in jobs}
        again = [job for job in jobs if job.path in failed and not marks[job.path].exists()]
        for job in again:
            files.write_text(marks[job.path], failed.pop(job.path))
        return failed | (self._train(again, title, retry=True) if again else {})

    def _train(self, jobs: Sequence[Job], title: str, *, retry: bool) -> dict[pathlib.Path, str]:
        """Where and how runs are trained is said here, and nowhere else in a sweep."""
        if self.on.kind == "local":  # elsewhere a run waits itself
            for job in jobs:
                _wait(job.path)
        how: dict[str, Any] = {"on": self.on, "title": title, "again": self.again}
        try:
            executors.run(jobs, self.workers, retry=retry, **how)
        except RunsFailed as error:
            return error.failures
        return {}


class _Round:
    """Trials that are trained side by side.

    - `trials`: as far as they came; `jobs`: of those that train on; both by number.
    - `values`: of all trials so far, by number and by the number of seeds that they are of.
    """

    def __init__(self, search: Search, trials: Sequence[Trial]):
        self.search, self.plan = search, search.plan
        self.trials = {trial.number: trial for trial in trials}
        self.values = {trial.number: trial.values for trial in search.journal.trials}
        self.jobs: dict[int, list[Job]] = {}
        for trial in trials:
            try:
                self.jobs |= {trial.number: search.jobs(trial)} if trial.state == RUNNING else {}
            except ValueError as error:
                self._end(trial.number, FAILED, str(error))

    def ended(self) -> list[Trial]:
        """All of them, once each has ended."""
        stages = [range(n, n + 1) for n in range(self.plan.seeds)]
        if not self.plan.prune or max(self.trials) < self.plan.startup:
            stages = [range(self.plan.seeds)]  # none can be pruned: more runs at the same time
        for stage in stages:
            self._train(stage)
        return list(self.trials.values())

    def _train(self, stage: range) -> None:
        """Train these seeds, counted from 0, of all that train on, and see in order what became of
        each."""
        jobs = {number: jobs[stage.start : stage.stop] for number, jobs in self.jobs.items()}
        if not jobs:
            return
        title = f"trials {min(jobs)} to {max(jobs)}" if len(jobs) > 1 else f"trial {min(jobs)}"
        title += f", of {self.plan.trials}"
        failed = self.search.train([job for some in jobs.values() for job in some], title)
        for number, some in jobs.items():
            for job in some:
                self._score(number, job, failed.get(job.path))
            self._judge(number)

    def _score(self, number: int, job: Job, failure: str | None) -> None:
        """One more seed of a trial, unless one before it has failed."""
        trial = self.trials[number]
        if trial.state != RUNNING:
            return
        if failure is not None:  # its first sentence: the others say what to do about that run
            self._end(number, FAILED, f"seed {job.seed}: {failure.partition('. ')[0]}")
        elif not np.isfinite(value := score(job.path, self.plan)):
            self._end(number, FAILED, f"seed {job.seed}: its score is {value}")
        else:
            trial = dataclasses.replace(trial, scores=(*trial.scores, value))
            self.trials[number], self.values[number] = trial, trial.values

    def _judge(self, number: int) -> None:
        """End a trial that has all of its seeds, or is pruned."""
        trial = self.trials[number]
        if trial.state != RUNNING:
            return
        count = len(trial.scores)
        before = [values for n, values in self.values.items() if n < number]
        if count == self.plan.seeds:
            self._end(number, COMPLETE)
        elif why := pruned(
            trial, [values[count] for values in before if count in values], self.plan
        ):
            self._end(number, PRUNED, why)

    def _end(self, number: int, state: str, why: str = "") -> None:
        self.jobs.pop(number, None)
        self.trials[number] = dataclasses.replace(self.trials[number], state=state, why=why)


def pruned(trial: Trial, earlier: Sequence[float], plan: Plan) -> str:
    """Why a trial is given up, "" if it is not: its value is worse than the median of `earlier`,
    values of trials before it with as many seeds. The first `startup` trials are spared."""
    if not (plan.prune and earlier and trial.number >= plan.startup):
        return ""
    middle, count = statistics.median(earlier), len(trial.scores)
    if not plan.better(middle, trial.value):
        return ""
    return (
        f"{trial.value:.4g} after {count} seed{'s' * (count > 1)} is worse than {middle:.4g}, the "
        f"median of {len(earlier)} trials before it"
    )


def score(path: pathlib.Path, plan: Plan) -> float:
    """The mean of the metric over the last share of a run's generations, one at least. Raises
    `RunError` if the run has no such metric."""
    metrics = Run(path).metrics
    if plan.metric not in metrics:
        raise RunError(
            f"{path / 'metrics.csv'} has no {plan.metric!r}: the metric of a sweep is one of "
            f"{', '.join(metrics)}"
        )
    values = metrics[plan.metric]
    return float(np.mean(values[-max(1, round(plan.last * len(values))) :]))


def told(trial: Trial, top: Trial | None) -> str:
    """A line about a trial that has ended, and the best one so far."""
    what = f"{trial.value:.4g}" if trial.state == COMPLETE else f"{trial.state}: {trial.why}"
    found = "" if top is None else f"; best {top.value:.4g} of trial {top.number}"
    return f"trial {trial.number}: {what}{found}"


def _wait(path: pathlib.Path) -> None:
    """Wait until no process holds a run: those of a sweep that was killed save before they end."""
    said, held = False, (path / "lock").exists()
    while held:
        try:
            with lock(path):
                held = False
        except RunLocked as error:
            if not said:
                screen.say(f"credo: waiting, since {error}")
            said = True
            time.sleep(PATIENCE)
