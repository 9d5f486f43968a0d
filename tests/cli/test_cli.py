"""The command line, from the help text to a report; wrong use ends with a suggestion."""

import dataclasses
import importlib
import json
import operator
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
import tomllib
import warnings

import pytest
from jax.errors import JaxRuntimeError

from credo import cli, require
from credo.cli import settings, tasks, train
from credo.cli.line import Line
from credo.cli.names import ALGORITHMS, COMMANDS, NETWORKS, TASKS, load
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Meet, Remember
from credo.experiments.catalogue import EXPERIMENTS
from credo.networks.choosing import Choosing
from credo.networks.mlp import MLP
from credo.networks.team import Team
from credo.runs.loop import Interrupted
from credo.runs.record import RunError
from credo.runs.store import Run

TRAIN = (
    "train neuroevolution sequence-classification --depth 2 --min-gap 1 --max-gap 2 "
    "--population-size 10 --episodes 4 --test-episodes 6 --network.hidden 3 --tensorboard False"
)


MEAN = "mean ± standard error over episodes"
LIST = "credo.cli.commands.List.__call__"


@pytest.fixture(autouse=True)
def as_it_was(monkeypatch):
    """A command may change the process that it thinks its own."""
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    monkeypatch.setattr(sys, "path", list(sys.path))


@pytest.fixture
def credo(capsys):
    """Run a command: its exit code, what it printed, and what it complained about."""

    def run(*words: str) -> tuple[int, str, str]:
        argv = [part for word in words for part in word.split()]
        try:
            cli.main(argv)
            code = 0
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """What `credo train` leaves behind."""
    path = tmp_path_factory.mktemp("cli") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(warnings, "showwarning", warnings.showwarning)
        patch.setattr(sys, "path", list(sys.path))
        cli.main(f"{TRAIN} --generations 1e1 --seed 3 --path {path}".split())
    return path


@pytest.mark.parametrize("words", [[], ["--help"], ["list"], ["--version"], ["train"]])
def test_what_only_informs_imports_no_jax(words):
    script = f"""
        import sys
        from credo import cli
        try:
            cli.main({words!r})
        except SystemExit as end:
            pass
        print("jax" in sys.modules, "matplotlib" in sys.modules)
        """
    shown = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True
    ).stdout
    assert shown.splitlines()[-1] == "False False"
    assert len(shown.splitlines()) >= 2


def test_help_names_every_command(credo):
    code, out, err = credo("--help")
    assert (code, err) == (0, "")
    for command in COMMANDS:
        assert f"\n  {command} " in out


def test_list_names_everything(credo):
    code, out, _ = credo("list")
    assert code == 0
    for names in (TASKS, ALGORITHMS, NETWORKS, EXPERIMENTS):
        for name in names:
            assert f"\n  {name} " in out
    assert "fig-3.4a" not in credo("list tasks")[1]


@pytest.mark.parametrize(
    ("words", "complaint", "help"),
    [
        ("trian", "no command 'trian'", "did you mean 'train'?"),
        ("dance", "no command 'dance'", "choose one of: train, resume"),
        ("list task", "nothing called 'task'", "did you mean 'tasks'?"),
        ("train evolution sequence-recall", "no algorithm 'evolution'", "did you mean 'neuroevol"),
        ("train neuroevolution sequence-recal", "no task 'sequence-recal'", "'sequence-recall'?"),
        ("train neuroevolution nowhere:Task", "cannot import 'nowhere:Task'", "folder of its file"),
        ("train neuroevolution os:sep", "os:sep is no task", "derive it from credo.Abstract"),
        ("check os:getcwd", "os:getcwd is no task", "derive it from credo.AbstractEnvironment"),
        ("check :Task", "no task ':Task'", "written package.module:name"),
        ("check os:Nothing", "cannot import 'os:Nothing'", "os has no Nothing"),
        ("train neuroevolution sequence-recall --network lstn", "no network 'lstn'", "'lstm'?"),
        ("train neuroevolution sequence-recall --preset our", "no preset 'our'", "'ours'?"),
        ("train neuroevolution sequence-recall --network", "--network needs a value", ""),
        (f"{TRAIN} --wall-clock soon", "wall-clock is 'soon'", "90s, 30m or 2h"),
        (f"{TRAIN} --depth 0", "depth is 0: it must be at least 1", ""),
        (f"{TRAIN} --generations 0", "--generations is 0: it must lie in [1, ", ""),
        (f"{TRAIN} --frames 0", "--frames is 0: it must lie in [1, ", ""),
        ("td3 Pendulum-v1", "td3 is an algorithm: credo train td3 TASK", ""),
        ("train merl Pendulum-v1", "merl trains teams", "or train erl"),
        ("train td3 ALE/Pong-v5", "a task of ale-py: pip install ale-py", "ale_py:ALE/Pong-v5"),
        ("train td3 my.Env", "no module 'my.Env'", "is written my:Env"),
        ("train td3 Pendulum-v1 --id Hopper-v5", "no flag '--id'", "the task is a word"),
        ("check Pendulum-v1 --id Hopper-v5", "no flag '--id'", "the task is a word"),
        ("train td3 Pendulum-v1 --name x", "no flag '--name'", "it is called --path"),
        ("train td3 Pendulum-v1 --network lstmm", "no network 'lstmm'", "did you mean 'lstm'?"),
        ("train erl Pendulum-v1 --preset as-coded", "no preset 'as-coded' of erl", "one of: ours"),
        ("train cerl Pendulum-v1 --manager thomson", "no manager 'thomson'", "'thompson'?"),
        ("train erl Pendulum-v1 --gamma big", "--learners.0.gamma is 'big'", "it must be a number"),
        ("train td3 Pendulum-v1 --config nowhere.toml", "--config nowhere.toml", "No such file"),
        ("train td3 Hoper-v5", "no task 'Hoper-v5'", "did you mean 'Hopper-v5'?"),
        ("train td3 Pendulum-v1 --preset td4", "td3 has no presets", ""),
        (f"{TRAIN} --seeds 0", "--seeds is 0: it must be at least 1", ""),
        (f"{TRAIN} --keep 0", "--keep is 0: it must be at least 1", ""),
        (f"{TRAIN} --seed -1", "--seed is -1: a seed must lie in 0 … 4294967295", ""),
        (f"{TRAIN} --seed 4294967296", "a seed must lie in 0 … 4294967295", ""),
        (f"{TRAIN} --seed 1180591620717411303424", "a seed must lie in 0 … 4294967295", ""),
        (f"{TRAIN} --seed 4294967295 --seeds 2", "--seed is 4294967295 … 4294967296: a seed", ""),
        (f"{TRAIN} --checkpoint-every nan", "--checkpoint-every is nan: it must be at least 0", ""),
        (f"{TRAIN} --stop-at nan", "--stop-at is nan", ""),
        (f"{TRAIN} --kwargs a=1", "SequenceClassification has no --kwargs", "see --help"),
        ("check Pendulum-v1 --kwargs", "--kwargs needs settings", "NAME=VALUE"),
        ("check Pendulum-v1 --kwargs g", "--kwargs: g has no value", "write g=VALUE"),
        ("check Pendulum-v1 --kwargs 1=g", "--kwargs: '1=g' is no setting", "NAME=VALUE"),
        ("check Pendulum-v1 --kwargs g=[1]", "a number, a string, a bool, None or a tuple", ""),
        ("resume nowhere --keep 0", "--keep is 0: it must be at least 1", ""),
        ("resume nowhere --generations 0", "--generations is 0: it must lie in [1, ", ""),
        ("resume nowhere --set gamma", "--set: gamma has no value", "write gamma=VALUE"),
        ("watch nowhere --episodes 0", "--episodes is 0: it must be at least 1", ""),
        ("watch nowhere --seed -1", "a seed must lie in 0 … 4294967295", ""),
        ("watch nowhere --fps 0", "--fps is 0.0: it must be more than 0", ""),
        ("report nowhere --out page.html", "no flag '--out'", "did you mean '--output'?"),
        ("list tasks now", "takes one word", ""),
        ("check subprocess:Popen", "subprocess:Popen is no task", ""),
        ("check os:system", "os:system is no task", ""),
        ("reproduce fig-3.4a --runs 0", "--runs is 0: it must be at least 1", ""),
        ("reproduce fig-3.4", "no experiment 'fig-3.4'", "did you mean 'fig-3.4"),
        ("reproduce fig-3.4a --budget quik", "no budget 'quik'", "did you mean 'quick'?"),
    ],
)
def test_wrong_use_says_what_is_wrong_and_what_to_do(credo, words, complaint, help):
    code, out, err = credo(words)
    assert (code, out) == (2, "")
    assert err.startswith("credo: ")
    assert complaint in err
    assert help in err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (f"{TRAIN} --dept 3", "--depth"),
        (f"{TRAIN} --depth three", "three"),
        (f"{TRAIN} --ties sometimes", "positive"),
        (f"{TRAIN} --netwrk lstm", "did you mean '--network'?"),
        ("train td3 Pendulum-v1 --form run", "did you mean '--from'?"),
        ("resume somewhere --generation 3", "--generations"),
        ("reproduce fig-3.4a --run 3", "--runs"),
    ],
)
def test_a_wrong_flag_is_answered_with_the_right_one(credo, words, told):
    code, out, err = credo(words)
    assert code == 2
    assert told in out + err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("resume nowhere", "nowhere is no run and has none in it"),
        ("evaluate nowhere", "nowhere is no run"),
        ("report nowhere", "nowhere is no run"),
    ],
)
def test_what_cannot_be_done_ends_in_one_line(credo, words, told):
    code, out, err = credo(words)
    assert (code, out) == (1, "")
    assert err.startswith("credo: ")
    assert told in err
    assert len(err.splitlines()) == 1


