"""Experiments of chapters 3 and 4: their cells, what is measured of tiny runs, and their pages."""

import pathlib
from dataclasses import replace

import jax
import numpy as np
import pytest

from credo.algorithms.bptt import BPTT
from credo.algorithms.ccea import CCEA
from credo.algorithms.neuroevolution import Neuroevolution
from credo.analysis import fleet
from credo.analysis.generalization import success_with_gap
from credo.environments.extended_tmaze import ExtendedTMaze
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.server_fleet import ServerFleet
from credo.environments.wrappers import NoisyObservations
from credo.experiments import (
    base,
    beyond_4,
    case_study,
    catalogue,
    fleets,
    gradient,
    sequences,
    tmazes,
)
from credo.experiments.base import Cell, Trained, find
from credo.networks.dmmu import DMMU
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.report import pages as page
from credo.report import sections as report
from credo.report.rows import Results, Row, Series, concat, read, rows, series, write
from credo.rollout import evaluate
from credo.runs import config
from credo.runs.loop import train

CHAPTER_3 = [name for name in catalogue.EXPERIMENTS if name.partition("-")[2].startswith("3")]
CHAPTER_4 = [name for name in catalogue.EXPERIMENTS if name.partition("-")[2].startswith("4")]
COMMITTED = pathlib.Path(base.__file__).parents[3] / "results"
SIZES = {"population_size": 10, "episodes": 4, "test_episodes": 6}
TINY_BPTT = {"batch_size": 10, "updates": 1, "test_episodes": 6}
SHORT = SequenceClassification(depth=2, min_gap=1, max_gap=2)
RECALL = SequenceRecall(depth=1, min_corridor=1, max_corridor=2)
MAZES = "converge, depth 2, fsp, mmu"
TEAMS = "spread, depth 2, robots 2, ff"
FLEETS = ["server fleet, synchronous, dmmu", "server fleet, synchronous, cnf"]
CHANGED = [
    "spread, depth 2, robots 3, mmu, difference",
    FLEETS[0],
    "server fleet, synchronous, dmmu, noise 0.5",
]
CHOSEN = {  # of each experiment of chapter 4, the cells that are run
    "fig-4.2": [MAZES],
    "fig-4.4": [TEAMS],
    "fig-4.7": FLEETS,
    "table-4.1": ["case study, dmmu"],
    "fig-4.8": ["case study, dmmu"],
    "beyond-4": CHANGED,
}


def tiny(task, depth, preset, trainer, algorithm, **more):
    labels = {"task": task, "depth": depth, "preset": preset, "trainer": trainer, "network": "mmu"}
    return Cell({**labels, **more}, algorithm, range(2), 12)


TINY = [
    tiny(
        "classification",
        2,
        "as written",
        "gradient",
        BPTT.as_written(SHORT, MMU(hidden=5), **TINY_BPTT),
    ),
    tiny(
        "classification",
        2,
        "as coded",
        "evolution",
        Neuroevolution.as_coded(SHORT, MMU(hidden=5), **SIZES),
    ),
    tiny(
        "classification", 2, "ours", "evolution", Neuroevolution.ours(SHORT, MMU(hidden=5), **SIZES)
    ),
    tiny("recall", 1, "ours", "gradient", BPTT.ours(RECALL, MMU(hidden=5), **TINY_BPTT)),
    tiny("recall", 1, "ours", "evolution", Neuroevolution.ours(RECALL, MMU(hidden=5), **SIZES)),
]


def trained(cell, folder, generations):
    runs = [
        train(
            cell.algorithm,
            generations=generations,
            seed=seed,
            path=folder / cell.folder / str(seed),
            tensorboard=False,
            progress=False,
        )
        for seed in cell.seeds
    ]
    return Trained(cell, runs, "smoke")


@pytest.fixture(scope="module")
def of_sequences(tmp_path_factory):
    """Two short runs of each tiny cell of chapter 3."""
    folder = tmp_path_factory.mktemp("sequences")
    found = [trained(cell, folder, 12) for cell in TINY]
    # A run caches only programs that took a while to compile; tests cache them all.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return {x.cell.name: x for x in found}


