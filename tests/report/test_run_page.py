"""The page about runs: seeds together, settings apart, scores beside floor and ceiling."""

import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.report import run_page as report
from credo.report.page import Page
from credo.runs import config, evaluation, log
from credo.runs.loop import Run, RunError, train
from credo.types import Evaluation

TASK = SequenceClassification(depth=2, min_gap=1, max_gap=2)
ALGORITHM = Neuroevolution(TASK, MMU(hidden=3), population_size=10, episodes=4, test_episodes=6)


def fake(path, algorithm, seed, scores):
    """A run with these scores, without the training."""
    path.mkdir(parents=True)
    record = {"algorithm": config.to_tree(algorithm), "seed": seed, "machine": config.machine()}
    config.write_json(path / "config.json", record)
    rows = [
        {"generation": g + 1, "frames": 10 * g, "champion_score": s, "fitness_max": 2.0 * s}
        for g, s in enumerate(scores)
    ]
    log.Log(path, 0, tensorboard=False).append(rows, 1.0, 1.0)
    return path


@pytest.fixture
def page_of(monkeypatch, tmp_path):
    """The `Page` that `report.write` hands over to be rendered."""
    pages = []
    monkeypatch.setattr(report, "write_page", lambda page, target: pages.append(page))

    def of(*paths) -> Page:
        report.write(list(paths), tmp_path / "page.html")
        return pages[-1]

    return of


def test_seeds_are_one_curve_and_settings_are_two(page_of, tmp_path):
    wider = Neuroevolution(TASK, MMU(hidden=4), population_size=10, episodes=4, test_episodes=6)
    page = page_of(
        fake(tmp_path / "a", ALGORITHM, 0, [0.0, 0.25, 0.5]),
        fake(tmp_path / "b", ALGORITHM, 1, [0.5, 0.75]),  # still running
        fake(tmp_path / "c", wider, 0, [1.0, 1.0, 1.0]),
    )
    scores, fitness, table, settings = page.sections
    narrow, wide = "Neuroevolution: network.hidden 3", "Neuroevolution: network.hidden 4"
    assert [curve.label for curve in scores.curves] == [narrow, wide]
    np.testing.assert_array_equal(scores.curves[0].runs, [[0.0, 0.25], [0.5, 0.75]])
    np.testing.assert_array_equal(scores.curves[0].x, [1, 2])
    np.testing.assert_array_equal(fitness.curves[1].runs, [[2.0, 2.0, 2.0]])
    assert [(r.label.split(":")[0], r.value) for r in scores.references] == [
        ("floor", pytest.approx(0.75)),
        ("ceiling", 1.0),
    ]
    # The last generation of each run: 0.5 and 0.75.
    assert table.rows[0][:3] == [narrow, "2", "2"]
    assert table.rows[0][4:6] == ["0.625 ± 0.125", "0.625"]
    assert table.rows[1][4:6] == ["1.000", "1.000"]
    assert ["network.hidden", "3", "4"] in settings.rows
    assert page.facts["seeds"] == f"{narrow}: 0, 1; {wide}: 0"
    assert page.command == f"credo report {tmp_path / 'a'} {tmp_path / 'b'} {tmp_path / 'c'}"


def test_groups_that_the_first_fields_cannot_tell_apart_stay_apart(page_of, tmp_path):
    def variant(depth, size, elites, episodes):
        task = SequenceClassification(depth, 1, 2)
        given = {"population_size": size, "elite_fraction": elites, "episodes": episodes}
        return Neuroevolution.as_written(task, MMU(hidden=3), **given, test_episodes=6)

    settings = [(2, 10, 0.1, 4), (2, 10, 0.1, 5), (3, 20, 0.2, 6)]
    page = page_of(
        *(
            fake(tmp_path / str(i), variant(*values), 0, [i / 4, i / 4])
            for i, values in enumerate(settings)
        )
    )
    table = page.sections[2].rows
    assert [row[4] for row in table] == ["0.000", "0.250", "0.500"]
    assert len({row[0] for row in table}) == 3
    assert "episodes 5" in table[1][0]


def test_a_task_without_a_known_floor_says_so(page_of, tmp_path):
    algorithm = Neuroevolution(Copy(), MMU(hidden=3), test_episodes=6)
    page = page_of(fake(tmp_path / "a", algorithm, 0, [0.0, 0.5]))
    assert page.sections[0].references == ()
    assert page.sections[2].rows[0][3] == page.sections[2].rows[0][6] == "not known"
    assert page.lead == f"Task: {config.brief(config.to_tree(Copy()))}."


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
        assert page.sections[2].rows[0][4] == "0.500"
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
    assert "Neuroevolution: 5" in page
    assert page.count("<svg") >= 2


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    path = tmp_path_factory.mktemp("report") / "run"
    return train(ALGORITHM, generations=2, path=path, tensorboard=False, progress=False)


def test_a_champion_is_described_by_every_signal_of_its_task(run):
    lines = evaluation.describe(run, TASK, 50, 0)[0]
    assert lines[0] == f"{run.path}: 50 fresh episodes, mean ± standard error over episodes"
    names = [line.split()[0] for line in lines[1:]]
    assert names == [*TASK.signals, "steps", "floor"]
    success = float(lines[3].split()[1])
    assert 50 * success == pytest.approx(round(50 * success))
    assert lines == evaluation.describe(run, TASK, 50, 0)[0]
    assert "floor            0.75 (" in lines[-1]
    assert lines[-1].endswith("ceiling 1")


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
