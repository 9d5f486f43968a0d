"""The page about runs: seeds together, settings apart, scores beside baseline and upper bound."""

import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.algorithms.bptt import BPTT
from credo.algorithms.ccea import CCEA
from credo.algorithms.erl import ERL
from credo.algorithms.merl import MERL
from credo.algorithms.neat import NEAT
from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.algorithms.ppo import PPO
from credo.analysis import bounds
from credo.environments.extended_tmaze import ExtendedTMaze
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy
from credo.environments.rover import Rover
from credo.environments.sequence_classification import SequenceClassification
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.report import run_page as report
from credo.report.sections import Page
from credo.runs import config, evaluation, files, log
from credo.runs.loop import train
from credo.runs.record import RunError
from credo.runs.store import Run
from credo.types import Evaluation

TASK = SequenceClassification(depth=2, min_gap=1, max_gap=2)
ALGORITHM = Neuroevolution(TASK, MMU(hidden=3), population_size=10, episodes=4, test_episodes=6)


def fake(path, algorithm, seed, scores, frames=None):
    """A run with these scores, without the training. `frames`: of its first generation."""
    path.mkdir(parents=True)
    record = {"algorithm": config.to_tree(algorithm), "seed": seed, "machine": config.machine()}
    record |= {"budget": {"frames": 1000}} if frames else {}
    files.write_json(path / "config.json", record)
    rows = [
        {
            "generation": g + 1,
            "frames": (frames or 0) + 10 * g,
            "champion_score": s,
            "fitness_max": 2.0 * s,
        }
        for g, s in enumerate(scores)
    ]
    log.Log(path, 0).append(rows, 1.0, 1.0)
    return path


@pytest.fixture
def page_of(monkeypatch, tmp_path):
    """The `Page` that `report.write` hands over to be rendered."""
    pages = []
    monkeypatch.setattr(report, "write_page", lambda page, target: pages.append(page))

    def of(*paths, **options) -> Page:
        report.write(list(paths), tmp_path / "page.html", **options)
        return pages[-1]

    return of


def test_seeds_are_one_curve_and_settings_are_two(page_of, tmp_path):
    wider = Neuroevolution(TASK, MMU(hidden=4), population_size=10, episodes=4, test_episodes=6)
    page = page_of(
        fake(tmp_path / "a", ALGORITHM, 0, [0.0, 0.25, 0.5]),
        fake(tmp_path / "b", ALGORITHM, 1, [0.5, 0.75]),  # still running
        fake(tmp_path / "c", wider, 0, [1.0, 1.0, 1.0]),
    )
    scores, fitness, table, few, every = page.sections
    narrow, wide = "neuroevolution: hidden 3", "neuroevolution: hidden 4"
    assert [curve.label for curve in scores.curves] == [narrow, wide]
    np.testing.assert_array_equal(scores.curves[0].runs, [[0.0, 0.25], [0.5, 0.75]])
    np.testing.assert_array_equal(scores.curves[0].x, [1, 2])
    np.testing.assert_array_equal(fitness.curves[1].runs, [[2.0, 2.0, 2.0]])
    assert [(r.label.split(":")[0], r.value) for r in scores.references] == [
        ("baseline", pytest.approx(0.75)),
        ("upper bound", 1.0),
    ]
    assert table.columns == [
        *("algorithm", "champion", "baseline", "upper bound", "seeds", "generations")
    ]
    # The last generation of each run: 0.5 and 0.75.
    name, score, baseline, bound, seeds, generations = table.rows[0]
    assert (name, bound, seeds, generations) == (narrow, 1.0, 2, 2)
    assert (score.values, score.seeds) == ([0.5, 0.75], [0, 1])
    assert baseline.startswith("0.750 (")
    assert table.rows[1][1].values == [1.0]
    assert few.rows == [["network.hidden", "3", "4"]]
    assert every.folded
    assert [every.rows[i] for i in every.marked] == few.rows
    assert len(every.rows) > 10
    assert page.facts["seeds"] == [f"{narrow}: 0, 1", f"{wide}: 0"]
    assert page.command == f"credo report {tmp_path / 'a'} {tmp_path / 'b'} {tmp_path / 'c'}"


def test_algorithms_are_called_what_the_command_calls_them():
    task, team = Copy(), Rover()
    made = {
        **{name: ERL.presets()[name](task) for name in ("ea", "erl", "cerl")},
        **{name: OffPolicy.presets()[name](task) for name in ("td3", "ddpg", "sac")},
        **{name: OffPolicy.presets()[name](team) for name in ("matd3", "maddpg")},
        "merl": MERL(team),
        "ccea": CCEA.ccea(team),
        "neuroevolution": ALGORITHM,
        "ppo": PPO.ppo(task),
        "neat": NEAT(task),
        "bptt": BPTT(TASK),
    }
    trees = {name: config.to_tree(algorithm) for name, algorithm in made.items()}
    assert {name: report.word(tree) for name, tree in trees.items()} == {n: n for n in made}
    assert report.group_labels(list(trees.values())) == list(made)
    assert report.word(config.to_tree(OffPolicy.td3(team))) == "td3"
    assert report.word({"class": "mine.tools:MySearch"}) == "MySearch"