def user_exit(_):
    sys.exit(0)


def user_error(_):
    return {}["x"]


def allocate(_):
    raise JaxRuntimeError(
        "RESOURCE_EXHAUSTED: Out of memory allocating 100000000000 bytes.\nand so"
    )


def raising(error):
    def command(_):
        raise error

    return command


@pytest.mark.parametrize(
    ("command", "code", "told"),
    [
        (raising(KeyboardInterrupt()), 130, "credo: stopped"),
        (raising(MemoryError()), 1, "credo: not enough memory: MemoryError. Give a smaller"),
        (allocate, 1, "memory: RESOURCE_EXHAUSTED: Out of memory allocating 100000000000 bytes. G"),
        (raising(PermissionError(13, "Permission denied", "x")), 1, "Permission denied: 'x'"),
        (raising(RunError("no run")), 1, "credo: no run"),
        (raising(Interrupted("stopped and saved", 143)), 143, "credo: stopped and saved"),
        (lambda _: require.at_least("depth", 0, 1), 2, "credo: depth is 0: it must be at least 1"),
        (user_exit, 1, "test_cli.py:"),
        (user_exit, 1, "ends Python (exit code 0)"),
        (user_error, 1, "raised KeyError: 'x'; the traceback is in "),
        (operator.add, 1, "credo: internal error: TypeError: add expected 2 arguments, got 1; the"),
    ],
)
def test_whatever_a_command_raises_ends_in_one_line(credo, monkeypatch, command, code, told):
    monkeypatch.setattr(LIST, staticmethod(command))
    ended, out, err = credo("list")
    assert (ended, out, len(err.splitlines())) == (code, "", 1)
    assert told in err


def test_what_nobody_foresaw_leaves_its_traceback(credo, monkeypatch, tmp_path):
    monkeypatch.setattr(LIST, staticmethod(user_error))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    _, _, err = credo("list")
    (log,) = tmp_path.iterdir()
    assert err.endswith(f"the traceback is in {log}\n")
    assert "Traceback" in log.read_text()
    assert "KeyError: 'x'" in log.read_text()


def test_what_a_file_says_moves_no_cursor(credo, monkeypatch):
    error = RunError("\x1b[2Jclean")
    monkeypatch.setattr(LIST, staticmethod(raising(error)))
    assert credo("list")[2] == "credo: \\x1b[2Jclean\n"


def sh(script: str, **options) -> tuple[int, str]:
    """A shell's exit code for `credo …`, and all that was said."""
    script = script.replace("credo", f"{sys.executable} -m credo")
    ran = subprocess.run(["bash", "-c", script], capture_output=True, text=True, **options)
    return ran.returncode, ran.stdout + ran.stderr


@pytest.mark.parametrize(
    ("script", "code", "said"),
    [
        ("credo list | head -0; exit ${PIPESTATUS[0]}", 141, ""),
        ("credo list >&-", 0, ""),
        ("credo trian 2>&-", 2, ""),
        ("credo trian 2>&1 | head -0; exit ${PIPESTATUS[0]}", 2, ""),
        (
            "mkdir gone; cd gone; rmdir ../gone; credo list",
            1,
            "credo: this folder is not there any",
        ),
        ("credo list tasks > /dev/full", 1, "credo: [Errno 28] No space left on device"),
    ],
)
def test_streams_and_folders_that_are_gone(script, code, said, tmp_path):
    ended, told = sh(script, cwd=tmp_path)
    assert ended == code
    assert told.startswith(said)
    assert len(told.splitlines()) == bool(said)


@pytest.mark.parametrize("command", ["resume", "evaluate", "report", "check", "reproduce", "train"])
def test_a_command_without_its_argument_shows_its_usage(credo, command):
    code, out, _ = credo(command)
    assert code == 2
    assert out.startswith(f"usage: credo {command} ")
    code, out, _ = credo(command, "--help")
    assert code == 0
    assert f"credo {command}" in out


def test_every_flag_is_listed_with_its_meaning_and_default(credo):
    code, out, _ = credo("train neuroevolution sequence-classification --help-all")
    assert code == 0
    for flag in ("--depth", "--network.hidden", "--mutation.strength", "--generations"):
        assert flag in out
    assert "signals per sequence" in out
    assert "21" in out


def test_train_leaves_a_run_with_the_flags_in_it(run):
    trained = Run(run)
    algorithm = trained.algorithm
    assert (algorithm.env.depth, algorithm.env.min_gap, algorithm.env.max_gap) == (2, 1, 2)
    assert (algorithm.population_size, algorithm.episodes, algorithm.network.hidden) == (10, 4, 3)
    assert trained.config["seed"] == 3
    assert trained.config["algorithm"]["class"].endswith(":Neuroevolution")
    assert trained.metrics["generation"].tolist() == list(range(1, 11))


