"""`credo sweep`: what a file may say, and that a search that is killed ends as one left alone."""

import hashlib
import os
import pathlib
import signal
import subprocess
import sys
import time
import tomllib
import warnings

import pytest

from credo import cli
from credo.cli import sweep_file
from credo.cli.sweep_file import File
from credo.environments.sequence_recall import SequenceRecall
from credo.executors import local
from credo.runs.lock import lock
from credo.runs.store import Run
from credo.sweep.journal import Journal, best
from credo.sweep.plan import Plan
from credo.sweep.space import Range

optuna = pytest.importorskip("optuna", reason="Optuna is of the extra sweep")

FIXED = """
algorithm = "neuroevolution"
task = "sequence-recall"
generations = 150
depth = 2
min-corridor = 1
max-corridor = 2
population-size = 6
elite-fraction = 0.34
episodes = 2
test-episodes = 4
tensorboard = false
checkpoint-every = 0.02
network.hidden = 2
"""
TINY = f"""{FIXED}
[ranges]
mutation-strength = {{ low = 1e-3, high = 1.0, log = true }}

[sweep]
trials = 4
seeds = 2
"""


@pytest.fixture(autouse=True)
def as_it_was(monkeypatch, tmp_path):
    """A command may change the process that it thinks its own."""
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def credo(capsys):
    """Run a command: its exit code, what it printed, and what it complained about."""

    def run(words: str) -> tuple[int, str, str]:
        try:
            cli.main(words.split())
            code = 0
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return run


def written(text: str, name: str = "tiny.toml") -> str:
    pathlib.Path(name).write_text(text, "utf-8")
    return name


def ranged(text: str) -> str:
    """A file with these ranges, and little else."""
    bare = 'algorithm = "neuroevolution"\ntask = "sequence-recall"\ngenerations = 150\n'
    return f"{bare}\n[ranges]\n{text}\n"


CEM = 'breeder = ["genetic", "cem"]\n'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (FIXED, "has no [ranges]: a sweep needs one at least"),
        ("[ranges]\ngamma = [0.9]", 'names no algorithm: write algorithm = "td3"'),
        ('algorithm = "td3"\n[ranges]\ngamma = [0.9]', 'names no task: write task = "Hopper-v5"'),
        ('algorithm = "td4"\ntask = "x"\n[ranges]\ngamma = [0.9]', "no algorithm 'td4'"),
        ("x = ", "tiny.toml: Invalid value"),
        (f"{FIXED}ranges = 3", "write [ranges] and [sweep]"),
        (f"{TINY}trails = 3", "[sweep] has no 'trails'"),
        (f"{TINY}trails = 3", "did you mean 'trials'?"),
        (f"{TINY}jobs = 3", "[sweep] has no 'jobs'"),
        (f"{TINY}last = 0", "last is 0"),
        (f'{TINY}sampler = "cma"', "no sampler 'cma'"),
        (ranged("mutaton-strength = [0.1]"), "no flag '--mutaton-strength'"),
        (ranged("mutaton-strength = [0.1]"), "did you mean '--mutation-strength'?"),
        (ranged("mutaton-strength = [0.1]"), "in tiny.toml, where mutaton-strength = 0.1"),
        (ranged("learner.gamma = [0.1]"), "no flag '--learner.gamma'"),
        (ranged("breeder.elite-fraction = { low = 0.2, high = 1.5 }"), "elite_fraction is 1.5"),
        (f"depth = 2\n{ranged('depth = [3, 4]')}", "sets depth, and has a range of it: leave one"),
        (ranged('selection = ["tournament", "best"]'), "no selection 'best'"),
        (ranged("selection = { low = 1, high = 2 }"), "no selection '1'"),
        (ranged("population-size = { low = 6.5, high = 8 }"), "it must be a whole number"),
        (
            ranged("population-size = [6, 'many']"),
            "--population-size is 'many': it must be a whole number",
        ),
        (ranged("network.hidden = { low = 0, high = 3 }"), "hidden is 0: it must be at least 1"),
        (ranged("normalize-observations = { low = 0, high = 1 }"), "takes no numbers: give a list"),
        (ranged('normalize-observations = ["yes", "no"]'), "is true or false, not yes or no"),
        (ranged("frames = { low = 0, high = 10 }"), "--frames is 0: it must lie in [1, "),
        (ranged("depth = { low = 3, hihg = 4 }"), "depth has no 'hihg' (did you mean 'high'?)"),
        (ranged("seed = [1, 2]"), "a range of seed: the first seed is the same for every trial"),
        (ranged('task = ["a", "b"]'), "a range of task: a task is the same for every trial"),
        (ranged("seeds = [1, 2]"), "a range of seeds: how many a trial has is said in [sweep]"),
        (ranged('config = ["a.toml"]'), "sets --config, which is for the command line alone"),
        (f'path = "there"{TINY}', "sets path: where runs lie is for the sweep to say"),
        (f'wall-clock = "2h"{TINY}', "sets wall-clock: what a run reaches in a time"),
        (f'on = "slurm"{TINY}', "sets on: where runs are trained is for the command line alone"),
        (f"seeds = 3{TINY}", "sets seeds: how many a trial has is said in [sweep]"),
        (f"gamma = 0.9{TINY}", "no flag '--gamma'"),
        (ranged(f"{CEM}parents = {{ low = 0.4, high = 0.6 }}"), "no flag '--parents'"),
        (
            ranged(f'{CEM}parents = {{ low = 0.4, high = 0.6, when = {{ breder = "cem" }} }}'),
            "when names breder, which is no list of values above it (did you mean 'breeder'?)",
        ),
        (
            ranged(f'{CEM}parents = {{ low = 0.01, high = 0.6, when = {{ breeder = "cem" }} }}'),
            "parents is 0.01 of 100 members",
        ),
    ],
)
def test_what_cannot_be_is_told_before_anything_is_begun(credo, text, told):
    code, out, err = credo(f"sweep {written(text)}")
    assert (code, out) == (2, "")
    assert err.startswith("credo: ")
    assert told in err
    assert os.listdir() == ["tiny.toml"]


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ("sweep nowhere.toml", 2, "nowhere.toml: [Errno 2] No such file"),
        ("sweep .", 2, ". is no sweep: it has no sweep.toml"),
        ("sweep tiny.toml --best best.toml", 2, "runs/tiny is no sweep"),
        ("sweep tiny.toml --jobs 0", 2, "--jobs is 0: it must be at least 1"),
        ("sweep tiny.toml --on nowhere", 2, "on is 'nowhere': runs are trained on local, slurm"),
        ("sweep tiny.toml --together 0", 2, "together is 0: it must be at least 1"),
        ("sweep tiny.toml --trails 3", 2, "did you mean '--trials'?"),
        ("sweep tiny.toml --path full", 1, "full is not empty and no sweep (it holds mine)"),
        ("sweep tiny.toml --path held", 1, "held is in use by process"),
        ("sweep late.toml", 2, "a seed must lie in 0 … 4294967295"),
    ],
)
def test_what_cannot_be_done_is_told(credo, words, code, told):
    written(TINY)
    written(f"seed = 4294967294\n{TINY}", "late.toml")
    for name in ("full", "held"):
        pathlib.Path(name).mkdir()
    pathlib.Path("full/mine").touch()
    with lock(pathlib.Path("held")):
        ended, out, err = credo(words)
    assert (ended, out) == (code, "")
    assert told in err
    assert not pathlib.Path("runs").exists()
    assert os.listdir("full") == ["mine"]