@pytest.fixture(scope="module")
def of_teams(tmp_path_factory):
    """Two runs of every chosen cell of chapter 4, at smoke."""
    folder, found = tmp_path_factory.mktemp("teams"), {}
    for name, chosen in CHOSEN.items():
        for cell in find(name).cells("smoke"):
            if cell.name in chosen and cell.name not in found:
                found[cell.name] = trained(cell, folder, 2)
    return found


def measured(name, cells):
    """Results of an experiment on these trained cells."""
    found = concat(measure(cell) for cell in cells for measure in find(name).measures)
    records = [x.cell.record() | {"machine": config.machine()} for x in cells]
    return Results(name, "smoke", "credo reproduce", records, *found)


def shown(name, results, tmp_path):
    """Sections of its page, by title, from what the file has; the page renders."""
    write(results, tmp_path / "results.json")
    again = read(tmp_path / "results.json")
    assert len(again.rows) == len(results.rows)
    assert len(again.curves) == len(results.curves)
    found = base.describe(again)
    assert ">nan" not in page.render(found)
    return {section.title: section for section in found.sections}


def made_up(name, cells, *parts):
    """Results of these labels and of whatever else is given."""
    records = [{"labels": x, "seeds": [200, 201], "machine": config.machine()} for x in cells]
    return Results(name, "full", "credo reproduce", records, *concat([parts]))


def sections(results):
    return {x.title: x for x in base.sections(find(results.experiment), results)}


def kinds(results):
    """Metrics, with the labels that they have beside those of cells."""
    of_cells = {name for cell in results.cells for name in cell["labels"]}
    return {
        (x.metric, x.x if isinstance(x, Series) else None, frozenset(x.labels) - of_cells)
        for x in [*results.rows, *results.curves]
    }


# ------------------------------------------------------------------------------------------ cells


@pytest.mark.parametrize("name", CHAPTER_3)
@pytest.mark.parametrize("budget", base.BUDGETS)
def test_cells_of_chapter_3_are_what_their_labels_say(name, budget):
    cells = find(name).cells(budget)
    assert len({cell.name for cell in cells}) == len(cells) >= 1
    for cell in cells:
        labels, algorithm = cell.labels, cell.algorithm
        assert len(cell.seeds) >= 2
        assert cell.generations >= 10
        assert cell.seeds[0] == (200 if labels["preset"] == "ours" else 0)
        assert algorithm.env.depth == labels["depth"]
        assert isinstance(algorithm.env, sequences.TASKS[labels["task"]])
        assert isinstance(algorithm, BPTT) == (labels["trainer"] == "gradient")
        kind = algorithm.network
        assert getattr(kind, "cell", type(kind).__name__.lower()) == labels["network"]


@pytest.mark.parametrize("name", CHAPTER_4)
def test_cells_of_chapter_4_have_the_published_sizes(name):
    for budget in find(name).budgets:
        cells = find(name).cells(budget)
        assert len({cell.name for cell in cells}) == len(cells)
        for cell in cells:
            maze = isinstance(cell.algorithm, CCEA)
            assert cell.seeds[0] == (500 if maze else 200)
            if budget == "smoke":
                continue
            labels, algorithm = cell.labels, cell.algorithm
            assert (algorithm.population_size, algorithm.elites) == (100, 4)
            islands = algorithm.breeder.islands if hasattr(algorithm, "breeder") else None
            apart = (labels["task"], labels.get("partner")) == ("converge", "fsp")
            assert (islands is not None) == apart
            if maze:
                assert (algorithm.teams, algorithm.episodes, algorithm.test_episodes) == (5, 7, 15)
                assert algorithm.env.robots == labels.get("robots", 1)
                assert algorithm.env.partner == labels.get("partner")
            else:
                assert algorithm.episodes == (30 if name in ("table-4.1", "fig-4.8") else 10)
                assert len(algorithm.breeder.mating) == (1 if labels["network"] == "cnf" else 2)


def test_both_trainers_have_as_many_instances_in_beyond_3():
    for cell in find("beyond-3").cells("full"):
        algorithm = cell.algorithm
        if isinstance(algorithm, BPTT):
            assert algorithm.updates * algorithm.batch_size == 1000
        else:
            assert algorithm.population_size * algorithm.episodes == 1000
        assert cell.generations == {"classification": 200, "recall": 400}[cell.labels["task"]]