def test_a_preset_can_be_overridden_by_flags():
    """What the flags are parsed into, without a run."""
    from credo.algorithms.neuroevolution import Neuroevolution
    from credo.environments.sequence_classification import SequenceClassification
    from credo.networks.mmu import MMU

    argv = ["--depth", "5", "--episodes", "7", "--mutation.strength", "0.3", "--seed", "4"]
    line = Line("train", ["neuroevolution", "sequence-classification", "--preset", "ours", *argv])
    options = line.command(train.Train)
    algorithm = train._algorithm(line, options)
    expected = Neuroevolution.ours(SequenceClassification(depth=5), MMU(), episodes=7)
    mutation = dataclasses.replace(expected.breeder.mutation, strength=0.3)
    assert type(algorithm) is Neuroevolution
    breeder = dataclasses.replace(expected.breeder, mutation=mutation)
    assert algorithm == dataclasses.replace(expected, breeder=breeder)
    assert options.seed == 4


def test_training_again_in_the_same_folder_is_refused(credo, run):
    code, out, err = credo(f"{TRAIN} --path {run}")
    assert (code, out) == (1, "")
    assert f"{run} holds a run already: `credo resume {run}`" in err


def test_resume_to_a_larger_budget(credo, run, tmp_path):
    path = tmp_path / "run"
    assert credo(f"{TRAIN} --seed 3 --generations 4 --path {path}")[0] == 0
    code, out, _ = credo(f"resume {path} --generations 1e1")
    assert code == 0
    assert out.startswith(f"{path}: generation 10, best fitness ")
    assert "on 6 fresh episodes" in out
    for name in ("metrics.csv", "champion.safetensors"):
        assert (path / name).read_bytes() == (run / name).read_bytes()
    code, out, err = credo(f"resume {path}")
    assert code == 0
    assert out.startswith(f"{path}: generation 10, best fitness ")
    assert f"{path} is finished: 10 of 10 generations; to go on give a larger" in err
    code, _, err = credo(f"resume {path} --generations 5")
    assert code == 1
    assert "must be larger, not 5" in err


def test_stop_at_and_wall_clock_end_a_run_early(credo, tmp_path):
    for i, flags in enumerate(("--stop-at 0.0", "--wall-clock 0s")):
        code, out, _ = credo(f"{TRAIN} --generations 1000 --path {tmp_path / str(i)} {flags}")
        assert code == 0
        assert f"{tmp_path / str(i)}: generation 1," in out


def test_evaluate_plays_fresh_episodes_of_any_depth(credo, run):
    code, out, _ = credo(f"evaluate {run} --episodes 40")
    assert code == 0
    lines = out.splitlines()
    assert lines[0] == f"{run}: 40 fresh episodes, {MEAN}"
    assert [line.split()[0] for line in lines[1:]] == [
        "fitness",
        "accuracy",
        "success",
        "steps",
        "baseline",
        "upper",
    ]
    assert 3 <= float(lines[4].split()[1]) <= 4  # depth 2, a gap of 1 or 2
    assert credo(f"evaluate {run} --episodes 40")[1] == out
    assert credo(f"evaluate {run} --episodes 40 --seed 1")[1] != out
    deeper = credo(f"evaluate {run} --episodes 40 --depth 5")[1].splitlines()
    assert 9 <= float(deeper[4].split()[1]) <= 13


def test_evaluate_streams_what_is_very_deep(credo, run):
    code, out, _ = credo(f"evaluate {run} --depth 2e3 --episodes 3")
    assert code == 0
    first, success, right = out.splitlines()
    assert first == f"{run}: 3 streams of 2,000 signals"
    assert 0 <= float(success.split()[1]) <= 1
    assert "median" in right


def test_report_is_a_page_about_the_runs(credo, run, tmp_path):
    code, out, _ = credo(f"report {run} -o {tmp_path / 'page.html'}")
    assert (code, out) == (0, f"page: {tmp_path / 'page.html'}\n")
    page = (tmp_path / "page.html").read_text()
    assert "Neuroevolution" in page
    assert "SequenceClassification(depth=2, min_gap=1, max_gap=2" in page
    assert f"credo report {run}" in re.sub("<[^>]*>", "", page)


def test_flags_may_not_change_what_a_champion_is_made_for(credo, hosted):
    code, out, err = credo(f"evaluate {hosted} --id MountainCarContinuous-v0")
    assert (code, out) == (2, "")
    assert "with these flags the task has 2 numbers in an observation: its champion cannot" in err
    code, out, _ = credo(f"evaluate {hosted} --episodes 2 --kwargs g=0.0")
    assert code == 0


def test_several_seeds_are_trained_in_processes_of_their_own(credo, run, tmp_path):
    code, out, _ = credo(f"{TRAIN} --generations 10 --seed 2 --seeds 2 --path {tmp_path / 'runs'}")
    assert code == 0
    assert f"compare them: credo report {tmp_path / 'runs'}/seed-*" in out
    runs = [tmp_path / "runs" / f"seed-{seed}" for seed in (2, 3)]
    assert [Run(path).config["seed"] for path in runs] == [2, 3]
    assert (runs[1] / "metrics.csv").read_bytes() == (run / "metrics.csv").read_bytes()
    code, *_ = credo("report", *map(str, runs), f"-o {tmp_path / 'both.html'}")
    assert code == 0
    assert "neuroevolution: 2, 3" in (tmp_path / "both.html").read_text()


@pytest.fixture
def seeds(run, tmp_path, monkeypatch):
    """A folder of two runs, as `--seeds` leaves it."""
    monkeypatch.chdir(tmp_path)
    for seed in (3, 11):
        shutil.copytree(run, tmp_path / "several" / f"seed-{seed}")
    return "several"


def test_a_folder_of_runs_is_reported_in_itself(credo, seeds):
    page = pathlib.Path(seeds) / "report.html"
    for words in (seeds, f"{seeds}/seed-3 {seeds}/seed-11"):
        assert credo(f"report {words}") == (0, f"page: {page}\n", "")
        page.unlink()
    assert not list(pathlib.Path(seeds).glob("seed-*/report.html"))


def test_a_folder_of_runs_is_evaluated_run_by_run_and_together(credo, seeds):
    code, out, _ = credo(f"evaluate {seeds} --episodes 20")
    lines = out.splitlines()
    assert (code, lines[0]) == (0, f"{seeds}/seed-3: 20 fresh episodes, {MEAN}")
    assert lines[7] == f"{seeds}/seed-11: 20 fresh episodes, {MEAN}"
    assert lines[14] == f"{seeds}: 2 runs, mean ± standard error over runs"
    for alone, together in zip(lines[1:4], lines[15:], strict=True):  # the same run twice
        assert together.split()[1:] == [alone.split()[1], "±", "0"]


@pytest.mark.parametrize("command", ["watch", "export"])
def test_of_a_folder_of_runs_one_must_be_named(credo, seeds, command):
    code, out, err = credo(f"{command} {seeds}")
    assert (code, out) == (2, "")
    assert f"{seeds} holds 2 runs: name one of them, as in credo {command} {seeds}/seed-3" in err
    assert f"{seeds}/seed-11" in err


def test_every_run_of_a_folder_is_resumed(credo, seeds, monkeypatch):
    given = []
    monkeypatch.setattr("credo.executors.run", lambda jobs, **_: given.extend(jobs))
    assert credo(f"resume {seeds} --generations 20 --keep 2")[0] == 0
    assert [(job.path.name, job.seed) for job in given] == [("seed-3", 3), ("seed-11", 3)]
    told = [(job.options.generations, job.options.frames, job.options.keep) for job in given]
    assert told == [(20, None, 2)] * 2
    given.clear()
    assert credo(f"resume {seeds} --stop-at 2")[0] == 0
    assert [(job.budget.generations, job.budget.stop_at) for job in given] == [(10, 2.0)] * 2
    assert [job.finished() for job in given] == [True, True]


