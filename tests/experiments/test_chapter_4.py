"""Experiments of chapter 4: their cells, tiny runs of some of them, and the pages of these."""

import importlib
import json

import jax
import numpy as np
import pytest

from credo.algorithms.ccea import CCEA
from credo.analysis import fleet
from credo.environments.server_fleet import ServerFleet
from credo.environments.wrappers import NoisyObservations
from credo.experiments import base, beyond_4, chapter4, chapter4_fleet, table_4_1
from credo.networks.dmmu import DMMU
from credo.report.pages import render
from credo.report.sections import Page, Table
from credo.runs.loop import train

NAMES = ("fig-4.2", "fig-4.3", "fig-4.4", "fig-4.7", "fig-4.8", "table-4.1", "beyond-4")
CHOSEN = {  # of each experiment, the cells that are run
    "fig-4.2": ("converge 2-deep, fsp, mmu",),
    "fig-4.4": ("spread 2-deep, 2 robots, ff",),
    "fig-4.7": ("synchronous, dmmu", "synchronous, cnf"),
    "table-4.1": ("case study, dmmu",),
    "fig-4.8": ("case study, dmmu",),
    "beyond-4": (
        "spread 2-deep, 3 robots, mmu on difference",
        "synchronous, dmmu",
        "synchronous, dmmu in noise 0.5",
    ),
}