def test_a_cell_has_the_trainer_the_network_and_the_size_of_its_labels():
    cell = sequences.cell("quick", "recall", 4, "as written", "gradient", "gru")
    assert cell.name == "recall, depth 4, as written, gradient, gru"
    assert cell.algorithm.network == Recurrent("gru", 20, initializer="kaiming")
    assert (cell.algorithm.env.depth, cell.algorithm.l2, cell.seeds[0]) == (4, 0.1, 0)
    cell = sequences.cell("full", "classification", 5, "ours", memory=2)
    assert cell.name == "classification, depth 5, ours, evolution, mmu, memory 2"
    network = cell.algorithm.network
    assert (network.hidden, network.cells, network.encoder) == (5, 2, "learned")
    assert (len(cell.seeds), cell.generations) == (5, 1000)


@pytest.mark.parametrize("name", ["fig-3.4b", "fig-3.9b"])
def test_neat_plays_as_many_sequences_as_the_networks_beside_it(name):
    """The published protocol: 100 networks, 10 sequences each, 15,000 generations."""
    cells = find(name).cells("published")
    kinds = {(c.labels["trainer"], c.labels["network"], "info-max" in c.labels) for c in cells}
    assert ("NEAT", "lstm", True) in kinds
    assert len(kinds) == 4 + 3
    depths = {c.labels["depth"] for c in cells}
    assert len(cells) == len(kinds) * len(depths)
    for cell in cells:
        algorithm = cell.algorithm
        first = getattr(algorithm, "infomax", None)
        more = first.generations * first.episodes if first else 0
        assert (algorithm.population_size, algorithm.episodes) == (100, 10)
        assert cell.generations * algorithm.episodes + more == 150_000
        assert len(cell.seeds) == 3


def test_a_cell_of_neat_is_measured_like_the_others(tmp_path):
    cell = sequences.neat("recall", 1, "lstm", True, 15_000)
    algorithm = replace(cell.algorithm, env=RECALL, **SIZES)
    algorithm = replace(algorithm, infomax=replace(algorithm.infomax, generations=2, episodes=8))
    tiny = replace(cell, algorithm=algorithm, seeds=range(2), generations=12)
    options = {"tensorboard": False, "progress": False}
    runs = [
        train(algorithm, generations=12, seed=seed, path=tmp_path / str(seed), **options)
        for seed in tiny.seeds
    ]
    found = sequences.success(Trained(tiny, runs, "published"))
    assert len(found) == 2


def test_every_network_of_a_fleet_has_the_same_budget():
    cells = fleets.cells("published")
    assert {cell.generations for cell in cells} == {15_000}
    assert len(cells) == 2 * len(fleets.networks())
    busy = [cell.algorithm.env.busy for cell in cells]
    assert np.array_equal(busy[:6], [1] * 6)
    assert busy[6:] == [(0, 2)] * 6


def test_large_fleets_have_few_matrices_hit_whatever_their_network():
    for cell in fleets.cells("published"):
        env, network = cell.algorithm.env, cell.algorithm.network
        matrices = len(jax.tree.leaves(network.init(*env.sizes, key=jax.random.key(0))))
        hit = cell.algorithm.breeder.mutation.probability * matrices
        assert hit == pytest.approx(min(3.0, 0.9 * matrices))
        assert (env.servers, env.devices, env.scale) == (10, 20, (0.02, 1.0))


def test_beyond_4_asks_its_questions():
    cells = {cell.name: cell.algorithm for cell in beyond_4.cells("full")}
    for robots in (3, 4):
        name = f"spread, depth 2, robots {robots}, mmu"
        score, difference = cells[name], cells[f"{name}, difference"]
        assert (score.reward, difference.reward) == ("score", "difference")
        assert score.env.reported == difference.env.reported == "score"
        assert (score.network, score.breeder) == (difference.network, difference.breeder)
    networks = [cells[f"spread, depth 2, robots 2, {kind}"].network for kind in ("lstm", "gru")]
    assert [(x.cell, x.hidden) for x in networks] == [("lstm", 20), ("gru", 20)]
    deep = [cells[f"spread, depth 4, fsp, {network}"] for network in ("mmu", "ff")]
    assert [x.env.depth for x in deep] == [4, 4]
    clear, noisy = cells[FLEETS[0]], cells[f"{FLEETS[0]}, noise 0.5"]
    assert clear.env == ServerFleet(scale=(0.02, 1.0), busy=1)
    assert noisy.env == NoisyObservations(clear.env, 0.5, spared=1)
    assert noisy.network == clear.network


