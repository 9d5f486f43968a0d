"""The trials of a sweep in a journal of Optuna's: `journal.log` of its folder, which Optuna and its
dashboard read.

A line of it is there whole or not at all. A trial is one line when it begins, with all that it
drew, and a few when it ends, of which the last one counts. So whatever kills a sweep leaves trials
that have ended, and trials with their parameters that have not: nothing is drawn twice.
"""

import contextlib
import dataclasses
import inspect
import math
import os
import pathlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..analysis.statistics import interquartile_mean
from ..runs import files
from ..runs.record import RunError
from . import space
from .plan import Plan
from .space import Drawn, Range

NAME, STUDY = "journal.log", "credo"
RUNNING, COMPLETE, PRUNED, FAILED = "running", "complete", "pruned", "failed"
STATES = {"COMPLETE": COMPLETE, "PRUNED": PRUNED, "FAIL": FAILED}  # of Optuna's that have ended
LEAST = 12  # trials whose best quarter says something


@dataclasses.dataclass(frozen=True)
class Trial:
    """One drawing of the ranges, and what became of it.

    - `drawn`: values by the names of ranges; those that did not count are not among them.
    - `scores`: of its seeds, in order, as far as it came.
    - `state`: running, complete, pruned or failed; `why`: the reason of the last two.
    """

    number: int
    drawn: Drawn
    scores: tuple[float, ...] = ()
    state: str = RUNNING
    why: str = ""

    @property
    def values(self) -> dict[int, float]:
        """The interquartile mean of its first scores, by how many these are."""
        counts = range(1, len(self.scores) + 1)
        return {n: float(interquartile_mean(self.scores[:n])) for n in counts}

    @property
    def value(self) -> float:
        """That of all its seeds so far; NaN before the first has ended."""
        return self.values.get(len(self.scores), math.nan)


class Journal:
    """The journal in a folder.

    - `owned`: this process owns the folder: what a killed one left is removed, and a journal is
      begun if there is none. Otherwise it is read, and no more.

    Raises `RunError` without Optuna, without a journal, or if it cannot be read.
    """

    def __init__(
        self, folder: pathlib.Path, plan: Plan, ranges: Sequence[Range], *, owned: bool = False
    ):
        self.plan, self.ranges, self.path = plan, ranges, folder / NAME
        optuna = imported()
        if owned:
            _mend(self.path)
        elif not self.path.exists():
            raise RunError(f"{folder} has no {NAME}: no trial of it has begun")
        try:
            with _quiet():
                backend = optuna.storages.journal.JournalFileBackend(str(self.path))
                self.storage = optuna.storages.JournalStorage(backend)
                self.study = self._study()
        except (ValueError, KeyError) as error:
            raise RunError(
                f"{self.path} cannot be read ({error}): restore it from a copy, or choose another "
                "folder"
            ) from error

    def _study(self) -> Any:
        """The study, of which there is one."""
        optuna = imported()
        known = {"storage": self.storage, "study_name": STUDY}
        known["sampler"] = optuna.samplers.RandomSampler()  # never asked: `_draw` draws
        if any(study.study_name == STUDY for study in self.storage.get_all_studies()):
            return optuna.load_study(**known)
        return optuna.create_study(**known, direction=self.plan.direction)

    @property
    def trials(self) -> list[Trial]:
        """All that were begun, by number."""
        return [_read(trial) for trial in self.study.get_trials(deepcopy=False)]

    def begin(self, number: int) -> Trial:
        """The trial of this number, which is drawn and written unless it was begun before."""
        trials = self.trials
        if number < len(trials):
            return trials[number]
        with _quiet():
            drawn, distributions = self._draw(number)
            self.study.add_trial(_told(drawn, distributions, "RUNNING"))
        return Trial(number, drawn)

    def _draw(self, number: int) -> tuple[Drawn, dict[str, Any]]:
        """What a trial draws, and from what, in a study in memory that knows what this trial may
        know: those of earlier rounds with their results, and those of its own with their parameters
        alone. So it follows from the plan, the ranges and these, and from nothing else that
        happened meanwhile."""
        direction, first = self.plan.direction, self.plan.round_of(number).start
        study = imported().create_study(direction=direction, sampler=self._sampler(number))
        for trial in self.study.get_trials()[:number]:
            if trial.number >= first:
                trial = _told(trial.params, trial.distributions, "RUNNING")
            elif trial.state.name == "FAIL":
                # Optuna leaves it out, and would draw the like again; so it ranks below all.
                trial = _told(trial.params, trial.distributions, "PRUNED")
            study.add_trial(trial)
        asked = study.ask()
        return space.draw(self.ranges, asked), asked.distributions

    def _sampler(self, number: int) -> Any:
        """That of one trial, with a seed of its own."""
        seed = int(np.random.SeedSequence([self.plan.seed, number]).generate_state(1)[0])
        samplers = imported().samplers
        if self.plan.sampler == "random":
            return samplers.RandomSampler(seed=seed)
        how: dict[str, Any] = {"multivariate": True, "constant_liar": True}
        return samplers.TPESampler(seed=seed, n_startup_trials=self.plan.startup, **how)

    def end(self, trial: Trial) -> None:
        """Write what became of a trial. It has ended with the last line: until then it is running,
        and the same lines may be written again."""
        study = self.storage.get_study_id_from_name(STUDY)
        at = self.storage.get_trial_id_from_study_id_trial_number(study, trial.number)
        self.storage.set_trial_user_attr(at, "scores", list(trial.scores))
        self.storage.set_trial_user_attr(at, "why", trial.why)
        for count, value in trial.values.items():
            self.storage.set_trial_intermediate_value(at, count, value)
        name = next(name for name, state in STATES.items() if state == trial.state)
        value = trial.value if trial.state == COMPLETE else None
        self.study.tell(trial.number, value, imported().trial.TrialState[name])

    def importance(self) -> Mapping[str, float]:
        """Shares of the ranges in what tells the best quarter of trials from all of them, by
        PED-ANOVA (Watanabe et al. 2023). Pruned trials count with the value that they had. None of
        fewer than `LEAST` trials, or if all have one value."""
        optuna = imported()
        ended = [trial for trial in self.trials if trial.state in (COMPLETE, PRUNED)]
        if len(ended) < LEAST or len({trial.value for trial in ended}) < 2:
            return {}
        kept = self.study.get_trials(deepcopy=False)
        with _quiet():
            study = optuna.create_study(direction=self.plan.direction)
            for trial in ended:
                drawn = trial.drawn, kept[trial.number].distributions
                study.add_trial(_told(*drawn, "COMPLETE", trial.value))
            evaluator = optuna.importance.PedAnovaImportanceEvaluator
            # Optuna 4 and 5 call it by different names.
            names = inspect.signature(evaluator).parameters
            name = next(x for x in ("target_quantile", "baseline_quantile") if x in names)
            return optuna.importance.get_param_importances(
                study, evaluator=evaluator(**{name: 0.25})
            )