def experiment(name):
    return importlib.import_module(f"credo.experiments.{base.MODULES[name]}")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of every chosen cell, at smoke."""
    folder, found = tmp_path_factory.mktemp("cells"), {}
    for name, chosen in CHOSEN.items():
        for cell in experiment(name).cells("smoke"):
            if cell.name in chosen and cell.name not in found:
                found[cell.name] = [
                    train(
                        cell.algorithm,
                        generations=2,
                        seed=seed,
                        path=folder / cell.name / str(seed),
                        tensorboard=False,
                        progress=False,
                    )
                    for seed in base.seeds(cell)
                ]
    return found


@pytest.mark.parametrize("name", NAMES)
def test_cells_have_names_of_their_own_and_the_published_sizes(name):
    for budget in base.budgets(name):
        cells = experiment(name).cells(budget)
        assert len({cell.name for cell in cells}) == len(cells)
        for cell in cells:
            of = chapter4 if isinstance(cell.algorithm, CCEA) else chapter4_fleet
            assert cell.first_seed == of.FIRST_SEED
        if budget == "smoke":
            continue
        for cell in cells:
            algorithm = cell.algorithm
            assert (algorithm.population_size, algorithm.elites) == (100, 4)
            islands = getattr(algorithm, "islands", None)
            assert (islands is not None) == (cell.name[:8] == "converge" and ", fsp" in cell.name)
            if isinstance(algorithm, CCEA):
                assert (algorithm.teams, algorithm.episodes, algorithm.test_episodes) == (5, 7, 15)
            else:
                assert algorithm.episodes == (30 if name in ("table-4.1", "fig-4.8") else 10)
                assert len(algorithm.mating) == (1 if cell.name.endswith("cnf") else 2)


@pytest.mark.parametrize("name", CHOSEN)
def test_its_numbers_are_plain_and_its_page_renders(name, runs):
    module = experiment(name)
    measured = module.measure({cell: runs[cell] for cell in CHOSEN[name]}, "smoke")
    assert json.loads(json.dumps(measured)) == measured
    html = render(
        Page(name, module.PUBLISHED, "command", module.sections(measured), {"budget": "smoke"})
    )
    assert "nan" not in html.replace("nance", "")


def test_the_best_team_with_memory_is_shown_and_older_results_still_render(runs):
    with_memory = chapter4.measure({name: runs[name] for name in CHOSEN["fig-4.2"]}, "smoke")
    ((name, cell),) = with_memory.items()
    walk, memory = chapter4.pictures(with_memory)
    best = int(np.argmax(cell["final"]))
    assert walk.title == f"An episode of {name}: run {best}, the best of 2"
    assert [len(track.rows) for track in walk.tracks] == [12, 12]
    assert np.shape(memory.values) == (3, 12)
    del cell["episode"]
    assert chapter4.pictures(with_memory) == []
    assert len(experiment("fig-4.2").sections(with_memory)) == 3
    without = chapter4.measure({name: runs[name] for name in CHOSEN["fig-4.4"]}, "smoke")
    assert [cell["episode"] for cell in without.values()] == [None]
    assert chapter4.pictures(without) == []


def test_shares_of_the_ceiling_are_of_the_median():
    measured = {
        "converge 2-deep, fsp, mmu": {
            "where": "converge 2-deep, fsp",
            "network": "mmu",
            "final": [0.4, 0.5, 0.45],
            "floors": {"always left": 0.25, "imitating FSP": 0.5},
            "ceiling": ["optimal", 0.5],
        }
    }
    (row,) = chapter4.scores(measured, {"converge 2-deep, fsp, mmu": "41.3 ± 2.4"}).rows
    expected = ["25.0", "41.3 ± 2.4", "45.0 (40.0…50.0)", "50.0 (optimal)", "90.0"]
    assert row == ["converge 2-deep, fsp", "mmu", *expected]


def test_a_run_is_as_good_as_the_table_in_any_order_of_the_configurations():
    def run(rewards):
        signatures = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 0, 1]]
        pairs = zip(rewards, signatures, strict=True)
        return [{"reward": reward, "signature": signature} for reward, signature in pairs]

    runs = [run((4, 5, 4, 6, 4, 5)), run((6, 6, 6, 6, 3, 6))]
    rows = table_4_1.every_run({"runs": runs}).rows
    assert [row[3:] for row in rows] == [["yes", 5], ["no", 5]]


def test_every_network_of_a_fleet_has_the_same_budget():
    cells = experiment("fig-4.7").cells("published")
    assert {cell.generations for cell in cells} == {15_000}
    assert len(cells) == 2 * len(chapter4_fleet.networks())
    busy = [cell.algorithm.env.busy for cell in cells]
    assert np.array_equal(busy[:6], [1] * 6)
    assert busy[6:] == [(0, 2)] * 6


def test_a_fleet_that_cannot_write_keeps_its_memory_as_it_begins(runs):
    cells = {name: runs[name] for name in CHOSEN["fig-4.7"]}
    measured = experiment("fig-4.7").measure(cells, "smoke")
    assert [len(cell.get("nobody writes", ())) for cell in measured.values()] == [2, 0]
    env = ServerFleet(servers=2, devices=4, nefarious=2)
    team = DMMU(hidden=4, initializer="normal").init(*env.sizes, key=jax.random.key(0))
    obs = env.reset(key=jax.random.key(1))[1].obs
    for who, writes in ((team, True), (fleet.without_writing(team), False)):
        carry = who.start(key=jax.random.key(2))
        assert bool(np.any(who(obs, carry)[1].memory != carry.memory)) == writes


def test_large_fleets_have_few_matrices_hit_whatever_their_network():
    for cell in experiment("fig-4.7").cells("published"):
        env, network = cell.algorithm.env, cell.algorithm.network
        matrices = len(jax.tree.leaves(network.init(*env.sizes, key=jax.random.key(0))))
        hit = cell.algorithm.mutation.probability * matrices
        assert hit == pytest.approx(min(3.0, 0.9 * matrices))
        assert (env.servers, env.devices, env.scale) == (10, 20, (0.02, 1.0))


def test_beyond_4_asks_its_questions():
    cells = {cell.name: cell.algorithm for cell in beyond_4.cells("full")}
    for robots in (3, 4):
        name = f"spread 2-deep, {robots} robots, mmu"
        score, difference = cells[name], cells[f"{name} on difference"]
        assert (score.signal, difference.signal) == ("score", "difference")
        assert score.env.reported == difference.env.reported == "score"
        assert (score.network, score.mutation) == (difference.network, difference.mutation)
    networks = [cells[f"spread 2-deep, 2 robots, {kind}"].network for kind in ("lstm", "gru")]
    assert [(x.cell, x.hidden) for x in networks] == [("lstm", 20), ("gru", 20)]
    deep = [cells[f"spread 4-deep, fsp, {network}"] for network in chapter4.NETWORKS]
    assert [x.env.depth for x in deep] == [4, 4]
    clear, noisy = cells["synchronous, dmmu"], cells["synchronous, dmmu in noise 0.5"]
    assert clear.env == chapter4_fleet.large()
    assert noisy.env == NoisyObservations(clear.env, 0.5, spared=1)
    assert noisy.network == clear.network


def test_beyond_4_takes_any_of_its_cells(runs):
    chosen = {name: runs[name] for name in CHOSEN["beyond-4"]}
    measured = beyond_4.measure(chosen, "smoke")
    assert list(measured) == list(chosen)
    alone = "synchronous, dmmu in noise 0.5"
    assert beyond_4.measure({alone: runs[alone]}, "smoke") == {alone: measured[alone]}
    tables = {
        name: [x.title[:12] for x in beyond_4.sections({name: cell}) if isinstance(x, Table)]
        for name, cell in measured.items()
    }
    assert list(tables.values()) == [
        ["Difference r"],
        ["Noisy observ", "Servers that", "Against the "],
        ["Noisy observ"],
    ]
    first, *others = measured["synchronous, dmmu"]["changes"].values()
    assert first["change"] == [[0.0, 0.0]] * 2
    for row in others:
        change = np.array(row["ours"]) - first["ours"]
        np.testing.assert_allclose(change[:, 0], np.array(row["change"])[:, 0], atol=2e-3)
    # Of ten genuine requests one server alone, which acts at every other step, serves eight.
    earned = [row["known"]["oracle"][0] for row in (first, *others)]
    assert earned == [10.0, 10.0, 8.0, 10.0, 10.0]
    assert list(measured[alone]["in noise"]) == ["0.0", "0.25", "0.5", "1.0"]


def test_fleets_that_change():
    env = ServerFleet(devices=4, requests=2, nefarious=2)
    team = DMMU(hidden=2).init(*env.sizes, key=jax.random.key(0))
    found = beyond_4.variants(env, team)
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


def test_rewards_networks_and_depths_have_tables_without_a_published_column():
    cell = {
        "where": "spread 2-deep, 3 robots",
        "network": "mmu on difference",
        "final": [0.8, 0.7, 0.75],
        "floors": {"one at each end": 0.5},
        "ceiling": ["upper bound", 0.9375],
    }
    table = beyond_4.shares("Reward", {"spread 2-deep, 3 robots, mmu on difference": cell})
    assert table.title.startswith("Reward: trials")
    assert table.columns[2:4] == ["floor: best without memory", "ours, median (range)"]
    expected = ["50.0", "75.0 (70.0…80.0)", "93.8 (upper bound)", "80.0"]
    assert table.rows == [["spread 2-deep, 3 robots", "mmu on difference", *expected]]


def test_a_champion_has_a_row_of_tests_in_noise():
    pairs = [[10.0, 0.25], [8.0, 0.2], [4.04, 0.3], [1.0, 0.26]]
    cell = {
        "noise": 0.5,
        "final": [9.0, 3.0],
        "reference": {"random": 0.5, "discovering": 40.4, "oracle": 50.4},
        "in noise": {
            str(std): [pair, [0.0, 0.1]] for std, pair in zip(beyond_4.TESTED, pairs, strict=True)
        },
    }
    table = beyond_4.noise({"synchronous, dmmu in noise 0.5": cell})
    assert table.columns[2:] == [f"tested at std {std}" for std in ("0", "0.25", "0.5", "1")]
    assert table.rows == [
        ["0.5", "0", "10.0 ± 0.2", "8.0 ± 0.2", "4.0 ± 0.3", "1.0 ± 0.3"],
        ["0.5", "1", *["0.0 ± 0.1"] * 4],
    ]
    assert "random servers earn 0.5, a script that discovers 40.4" in table.caption


def test_what_leaving_costs_stands_beside_what_it_costs_others():
    def row(ours, change, random, discovering, oracle):
        known = {"random": random, "fixed": 0.0, "discovering": discovering, "oracle": oracle}
        known = {name: [mean, 0.3] for name, mean in known.items()}
        return {"ours": [[ours, 0.2]], "change": [[change, 0.1]], "known": known}

    changed = {
        "10 servers": row(12.0, 0.0, 0.5, 40.0, 50.0),
        "3 of 10 leave": row(10.5, -1.5, 0.4, 34.0, 45.0),
    }
    assert beyond_4.sizes(changed).rows == [
        ["10 servers", "0.5 ± 0.3", "12.0 ± 0.2", "40.0 ± 0.3", "50.0 ± 0.3"],
        ["3 of 10 leave", "0.4 ± 0.3", "10.5 ± 0.2", "34.0 ± 0.3", "45.0 ± 0.3"],
    ]
    assert beyond_4.costs(changed).rows == [
        ["3 of 10 leave", "-1.5 ± 0.1", "-6.0 ± 0.4", "-5.0 ± 0.4"]
    ]
