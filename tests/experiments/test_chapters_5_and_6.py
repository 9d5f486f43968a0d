"""Experiments on MuJoCo, on runs made up: folders with metrics whose answer is known."""

import importlib
import json
from html import escape

import jax
import numpy as np
import pytest

from credo import tree
from credo.algorithms.erl import ERL
from credo.algorithms.off_policy import OffPolicy
from credo.environments.gymnasium import Gymnasium
from credo.environments.wrappers import DelayedHostReward
from credo.experiments import base, chapter5, chapter6, check_td3, fig_5_2, note_5_5, table_5_2
from credo.learners.manager import UCB
from credo.learners.sac import SAC
from credo.learners.td3 import ddpg
from credo.report import run_page as report
from credo.report.pages import render
from credo.report.sections import Page
from credo.rollout import evaluate
from credo.runs import checkpoint, config, log
from credo.runs.store import Run

OTHERS = ("3.", "3", "4.", "4", "7.", "7", "sp")  # chapters 3, 4 and 7
NAMES = [name for name in base.MODULES if name.partition("-")[2][:2] not in OTHERS]
GENERATIONS, FRAMES = 20, 100  # per generation


def experiment(name):
    return importlib.import_module(f"credo.experiments.{base.MODULES[name]}")


def cell_named(name, budget="full"):
    having = [experiment(x) for x in NAMES if budget in base.budgets(x)]
    return {cell.name: cell for module in having for cell in module.cells(budget)}[name]


def fake(path, algorithm, seed, speed=1.0, **columns):
    """A run of this algorithm that was never trained: the champion is the first draw."""
    path.mkdir(parents=True)
    record = {"algorithm": config.to_tree(algorithm), "seed": seed, "machine": config.machine()}
    config.write_json(path / "config.json", record | {"budget": {"frames": 1}})
    g = np.arange(1, GENERATIONS + 1)
    table = {"frames": FRAMES * g, "champion_score": 10.0 * g + seed, "fitness_max": 1.0 * g}
    table["updates"] = np.full(GENERATIONS, FRAMES if getattr(algorithm, "learners", True) else 0)
    if isinstance(algorithm, ERL):
        table |= {"episodes": 11 * g, "champion_maker": g % 5}
        for i in range(len(algorithm.learners)):
            table |= {f"workers_{i}": np.full(GENERATIONS, 1 + i), f"elite_{i}": g % 2 == 0}
            table |= {f"selected_{i}": g % 4 == 1, f"discarded_{i}": g % 4 == 3}
            table[f"champion_share_{i}"] = np.full(GENERATIONS, 0.2)
    table |= columns
    journal = log.Log(path, 0, tensorboard=False)
    for k in range(GENERATIONS):
        row = {"generation": k + 1} | {name: column[k].item() for name, column in table.items()}
        journal.append([row], 1.0, 5.0 + k / speed)
    state = algorithm.init(key=jax.random.key(seed))
    metadata = {"generation": str(GENERATIONS)}
    checkpoint.export_policy(path / "champion.safetensors", state.champion, metadata)
    return Run(path)


@pytest.fixture(scope="session")
def runs_of(tmp_path_factory):
    """Two made-up runs of a cell; cells of one name share them."""
    folder, made = tmp_path_factory.mktemp("cells"), {}

    def of(cell):
        if cell.name not in made:
            made[cell.name] = [fake(folder / cell.name / str(s), cell.algorithm, s) for s in (0, 1)]
        return made[cell.name]

    return of


# ------------------------------------------------------------------------------------------ cells


@pytest.mark.parametrize("name", NAMES)
def test_cells_are_named_by_their_task_and_have_a_budget(name):
    for budget in base.budgets(name):
        cells = experiment(name).cells(budget)
        assert len({cell.name for cell in cells}) == len(cells)
        for cell in cells:
            assert cell.name.removesuffix(" delayed").endswith(
                f" {chapter5.task_of(cell.algorithm.env)}"
            )
            assert cell.frames >= 500
            assert cell.runs >= 2
            assert config.from_tree(config.to_tree(cell.algorithm)) == cell.algorithm


def test_the_check_of_td3_is_td3_as_it_comes():
    for task in ("Hopper-v5", "HalfCheetah-v5"):
        cell = cell_named(f"td3 {task}")
        assert cell.algorithm == OffPolicy.td3(Gymnasium(task))
        assert (cell.runs, list(base.seeds(cell))) == (3, [0, 1, 2])
        limits = {"generations": None, "frames": 300_000, "stop_at": None}
        assert base.limits(cell) == limits