# ------------------------------------------------------------------------- measures and their pages


@pytest.mark.parametrize("name", CHAPTER_3)
def test_tiny_runs_of_chapter_3_have_rows_like_the_committed_ones(name, of_sequences, tmp_path):
    wanted = find(name).cells("smoke")
    task = wanted[0].labels["task"]
    chosen = [x for x in of_sequences.values() if x.labels["task"] == task][-len(wanted) :]
    results = measured(name, chosen)
    assert kinds(results) <= committed(name)
    assert shown(name, results, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", CHOSEN)
def test_tiny_runs_of_chapter_4_have_rows_like_the_committed_ones(name, of_teams, tmp_path):
    results = measured(name, [of_teams[cell] for cell in CHOSEN[name]])
    assert kinds(results) <= committed(name)
    assert shown(name, results, tmp_path)


def committed(name):
    found = [kinds(read(path)) for path in (COMMITTED / name).glob("*/results.json")]
    return set().union(*found)


def test_success_is_that_of_the_champions_on_sequences_of_their_own(of_sequences):
    group = of_sequences["classification, depth 2, ours, evolution, mmu"]
    found = measured("fig-3.4a", [group])
    success = list(found.by_seed("success").values())
    assert len(success) == 2
    assert all(0 <= s <= 1 and round(1000 * s) == pytest.approx(1000 * s) for (s,) in success)
    assert found.value("baseline success") == pytest.approx(0.75)
    last = [[x.metrics["champion_score"][-1]] for x in group.runs]
    got = list(found.by_seed("last test success").values())
    np.testing.assert_allclose(got, last, atol=1e-4)
    assert {tuple(curve.at) for curve in found.curves} == {(10,)}
    smooth = [[x.metrics["champion_score"].mean()] for x in group.runs]  # fewer than 100
    got = list(found.by_seed("last test success, smoothed").values())
    np.testing.assert_allclose(got, smooth, atol=1e-4)


def test_a_sweep_over_gaps_agrees_with_the_task_itself(of_sequences):
    """A gap of fixed length, as data and as a task."""
    policies = of_sequences["classification, depth 2, as coded, evolution, mmu"].champions
    wide, key = SequenceClassification(depth=2, min_gap=0, max_gap=3), jax.random.key(0)
    for gap in (0, 3):
        task = SequenceClassification(2, gap, gap)
        played = evaluate(task, policies, 400, key=jax.random.key(10_000))
        exact = played.returns["success"].mean(axis=1)
        swept = success_with_gap(wide, policies, np.int32(gap), key=key, episodes=400)
        np.testing.assert_allclose(swept, exact, atol=0.14)  # other sequences: 4 σ


def test_success_is_laid_over_the_instances_of_each_trainer(of_sequences):
    for name, each in (
        ("classification, depth 2, ours, evolution, mmu", 40),
        ("classification, depth 2, as written, gradient, mmu", 10),
    ):
        group = of_sequences[name]
        curves = gradient.over_instances(group)
        assert [list(curve.at) for curve in curves] == [[each * g for g in range(1, 13)]] * 2
        scores = [run.metrics["champion_score"] for run in group.runs]
        np.testing.assert_allclose([curve.values for curve in curves], scores, atol=1e-4)


def test_weights_are_counted():
    network = Recurrent("gru", 3)
    champion = network.init(1, 1, key=jax.random.key(0))
    run = type("Run", (), {"champion": champion})
    (row,) = gradient.weights(Trained(Cell({}, None, [0]), [run], ""))
    assert row.value == 3 * (3 * 1 + 3 * 3 + 3) + 3 + 1


def test_figure_3_11_has_its_four_parts_and_the_published_number():
    by_gradient = sequences.cell("full", "classification", 21, "ours", "gradient").labels
    evolution = sequences.cell("full", "classification", 21, "as coded").labels
    parts = []
    for labels, success in ((by_gradient, [0.9, 1.0]), (evolution, [0.5, 0.7])):
        told = {"labels": labels, "seed": [200, 201]}
        parts += rows("success", success, **told)
        axis = ("success by instances", "reinforcement instances", [10_000, 20_000])
        parts += series(*axis, [[0.1, s] for s in success], **told)
    told = {"labels": by_gradient, "seed": [200, 201]}
    gaps = ("success by distractors", "distractors between signals", [0, 15, 101])
    parts += series(*gaps, [[1.0, 1.0, 0.5], [1.0, 0.9, 0.3]], **told)
    depths = ("success by depth", "depth of the test", [16, 21, 66, 101])
    parts += series(*depths, [[1.0, 1.0, 0.5, 0.2], [1.0, 0.9, 0.5, 0.1]], **told)
    found = sections(made_up("fig-3.11", [by_gradient, evolution], *parts))
    for part in ("(a) ours, gradient", "(b) Gradient and evolution, depth 21", "(d) Champions"):
        assert any(title.startswith(part) for title in found)
    both = found["(b) Gradient and evolution, depth 21"]
    assert [curve.label for curve in both.curves] == ["ours, gradient", "as coded, evolution"]
    (row,) = found["Away from what was trained: success, %"].rows
    assert row[:4] == [21, "ours", "gradient", "mmu"]
    assert row[5] == "14.5 ± 2.3"
    assert [list(x.values) for x in (row[4], row[6])] == [[0.5, 0.3], [0.2, 0.1]]


def test_figure_3_12_compares_at_one_depth():
    parts, cells = [], []
    for depth in (2, 4):
        for trainer, equal in (("gradient", False), ("evolution", True)):
            cells.append(
                sequences.cell("full", "recall", depth, "ours", trainer, equal=equal).labels
            )
            axis = ("success by instances", "reinforcement instances", [10_000, 20_000])
            parts += series(*axis, [[0.1, 0.9], [0.1, 1.0]], cells[-1], seed=[200, 201])
    both = sections(made_up("fig-3.12", cells, *parts))["(b) Gradient and evolution, depth 4"]
    labels = ["gradient", "evolution, at equal instances"]
    assert [curve.label for curve in both.curves] == labels


def test_published_values_stand_at_their_depth():
    cells = [sequences.cell("full", "recall", depth, "ours").labels for depth in (2, 6)]
    parts = [Row(x, 200, "success", 0.5) for x in cells]
    table = sections(made_up("fig-3.9a", cells, *parts))["Success, %"]
    column = table.columns.index("published")
    assert [row[column] for row in table.rows] == ["> 45", "46.3 ± 0.9"]
    depths = {cell.labels["depth"] for cell in find("fig-3.9a").cells("full")}
    assert depths == {1, 2, 3, 4, 5, 6}


def test_the_best_team_with_memory_is_shown_and_results_without_episodes_still_render(of_teams):
    with_memory = measured("fig-4.2", [of_teams[MAZES]])
    walk, memory = tmazes.pictures(with_memory, ())
    final = with_memory.by_seed("share of trials")
    best = max(final, key=lambda seed: final[seed])
    assert walk.title == f"An episode of {MAZES}: seed {best}, the best of 2"
    assert [len(track.rows) for track in walk.tracks] == [12, 12]
    assert np.shape(memory.values) == (3, 12)
    without = replace(with_memory, curves=[x for x in with_memory.curves if x.x != "trial"])
    assert list(tmazes.pictures(without, ())) == []
    assert len(sections(without)) == 3
    reactive = measured("fig-4.4", [of_teams[TEAMS]])
    assert list(tmazes.pictures(reactive, ())) == []


def share(labels, final, baselines, kind, bound):
    known = [Row({**labels, "policy": k}, None, "baseline", x) for k, x in baselines.items()]
    bound = Row({**labels, "kind": kind}, None, "upper bound", bound)
    return [*known, bound, *rows("share of trials", final, labels, seed=[0, 1, 2])]


def test_shares_of_the_bound_are_of_the_median():
    labels = {"task": "converge", "depth": 2, "partner": "fsp", "network": "mmu"}
    baselines = {"always left": 0.25, "imitating FSP": 0.5}
    found = share(labels, [0.4, 0.5, 0.45], baselines, "optimal", 0.5)
    table = next(iter(sections(made_up("fig-4.2", [labels], *found)).values()))
    (row,) = table.rows
    assert isinstance(row.pop(6), report.Summary)
    expected = ["25.0", "41.3 ± 2.4", "45.0 (40.0…50.0)", "50.0 (optimal)", "90.0"]
    assert row == ["converge", 2, "fsp", "mmu", *expected]


def test_rewards_have_tables_without_a_published_column():
    labels = {"task": "spread", "depth": 2, "robots": 3, "network": "mmu", "fitness": "difference"}
    found = share(labels, [0.8, 0.7, 0.75], {"one at each end": 0.5}, "upper bound", 0.9375)
    title, table = next(iter(sections(made_up("beyond-4", [labels], *found)).items()))
    assert title.startswith("Difference reward against global reward: trials")
    assert table.columns[5:8] == ["baseline: best without memory", "measured", "median (range)"]
    (row,) = table.rows
    row.pop(6)
    expected = ["50.0", "75.0 (70.0…80.0)", "93.8 (upper bound)", "80.0"]
    assert row == ["spread", 2, 3, "mmu", "difference", *expected]


def test_a_run_is_as_good_as_the_table_in_any_order_of_the_configurations():
    labels = {"task": "case study", "network": "dmmu"}
    orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 0, 1]]
    rewards, where = [[4, 5, 4, 6, 4, 5], [6, 6, 6, 6, 3, 6]], case_study.CONFIGURATIONS
    axes = {"seed": [200, 201], "configuration": where}
    found = made_up(
        "table-4.1",
        [labels],
        Row(labels, None, "best run", 1),
        *rows("reward", rewards, labels, **axes),
        *rows("signature", [orders] * 2, labels, **axes, rank=None),
        *rows("memory", [[[0.5]] * 6] * 2, labels, **axes, cell=["M1"]),
    )
    table = sections(found)["Every run"]
    assert [row[3:] for row in table.rows] == [["yes", 5], ["no", 5]]
    assert [row[1] for row in table.rows] == ["4, 5, 4, 6, 4, 5", "6, 6, 6, 6, 3, 6"]
    best = sections(found)["Champion of seed 201, the best of its cell"]
    assert best.rows[2] == ["NGGN", 5.0, "6", "[0.5]", "[1, 0, 2]"]


