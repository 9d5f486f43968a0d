"""Experiments of chapters 5 to 7, on runs made up: folders with metrics whose answer is known."""

import json

import jax
import numpy as np
import pytest

from credo import tree
from credo.algorithms.erl import ERL
from credo.algorithms.lineage import MAKERS
from credo.algorithms.merl import MERL
from credo.algorithms.off_policy import OffPolicy
from credo.environments.gymnasium import Gymnasium
from credo.environments.wrappers import DelayedHostReward
from credo.experiments import (
    base,
    catalogue,
    check_spread,
    measures,
    mujoco,
    paths,
    pendulum,
    portfolios,
    rovers,
    runtime,
)
from credo.experiments.base import Trained, find
from credo.learners.credit import Even
from credo.learners.manager import UCB
from credo.learners.sac import SAC
from credo.learners.td3 import ddpg
from credo.report import pages as page
from credo.report import run_page
from credo.report import sections as report
from credo.report.rows import Results, Row, Series, concat, read, rows, series, write
from credo.rollout import evaluate
from credo.runs import checkpoint, config, files, log
from credo.runs.store import Run

CHAPTERS = ("5", "6", "td3", "learners", "dense", "late")
ON_MUJOCO = [x for x in catalogue.EXPERIMENTS if x.partition("-")[2].startswith(CHAPTERS)]
DECOYS = ("beyond-7-decoys", "beyond-7-critics")
ON_ROVERS = ("fig-7.1", "fig-7.4", "fig-7.5", "beyond-7", *DECOYS, "check-spread")
GENERATIONS, FRAMES = 20, 100  # per generation
TEAMS = ("check-spread", "fig-7.5")  # of which runs are measured here; others have a planner


def cell_named(name, budget="full"):
    every = [find(x) for x in ON_MUJOCO]
    having = [x for x in every if budget in x.budgets]
    return {cell.name: cell for x in having for cell in x.cells(budget)}[name]