def test_the_double_pendulum_is_played_both_ways():
    name = "InvertedDoublePendulum-v5"
    cells = {cell.name: cell for cell in fig_5_2.cells("full")}
    kinds = ("erl", "erl ours", "ddpg", "ea")
    standard = [f"{kind} {name}" for kind in kinds]
    spread = f"ddpg spread {name} delayed"
    assert [label for label in cells if label != spread] == standard + [
        f"{label} delayed" for label in standard
    ]
    task = DelayedHostReward(Gymnasium(name))
    alone = OffPolicy.ddpg(task, test_episodes=100, redistribute=True)
    assert cells[spread].algorithm == alone
    assert cells[f"erl {name}"].algorithm == ERL.erl(Gymnasium(name), test_episodes=100)
    hard = cells[f"ddpg {name} delayed"].algorithm
    assert hard == OffPolicy.ddpg(task, test_episodes=100)
    assert all(cell.stop_at == 9200 and cell.runs == 3 for cell in cells.values())
    # Within the episodes that were published to be needed.
    assert 9_900 < cells[f"erl {name} delayed"].generations * 11 <= 10_000
    assert cells[f"ea {name} delayed"].generations * 10 >= 25_000


def test_erl_has_its_column_of_table_5_1():
    cell = cell_named("erl Hopper-v5")
    assert cell.algorithm == ERL.erl(Gymnasium("Hopper-v5"))
    assert (cell.algorithm.elites, cell.algorithm.episodes) == (3, 5)
    assert (cell.frames, cell.runs) == (300_000, 2)
    assert cell_named("erl Ant-v5", "published").frames == 6_000_000


def test_portfolios_differ_in_what_the_figures_say():
    cell = cell_named("cerl Swimmer-v5")
    assert [learner.gamma for learner in cell.algorithm.learners] == [0.9, 0.99, 0.997, 0.9995]
    assert cell.algorithm.manager == UCB(exploration=0.9)
    assert cell.algorithm.updates_per_frame == 0.1
    extreme = cell_named("cerl gamma 0 1 Hopper-v5").algorithm
    assert [learner.gamma for learner in extreme.learners] == [0.0, 1.0]
    assert cell_named("cerl c 5 Humanoid-v5").algorithm.manager.exploration == 5.0
    alone = cell_named("td3 gamma 0.9 Humanoid-v5").algorithm.learner
    assert alone == chapter6.portfolio((0.9,))[0]
    assert cell_named("ea of cerl Hopper-v5").algorithm.learners == ()


# ------------------------------------------------------------------------------------------ pages


@pytest.mark.parametrize("name", NAMES)
def test_its_numbers_are_plain_and_its_page_renders(name, runs_of):
    module = experiment(name)
    runs = {cell.name: runs_of(cell) for cell in module.cells("smoke")}
    measured = module.measure(runs, "smoke")
    text = json.dumps(measured, allow_nan=False)
    assert json.loads(text) == measured
    assert list(measured) == list(runs)
    sections = module.sections(json.loads(text))
    html = render(Page(module.TITLE, module.PUBLISHED, f"credo reproduce {name}", sections))
    for section in sections:
        assert escape(section.title) in html
    assert ">nan" not in html
    one_less = {name: measured[name] for name in list(measured)[:1]}
    assert len(module.sections(one_less)) >= 1  # as with --only


def test_scores_are_those_logged_and_those_of_fresh_episodes(runs_of):
    cell = check_td3.cells("smoke")[0]
    found = chapter5.outcome(cell.name, runs_of(cell))
    assert (found["task"], found["label"]) == (chapter5.STAND_IN, "td3")
    assert found["frames"] == list(range(20, 2001, 20))
    assert found["score"][1][:6] == [None] * 4 + [11.0, 11.0]  # tested after 100 frames
    assert found["last"] == [200.0, 201.0]
    assert found["last smoothed"] == [155.0, 156.0]  # mean of the last ten
    assert found["updates per frame"] == [1.0, 1.0]
    env = cell.algorithm.env
    champions = tree.stack(*(run.champion for run in runs_of(cell)))
    again = evaluate(env, champions, 10, key=jax.random.key(20_000)).returns["reward"]
    np.testing.assert_allclose(found["final"], again, atol=0.006)
    assert 4.0 < found["floor"][0] < 8.0  # the pole falls
    assert chapter5.random_returns(env) == chapter5.random_returns(env)


def test_evolution_alone_makes_no_updates(runs_of):
    cell = chapter5.cell("ea", ERL.ea, chapter5.STAND_IN, "smoke")
    assert chapter5.outcome(cell.name, runs_of(cell))["updates per frame"] == [0.0, 0.0]


def test_a_pendulum_is_solved_when_its_test_says_so(tmp_path):
    erl, _, ddpg = fig_5_2.cells("smoke")[:3]
    scores = {"champion_score": np.r_[np.zeros(9), 9001.0, np.zeros(10)]}
    runs = {
        erl.name: [fake(tmp_path / "a", erl.algorithm, 0, **scores)],
        ddpg.name: [fake(tmp_path / "b", ddpg.algorithm, 0, champion_score=np.full(20, 8999.0))],
    }
    measured = fig_5_2.measure(runs, "smoke")
    assert measured[erl.name]["solved after"] == [110]  # 11 episodes a generation
    assert measured[ddpg.name]["solved after"] == [None]
    assert measured[ddpg.name]["episodes played"] == [20]
    rows = fig_5_2.solved(measured).rows
    assert [row[2:4] for row in rows] == [["1 of 1", "110"], ["0 of 1", "not in 20"]]