@pytest.mark.parametrize(
    "words", ["train neuroevolution sequence-recall", "resume some-run", "reproduce fig-3.4a"]
)
def test_a_place_that_there_is_not_is_refused(credo, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = credo(f"{words} --on locale")
    assert (code, out) == (2, "")
    told = "credo: --on is 'locale': runs are trained on local, slurm, ray or ray:HOST:PORT"
    assert err.splitlines()[-1] == f"{told} (did you mean 'local'?)"
    assert list(tmp_path.iterdir()) == []


def test_what_resume_is_told_reaches_the_loop(credo, seeds, run, monkeypatch):
    told = []
    resumed = lambda path, options, **fields: told.append((path, fields | vars(options)))  # noqa: E731
    monkeypatch.setattr("credo.runs.loop.resume", resumed)
    given = lambda jobs, **_: told.extend((j.path, j.again | vars(j.options)) for j in jobs)  # noqa: E731
    monkeypatch.setattr("credo.executors.run", given)
    words = "--set mutation.strength=0.5 --set episodes=5 --trust --without-replay --generations 20"
    assert credo(f"resume {run} {words} --wall-clock 2m")[0] == 0
    assert credo(f"resume {seeds} {words}")[0] == 0
    assert [path for path, _ in told] == [run, *sorted(pathlib.Path(seeds).glob("*"), reverse=True)]
    for _, fields in told:
        assert fields["set"] == {"breeder.mutation.strength": 0.5, "episodes": 5}
        assert (fields["trust"], fields["without_replay"]) == (True, True)
    assert told[0][1]["wall_clock"] == 120.0
    told.clear()
    words = "--set mutation-strength=0.25 --set elite_fraction=0.3 --frames 1e6"
    assert credo(f"resume {run} {words}")[0] == 0
    assert told[0][1]["set"] == {"breeder.mutation.strength": 0.25, "breeder.elite_fraction": 0.3}
    code, _, err = credo(f"resume {run} --set mutation.strngth=0.5")
    assert code == 2
    assert "did you mean 'strength'?" in err


def test_a_setting_of_a_finished_run_is_said_to_be_unused(credo, seeds, run, tmp_path):
    alone = shutil.copytree(run, tmp_path / "alone")
    for path, first in ((alone, alone), (seeds, f"{seeds}/seed-3")):
        code, _, err = credo(f"resume {path} --set episodes=5")
        assert code == 0
        assert f"--set is not used: {first} is finished and trains no more; give a larger" in err
    config = Run(alone).config
    assert (Run(alone).algorithm.episodes, "changes" in config) == (4, False)


def test_a_seed_or_a_budget_is_no_setting(credo, run):
    for change, told in (("seed=3", "start another"), ("frames=1e6", "a budget is a flag")):
        code, _, err = credo(f"resume {run} --set {change}")
        assert code == 2
        assert told in err


def test_all_settings_are_written_and_read(credo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = "train cerl Pendulum-v1 --gamma 0.7 --learners.1.gamma 0.9 --manager thompson"
    words += " --hidden 4,5 --seed 7 --frames 1e3 --kwargs g=5.0 --learners td3,sac --workers 3"
    code, saved, _ = credo(f"{words} --print-config")
    assert code == 0
    settings = tomllib.loads(saved)
    told = {"learners.0.gamma": 0.7, "learners.1.gamma": 0.9, "manager": "thompson", "seed": 7}
    told |= {"network.hidden": [4, 5], "frames": 1000, "kwargs": ["g=5.0"], "learners": "td3,sac"}
    assert told.items() <= settings.items()
    pathlib.Path("run.toml").write_text(saved)
    assert credo("train --config run.toml --print-config") == (0, saved, "")
    _, other, _ = credo("train cerl --config run.toml --gamma 0.5 --seed 8 --print-config")
    changed = {name for name, value in tomllib.loads(other).items() if settings[name] != value}
    assert changed == {"learners.0.gamma", "learners.1.gamma", "seed"}
    pathlib.Path("own.toml").write_text("[network]\nhidden = [3]\n[learner.critic]\nhidden = 2\n")
    _, nested, _ = credo("train td3 Pendulum-v1 --config own.toml --print-config")
    assert tomllib.loads(nested)["network.hidden"] == [3]
    assert tomllib.loads(nested)["learner.critic.hidden"] == [2]
    pathlib.Path("wrong.toml").write_text("gama = 3\n")
    code, _, err = credo("train td3 Pendulum-v1 --config wrong.toml")
    assert code == 2
    assert "no flag '--gama'" in err
    assert "'--gamma'?" in err
    assert list(tmp_path.glob("runs*")) == []


PRESETS = [
    (word, preset) for word in ALGORITHMS for preset in (None, *ALGORITHMS[word].get("presets", ()))
]


@pytest.mark.parametrize(("word", "preset"), PRESETS)
def test_the_settings_of_every_preset_are_read_as_they_were(word, preset):
    tasks = {"one agent": "Pendulum-v1", "a team": "rover"}
    task = tasks.get(ALGORITHMS[word].get("learns", "one agent"), "sequence-recall")
    argv = [word, task]
    if preset:
        argv = [word, "rover" if preset == "dmmu" else task, "--preset", preset]
        argv += ["--network", "dmmu"] if preset == "dmmu" else []

    def made(line):
        command = line.command(train.Train)
        algorithm = train._algorithm(line, command)
        line.done()
        return command, algorithm

    command, algorithm = made(Line("train", argv))
    saved, again = tomllib.loads(settings.written(command, algorithm)), Line("train", [])
    settings.place(again, settings.read("run.toml", saved, trust=False))
    assert made(again)[1] == algorithm


@pytest.mark.parametrize(
    "text",
    [
        'algorithm = "td3"\ntask = "shutil:rmtree"\nkwargs = ["path=kept"]',
        'learner = "stranger_1:Learner"',
        'task = "stranger_1.team"',
        'rewards = ["global=stranger_1:pay"]',
        'kwargs = ["task=stranger_1:f"]',
        'algorithm = ["td3", "stranger_1.team"]',
        'trust = true\nlearner = "stranger_1:Learner"',
        'learner = "stranger-:Learner"',
        "rewards = [\"global='stranger_1\\\\x3apay'\"]",
    ],
)
@pytest.mark.parametrize("trust", ["", "--trust False", "--trust=false"])
def test_a_file_of_settings_names_no_code_without_trust(credo, tmp_path, monkeypatch, text, trust):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kept").mkdir()
    for name in ("stranger_1.py", "stranger-.py"):
        (tmp_path / name).write_text("open('begun', 'w')")
    (tmp_path / "run.toml").write_text(text)
    words = "" if text.startswith("algorithm") else "td3 Pendulum-v1"
    code, _, err = credo(f"train {words} --config run.toml {trust}")
    assert code == 2
    told = "maybe code of others: look into it, and give --trust"
    told = "give one word" if text.startswith("algorithm = [") else told
    assert ("for the command line alone" if "trust =" in text else told) in err
    assert (tmp_path / "kept").exists()
    assert not (tmp_path / "begun").exists()


def test_the_rewards_of_a_task_are_named():
    env = tasks.task("rover", {}, ("difference", "global"))
    assert env.rewards == ("difference", "global")
    line = Line("train", ["merl", "rover", "--rewards", "global,local,dpp", "--coupling", "2"])
    env = train._algorithm(line, line.command(train.Train)).env
    assert (env.rewards, env.coupling) == (("global", "local", "dpp"), 2)


def test_decoys_and_fitness_critics_have_words():
    def made(words):
        line = Line("train", words.split())
        return train._algorithm(line, line.command(train.Train))

    ccea = made(
        "ccea rover-decoys --coupling 4 --mislead 0.25 --critic perceptron --critic.hidden 8"
    )
    assert ccea.env == load("environments.rover:Rover").misleading(4, 0.25)
    assert ccea.env.needed == (1, 1, 1, 1, 4, 4, 4, 4)
    assert ccea.critic.hidden == (8,)
    merl = made("merl rover --learners criticised --redistribute --learners.0.critic.hidden 8")
    assert merl.learners[0].critic.hidden == (8,)
    assert merl.learners[0].signal == "global"


def test_check_tells_how_often_the_rewards_of_a_team_agree(credo):
    code, out, _ = credo("check rover --rovers 2 --coupling 1 --pois 2 --max-steps 5 --size 8")
    assert code == 0
    told = dict(line.split(maxsplit=1) for line in out.splitlines() if line.startswith("  "))
    assert told["global"].startswith("1.00")
    assert 0 <= float(told["local"].split()[0]) <= 1


def test_what_a_short_budget_leaves_out_is_said(credo, tmp_path):
    """A learner that is tested once, and a population that plays more than it was given."""
    words = "train dqn CartPole-v1 --frames 300 --start-frames 100 --in-process True"
    err = credo(f"{words} --path {tmp_path / 'dqn'}")[2]
    assert "tests come every 5,000 frames: a run of 300 has one" in err
    assert "give --test-every 60" in err
    words = "train neuroevolution CartPole-v1 --population-size 20 --in-process True --frames 300"
    assert "so this run may have one generation only" in credo(f"{words} --path {tmp_path}/e")[2]


def test_the_best_policy_can_be_asked_for(credo, run, tmp_path):
    for flag, name in (("", "champion"), ("--best", "best")):
        assert credo(f"evaluate {run} --episodes 20 {flag}")[0] == 0
        target = tmp_path / f"{name}.safetensors"
        assert credo(f"export {run} {target} {flag}")[0] == 0
    assert (tmp_path / "best.safetensors").exists()


def test_every_algorithm_is_made_of_its_preset():
    alone = Gymnasium("Pendulum-v1", in_process=True)
    other = {"bptt": Remember()} | dict.fromkeys(("merl", "matd3", "maddpg", "ccea"), Meet())
    for name, entry in ALGORITHMS.items():
        env = other.get(name, alone)
        network = MLP() if "network" in entry else None
        algorithm = load(entry["path"])(env, network)
        assert type(algorithm).__name__ in entry["path"]
        assert algorithm.env == env
        for preset in entry.get("presets", ()):
            assert preset in type(algorithm).presets()


def test_no_command_leaves_a_trace_when_it_is_stopped(credo, monkeypatch, tmp_path):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("credo.runs.loop._initial", stopped)
    assert credo(TRAIN) == (130, "", "credo: stopped\n")
    assert list(tmp_path.iterdir()) == []


OFF_POLICY = (
    "--network mlp --network.hidden 4 --learner.critic.hidden 4 --learner.batch-size 4 "
    "--start-frames 20 --test-every 20 --test-episodes 1 --replay-capacity 100 "
    "--tensorboard False --in-process True --max-episode-steps 10"
)


@pytest.fixture(scope="module")
def hosted(tmp_path_factory):
    """A run of a Gymnasium task that pays at the end, in a folder of its own name."""
    folder = tmp_path_factory.mktemp("hosted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(warnings, "showwarning", warnings.showwarning)
        patch.setattr(sys, "path", list(sys.path))
        patch.chdir(folder)
        flags = f"{OFF_POLICY} --learner.gamma 0.5 --delayed --frames 4e1"
        cli.main(f"train td3 Pendulum-v1 {flags}".split())
    return folder / "runs" / "td3-pendulum-v1-delayed-0"


def test_a_task_of_gymnasium_is_trained_to_a_number_of_frames(hosted):
    record = json.loads((hosted / "config.json").read_text())
    algorithm = Run(hosted).algorithm
    assert record["budget"] == {"generations": None, "frames": 40, "stop_at": None}
    assert record["algorithm"]["env"]["class"].endswith(":DelayedHostReward")
    assert (algorithm.env.env.id, algorithm.env.max_steps) == ("Pendulum-v1", 10)
    assert (algorithm.learner.gamma, algorithm.learner.batch_size) == (0.5, 4)
    assert Run(hosted).metrics["frames"].tolist() == [10, 20, 30, 40]


def test_it_is_resumed_evaluated_and_started_from(credo, hosted, tmp_path):
    shutil.copytree(hosted, tmp_path / "run")
    code, out, _ = credo(f"resume {tmp_path / 'run'} --frames 60")
    assert code == 0
    assert out.startswith(f"{tmp_path / 'run'}: generation 6, best fitness ")
    code, out, _ = credo(f"evaluate {hosted} --max-episode-steps 7")
    lines = out.splitlines()
    assert lines[0] == f"{hosted}: 20 fresh episodes, {MEAN}"
    assert lines[1].split()[0] == "reward"
    assert lines[2].split() == ["steps", "7.0"]
    words = f"train td3 Pendulum-v1 {OFF_POLICY} --frames 10 --from {hosted}"
    assert credo(f"{words} --path {tmp_path / 'warm'}")[0] == 0
    assert Run(tmp_path / "warm").config["warm_start"] == str(hosted)


def test_an_environment_that_fails_ends_in_one_line(credo, own_tasks, tmp_path, monkeypatch):
    monkeypatch.setattr("credo.cli.tasks.require_sound", lambda *_: None)  # it would be found out
    words = f"train td3 {own_tasks}:Crumbling {OFF_POLICY} --frames 1000 --path {tmp_path / 'run'}"
    code, out, err = credo(words)
    *_, last = err.splitlines()
    assert (code, out) == (1, "")
    assert last.startswith("credo: ")
    assert "its floor gave way" in last
    assert last.endswith(f"resume with `credo resume {tmp_path / 'run'}`")


TASK = """
    from typing import ClassVar
    import gymnasium
    import jax.numpy as jnp
    import numpy as np
    from credo.environments.probes import Copy
    from credo.types import TimeStep

    class Good(Copy):
        pass

    class Broken(Copy):
        def step(self, state, action, *, key):
            state, t = super().step(state, action, key=key)
            rewards = {name: r * jnp.nan for name, r in t.rewards.items()}
            return state, TimeStep(t.obs, rewards, t.terminated, t.truncated)

    class NeedsMore(Copy):
        shape: int
        def __init__(self, shape):
            self.shape = shape

    def swing(g: float = 10.0):
        return gymnasium.make("Pendulum-v1", g=g, max_episode_steps=9)

    class Crumbling(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)
        steps = 0

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(2, np.float32), {}

        def step(self, action):
            self.steps += 1
            if self.steps > 25:
                raise RuntimeError("its floor gave way")
            return np.zeros(2, np.float32), 0.0, False, False, {}
    """


@pytest.fixture
def own_tasks(tmp_path, monkeypatch):
    (tmp_path / "tasks_of_mine.py").write_text(textwrap.dedent(TASK))
    monkeypatch.chdir(tmp_path)
    yield "tasks_of_mine"
    sys.modules.pop("tasks_of_mine", None)


def test_a_package_that_registers_its_tasks_is_imported(credo, tmp_path, monkeypatch):
    """Gymnasium has no plug-ins: `package:Name-v0`, as in `gymnasium.make`."""
    text = """
        import gymnasium
        from gymnasium.envs.classic_control import PendulumEnv

        gymnasium.register("Swing/Mine-v3", lambda: PendulumEnv(), max_episode_steps=7)
    """
    (tmp_path / "registers_tasks.py").write_text(textwrap.dedent(text))
    monkeypatch.chdir(tmp_path)
    code, out, _ = credo("check", "registers_tasks:Swing/Mine-v3")
    assert (code, out) == (0, "registers_tasks:Swing/Mine-v3: 0 problems found\n")
    code, _, err = credo("check", "registers_nothing:Mine-v3")
    assert code == 2
    assert "cannot import 'registers_nothing:Mine-v3'" in err


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("import sys; sys.exit(0)", "mine_1.py:1 ends Python (exit code 0): put that under if"),
        ("def x(:", "mine_1.py:1: invalid syntax"),
        ("import os\nundefined", "mine_1.py:2 raised NameError: name 'undefined' is not defined"),
        ("import not_there", "No module named 'not_there'"),
        ("X = 3", "mine_1:X is no task"),
        ("def X():\n  1 / 0", "mine_1.py:2 raised ZeroDivisionError: division by zero"),
        ("def X():\n  return 3", "mine_1:X is no task"),
    ],
)
@pytest.mark.parametrize("command", ["check", "train ea"])
def test_a_module_that_cannot_be_used_is_a_failure(
    credo, tmp_path, monkeypatch, text, told, command
):
    (tmp_path / "mine_1.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine_1", raising=False)
    importlib.invalidate_caches()
    code, out, err = credo(f"{command} mine_1:X")
    assert (code, out) == (2, "")
    assert told in err
    assert len(err.splitlines()) == 1


def test_a_function_makes_a_task_with_the_settings_it_is_given(credo, own_tasks, tmp_path):
    task = f"{own_tasks}:swing"
    for given in ("--kwargs g=5.0", "--kwargs.g 5.0", "--kwargs g 5.0"):
        code, out, _ = credo(f"check {task} --in-process True {given}")
        assert (code, out) == (0, f"{task}: 0 problems found\n")
    code, _, err = credo(f"check {task} --in-process True --kwargs h=5")
    assert code == 2
    assert f"cannot use {task}: it raised TypeError: swing() got an unexpected" in err
    flags = "--population-size 3 --elite-fraction 0.4 --network.hidden 4 --generations 1"
    words = f"train ea {task} --kwargs g=5.0 --in-process True {flags} --test-episodes 1"
    assert credo(f"{words} --path {tmp_path / 'run'}")[0] == 0
    env = Run(tmp_path / "run").algorithm.env
    assert (env.id, env.kwargs, env.max_steps) == (task, (("g", 5.0),), 9)


def test_check_finds_nothing_wrong_with_a_good_task(credo, own_tasks):
    assert credo("check", f"{own_tasks}:Good") == (0, f"{own_tasks}:Good: 0 problems found\n", "")


def test_check_names_the_fault_of_a_broken_task(credo, own_tasks):
    code, out, _ = credo("check", f"{own_tasks}:Broken")
    *problems, last = out.splitlines()
    assert code == 1
    assert len(problems) >= 1
    assert any("NaN" in problem or "finite" in problem for problem in problems)
    assert last.startswith(f"{own_tasks}:Broken: {len(problems)} problem")


def test_a_gymnasium_class_of_ones_own_is_checked_with_its_flags(credo, own_tasks):
    code, out, _ = credo("check", f"{own_tasks}:Crumbling")
    assert code == 1
    assert "no time limit" in out
    words = f"train td3 {own_tasks}:Crumbling --frames 10"
    code, out, err = credo(words)
    assert (code, out) == (2, "")
    assert f"fix {own_tasks}:Crumbling before training" in err
    code, out, _ = credo(f"{words} {OFF_POLICY}")  # with --max-episode-steps
    assert code == 0
    assert out.startswith("runs/td3-crumbling-0: generation 1,")


def test_a_task_that_needs_arguments_is_refused(credo, own_tasks):
    code, _, err = credo("check", f"{own_tasks}:NeedsMore")
    assert code == 2
    assert "cannot be made without arguments" in err


def test_a_task_of_ones_own_is_trained_and_resumed(credo, own_tasks, tmp_path, monkeypatch):
    flags = "--population-size 4 --episodes 2 --test-episodes 2 --network mlp --tensorboard False"
    path = tmp_path / "run"
    words = f"train neuroevolution {own_tasks}:Good {flags} --generations 1 --path {path}"
    assert credo(words)[0] == 0
    record = json.loads((path / "config.json").read_text())
    assert record["algorithm"]["env"]["class"] == f"{own_tasks}:Good"
    code, out, _ = credo(f"resume {path} --generations 2")
    assert code == 0
    assert "generation 2," in out
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "somebody"))  # another user's key
    for command in ("resume", "evaluate", "watch"):
        code, out, err = credo(f"{command} {path}")
        assert (code, out) == (1, "")
        assert f"names {own_tasks}:Good, which is code of others" in err
        assert "--trust" in err
    assert credo(f"evaluate {path} --episodes 2 --trust")[0] == 0
    for command in ("report", "export"):  # they import nothing
        assert credo(f"{command} {path}")[0] == 0