def best(trials: Sequence[Trial], plan: Plan) -> Trial | None:
    """The complete trial with the best value, of equal ones the first; None if there is none."""
    found = None
    for trial in trials:
        if trial.state == COMPLETE and (found is None or plan.better(trial.value, found.value)):
            found = trial
    return found


def imported() -> Any:
    """Optuna. Raises `RunError` if it is not installed, or too old."""
    try:
        import optuna
        import optuna.storages.journal
    except ImportError as error:
        raise RunError(
            f"a sweep needs Optuna 4 or newer ({error}): pip install 'credo[sweep]'"
        ) from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _read(trial: Any) -> Trial:
    """A trial of Optuna. What is written of one that has not ended may not be all of it."""
    if trial.state.name not in STATES:
        return Trial(trial.number, dict(trial.params))
    scores, why = trial.user_attrs.get("scores", ()), trial.user_attrs.get("why", "")
    return Trial(trial.number, dict(trial.params), tuple(scores), STATES[trial.state.name], why)


def _told(
    drawn: Drawn, distributions: Mapping[str, Any], state: str, value: float | None = None
) -> Any:
    """A trial of Optuna in a state, which has the name that it has there."""
    optuna = imported()
    given = {"params": drawn, "distributions": dict(distributions), "value": value}
    return optuna.create_trial(state=optuna.trial.TrialState[state], **given)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without Optuna's warnings that some of what is used here is experimental."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", imported().exceptions.ExperimentalWarning)
        yield


def _mend(path: pathlib.Path) -> None:
    """Remove what a killed process leaves: half a line, and Optuna's lock. The caller owns the
    folder, so no other process writes."""
    for left in path.parent.glob(f"{path.name}.lock*"):
        files.remove(left)
    if path.exists():
        content = path.read_bytes()
        if not content.endswith(b"\n"):
            os.truncate(path, content.rfind(b"\n") + 1)