def test_a_fleet_that_cannot_write_keeps_its_memory_as_it_begins(of_teams):
    found = measured("fig-4.7", [of_teams[name] for name in FLEETS])
    silent = found.where(network="dmmu").by_seed("net requests while nobody writes")
    assert len(silent) == 2
    assert not found.where(network="cnf").by_seed("net requests while nobody writes")
    env = ServerFleet(servers=2, devices=4, nefarious=2)
    team = DMMU(hidden=4, initializer="normal").init(*env.sizes, key=jax.random.key(0))
    obs = env.reset(key=jax.random.key(1))[1].obs
    for who, writes in ((team, True), (fleet.without_writing(team), False)):
        carry = who.start(key=jax.random.key(2))
        assert bool(np.any(who(obs, carry)[1].memory != carry.memory)) == writes


def test_beyond_4_takes_any_of_its_cells(of_teams):
    tables = {}
    for name in CHANGED:
        alone = measured("beyond-4", [of_teams[name]])
        found = sections(alone).values()
        tables[name] = [x.title[:12] for x in found if isinstance(x, report.Table)]
    fleets = ["Noisy observ", "Genuine minu"]
    changed = ["Servers that", "Against the "]
    assert list(tables.values()) == [["Difference r"], [*fleets, *changed], fleets]