@pytest.mark.parametrize(
    "words",
    [
        "sac Pendulum-v1 --hide velocities --network gru",
        "erl passive-tmaze --length 5 --network mmu",
    ],
)
def test_networks_with_memory_are_trained_go_on_and_are_exported(credo, tmp_path, words):
    """Those of learners are larger than those of evolution."""
    path, few = tmp_path / "run", "--start-frames" if "sac" in words else "--warmup-frames"
    how = f"--frames 420 {few} 200 --test-episodes 1 --replay-capacity 1000 --path {path}"
    code, _, err = credo(f"train {words} {how}")
    assert code == 0, err
    run = Run(path)
    assert run.metrics["updates"].any()
    assert run.algorithm.network.hidden == 64
    assert run.algorithm.env.obs_size == 2
    assert credo(f"resume {path} --frames 840")[0] == 0
    assert credo(f"evaluate {path} --episodes 1")[0] == 0
    code, _, err = credo(f"export {path} {tmp_path / 'policy.npz'}")
    assert code != 0
    assert "ends in .npz, and a policy is written as .safetensors" in err
    assert credo(f"export {path} {tmp_path / 'policy.safetensors'}")[0] == 0


def test_the_last_reward_is_told_as_it_is_paid(credo, tmp_path):
    path = tmp_path / "run"
    how = "--frames 200 --test-episodes 1 --network.hidden 4 --replay-capacity 1000"
    code, _, err = credo(
        f"train td3 Pendulum-v1 --delayed --last-step --hide 2 {how} --path {path}"
    )
    assert code == 0, err
    env = Run(path).algorithm.env
    kinds = [type(env).__name__, type(env.env).__name__, type(env.env.env).__name__]
    assert kinds == ["LastHostStep", "DelayedHostReward", "HiddenHostEntries"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("td3 Pendulum-v1 --hide velocities --kwargs g=9", "not known which observations of Pend"),
        ("td3 Pendulum-v1 --hide 7", r"hides entries \(7,\): there are 0 … 2"),
        ("td3 Pendulum-v1 --hide 0,1,2", "hides all 3 entries"),
        ("td3 Pendulum-v1 --hide x", "hide is 'x': give numbers of entries"),
        ("erl passive-tmaze --hide velocities", "not known which observations of PassiveTMaze"),
    ],
)
def test_what_cannot_be_hidden_is_said(credo, words, told):
    code, out, err = credo(f"train {words} --frames 60")
    assert (code, out) == (2, "")
    assert re.search(told, err.splitlines()[-1])


