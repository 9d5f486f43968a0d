"""The search itself, with a formula in place of training: what is drawn, pruned, told and kept."""

import collections
import contextlib
import dataclasses
import json
import math
import os
import statistics
import subprocess
import sys

import pytest

from credo.executors import Job
from credo.executors.jobs import Pending
from credo.runs.options import RunOptions
from credo.runs.record import RunError
from credo.sweep import search
from credo.sweep.journal import COMPLETE, FAILED, PRUNED, RUNNING, Journal, Trial, best
from credo.sweep.plan import Plan
from credo.sweep.space import Range

optuna = pytest.importorskip("optuna", reason="Optuna is of the extra sweep")

RANGES = [
    Range("rate", low=1e-4, high=1.0, log=True),
    Range("size", low=1, high=9, step=2, whole=True),
    Range("kind", ("a", "b")),
    Range("extra", low=0.0, high=1.0, step=0.1, when=(("kind", ("b",)),)),
]
PLAN = Plan(trials=13, seeds=3, startup=4, together=3, seed=7)


def formula(drawn, seed) -> float:
    """What a run of this seed scores; NaN is a run that fails."""
    if drawn["rate"] > 0.5:
        return math.nan
    noise = math.sin(1e4 * drawn["rate"] + 7 * seed)
    return -abs(math.log10(drawn["rate"]) + 2) + 0.1 * drawn["size"] + 0.3 * noise


class Formula(search.Search):
    """Runs that take no time; `order` says which of them end first, `trained` which there were."""

    def __init__(self, folder, plan=PLAN, formula=formula, order=1):
        journal = Journal(folder, plan, RANGES, owned=True)
        super().__init__(folder, journal, lambda drawn: search.Setup(drawn, RunOptions(), 5))
        self.formula, self.order, self.trained = formula, order, []

    def _train(self, jobs, title, *, retry):
        failed = {}
        for job in list(jobs)[:: self.order]:
            self.trained.append(job.path)
            value = self.formula(job.algorithm, job.seed)
            if math.isnan(value):
                failed[job.path] = "RunError: no numbers. The checkpoint of generation 3 stands"
            else:
                job.path.mkdir(parents=True, exist_ok=True)
                (job.path / "score").write_text(repr(value))
        return failed


@pytest.fixture(autouse=True)
def scores(monkeypatch):
    """The score of a run that took no time."""
    monkeypatch.setattr(search, "score", lambda path, plan: float((path / "score").read_text()))


def searched(folder, **changes) -> list[Trial]:
    folder.mkdir(exist_ok=True)
    sweep = Formula(folder, **changes)
    sweep.run()
    return sweep.journal.trials


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The trials of a search that was left alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "score", lambda path, plan: float((path / "score").read_text()))
        return searched(tmp_path_factory.mktemp("plain"))


def test_every_trial_ends_as_the_rules_say(plain):
    """Each is done again by hand: scores, interquartile mean, median, and what failed."""
    assert [trial.number for trial in plain] == list(range(PLAN.trials))
    assert {trial.state for trial in plain} == {COMPLETE, PRUNED, FAILED}
    for trial in plain:
        expected, state = [], COMPLETE
        for count in (1, 2, 3):
            value = formula(trial.drawn, 4 + count)
            if math.isnan(value):
                state = FAILED
                break
            expected.append(value)
            middle = statistics.fmean(expected)  # of three and fewer nothing is cut off
            earlier = [t.values[count] for t in plain[: trial.number] if count in t.values]
            if count < 3 and trial.number >= 4 and middle < statistics.median(earlier):
                state = PRUNED
                break
        assert (trial.state, list(trial.scores)) == (state, expected)
        assert ("extra" in trial.drawn) == (trial.drawn["kind"] == "b")
        if state == FAILED:
            assert trial.why == "seed 5: RunError: no numbers"


def test_the_sampler_learns(plain):
    """What comes after the random trials is nearer to the best rate than these are."""
    apart = [abs(math.log10(trial.drawn["rate"]) + 2) for trial in plain]
    assert statistics.fmean(apart[-5:]) < statistics.fmean(apart[:4])


def test_trials_do_not_depend_on_which_run_ends_first(plain, tmp_path):
    assert searched(tmp_path, order=-1) == plain