def test_labels_have_the_fewest_fields_that_tell_settings_apart():
    def labels(*algorithms):
        return report.group_labels([config.to_tree(algorithm) for algorithm in algorithms])

    task = Copy()
    rates = [OffPolicy.td3(task, learner=TD3(actor_lr=rate)) for rate in (1e-4, 1e-3)]
    assert labels(ERL.erl(task), *rates) == ["erl", "td3: actor_lr 0.0001", "td3: actor_lr 0.001"]
    # Sizes alone would do; with two values each it takes two fields.
    four = [
        ERL.erl(task, population_size=size, episodes=episodes)
        for size in (10, 20)
        for episodes in (1, 2)
    ]
    assert labels(*four)[0] == "erl: population_size 10, episodes 1"
    assert len(set(labels(*four))) == 4


def test_groups_that_three_fields_cannot_tell_apart_are_numbered():
    tree = {"class": "credo.algorithms.erl:ERL", "learners": [], **dict.fromkeys("abcd", 0)}
    labels = report.group_labels([tree, *({**tree, name: 1} for name in "abcd")])
    assert len(set(labels)) == 5
    assert sum(label.endswith("(2)") for label in labels) == 1
    assert all(label.count(",") <= 2 for label in labels)


def test_a_reader_may_give_labels(page_of, tmp_path, monkeypatch):
    wider = Neuroevolution(TASK, MMU(hidden=4), population_size=10, episodes=4, test_episodes=6)
    paths = [fake(tmp_path / "a", ALGORITHM, 0, [0.5]), fake(tmp_path / "b", wider, 0, [0.5])]
    page = page_of(*paths, labels=["narrow", "wide"])
    assert [curve.label for curve in page.sections[0].curves] == ["narrow", "wide"]
    for labels in (["narrow"], ["same", "same"]):
        with pytest.raises(RunError, match=r"for 2 curves: give one for each of neuroevolution: h"):
            page_of(*paths, labels=labels)


def test_a_task_without_a_known_baseline_says_so(page_of, tmp_path):
    algorithm = Neuroevolution(Copy(), MMU(hidden=3), test_episodes=6)
    page = page_of(fake(tmp_path / "a", algorithm, 0, [0.0, 0.5]))
    assert page.sections[0].references == ()
    assert page.sections[2].columns == ["algorithm", "champion", "seeds", "generations"]
    assert "No baseline and no upper bound of this task are known." in page.sections[2].caption
    assert page.lead == f"Task: {config.brief(config.to_tree(Copy()))}."


def test_a_run_of_one_generation_is_a_point_on_the_frames_axis(page_of, tmp_path):
    paths = [
        fake(tmp_path / str(seed), ALGORITHM, seed, [score], frames=100 + seed)
        for seed, score in enumerate((0.25, 0.75))
    ]
    curve = page_of(*paths).sections[0].curves[0]
    assert curve.x[-1] == 101
    assert [runs[-1] for runs in curve.runs] == [0.25, 0.75]