def test_a_run_that_ends_before_it_learns_is_mentioned(credo, tmp_path):
    words = "train td3 Pendulum-v1 --frames 250 --test-episodes 1 --network.hidden 4 --path"
    code, _, err = credo(*words.split(), str(tmp_path / "a"))
    assert code == 0
    assert "learning by gradient begins with the generation after 25,000 frames" in err
    assert "fewer --start-frames" in err
    assert f"credo: no gradient update was made in {tmp_path / 'a'}: learning by" in err
    _, _, err = credo(*words.split(), str(tmp_path / "b"), "--start-frames", "200")
    assert "nothing is learned" not in err
    assert "no gradient update" not in err


@pytest.mark.filterwarnings("ignore:.*names no time limit")
def test_a_task_is_checked_with_the_flags_it_is_given(credo, own_tasks):
    task = f"{own_tasks}:Crumbling"
    assert "its floor gave way" in credo("check", task)[1]
    code, out, _ = credo("check", task, "--max-episode-steps", "2")
    assert (code, out) == (0, f"{task}: 0 problems found\n")


def test_a_champion_of_another_network_is_refused_with_both(credo, tmp_path):
    words = "train ea Pendulum-v1 --generations 1 --population-size 3 --elite-fraction 0.4"
    assert credo(*words.split(), "--network.hidden", "4", "--path", str(tmp_path / "a"))[0] == 0
    code, _, err = credo(
        *words.split(), "--from", str(tmp_path / "a"), "--path", str(tmp_path / "b")
    )
    assert code == 1
    assert "give the same --preset or --network" in err
    assert "network.hidden: [4] != [128, 128]: give" in err
    assert "(left) is none of this run's policies (right)" in err