def test_what_happens_to_a_fleet_is_compared_world_by_world(of_teams):
    found = measured("beyond-4", [of_teams[FLEETS[0]]])
    ours = found.array("net requests of a fleet", "fleet", "seed").astype(float)
    change = found.array("change", "fleet", "seed").astype(float)
    assert (change[0] == 0).all()
    np.testing.assert_allclose(ours - ours[0], change, atol=2e-3)
    assert (found.array("change, s.e.", "fleet", "seed")[0] == 0).all()
    # Of ten genuine requests one server alone, which acts at every other step, serves eight.
    oracle = found.array("reference of a fleet", "policy", "fleet")[3]
    assert oracle.tolist() == [10.0, 10.0, 8.0, 10.0, 10.0]
    tested = found.levels("noise of the test")
    assert tested == [0.0, 0.25, 0.5, 1.0]


def test_fleets_that_change():
    env = ServerFleet(devices=4, requests=2, nefarious=2)
    team = DMMU(hidden=2).init(*env.sizes, key=jax.random.key(0))
    found = fleet.changes(env, team)
    assert list(found) == [
        "10 servers",
        "3 of 10 leave at step 7",
        "7 of 10 from the start",
        "clones of 5 join at step 7",
        "clones of 5 from the start",
    ]
    present = {
        name: [int(task.present(step).sum()) for step in (0, 6, 7, 14)]
        for name, (task, _) in found.items()
    }
    assert list(present.values()) == [[10] * 4, [10, 10, 7, 7], [7] * 4, [10, 10, 15, 15], [15] * 4]
    assert [len(x.agents) for _, x in found.values()] == [10, 10, 7, 15, 15]
    assert found["7 of 10 from the start"][1].agents == team.agents[:7]
    assert found["clones of 5 from the start"][1].agents == team.agents + team.agents[:5]
    # Worlds differ in who is there alone.
    states = [task.reset(key=jax.random.key(3))[0] for task, _ in found.values()]
    assert len({tuple(x.genuine.tolist()) for x in states}) == 1