def test_trials_do_not_depend_on_the_process(plain, tmp_path):
    """Words have another hash in every process."""
    script = (
        "import sys, json, pathlib, dataclasses; from credo.sweep.journal import Journal\n"
        "from tests_of_search import PLAN, RANGES\n"
        "print(json.dumps([t.drawn for t in map(Journal(pathlib.Path(sys.argv[1]), PLAN, RANGES, "
        "owned=True).begin, range(6))]))"
    )
    (tmp_path / "tests_of_search.py").write_text(
        f"from credo.sweep.plan import Plan\nfrom credo.sweep.space import Range\n"
        f"PLAN, RANGES = {PLAN!r}, {RANGES!r}\n"
    )
    for number in "12":
        folder = tmp_path / number
        folder.mkdir()
        done = subprocess.run(
            [sys.executable, "-c", script, str(folder)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=os.environ | {"PYTHONHASHSEED": number},
        )
        assert done.returncode == 0, done.stderr
        drawn = json.loads(done.stdout)
        assert drawn[:3] == [trial.drawn for trial in plain[:3]]


class Killed(BaseException):
    """In place of kill -9."""


@pytest.mark.parametrize("torn", ["before", "half", "after"])
def test_killed_at_any_line_it_ends_as_if_it_was_left_alone(plain, tmp_path, monkeypatch, torn):
    """Each line of the journal is once the last one that is written: before it, with half of it,
    and after it."""
    from optuna.storages.journal import JournalFileBackend

    append, countdown = JournalFileBackend.append_logs, [0]

    def dying(self, logs):
        countdown[0] -= 1
        if countdown[0] != 0:
            return append(self, logs)
        if torn == "half":
            line = json.dumps(logs[0]).encode()
            with open(self._file_path, "ab") as file:
                file.write(line[: len(line) // 2])
        elif torn == "after":
            append(self, logs)
        raise Killed

    monkeypatch.setattr(JournalFileBackend, "append_logs", dying)
    (tmp_path / "journal.log.lock").symlink_to("journal.log")  # of one that held it
    trials, kills = None, 0
    while trials is None:
        countdown[0] = 1 + kills % 9  # a trial ends with six lines
        with contextlib.suppress(Killed):
            trials = searched(tmp_path)
        kills += 1
        assert kills < 200
    assert kills > 20
    assert trials == plain
    assert not any(trial.state == RUNNING for trial in trials)


def test_a_trial_that_has_begun_is_not_drawn_again(tmp_path):
    """Even by a sampler with another mind, as a newer Optuna's may have."""
    tmp_path.mkdir(exist_ok=True)
    begun = [Journal(tmp_path, PLAN, RANGES, owned=True).begin(n) for n in range(2)]
    other = dataclasses.replace(PLAN, seed=8)
    assert Journal(tmp_path, other, RANGES, owned=True).trials == begun
    trials = searched(tmp_path, plan=other)
    assert [trial.drawn for trial in trials[:2]] == [trial.drawn for trial in begun]


def test_what_has_ended_is_not_trained_again(plain, tmp_path):
    searched(tmp_path)
    again = Formula(tmp_path)
    again.run()
    assert again.trained == []
    assert again.journal.trials == plain


def test_more_trials_are_those_of_a_longer_sweep(plain, tmp_path):
    """Eleven of them end in the middle of a round."""
    short = searched(tmp_path, plan=dataclasses.replace(PLAN, trials=11))
    assert short == plain[:11]
    assert searched(tmp_path) == plain


def test_seeds_are_trained_one_after_the_other_where_trials_can_be_pruned(tmp_path):
    sweep, calls = Formula(tmp_path, dataclasses.replace(PLAN, trials=6)), []
    train = sweep._train

    def noted(jobs, title, **how):
        calls.append((title, len(jobs)))
        return train(jobs, title, **how)

    sweep._train = noted
    sweep.run()
    assert calls[0] == ("trials 0 to 2, of 6", 9)  # none of these can be
    assert ("trials 3 to 5, of 6", 3) in calls


def test_without_pruning_every_trial_has_all_seeds(tmp_path):
    trials = searched(tmp_path, plan=dataclasses.replace(PLAN, prune=False))
    assert {trial.state for trial in trials} == {COMPLETE, FAILED}


def test_where_less_is_better(tmp_path):
    plan = dataclasses.replace(PLAN, direction="minimize")
    trials = searched(tmp_path, plan=plan, formula=lambda drawn, seed: -formula(drawn, seed))
    apart = [abs(math.log10(trial.drawn["rate"]) + 2) for trial in trials]
    assert statistics.fmean(apart[-5:]) < statistics.fmean(apart[:4])
    top = best(trials, plan)
    assert top.value == min(trial.value for trial in trials if trial.state == COMPLETE)


def trial(number, *scores, state=COMPLETE):
    return Trial(number, {}, scores, state)


def test_the_median_prunes():
    """Hand-computed: 1, 2, 6 and 7 have the median 4."""
    plan = Plan(startup=3)
    assert search.pruned(trial(3, 3.9), [1, 6, 2, 7], plan) == (
        "3.9 after 1 seed is worse than 4, the median of 4 trials before it"
    )
    assert search.pruned(trial(3, 4.0), [1, 6, 2, 7], plan) == ""
    assert search.pruned(trial(3, 4.1), [1, 6, 2, 7], plan) == ""
    assert search.pruned(trial(2, 3.9), [1, 6, 2, 7], plan) == ""  # of the first three
    assert search.pruned(trial(3, 3.9), [], plan) == ""
    # The interquartile mean of two seeds is their mean.
    assert "3.5 after 2 seeds" in search.pruned(trial(3, 3.0, 4.0), [1, 6, 2, 7], plan)
    least = dataclasses.replace(plan, direction="minimize")
    assert search.pruned(trial(3, 3.9), [1, 6, 2, 7], least) == ""
    assert "4.1 after 1 seed is worse than 4" in search.pruned(trial(3, 4.1), [1, 6, 2, 7], least)
    assert search.pruned(trial(3, 3.9), [9], dataclasses.replace(plan, prune=False)) == ""


def test_values_are_interquartile_means():
    assert trial(0, 1.0, 9.0, 2.0, 4.0).values == {1: 1.0, 2: 5.0, 3: 4.0, 4: 3.0}
    assert math.isnan(trial(0).value)


def test_the_best_is_complete_and_of_equal_ones_the_first():
    trials = [trial(0, 1.0), trial(1, 3.0), trial(2, 3.0), trial(3, 9.0, state=PRUNED)]
    assert best(trials, Plan()).number == 1
    assert best(trials, Plan(direction="minimize")).number == 0
    assert best(trials[3:], Plan()) is None


def test_what_fails_is_tried_once_more(tmp_path, plain):
    """A run whose process was killed for want of memory, say, is no worse for it."""
    tries = collections.Counter()

    class Flaky(Formula):
        def _train(self, jobs, title, *, retry):
            tries.update(job.path for job in jobs)
            failed = {job.path: "its process ended" for job in jobs if tries[job.path] == 1}
            return failed or super()._train(jobs, title, retry=retry)

    sweep = Flaky(tmp_path)
    sweep.run()
    assert sweep.journal.trials == plain
    assert set(tries.values()) == {2}
    assert list(tmp_path.rglob("*.again")) == []


def test_a_second_try_that_was_killed_is_no_first_one(tmp_path, plain):
    tries, kill = collections.Counter(), [True]

    class Dying(Formula):
        def _train(self, jobs, title, *, retry):
            tries.update(job.path for job in jobs)
            if retry and kill[0]:
                kill[0] = False
                raise Killed
            return super()._train(jobs, title, retry=retry)

    with pytest.raises(Killed):
        Dying(tmp_path).run()
    marks = list(tmp_path.rglob("*.again"))
    assert {mark.read_text()[:20] for mark in marks} == {"RunError: no numbers"}
    sweep = Dying(tmp_path)
    sweep.run()
    assert sweep.journal.trials == plain
    assert max(tries.values()) == 3  # the first, the one that was killed, and the next command's
    assert list(tmp_path.rglob("*.again")) == []


def test_on_a_cluster_each_command_does_what_can_be_done(tmp_path, plain):
    """As with Slurm: what is submitted ends after the command, and a failure stays until it is
    submitted again."""
    queued, failed = {}, {}

    class Cluster(Formula):
        def _train(self, jobs, title, *, retry):
            new = [job for job in jobs if not (job.path / "score").exists()]
            told = {job.path: failed[job.path] for job in new if job.path in failed}
            if retry:
                told = {}
            queued.update({job.path: job for job in new if job.path not in told})
            if queued:
                raise Pending("submitted")
            return told

    commands = 0
    while True:
        sweep = Cluster(tmp_path)
        try:
            sweep.run()
            break
        except Pending:
            commands += 1
            assert commands < 50
        failed |= Formula._train(sweep, list(queued.values()), "", retry=False)
        queued.clear()
    assert sweep.journal.trials == plain
    assert commands > 10
    assert list(tmp_path.rglob("*.again")) == []


def test_a_score_that_is_no_number_is_a_failure(tmp_path):
    def scored(drawn, seed):
        return -math.inf if drawn["kind"] == "a" and seed == 6 else 1.0 * seed

    for one in searched(tmp_path, formula=scored):
        failed = FAILED, (5.0,), "seed 6: its score is -inf"
        expected = failed if one.drawn["kind"] == "a" else (COMPLETE, (5.0, 6.0, 7.0), "")
        assert (one.state, one.scores, one.why) == expected


def test_a_round_that_fails_stops_the_sweep_and_is_tried_again(tmp_path, plain):
    plan = dataclasses.replace(PLAN, together=5, trials=10)
    with pytest.raises(RunError) as error:
        searched(tmp_path, plan=plan, formula=lambda drawn, seed: math.nan)
    lines = str(error.value).splitlines()
    assert lines[0] == "5 trials in a row failed, the last ones:"
    assert lines[1] == "trial 0: seed 5: RunError: no numbers"
    assert "mend what is wrong, and the same command tries these again" in lines[-1]
    (alone := tmp_path / "alone").mkdir()
    mended = searched(tmp_path, plan=plan)
    assert mended == searched(alone, plan=plan)
    assert COMPLETE in {trial.state for trial in mended}


def test_a_few_failures_do_not_stop_a_sweep(tmp_path):
    """One trial a round: it takes four in a row."""
    plan = dataclasses.replace(PLAN, together=1, trials=8)
    count = []

    def failing(drawn, seed):
        count.append(drawn)
        return math.nan if len({str(x) for x in count}) <= 3 else 1.0

    trials = searched(tmp_path, plan=plan, formula=failing)
    assert [trial.state for trial in trials[:5]] == [FAILED] * 3 + [COMPLETE] * 2
    (other := tmp_path / "other").mkdir()
    with pytest.raises(RunError, match="4 trials in a row failed"):
        searched(other, plan=plan, formula=lambda drawn, seed: math.nan)
    assert [trial.state for trial in Journal(other, plan, RANGES).trials] == [FAILED] * 3 + [
        RUNNING
    ]


def test_what_cannot_be_put_together_is_a_failure(tmp_path):
    class Strict(Formula):
        def jobs(self, trial):
            if trial.drawn["kind"] == "b":
                raise ValueError("b does not go with that")
            return super().jobs(trial)

    sweep = Strict(tmp_path)
    sweep.run()
    for one in sweep.journal.trials:
        assert (one.why == "b does not go with that") == (one.drawn["kind"] == "b")


def test_other_errors_are_nobodys_failure(tmp_path, monkeypatch):
    """A folder with another run, say: it says nothing of the trial."""

    class Occupied(Formula):
        def _train(self, jobs, title, *, retry):
            raise RunError("trial-000/seed-5 holds a run with other settings")

    with pytest.raises(RunError, match="holds a run with other settings"):
        Occupied(tmp_path).run()
    assert {trial.state for trial in Journal(tmp_path, PLAN, RANGES).trials} == {RUNNING}


def test_runs_have_folders_by_trial_and_seed(tmp_path):
    sweep = Formula(tmp_path)
    jobs = sweep.jobs(Trial(7, {"rate": 0.1}))
    assert [str(job.path.relative_to(tmp_path)) for job in jobs] == [
        "trial-007/seed-5",
        "trial-007/seed-6",
        "trial-007/seed-7",
    ]
    assert all(isinstance(job, Job) and job.algorithm == {"rate": 0.1} for job in jobs)


def test_a_journal_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "journal.log").write_text("no json\nat all\n")
    with pytest.raises(RunError, match=r"journal.log cannot be read .*restore it from a copy"):
        Journal(tmp_path, PLAN, RANGES, owned=True)
    with pytest.raises(RunError, match="no trial of it has begun"):
        Journal(tmp_path / "nowhere", PLAN, RANGES)


def test_without_optuna_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(RunError, match=r"pip install 'credo\[sweep\]'"):
        Journal(tmp_path, PLAN, RANGES, owned=True)


def test_optuna_reads_the_journal(plain, tmp_path):
    """As its dashboard does: states, values and what was said after each seed."""
    searched(tmp_path)
    backend = optuna.storages.journal.JournalFileBackend(str(tmp_path / "journal.log"))
    study = optuna.load_study(study_name="credo", storage=optuna.storages.JournalStorage(backend))
    states = {"COMPLETE": COMPLETE, "PRUNED": PRUNED, "FAIL": FAILED}
    assert [states[trial.state.name] for trial in study.trials] == [trial.state for trial in plain]
    assert [trial.intermediate_values for trial in study.trials] == [t.values for t in plain]
    assert study.best_trial.number == best(plain, PLAN).number


def test_importance_finds_what_matters(tmp_path):
    plan = dataclasses.replace(PLAN, trials=40, sampler="random", prune=False)

    def rate_alone(drawn, seed):
        return -abs(math.log10(drawn["rate"]) + 2)

    tmp_path.mkdir(exist_ok=True)
    sweep = Formula(tmp_path, plan, rate_alone)
    sweep.run()
    shares = sweep.journal.importance()
    assert max(shares, key=shares.get) == "rate"
    assert sum(shares.values()) == pytest.approx(1.0)
    few = Journal(tmp_path, plan, RANGES)
    assert few.importance() == shares  # read again