# Teams

MERL = (
    "--rovers 3 --coupling 2 --pois 2 --max-steps 4 --size 8 --network.trunk 4 "
    "--population-size 4 --elite-fraction 0.25 --episodes 2 --workers 2 --test-episodes 2 "
    "--warmup-frames 30 --replay-capacity 100 --migration-period 3 --fitness global "
    "--updates-per-frame 0.1 --tensorboard False"
)


def test_a_team_of_rovers_is_trained_with_the_flags_of_its_parts(credo, tmp_path):
    path = tmp_path / "run"
    code, out, err = credo(f"train merl rover {MERL} --generations 3 --seed 2 --path {path}")
    assert code == 0, err
    assert out.startswith(f"{path}: generation 3, best fitness ")
    run = Run(path)
    algorithm = run.algorithm
    assert type(algorithm) is load("algorithms.merl:MERL")
    env = algorithm.env
    assert (env.agents, env.coupling, env.pois, env.max_steps, env.size) == (3, 2, 2, 4, 8.0)
    assert (algorithm.network.trunk, algorithm.network.sharing) == ((4,), "trunk")
    assert (algorithm.population_size, algorithm.elites, algorithm.workers) == (4, 1, 2)
    assert (algorithm.migration_period, algorithm.fitness) == (3, "global")
    assert [learner.signal for learner in algorithm.learners] == ["local"]
    assert run.metrics["generation"].tolist() == [1, 2, 3]
    assert 0 < run.metrics["frames"][-1] <= 3 * (4 * 2 + 2) * 4
    assert run.metrics["updates"].max() > 0
    code, out, _ = credo(f"evaluate {path} --episodes 5")
    assert code == 0
    assert out.splitlines()[0] == f"{path}: 5 fresh episodes, {MEAN}"
    assert {"global", "local"} <= {line.split()[0] for line in out.splitlines()[1:]}
    code, out, _ = credo(f"resume {path} --generations 4")
    assert code == 0
    assert out.startswith(f"{path}: generation 4,")


def test_a_team_of_pettingzoo_is_trained_by_its_name(credo, tmp_path):
    pytest.importorskip("mpe2")
    path = tmp_path / "run"
    flags = (
        "--max-episode-steps 4 --network.trunk 4 --learner.critic.critic.hidden 4 "
        "--learner.batch-size 4 --learner.gamma 0.5 --episodes 2 --start-frames 5 "
        "--updates-per-frame 0.5 --test-episodes 1 --replay-capacity 50 --tensorboard False"
    )
    words = f"train matd3 mpe2.simple_spread_v3 {flags} --frames 16 --path {path}"
    code, out, err = credo(words)
    assert code == 0, err
    assert out.startswith(f"{path}: generation 2,")
    run = Run(path)
    assert (run.algorithm.env.id, run.algorithm.env.agents) == ("mpe2.simple_spread_v3", 3)
    learner = run.algorithm.learner
    assert (learner.together, learner.critics, learner.gamma) == (True, 2, 0.5)
    assert learner.critic.critic.hidden == (4,)
    assert run.metrics["frames"].tolist() == [8, 16]
    assert run.metrics["updates"].tolist() == [4, 4]
    assert run.metrics["champion_score"][-1] < 0.0  # minus the distances to the landmarks


def test_each_agent_of_a_team_has_a_network_of_its_own():
    network = lambda *given: train._network(Line("train", []), *given)  # noqa: E731
    expected = Team(trunk=(), head=MLP(), sharing="nothing")
    assert network("mlp", "neuroevolution", Meet()) == expected
    assert network("cnf", "merl", Meet()) == load("networks.team:Centralized")()
    assert network("mlp", "ccea", Meet()) == MLP()  # it has one per population
    assert network("mlp", "neuroevolution", Remember()) == MLP()
    assert network(None, "merl", Meet()) is None


@pytest.mark.parametrize("words", ["ppo", "merl", "merl --network mlp", "neuroevolution"])
def test_agents_of_a_kind_may_share_in_any_algorithm(words, monkeypatch):
    """Who is of a kind only the task knows: a network is fitted before an algorithm refuses it."""
    pytest.importorskip("pettingzoo")
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1] / "environments"))
    word, *others = words.split()
    line = Line("train", [word, "barred:Team", *others, "--network.sharing", "groups"])
    network = train.algorithm_of(line, line.command(train.Train)).network
    assert network.network.groups == (0, 1)


def test_settings_files_of_before_are_read(credo, tmp_path):
    """They name what is within a network that chooses by both, and what follows from the task."""
    file = tmp_path / "old.toml"
    file.write_text(
        '"algorithm" = "dqn"\n"task" = "CartPole-v1"\n"network.network.hidden" = [32]\n'
        '"network.choices" = [2]\n"network.masked" = false\n"in-process" = true\n'
    )
    code, out, err = credo(f"train --config {file} --print-config")
    assert code == 0, err
    assert '"network.hidden" = [32]' in out
    assert "--network.network" in credo("train dqn CartPole-v1 --network.network.hidden 3")[2]


def test_units_of_a_centralized_network_have_a_short_name():
    line = Line("train", ["neuroevolution", "rover", "--network", "cnf", "--hidden", "32"])
    network = train.algorithm_of(line, line.command(train.Train)).network
    assert network.network.hidden == (32,)