@pytest.mark.parametrize(
    "text",
    [
        'algorithm = "neuroevolution"\ntask = "stranger:Task"\n[ranges]\ngamma = [1]',
        ranged('selection = ["tournament", "stranger:Selection"]'),
        ranged('[ranges.breeder]\nselection = ["tournament", "stranger:Selection"]'),
        ranged('selection = { choices = ["tournament", "stranger:Selection"] }'),
        f'{TINY}sampler = "stranger:Sampler"',
    ],
)
def test_a_file_names_no_code_without_trust(credo, text):
    pathlib.Path("stranger.py").write_text("open('begun', 'w')")
    code, _, err = credo(f"sweep {written(text)}")
    assert code == 2
    assert "maybe code of others: look into it, and give --trust" in err
    assert not pathlib.Path("begun").exists()


def checked(text: str) -> sweep_file.Trials:
    return sweep_file.checked(File.read(written(text)), trust=False)


def test_ranges_are_of_the_numbers_that_their_flags_take():
    text = """
    population-size = { low = 1e1, high = 3e1, step = 10 }
    frames = { low = 1e3, high = 1e6, log = true }
    delayed = [false, true]
    breeder = ["genetic", "cem"]
    parents = { low = 0.4, high = 0.6, when = { breeder = "cem" } }
    mutation-strength = { low = 0, high = 1, when = { breeder = ["genetic"] } }
    [ranges.network]
    hidden = { low = 2, high = 4 }
    alpha = { low = 0, high = 1 }
    """
    genetic, cem = ("breeder", ("genetic",)), ("breeder", ("cem",))
    assert list(checked(ranged(text)).ranges) == [
        Range("population-size", low=10, high=30, step=10, whole=True),
        Range("frames", low=1000, high=1_000_000, log=True, whole=True),
        Range("delayed", ("False", "True")),
        Range("breeder", ("genetic", "cem")),
        Range("parents", low=0.4, high=0.6, when=(cem,)),
        Range("mutation-strength", low=0.0, high=1.0, when=(genetic,)),
        Range("network.hidden", low=2, high=4, whole=True),
        Range("network.alpha", low=0.0, high=1.0),
    ]