FLEET = {"task": "server fleet", "timing": "synchronous", "network": "dmmu"}


def pairs(metric, found, labels, seeds):
    yield from rows(metric, [mean for mean, _ in found], labels, seed=seeds)
    yield from rows(f"{metric}, s.e.", [error for _, error in found], labels, seed=seeds)


def test_a_champion_has_a_row_of_tests_in_noise():
    labels, tests = {**FLEET, "noise": 0.5}, [[10.0, 0.25], [8.0, 0.2], [4.04, 0.3], [1.0, 0.26]]
    found = [
        row
        for std, pair in zip((0.0, 0.25, 0.5, 1.0), tests, strict=True)
        for row in pairs(
            "net requests in noise",
            [pair, [0.0, 0.1]],
            {**labels, "noise of the test": std},
            [200, 201],
        )
    ]
    table = next(iter(sections(made_up("beyond-4", [labels], *found)).values()))
    assert table.title.endswith("server fleet, synchronous, dmmu, noise 0.5")
    assert table.columns[1:] == [f"tested at std {std}" for std in ("0", "0.25", "0.5", "1")]
    assert table.rows == [
        ["200", "10.0 ± 0.2", "8.0 ± 0.2", "4.0 ± 0.3", "1.0 ± 0.3"],
        ["201", *["0.0 ± 0.1"] * 4],
    ]


def test_what_leaving_costs_stands_beside_what_it_costs_others():
    def of(name, ours, change, **known):
        labels = {**FLEET, "fleet": name}
        yield from pairs("net requests of a fleet", [[ours, 0.2]], labels, [200])
        yield from pairs("change", [[change, 0.1]], labels, [200])
        for policy, mean in known.items():
            here = {**labels, "policy": policy}
            yield from pairs("reference of a fleet", [[mean, 0.3]], here, [None])

    found = sections(
        made_up(
            "beyond-4",
            [FLEET],
            *of("10 servers", 12.0, 0.0, random=0.5, discovering=40.0, oracle=50.0),
            *of("3 of 10 leave", 10.5, -1.5, random=0.4, discovering=34.0, oracle=45.0),
        )
    )
    sizes = found["Servers that leave and join: net requests of final champions"]
    assert sizes.rows == [
        ["10 servers", "0.5 ± 0.3", "12.0 ± 0.2", "40.0 ± 0.3", "50.0 ± 0.3"],
        ["3 of 10 leave", "0.4 ± 0.3", "10.5 ± 0.2", "34.0 ± 0.3", "45.0 ± 0.3"],
    ]
    costs = found["Against the first row: what leaving costs and joining brings"]
    assert costs.rows == [["3 of 10 leave", "-1.5 ± 0.1", "-6.0 ± 0.4", "-5.0 ± 0.4"]]


def test_mazes_are_made_of_their_labels():
    env = tmazes.cell("quick", "converge", 3, "mmu", partner="resp").algorithm.env
    expected = ExtendedTMaze(depth=3, objective="converge", partner="resp", shaping=True)
    assert env == expected
    assert not tmazes.cell("quick", "spread", 2, "ff", robots=3).algorithm.env.shaping