def test_cerl_trains_a_team(monkeypatch):
    pytest.importorskip("pettingzoo")
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1] / "environments"))
    line = Line("train", ["cerl", "barred:Team"])
    made = train.algorithm_of(line, line.command(train.Train))
    assert made.network == Choosing(Team(), (3,), masked=True)


def test_a_team_of_ones_own_is_given_its_time_limit(credo, tmp_path, monkeypatch):
    pytest.importorskip("pettingzoo")
    monkeypatch.syspath_prepend(str(pathlib.Path(__file__).parents[1] / "environments"))
    path = tmp_path / "run"
    flags = (
        "--population-size 5 --elite-fraction 0.2 --episodes 1 --workers 1 --network.trunk 4 "
        "--learners.0.batch-size 4 --warmup-frames 1000 --replay-capacity 50 --tensorboard False"
    )
    words = f"train merl broken_team:Pair --max-episode-steps=4 {flags} --generations 1"
    code, _, err = credo(f"{words} --path {path}")
    assert code == 0, err
    assert Run(path).algorithm.env.max_episode_steps == 4
    code, _, err = credo(f"train merl broken_team:Pair {flags} --path {tmp_path / 'other'}")
    assert code != 0
    assert "--max-episode-steps 1000, say" in err


def test_list_shows_what_teams_need(credo):
    out = credo("list")[1]
    for name in ("merl", "matd3", "maddpg", "rover", "simple-spread", "fig-7.1", "fig-7.4"):
        assert f"\n  {name} " in out
    assert "mpe2.simple_spread_v3" in credo("list tasks")[1]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("train sac rover", "Rover has 6 agents: SAC cannot learn that. Teams learn by TD3"),
        ("train neuroevolution Pendulum-v1 --network dmmu", "DMMU acts for a team and Pendulum-v1"),
        ("train CartPole-v1 dqn", "the algorithm comes first: credo train dqn CartPole-v1"),
        ("train matd3 Pendulum-v1", "trains teams and Pendulum-v1 has one agent"),
        ("train matd3 Pendulum-v1 --network mlp", "one agent"),
        ("train merl Pendulum-v1", "trains teams and Pendulum-v1 has one agent"),
        ("train merl rover --coupling 0", "coupling"),
        ("train merl rover --fitness fun", "no reward signal 'fun': this task has global, local"),
        ("train mrl rover", "did you mean 'merl'?"),
        ("train merl rovr", "did you mean 'rover'?"),
    ],
)
def test_a_task_and_an_algorithm_that_do_not_go_together(credo, words, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = credo(f"{words} --frames 1")
    assert (code, out) == (2, "")
    assert told in err.splitlines()[-1]
    assert err.startswith("credo: ")
    assert list(tmp_path.iterdir()) == []  # nothing was begun


def test_ctrl_c_ends_a_command_without_taking_python_apart():
    """jaxlib, interrupted while it is imported, crashed there: exit code -11 in place of 130."""
    script = (
        "import atexit, sys\nfrom credo import cli\n"
        "atexit.register(lambda: print('taken apart'))\n"
        "def stop(argv):\n    print('begun')\n    raise KeyboardInterrupt\n"
        "from credo.cli import commands\ncommands.List.__call__ = staticmethod(stop)\n"
        "sys.argv = ['credo', 'list']\ncli.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "begun\n", "credo: stopped\n")


EXTRAS = "pettingzoo,mpe2,mujoco,imageio_ffmpeg,tensorboardX,wandb,trackio,shtab,sphinx"
WITHOUT = """
import sys
for name in sys.argv[1].split(","):
    sys.modules[name] = None
from credo.cli import main
main(sys.argv[2:])
"""


@pytest.mark.parametrize(
    "words",
    [
        "train erl --help",
        "train merl rover --help-all",
        "train neuroevolution sequence-recall --generations 1 --population-size 10 --path run",
        "check sequence-recall",
        "list tasks",
        "list",
    ],
)
def test_the_base_install_is_enough(words, tmp_path):
    """None of the extras can be imported here."""
    told = subprocess.run(
        [sys.executable, "-c", WITHOUT, EXTRAS, *words.split()],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert (told.returncode, told.stderr.count("Traceback")) == (0, 0), told.stderr


def test_a_hybrid_whose_learners_never_joined_says_so(credo, tmp_path):
    short = "--warmup-frames 1 --updates-per-frame 0.05 --population-size 4 --elite-fraction 0.25"
    short += " --replay-capacity 2000 --batch-size 8"
    told = "is evolution alone: its learners join the population every 2 generations"
    for generations, said in ((2, True), (3, False)):
        words = f"train erl Pendulum-v1 --generations {generations} --sync-period 2 {short}"
        code, _, err = credo(f"{words} --path {tmp_path / str(generations)}")
        assert (code, told in err) == (0, said), err


def test_evaluate_says_how_far_memory_reaches(credo, run):
    code, out, _ = credo(f"evaluate {run} --episodes 10 --horizon 1,3")
    assert code == 0
    first, once, thrice = out.splitlines()
    assert first.endswith("success in 10 fresh episodes of each")
    assert re.match(r"  × 1 +[\d.]+ ± [\d.]+ +depth 2$", once)
    assert re.match(r"  × 3 +[\d.]+( ± [\d.]+)? +depth 6$", thrice)
    assert "horizon is 0: it must be at least 1" in credo(f"evaluate {run} --horizon 0")[2]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("neat sequence-recall --network lstm", "topology of its networks (--cells"),
        ("neat sequence-recall --preset ours", "neat has no presets"),
        ("neat sequence-recall --from run", "neat cannot start from another run's champion: erl,"),
        ("neuroevolution sequence-recall --from run", "ppo, merl, matd3, maddpg can"),
    ],
)
def test_flags_that_an_algorithm_has_no_use_for_are_refused_and_not_shown(credo, given, told):
    code, _, err = credo(f"train {given}")
    assert code == 2
    assert told in err
    algorithm, task, flag, _ = given.split()
    for help in ("--help", "--help-all"):
        assert f"\n  {flag} " not in credo(f"train {algorithm} {task} {help}")[1]
    assert "\n  --from " in credo("train td3 Pendulum-v1 --help-all")[1]


def test_a_task_without_a_horizon_says_so(credo, tmp_path):
    path = tmp_path / "poles"
    credo(f"train neuroevolution double-pole --network mmu --generations 1 --path {path}")
    code, _, err = credo(f"evaluate {path} --horizon")
    assert code == 2
    assert "DoublePole has no setting that says for how long" in err


def test_a_run_that_ends_before_its_task_begins_says_so(credo, tmp_path):
    words = "train neuroevolution sequence-recall --depth 1 --network mmu --population-size 4"
    words += " --infomax infomax --infomax.generations 2 --infomax.episodes 4"
    told = "was evolved for what its memory knows alone, and not for its task"
    code, _, err = credo(f"{words} --generations 2 --path {tmp_path / 'c'}")
    assert code == 2
    assert "infomax.generations is 2 of a run of 2" in err
    assert "give 3 generations or more" in err
    assert not (tmp_path / "c").exists()
    # How many generations a budget of frames has is not known before.
    assert told in credo(f"{words} --frames 1 --path {tmp_path / 'a'}")[2]
    assert told not in credo(f"{words} --generations 3 --path {tmp_path / 'b'}")[2]
    again = f"resume {tmp_path / 'b'} --generations 5 --set infomax.generations="
    code, _, err = credo(f"{again}4")
    assert code == 1
    assert "would end the task at generation 3" in err
    assert credo(f"{again}3")[0] == 0