def test_what_is_drawn_are_flags():
    text = f"{CEM}parents = {{ low = 0.4, high = 0.6, when = {{ breeder = 'cem' }} }}"
    text += "\nstart-variance = { low = 1e-5, high = 1e-2, log = true, "
    text += "when = { breeder = ['cem'] } }\nnetwork.hidden = [2, 3]"
    trials = checked(ranged(text))
    variance = 0.00012345678901234567
    drawn = {"breeder": "cem", "parents": 0.5, "start-variance": variance}
    command, algorithm = trials.made(drawn | {"network.hidden": "3"})
    assert type(algorithm.breeder).__name__ == "CEM"
    assert (algorithm.breeder.parents, algorithm.breeder.start_variance) == (0.5, variance)
    assert (algorithm.network.hidden, algorithm.env) == (3, SequenceRecall())
    assert (command.options.generations, command.seed) == (150, 0)
    _, other = trials.made({"breeder": "genetic", "network.hidden": "2"})
    assert type(other.breeder).__name__ == "Breeder"


def test_what_does_not_go_together_is_said_when_it_is_drawn():
    text = "min-corridor = { low = 1, high = 20 }\nmax-corridor = { low = 20, high = 30 }"
    trials = checked(ranged(text))
    assert trials.made({"min-corridor": 20, "max-corridor": 20})[1].env.min_corridor == 20
    with pytest.raises(ValueError, match=r"corridors of 21\.\.20 steps"):
        trials.made({"min-corridor": 21, "max-corridor": 20})


def test_the_file_of_a_folder_says_the_same(tmp_path):
    text = TINY.replace("[sweep]", 'x = { choices = ["a"], when = { y = ["b", "c"] } }\n[sweep]')
    file = File.read(written(f"name = ['a', 'b=\"c\"']\n{text}"))
    again = File.read(written(file.text(Plan(trials=7)), "again.toml"))
    assert (again.fixed, again.ranges) == (file.fixed, file.ranges)
    assert again.fixed["network.hidden"] == 2
    assert again.search["trials"] == 7
    assert Plan(**again.search) == Plan(trials=7)


def test_a_sweep_goes_on_with_its_own_settings_alone(tmp_path):
    file = File.read(written(TINY))
    plan = Plan(trials=4, seeds=2)
    sweep_file.settle(tmp_path, file, plan, trust=False)
    sweep_file.settle(tmp_path, file, plan, trust=False)
    settled = (tmp_path / "sweep.toml").read_text()
    for text, told in (
        (TINY.replace("depth = 2", "depth = 3"), "depth: 2 != 3"),
        (
            TINY.replace("high = 1.0", "high = 2.0"),
            "mutation-strength: {'low': 0.001, 'high': 1.0,",
        ),
    ):
        with pytest.raises(RuntimeError, match="holds a sweep with other settings") as error:
            sweep_file.settle(tmp_path, File.read(written(text)), plan, trust=False)
        assert told in str(error.value)
    with pytest.raises(RuntimeError, match="seeds: 2 != 3"):
        sweep_file.settle(tmp_path, file, Plan(trials=4), trust=False)
    assert (tmp_path / "sweep.toml").read_text() == settled
    more = Plan(trials=6, seeds=2)
    sweep_file.settle(tmp_path, file, more, trust=False)
    assert tomllib.loads((tmp_path / "sweep.toml").read_text())["sweep"]["trials"] == 6
    sweep_file.settle(tmp_path, file, plan, trust=False)  # fewer are no other sweep
    assert tomllib.loads((tmp_path / "sweep.toml").read_text())["sweep"]["trials"] == 6


def started(jobs: int) -> subprocess.Popen:
    command = [sys.executable, "-m", "credo", "sweep", "tiny.toml", "--jobs", str(jobs)]
    env = os.environ | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=env)


def killed(jobs: int, there) -> None:
    """Kill a sweep with SIGKILL once `there` is so."""
    process, give_up = started(jobs), time.monotonic() + 300
    while process.poll() is None and not there():
        assert time.monotonic() < give_up
        time.sleep(0.01)
    assert process.poll() is None, process.stderr.read()
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -9


def finished(jobs: int) -> None:
    process = started(jobs)
    said = process.communicate(timeout=900)[1]
    assert process.returncode == 0, said


def outcome(plan: Plan) -> tuple:
    """Trials of the sweep in `runs/tiny`, a hash of each file of its runs that says what was
    learned, and its page."""
    folder = pathlib.Path("runs/tiny")
    files = {
        str(path): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("trial-*/seed-*/*"))
        if path.name in ("metrics.csv", "champion.safetensors", "best.safetensors")
    }
    page, settings = (folder / name for name in ("report.html", "sweep.toml"))
    trials = Journal(folder, plan, []).trials
    return trials, files, page.read_text(), settings.read_text()