def fake(path, algorithm, seed, speed=1.0, **columns):
    """A run of this algorithm that was never trained: the champion is the first draw."""
    path.mkdir(parents=True)
    record = {"algorithm": config.to_tree(algorithm), "seed": seed, "machine": config.machine()}
    files.write_json(path / "config.json", record | {"budget": {"frames": 1}})
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
    journal = log.Log(path, 0)
    for k in range(GENERATIONS):
        row = {"generation": k + 1} | {name: column[k].item() for name, column in table.items()}
        journal.append([row], 1.0, 5.0 + k / speed)
    state = algorithm.init(key=jax.random.key(seed))
    metadata = {"generation": str(GENERATIONS)}
    checkpoint.export_policy(path / "champion.safetensors", state.champion, metadata)
    return Run(path)


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Two made-up runs of a cell; cells of one name share them."""
    folder, made = tmp_path_factory.mktemp("cells"), {}

    def of(cell):
        if cell.folder not in made:
            folders = [(seed, folder / cell.folder / str(seed)) for seed in cell.seeds]
            made[cell.folder] = [fake(path, cell.algorithm, seed) for seed, path in folders]
        return Trained(cell, made[cell.folder], "smoke")

    return of


def results_of(name, *cells):
    """What an experiment measures of some cells."""
    found, curves = concat(measure(cell) for cell in cells for measure in find(name).measures)
    records = [cell.cell.record() | {"machine": config.machine()} for cell in cells]
    return Results(name, "smoke", f"credo reproduce {name}", records, found, curves)


def sections_of(results):
    return {x.title: x for x in base.sections(find(results.experiment), results)}


# -------------------------------------------------------------------------------------------- cells


@pytest.mark.parametrize("name", [*ON_MUJOCO, *ON_ROVERS])
def test_cells_have_frames_seeds_and_a_record(name):
    for budget in find(name).budgets:
        for cell in find(name).cells(budget):
            assert cell.frames >= 500
            assert len(cell.seeds) >= (1 if name == "fig-7.5" else 2)
            assert config.from_tree(config.to_tree(cell.algorithm)) == cell.algorithm
            if name in ON_MUJOCO:
                assert cell.labels["task"] == measures.undelayed(cell.algorithm.env).id


def test_the_check_of_td3_is_td3_as_it_comes():
    for task in ("Hopper-v5", "HalfCheetah-v5"):
        cell = cell_named(f"td3, {task}")
        assert cell.algorithm == OffPolicy.td3(Gymnasium(task))
        assert list(cell.seeds) == [0, 1, 2]
        assert cell.budget == {"frames": 300_000}


def test_the_double_pendulum_is_played_both_ways():
    name = "InvertedDoublePendulum-v5"
    cells = {cell.name: cell for cell in pendulum.cells("full")}
    standard = [f"{kind}, {name}" for kind in ("erl", "erl ours", "ddpg", "ea")]
    spread = f"ddpg spread, {name}, delayed"
    assert [label for label in cells if label != spread] == standard + [
        f"{label}, delayed" for label in standard
    ]
    task = DelayedHostReward(Gymnasium(name))
    alone = OffPolicy.ddpg(task, test_episodes=100, redistribute=Even())
    assert cells[spread].algorithm == alone
    assert cells[f"erl, {name}"].algorithm == ERL.erl(Gymnasium(name), test_episodes=100)
    hard = cells[f"ddpg, {name}, delayed"].algorithm
    assert hard == OffPolicy.ddpg(task, test_episodes=100)
    assert all(cell.stop_at == 9200 and len(cell.seeds) == 3 for cell in cells.values())
    # Within the episodes that were published to be needed.
    assert 9_900 < cells[f"erl, {name}, delayed"].generations * 11 <= 10_000
    assert cells[f"ea, {name}, delayed"].generations * 10 >= 25_000


def test_erl_has_its_column_of_table_5_1():
    cell = cell_named("erl, Hopper-v5")
    assert cell.algorithm == ERL.erl(Gymnasium("Hopper-v5"))
    assert (cell.algorithm.elites, cell.algorithm.episodes) == (3, 5)
    assert (cell.frames, len(cell.seeds)) == (300_000, 2)
    assert cell_named("erl, Ant-v5", "published").frames == 6_000_000


def test_portfolios_differ_in_what_the_figures_say():
    cell = cell_named("cerl, Swimmer-v5")
    assert [learner.gamma for learner in cell.algorithm.learners] == [0.9, 0.99, 0.997, 0.9995]
    assert cell.algorithm.manager == UCB(exploration=0.9)
    assert cell.algorithm.updates_per_frame == 0.1
    extreme = cell_named("cerl of gamma 0 and 1, Hopper-v5").algorithm
    assert [learner.gamma for learner in extreme.learners] == [0.0, 1.0]
    explorer = cell_named("cerl, exploration 5, Humanoid-v5").algorithm
    assert explorer.manager.exploration == 5.0
    alone = cell_named("td3, gamma 0.9, Humanoid-v5").algorithm.learner
    assert alone == portfolios.portfolio((0.9,))[0]
    assert cell_named("ea of cerl, Hopper-v5").algorithm.learners == ()


def test_every_method_on_rovers_has_the_same_team_discount_rates_and_updates():
    cells = [cell.algorithm for cell in find("fig-7.4").cells("full")]
    assert len(cells) == 7 * 7 + 6
    learners = [x for cell in cells for x in getattr(cell, "learners", ()) or ()]
    learners += [cell.learner for cell in cells if not isinstance(cell, MERL)]
    for name in ("gamma", "actor_lr", "critic_lr", "tau", "batch_size", "noise"):
        assert len({str(getattr(learner, name)) for learner in learners}) == 1
    assert len({str(cell.network) for cell in cells}) == 1
    assert {cell.updates_per_frame for cell in cells} == {0.05}
    assert {cell.env.agents for cell in cells} == set(range(2, 15, 2))
    assert {x.signal for x in learners} >= {"local", "mixed", "global"}


# --------------------------------------------------------------------------- measured, and its page


@pytest.mark.slow
@pytest.mark.parametrize("name", [*ON_MUJOCO, *TEAMS])
def test_its_numbers_are_plain_and_its_page_renders(name, trained, tmp_path, monkeypatch):
    monkeypatch.setattr(measures, "_rover_baselines", lambda env: {"random": 0.1, "bound": 1.0})
    cells = [trained(cell) for cell in find(name).cells("smoke")]
    results = results_of(name, *cells)
    write(results, tmp_path / "results.json")
    again = read(tmp_path / "results.json")
    assert again.rows == results.rows
    assert sorted(again.curves, key=repr) == sorted(results.curves, key=repr)
    for chosen in (cells, cells[:1]):  # as with --only
        described = base.describe(results_of(name, *chosen))
        html = page.render(described)
        assert all(section.title in described.title + html for section in described.sections[-1:])
        assert len(described.sections) >= 2
        assert ">nan" not in html


def test_scores_are_those_logged_and_those_of_fresh_episodes(trained):
    cell = trained(find("check-td3").cells("smoke")[0])
    found = results_of("check-td3", cell)
    assert found.levels("task", "method") == [(mujoco.STAND_IN, "td3")]
    first, second = found.curves
    assert list(first.at) == list(range(20, 2001, 20))
    assert second.values[:6] == [None] * 4 + [11.0, 11.0]  # tested after 100 frames
    assert found.by_seed("last test") == {0: [200.0], 1: [201.0]}
    assert found.by_seed("last test, smoothed") == {0: [155.0], 1: [156.0]}  # of the last ten
    assert found.by_seed("updates per frame") == {0: [1.0], 1: [1.0]}
    assert found.by_seed("frames") == {0: [2000], 1: [2000]}
    again = evaluate(cell.env, cell.champions, 10, key=jax.random.key(20_000)).returns["reward"]
    np.testing.assert_allclose(list(found.by_seed("return").values()), again, atol=0.006)
    assert 4.0 < found.value("random") < 8.0  # the pole falls


def test_evolution_alone_makes_no_updates(trained):
    cell = trained(mujoco.cell("ea", ERL.ea, mujoco.STAND_IN, "smoke"))
    updates = [row.value for row in measures.effort(cell) if row.metric == "updates per frame"]
    assert updates == [0.0, 0.0]


def test_a_pendulum_is_solved_when_its_test_says_so(tmp_path):
    erl, _, ddpg_cell = pendulum.cells("smoke")[:3]
    scores = {"champion_score": np.r_[np.zeros(9), 9001.0, np.zeros(10)]}
    solved = [fake(tmp_path / "a", erl.algorithm, 0, **scores)]
    failed = [fake(tmp_path / "b", ddpg_cell.algorithm, 0, champion_score=np.full(20, 8999.0))]
    cells = [Trained(erl, solved, ""), Trained(ddpg_cell, failed, "")]
    first = measures.first("solved after", pendulum.SOLVED, "episodes")
    cells[0].cell.__dict__["seeds"] = cells[1].cell.__dict__["seeds"] = [0]
    found = [row for cell in cells for row in [*first(cell), *pendulum.played(cell)]]
    assert [row.value for row in found] == [110, 220, None, 20]  # 11 episodes a generation
    results = Results("fig-5.2", "smoke", "", [cell.cell.record() for cell in cells], found, [])
    (table,) = pendulum.EPISODES(results, find("fig-5.2").values)
    published = [row[2] for row in table.rows]
    assert published == ["< 3,000", "< 3,000"]
    assert [row[3:5] for row in table.rows] == [["1 of 1", "110"], ["0 of 1", "not in 20"]]


def test_fates_stand_beside_the_published_ones_and_chance(trained):
    cell = trained(find("table-5.2").cells("smoke")[0])
    found = results_of("table-5.2", cell)
    assert found.by_seed("injected") == {0: [20], 1: [20]}
    assert found.by_seed("fate") == {0: [0.5, 0.25, 0.25], 1: [0.5, 0.25, 0.25]}
    # Simulated: ranks drawn at random meet the tournaments of ERL itself.
    erl = cell.cell.algorithm
    fitness = -np.arange(10.0, dtype=np.float32)
    draw = jax.vmap(lambda key: erl.breeder.selection(fitness, 10 - erl.elites, key=key))
    drawn = np.asarray(draw(jax.random.split(jax.random.key(0), 4000)))
    chosen = (drawn[:, :, None] == np.arange(10)).any(axis=1)[:, erl.elites :]
    expected = [row.value for row in found.rows if row.metric == "by chance"]
    np.testing.assert_allclose(expected[1], chosen.mean() * (10 - erl.elites) / 10, atol=0.01)
    assert sum(expected) == pytest.approx(1.0, abs=1e-3)
    table = next(iter(sections_of(found).values()))
    assert [row[1:3] for row in table.rows] == [
        [fate, 100 * x] for fate, x in zip(mujoco.FATES, expected, strict=True)
    ]
    hopper = {"task": "Hopper-v5", "fate": "elite"}
    (value,) = [x for x in find("table-5.2").values if dict(x.labels) == hopper]
    assert value.value == "28.7 ± 8.5"


def test_extra_time_is_that_of_the_clock(tmp_path):
    cells = runtime.cells("smoke")
    runs = [
        [fake(tmp_path / f"{speed}{seed}", cell.algorithm, seed, speed=speed) for seed in (0, 1)]
        for cell, speed in zip(cells, (0.8, 1.0), strict=True)
    ]
    found = results_of("note-5.5", *(Trained(*x, "") for x in zip(cells, runs, strict=True)))
    per_frame = found.where(method="erl").by_seed("seconds per 1000 frames")
    assert per_frame == {0: [pytest.approx(12.5)], 1: [pytest.approx(12.5)]}
    assert found.where(method="ddpg").by_seed("seconds per 1000 frames")[0] == [pytest.approx(10.0)]
    assert found.by_seed("updates per frame")[0] == [pytest.approx(1.0)] * 2
    (table,) = runtime.extra(found, ())
    published, measured = table.rows[0]
    assert published == "+3"
    assert list(measured.values) == pytest.approx([25.0, 25.0])


def test_hours_are_those_of_the_clock(trained):
    cell = trained(find("check-td3").cells("smoke")[0])
    assert cell.record()["hours"] == round(2 * 24 / 3600, 2)
    assert set(cell.record()) == {"labels", "seeds", "budget", "algorithm", "machine", "hours"}


def test_a_report_shows_attribution_where_there_is_any(trained, tmp_path):
    cells = [portfolios.cerl(mujoco.STAND_IN, "smoke"), find("check-td3").cells("smoke")[0]]
    folders = [run.path for cell in cells for run in trained(cell).runs]
    html = run_page.write(folders, tmp_path / "report.html").read_text()
    # One portfolio: two lines of figures and one table of learners.
    for title in ("Who was the last to change", "s weights come from", "Workers of"):
        assert html.count(f"{title}") >= 1
    assert html.count("Learners: their workers") >= 1
    assert "TD3 γ 0.9995" in html
    assert "learners.3.gamma" in html  # of the settings
    alone = run_page.write(folders[2:], tmp_path / "alone.html").read_text()
    assert "Learners: their workers" not in alone


def test_learners_are_named_by_kind_and_discount():
    learners = (*portfolios.portfolio((0.9, 0.9)), SAC(), ddpg())
    names = ["TD3 γ 0.9 (1)", "TD3 γ 0.9 (2)", "SAC γ 0.99", "DDPG γ 0.99"]
    assert run_page.learner_names(learners) == names


def test_allocation_stands_beside_the_published_one(trained):
    found = results_of("table-6.1", trained(portfolios.cerl(mujoco.STAND_IN, "smoke")))
    shown = sections_of(found)
    table = next(x for title, x in shown.items() if title.startswith("Cumulative allocation"))
    assert [row[2] for row in table.rows] == [f"TD3 γ {g:g}" for g in portfolios.PORTFOLIO]
    assert [list(row[3].values) for row in table.rows] == [[x] * 2 for x in (0.1, 0.2, 0.3, 0.4)]
    real = [Row({**row.labels, "task": "Hopper-v5"}, *row[1:]) for row in found.rows]
    (table,) = portfolios.ALLOCATION(Results("", "", "", [], real, []), find("table-6.1").values)
    column = table.columns.index("published")
    assert [row[column] for row in table.rows] == [14.0, 27.0, 32.0, 27.0]
    made = {curve.labels["operator"] for curve in found.curves if curve.metric == "last changed by"}
    assert len(made) == len(MAKERS)
    ancestors = {x.labels["ancestor"] for x in found.curves if x.metric == "ancestry"}
    assert "first draw" in ancestors
    assert len(ancestors) == 5


def test_what_is_lost_without_selection():
    found = []
    for method, last in ((mujoco.WITH, [110.0, 90.0]), (mujoco.WITHOUT, [30.0, 30.0])):
        labels = {"method": method, "task": "Swimmer-v5"}
        found += series(
            "test score", "frames", [1, 2], [[50.0, x] for x in last], labels, seed=[0, 1]
        )
        found += rows("random", 10.0, labels)
    known, curves = concat([found])
    (table,) = mujoco.ablation(Results("", "", "", [], known, curves), ())
    assert table.rows == [["Swimmer-v5", 90.0, 20.0, "~ -80 %", "-78 %"]]


# ---------------------------------------------------------------------------------- rovers, made up


def made_up(method, coupling=4, **metrics):
    labels = {"method": method, "coupling": coupling}
    values = {rovers.SHARE: [0.3, 0.4, 0.5], "frames": [300] * 3, "updates per frame": [0.05] * 3}
    found: list[Row | Series] = []
    for metric, by_seed in (values | metrics).items():
        found += rows(metric, by_seed, labels, seed=[0, 1, 2])
    for name, value in {"random": 0.01, "greedy": 0.93, "scripted": 1.0, "bound": 1.0}.items():
        found += rows(name, value, labels)
    scores = [[0.1, 0.2, 0.3 + 0.1 * run] for run in range(3)]
    return found + series("test score", "frames", [100, 200, 300], scores, labels, seed=[0, 1, 2])


def results_made_up(name, *parts):
    found, curves = concat(parts)
    return Results(name, "full", "", [{"labels": x.labels} for x in curves], found, curves)


def test_the_table_shows_baselines_published_ours_and_bound():
    results = results_made_up("fig-7.4", made_up("merl"))
    (table,) = rovers.table("coupling", "dynamics", "method")(results, find("fig-7.4").values)
    (row,) = table.rows
    shown = dict(zip(table.columns, row, strict=True))
    assert list(shown.pop("final champion").values) == [0.3, 0.4, 0.5]
    assert shown == {
        "coupling": 4,
        "method": "merl",
        "baseline: random": 0.01,
        "baseline: greedy script": 0.93,
        "published": 0.46,
        "median": pytest.approx(0.4),
        "planner reached": 1.0,
        "upper bound": 1.0,
        "frames": 300.0,
        "updates per frame": pytest.approx(0.05),
    }
    (figure,) = rovers.curves("coupling", "dynamics")(results, ())
    assert [reference.label for reference in figure.references] == ["random", "greedy script"]


def test_pages_of_rovers_have_their_sections():
    parts = [made_up(method, n) for n in (1, 4) for method in ("merl", "ea")]
    titles = list(sections_of(results_made_up("fig-7.4", *parts)))
    assert titles[1:3] == ["coupling 1", "coupling 4"]
    both = {"both after": [100, None, 300]}
    shown = sections_of(results_made_up("fig-7.1", made_up("merl", **both)))
    table = next(iter(shown.values()))
    assert table.rows[0] == ["merl", "2 of 3", "100, never, 300"]
    expected = {"merl": "1 (4 of 5)", "ea": 0.5, "td3 mixed": 0.5, "td3 global": 0.0}
    for method, value in expected.items():
        here = results_made_up("fig-7.1", made_up(method))
        (table,) = rovers.table("method")(here, find("fig-7.1").values)
        assert dict(zip(table.columns, table.rows[0], strict=True))["published"] == value


def test_paths_are_drawn_as_they_were_measured(trained):
    cell = trained(paths.cells("smoke")[1])
    found, curves = concat([paths.paths(cell)])
    env = cell.env
    assert len(curves) == 2 * env.agents
    assert {len(curve.at) for curve in curves} == {env.max_steps + 1}
    poi = [row.value for row in found if row.metric in ("POI x", "POI y")]
    assert len(poi) == 2 * 4
    assert all(0 <= x <= env.size for x in poi)
    results = Results("", "", "", [cell.cell.record()], found, curves)
    (drawing,) = paths.drawings(results, ())
    assert isinstance(drawing, report.Drawing)
    assert drawing.title == "merl, coupling 3"
    assert f"paths of {env.agents} rovers" in drawing.light
    assert json.dumps([row.value for row in found])


def test_the_check_of_baselines_says_what_is_to_be_exceeded():
    labels = {"method": "matd3", "task": "simple spread"}
    found = [*rows("return", [-9.0], labels, seed=[0]), *rows("random", -26.0, labels)]
    found += rows("frames", [2], labels, seed=[0])
    found += series("test score", "frames", [1, 2], [[-20.0, -9.0]], labels, seed=[0])
    shown = sections_of(results_made_up("check-spread", found))
    row = shown["Return per episode, mean over agents"].rows[0]
    assert row[:4] == ["matd3", -26.0, "-7.4 … -8.4, one -23.9", -10.0]
    assert row[4].values == [-9.0]
    assert [x.value for x in shown["simple_spread"].references] == [-26.0, -7.5]
    played = measures.returns(
        env := check_spread.SimpleSpread(),
        tree.stack(check_spread.scripts.random_team(env)),
        4,
        measures.BASELINE_KEY,
    )
    assert -60.0 < played.mean() < -10.0
