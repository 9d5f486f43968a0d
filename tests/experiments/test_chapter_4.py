"""Experiments of chapter 4: their cells, tiny runs of some of them, and the pages of these."""

import importlib
import json

import numpy as np
import pytest

from credo.algorithms.ccea import CCEA
from credo.experiments import base, chapter4, chapter4_fleet, table_4_1
from credo.runs import page
from credo.runs.loop import train

NAMES = ("fig-4.2", "fig-4.3", "fig-4.4", "fig-4.7", "fig-4.8", "table-4.1")
CHOSEN = {  # of each experiment, the cells that are run
    "fig-4.2": ("converge 2-deep, fsp, mmu",),
    "fig-4.4": ("spread 2-deep, 2 robots, ff",),
    "fig-4.7": ("synchronous, dmmu", "synchronous, cnf"),
    "table-4.1": ("case study, dmmu",),
    "fig-4.8": ("case study, dmmu",),
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
        assert all(cell.first_seed == chapter4.FIRST_SEED for cell in cells)
        if budget == "smoke":
            continue
        for cell in cells:
            algorithm = cell.algorithm
            assert (algorithm.population_size, algorithm.elites) == (100, 4)
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
    html = page.render(
        page.Page(name, module.PUBLISHED, "command", module.sections(measured), {"budget": "smoke"})
    )
    assert "nan" not in html.replace("nance", "")


def test_shares_of_the_ceiling_are_of_the_median():
    measured = {
        "converge 2-deep, fsp, mmu": {
            "where": "converge 2-deep, fsp",
            "network": "mmu",
            "final": [0.4, 0.5, 0.45],
            "floors": {"always left": 0.25, "imitating FSP": 0.2},
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