def test_the_page_of_a_stranger_s_run_imports_nothing(page_of, tmp_path, monkeypatch):
    (tmp_path / "strange_1.py").write_text("open('executed', 'w')\nclass Task:\n    pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    named = config.to_tree(Neuroevolution(Copy(), MMU(hidden=3), test_episodes=6))
    hosted = named | {"env": config.to_tree(Gymnasium("strange_1:Task"))}
    own = named | {"env": {"class": "strange_1:Task"}, "network": {"class": "strange_1:Task"}}
    monkeypatch.setattr(config, "to_tree", lambda tree: tree)
    for name, algorithm in {"hosted": hosted, "own": own}.items():
        page = page_of(fake(tmp_path / name, algorithm, 0, [0.0, 0.5]))
        assert "Task" in page.lead
        assert page.sections[2].rows[0][1].values == [0.5]
    assert not (tmp_path / "executed").exists()


def test_a_run_without_a_generation_is_refused(tmp_path):
    path = fake(tmp_path / "a", ALGORITHM, 0, [0.5])
    (path / "metrics.csv").unlink()
    with pytest.raises(RunError, match="has no generation yet"):
        report.write([path], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_what_is_not_a_run_is_refused(tmp_path):
    with pytest.raises(RunError, match="is not a run"):
        report.write([tmp_path], tmp_path / "page.html")


def test_the_page_is_written_and_holds_the_numbers(tmp_path):
    path = fake(tmp_path / "a", ALGORITHM, 5, [0.125, 0.5])
    target = report.write([path], tmp_path / "deep" / "er" / "page.html")
    page = target.read_text()
    assert target == tmp_path / "deep" / "er" / "page.html"
    assert "0.500" in page
    assert "neuroevolution: 5" in page
    assert page.count("<svg") >= 2


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    path = tmp_path_factory.mktemp("report") / "run"
    return train(ALGORITHM, generations=2, path=path, tensorboard=False, progress=False)


def test_a_champion_is_described_by_every_signal_of_its_task(run):
    lines = evaluation.describe(run, TASK, 50, 0)[0]
    assert lines[0] == f"{run.path}: 50 fresh episodes, mean ± standard error over episodes"
    names = [line.split()[0] for line in lines[1:]]
    assert names == [*TASK.signals, "steps", "baseline", "upper"]
    success = float(lines[3].split()[1])
    assert 50 * success == pytest.approx(round(50 * success))
    assert lines == evaluation.describe(run, TASK, 50, 0)[0]
    assert "baseline         0.75 (" in lines[-2]
    assert lines[-1] == "  upper bound      1"


def test_one_episode_has_no_standard_error(run):
    assert "±" not in evaluation.describe(run, TASK, 1, 0)[0][1]


def test_deep_sequences_are_streamed(run):
    deep = SequenceClassification(depth=evaluation.STREAMED + 1, min_gap=1, max_gap=2)
    lines = evaluation.describe(run, deep, 50, 0)[0]
    assert lines[0] == f"{run.path}: 20 streams of 1,001 signals"
    assert len(lines) == 3
    assert json.loads(lines[1].split()[-1]) in [i / 20 for i in range(21)]


def test_many_episodes_outside_jax_are_played_in_turn(monkeypatch):
    """A simulator for each of a thousand episodes would fill the memory."""
    asked = []
    copies = Gymnasium.copies
    monkeypatch.setattr(Gymnasium, "copies", lambda self, n: asked.append(n) or copies(self, n))
    task = Gymnasium("InvertedPendulum-v5", in_process=True)
    policies = tree.stack(MLP(hidden=()).init(4, 1, key=jax.random.key(0)))
    played = evaluation.in_turn(task, policies, 45, key=jax.random.key(1))
    assert asked == [20, 20, 20]
    assert played.steps.shape == played.returns["reward"].shape == (1, 45)
    returns = np.asarray(played.returns["reward"])
    assert not np.array_equal(returns[:, :20], returns[:, 20:40])
    again = evaluation.in_turn(task, policies, 30, key=jax.random.key(1))
    np.testing.assert_array_equal(again.returns["reward"], played.returns["reward"][:, :30])


def test_agents_of_one_episode_are_one_value_of_its_team():
    """Returns of two episodes: 1, 3, 5 and 7, 9, 11. The team's means are 3 and 9."""
    score = evaluation._score(np.array([[1.0, 3.0, 5.0], [7.0, 9.0, 11.0]]))
    assert (score.mean, score.agents) == (6.0, (4.0, 6.0, 8.0))
    assert score.error == pytest.approx(3.0)  # std 4.243 over the root of 2 episodes


def test_failed_episodes_are_left_out_and_counted(run, monkeypatch):
    nan = float("nan")
    returns = {"team": jnp.array([[1.0, nan, 3.0]]), "own": jnp.array([[[1.0, 2.0]] * 3])}
    played = Evaluation(returns, jnp.array([[4, 9, 6]]))
    monkeypatch.setattr(evaluation, "in_turn", lambda *_, **__: played)
    task = types.SimpleNamespace(signals=("team", "own"))
    lines, result = evaluation.describe(run, task, 3, 0)
    assert (result.episodes, result.failed, result.steps) == (2, 1, 5.0)
    assert lines == [
        f"{run.path}: 2 fresh episodes, mean ± standard error over episodes",
        "  1 of 3 episodes failed and are left out",
        "  team             2 ± 1",
        "  own              1.5 ± 0 (mean of 2 agents)",
        "    agent 0        1",
        "    agent 1        2",
        "  steps            5.0",
    ]


def test_a_page_about_a_strangers_run_imports_nothing(page_of, tmp_path, monkeypatch):
    """Its task is Credo's, and a field of the task is a class of a module that leaves a mark."""
    (tmp_path / "payload_1.py").write_text(f"open({str(tmp_path / 'mark')!r}, 'w')\nclass X: ...")
    monkeypatch.syspath_prepend(tmp_path)
    run = fake(tmp_path / "run", ALGORITHM, 0, [0.5, 0.7])
    record = json.loads((run / "config.json").read_text())
    record["algorithm"]["env"]["depth"] = {"class": "payload_1:X"}
    files.write_json(run / "config.json", record)
    assert page_of(run).sections
    assert not (tmp_path / "mark").exists()


def test_bounds_are_of_the_task_itself_and_of_none_that_derives_from_it():
    class Mine(SequenceClassification):
        """May pay other rewards."""

    assert bounds.exact(SequenceClassification(depth=2))
    assert not bounds.exact(Mine(depth=2))
    assert not bounds.exact(ExtendedTMaze(depth=2, robots=2, objective="converge"))
    assert bounds.exact(ExtendedTMaze(depth=2, robots=2, partner=None))
    assert not bounds.exact(None)