def ended(count: int) -> bool:
    """Whether so many trials have ended."""
    path = pathlib.Path("runs/tiny/journal.log")
    return path.exists() and path.read_text().count('"op_code":6') >= count


def runs() -> int:
    """How many runs have begun to learn."""
    return len(list(pathlib.Path("runs/tiny").glob("trial-*/seed-*/metrics.csv")))


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A small sweep that was left alone, with one process at a time: its folder."""
    before, folder = os.getcwd(), tmp_path_factory.mktemp("alone")
    os.chdir(folder)
    try:
        written(TINY)
        finished(1)
    finally:
        os.chdir(before)
    return folder


PLAN = Plan(trials=4, seeds=2)


def test_a_sweep_that_is_killed_ends_as_one_left_alone(alone, monkeypatch):
    """With another number of processes."""
    written(TINY)
    killed(2, lambda: runs() >= 3)
    finished(2)
    disturbed = outcome(PLAN)
    monkeypatch.chdir(alone)
    left = outcome(PLAN)
    assert disturbed == left
    trials, files, page, _ = left
    assert {trial.state for trial in trials} == {"complete"}
    assert len(files) == 3 * sum(len(trial.scores) for trial in trials)
    for trial in trials:
        for seed, score in enumerate(trial.scores):
            run = Run(f"runs/tiny/trial-{trial.number:03}/seed-{seed}")
            tested = run.metrics["champion_score"]
            assert len(tested) == 150
            assert score == pytest.approx(tested[-15:].mean())
    assert f"Best: trial {best(trials, PLAN).number}" in page


@pytest.mark.slow
def test_a_large_sweep_killed_twice_ends_as_one_left_alone(monkeypatch, tmp_path_factory):
    """20 trials of 2 seeds: random ones, those that the sampler draws, and pruned ones. Of the
    tests of champions many are equal; fitness tells all trials apart."""
    text = TINY.replace("trials = 4", 'trials = 20\nstartup = 6\nmetric = "fitness_mean"')
    text = text.replace("[sweep]", 'breeder.selection = ["tournament", "truncation"]\n[sweep]')
    plan = Plan(trials=20, seeds=2, startup=6, metric="fitness_mean")
    written(text)
    killed(2, lambda: runs() >= 3)
    killed(1, lambda: ended(9))
    finished(2)
    disturbed = outcome(plan)
    monkeypatch.chdir(tmp_path_factory.mktemp("alone"))
    written(text)
    finished(1)
    assert outcome(plan) == disturbed
    assert "pruned" in {trial.state for trial in disturbed[0]}


def test_the_best_settings_train_the_same_run(alone, credo, monkeypatch):
    monkeypatch.chdir(alone)
    trial = best(Journal(pathlib.Path("runs/tiny"), PLAN, []).trials, PLAN)
    for words in ("tiny.toml", "runs/tiny"):
        code, out, err = credo(f"sweep {words} --best best.toml")
        assert (code, err) == (0, "")
        assert f"Trial {trial.number} of runs/tiny, the best of 4 complete ones" in out
        assert "These seeds chose it, so that number flatters. Report others, from 2 on:\n" in out
        assert "  credo train --config best.toml --seeds 10\n" in out
    settings = tomllib.loads(pathlib.Path("best.toml").read_text())
    assert settings["seed"] == 2
    assert settings["mutation.strength"] == trial.drawn["mutation-strength"]
    code, out, _ = credo("train --config best.toml --seed 1 --path again --progress False")
    assert code == 0
    old = pathlib.Path(f"runs/tiny/trial-{trial.number:03}/seed-1")
    for name in ("metrics.csv", "champion.safetensors", "best.safetensors"):
        assert (pathlib.Path("again") / name).read_bytes() == (old / name).read_bytes()


def test_a_finished_sweep_trains_no_more(alone, credo, monkeypatch):
    monkeypatch.chdir(alone)
    monkeypatch.setattr(local, "_start", None)
    before = outcome(PLAN)
    code, out, err = credo("sweep runs/tiny")
    assert (code, err) == (0, "")
    assert "best: trial" in out
    assert out.endswith("page: runs/tiny/report.html\n")
    assert outcome(PLAN) == before


def test_help_shows_how_to_search(credo):
    code, out, _ = credo("sweep --help")
    assert code == 0
    for flag in ("path", "jobs", "best", "trials", "seeds", "sampler", "together", "on"):
        assert f"\n  --{flag} " in out
    code, out, _ = credo("sweep")
    assert code == 2
    assert out.startswith("usage: credo sweep FILE [flags]")
