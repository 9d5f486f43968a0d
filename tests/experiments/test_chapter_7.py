"""Experiments of chapter 7: their cells, and pages from numbers made up."""

import importlib

import pytest

from credo.algorithms.merl import MERL
from credo.experiments import base, chapter7, check_spread, fig_7_1, fig_7_4

NAMES = ("fig-7.1", "fig-7.4", "fig-7.5", "beyond-7", "check-spread")


def experiment(name):
    return importlib.import_module(f"credo.experiments.{base.MODULES[name]}")


@pytest.mark.parametrize("name", NAMES)
def test_every_budget_has_cells_with_names_of_their_own(name):
    for budget in base.budgets(name):
        cells = experiment(name).cells(budget)
        names = [cell.name for cell in cells]
        assert len(set(names)) == len(names) >= 2
        assert all(cell.frames >= 1_000 and cell.runs >= 1 for cell in cells)


def test_every_method_has_the_same_team_discount_rates_and_updates():
    cells = [cell.algorithm for cell in fig_7_4.cells("full")]
    assert len(cells) == 7 * 7 + 6
    learners = [x for cell in cells for x in getattr(cell, "learners", ()) or ()]
    learners += [cell.learner for cell in cells if not isinstance(cell, MERL)]
    for name in ("gamma", "actor_lr", "critic_lr", "tau", "batch_size", "noise"):
        assert len({str(getattr(learner, name)) for learner in learners}) == 1
    assert len({str(cell.network) for cell in cells}) == 1
    assert {cell.updates_per_frame for cell in cells} == {0.05}
    assert {cell.env.agents for cell in cells} == set(range(2, 15, 2))
    signals = [x.signal for x in learners]
    assert {"local", "mixed", "global"} == set(signals)


def made_up(method, where, runs=3):
    frames = [100, 200, 300]
    return {
        "method": method,
        "where": where,
        "frames": frames,
        "score": [[0.1, 0.2, 0.3 + 0.1 * r] for r in range(runs)],
        "final": [0.3 + 0.1 * r for r in range(runs)],
        "played": [300] * runs,
        "updates per frame": [0.05] * runs,
        "reference": {"random": 0.01, "greedy": 0.93, "scripted": 1.0, "bound": 1.0},
    }


def test_the_table_shows_floors_published_ours_and_ceiling():
    measured = {"merl, coupling 4": made_up("merl", "coupling 4")}
    (row,) = chapter7.scores(measured, {"merl, coupling 4": "0.46"}).rows
    assert row == [
        *("coupling 4", "merl", "0.01", "0.93", "0.46", "0.40 (0.30…0.50)", "1.00", "1.00"),
        *("300", "0.05"),
    ]
    (figure,) = chapter7.curves(measured)
    assert [reference.label for reference in figure.references] == ["random", "greedy script"]


def test_pages_of_the_figures_have_their_sections():
    measured = {
        f"{method}, {where}": made_up(method, where) | {"both after": [100, None, 300]}
        for method in ("merl", "ea")
        for where in ("coupling 1", "coupling 4")
    }
    titles = [section.title for section in fig_7_4.sections(measured)]
    assert titles[1:3] == ["coupling 1", "coupling 4"]
    both = fig_7_1.sections(measured)[0]
    assert both.rows[0] == ["merl", "2 of 3", "100, never, 300"]


def test_the_check_of_baselines_says_what_is_to_be_beaten():
    measured = {
        "matd3, simple spread": {
            "method": "matd3",
            "frames": [1, 2],
            "score": [[-20.0, -9.0]],
            "final": [-9.0],
            "played": [2],
            "reference": {"random": -26.0},
        }
    }
    table = check_spread.sections(measured)[1]
    assert table.rows[0][:5] == [
        "matd3",
        -26.0,
        "-7.4 … -8.4, one -23.9",
        -10.0,
        "-9.00 (-9.00…-9.00)",
    ]