def test_fates_stand_beside_the_published_ones_and_chance(runs_of):
    cell = table_5_2.cells("smoke")[0]
    found = table_5_2.measure({cell.name: runs_of(cell)}, "smoke")[cell.name]
    assert found["injected"] == [20, 20]
    assert found["fates"] == [[0.5, 0.25, 0.25]] * 2
    # Simulated: ranks drawn at random meet the tournaments of ERL itself.
    erl = cell.algorithm
    fitness = -np.arange(10.0, dtype=np.float32)
    draw = jax.vmap(lambda key: erl.selection(fitness, 10 - erl.elites, key=key))
    drawn = np.asarray(draw(jax.random.split(jax.random.key(0), 4000)))
    chosen = (drawn[:, :, None] == np.arange(10)).any(axis=1)[:, erl.elites :]
    np.testing.assert_allclose(
        found["expected"][1], chosen.mean() * (10 - erl.elites) / 10, atol=0.01
    )
    assert sum(found["expected"]) == pytest.approx(1.0, abs=1e-3)


def test_extra_time_is_that_of_the_clock(tmp_path):
    erl, ddpg = note_5_5.cells("smoke")
    runs = {
        erl.name: [fake(tmp_path / "a", erl.algorithm, 0, speed=0.8)],
        ddpg.name: [fake(tmp_path / "b", ddpg.algorithm, 0)],
    }
    measured = note_5_5.measure(runs, "smoke")
    assert measured[ddpg.name]["seconds per 1000 frames"] == pytest.approx([10.0])
    assert measured[erl.name]["seconds per 1000 frames"] == pytest.approx([12.5])
    assert measured[erl.name]["updates per frame"] == pytest.approx([1.0])
    assert note_5_5.extra(measured).rows == [["+3", "25.0", "+25.0"]]


def test_numbers_are_written_with_their_spread():
    assert chapter5.spread([7000.0, 8000.0]) == "7,500 ± 707"
    assert chapter5.spread([-4.0]) == "-4.00"
    assert chapter5.middle([99.0, 100.0, 1234.5]) == "100.0 (99.0…1,234)"


def test_a_report_shows_attribution_where_there_is_any(runs_of, tmp_path):
    cells = [chapter6.cerl("cerl", chapter5.STAND_IN, "smoke"), check_td3.cells("smoke")[0]]
    paths = [run.path for cell in cells for run in runs_of(cell)]
    html = report.write(paths, tmp_path / "report.html").read_text()
    # One portfolio: two lines of figures and one table of learners.
    for title in ("Who was the last to change", "Where the champion&#x27;s weights", "Workers of"):
        assert html.count(f"{title}") >= 1
    assert html.count("Learners: their workers") >= 1
    assert "TD3 γ 0.9995" in html
    assert "learners.3.gamma" in html  # of the settings
    alone = report.write(paths[2:], tmp_path / "alone.html").read_text()
    assert "Learners: their workers" not in alone


def test_learners_are_named_by_kind_and_discount():
    learners = (*chapter6.portfolio((0.9, 0.9)), SAC(), ddpg())
    names = ["TD3 γ 0.9 (1)", "TD3 γ 0.9 (2)", "SAC γ 0.99", "DDPG γ 0.99"]
    assert report.learner_names(learners) == names


def test_allocation_stands_beside_the_published_one(runs_of):
    cell = chapter6.cerl("cerl", chapter5.STAND_IN, "smoke")
    measured = chapter6.measure({cell.name: runs_of(cell)}, "smoke")
    table = chapter6.allocation(measured, {"InvertedPendulum": (0.24, 0.35, 0.2, 0.2)})
    assert [row[2] for row in table.rows] == ["2,000", "", "", ""]
    assert [row[3] for row in table.rows] == [f"TD3 γ {g:g}" for g in chapter6.PORTFOLIO]
    assert [row[5] for row in table.rows] == ["24", "35", "20", "20"]
    assert [row[6] for row in table.rows] == [f"{10 * i:.1f} ± 0.0" for i in (1, 2, 3, 4)]


def test_intervals_are_those_of_student():
    assert chapter5.confidence([1.0]) == "–"
    low, high = map(float, chapter5.confidence([100.0, 200.0, 300.0]).split(" … "))
    assert (low, high) == pytest.approx((200 - 248.4, 200 + 248.4), abs=0.1)  # 4.303 · 100 / √3


def test_a_stand_in_is_told_from_the_task_itself(runs_of):
    cell = check_td3.cells("smoke")[0]
    found = {cell.name: chapter5.outcome(cell.name, runs_of(cell))}
    assert "stands in for" in " ".join(chapter5.about(found).paragraphs)
    found[cell.name]["played"] = [30_000, 30_000]
    assert "stands in for" not in " ".join(chapter5.about(found).paragraphs)
