"""The page of claims follows from the committed results by the rule that it states."""

import importlib.util
import pathlib

import numpy as np
import pytest
import scipy.stats

from credo.experiments import base
from credo.experiments.catalogue import EXPERIMENTS

ROOT = pathlib.Path(__file__).parents[2]
BUDGETS = ("smoke", "quick", "full", "million", "published")
ROWS = {"sign", "policy", "configuration", "learner", "fate"}  # labels of rows within a cell


def loaded():
    path = ROOT / "docs" / "extensions" / "claims.py"
    spec = importlib.util.spec_from_file_location("claims", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


claims = loaded()
EVERY = claims.claims()


def test_the_page_says_what_follows_from_what_is_committed():
    assert claims.BLOCK.read() == claims.table()
    assert len(EVERY) >= 40


@pytest.mark.parametrize("number", range(len(EVERY)))
def test_every_part_is_of_a_cell_that_its_experiment_has(number):
    """Also where nothing is committed yet: a misspelt label would leave a claim open for ever."""
    for part in claims.parts(EVERY[number]):
        for name, cell in wanted(part):
            assert name in EXPERIMENTS
            planned = [x.labels for budget in BUDGETS for x in cells(name, budget)]
            assert set(cell) <= ROWS.union(*planned)
            assert claims.labels_of({"cells": [{"labels": x} for x in planned]}, cell) is not None


def test_what_is_open_names_what_it_would_cost():
    for number, claim in enumerate(EVERY):
        _, verdict = claims.row(number, claim)
        assert ("hours" in claim) or verdict != "open"


def wanted(part):
    """The experiment and cell of a part, and those that it is compared with."""
    yield part["experiment"], part["cell"]
    other = part.get("above", part.get("relative"))
    if other is not None:
        yield part.get("than", part["experiment"]), part["cell"] | other


def cells(name, budget):
    try:
        return base.find(name).cells(budget)
    except (KeyError, ValueError):  # it has no such budget
        return []


@pytest.mark.parametrize(
    ("x", "part", "verdict"),
    [
        ([0.9] * 5, {"at_least": 0.9}, "reproduced"),
        ([0.7, 0.8, 0.8, 0.8, 1.0], {"at_least": 0.85}, "in part"),
        ([0.7, 0.8, 1.0], {"at_least": 0.9}, "not reproduced"),  # three seeds: only the best one
        ([0.7, 0.7, 0.8], {"at_least": 0.9, "error": 0.2}, "reproduced"),
        ([0.7, 0.7, 1.0], {"at_least": 0.9, "best": True}, "reproduced"),
        ([0.7, 0.7, 1.0], {"at_most": 0.8, "low": True, "best": True}, "reproduced"),
        ([0.1, 0.0, 0.0], {"at_most": 0.1}, "reproduced"),
        ([0.5, 0.2, 0.4], {"at_most": 0.1}, "refuted"),
        ([0.5, 0.2, 0.4], {"at_most": 0.1, "low": True}, "not reproduced"),
        ([0.5, 0.2, 0.4], {"positive": True}, "reproduced"),
        ([0.5, -0.2, 0.4], {"positive": True}, "not reproduced"),
        ([-0.5, -0.6, -0.4], {"positive": True}, "refuted"),
        ([7, 8, 9], {"at_most": 9, "low": True}, "reproduced"),
        ([7, claims.NEVER, 9], {"at_most": 9, "low": True}, "in part"),
        ([10, claims.NEVER], {"at_most": 9, "low": True}, "not reproduced"),
    ],
)
def test_the_rule_of_a_number(x, part, verdict):
    assert claims.level(np.array(x, float), part)[0] == verdict


@pytest.mark.parametrize(
    ("x", "y", "verdict"),
    [
        ([3, 4, 5], [0, 1, 2], "reproduced"),
        ([0, 1, 2], [3, 4, 5], "refuted"),
        ([0, 4, 5], [1, 2, 3], "open"),
        ([1, 1, 1], [1, 1, 1], "open"),
        ([0, 1, 2, 3, 4], [0, 1, 2, 3, 4], "not reproduced"),
        ([claims.NEVER, claims.NEVER, 5], [1, 2, 3], "reproduced"),
    ],
)
def test_the_rule_of_a_comparison(x, y, verdict):
    assert claims.comparison(np.array(x), np.array(y), False, 1.0)[0] == verdict


def test_the_rank_test_is_that_of_scipy():
    rng = np.random.default_rng(0)
    for n, m in ((3, 3), (5, 4), (10, 10)):
        x, y = rng.normal(size=n) + 0.5, rng.normal(size=m)
        known = scipy.stats.mannwhitneyu(x, y, alternative="greater", method="exact").pvalue
        assert claims.rank_test(x, y) == pytest.approx(known)


@pytest.mark.parametrize(
    ("verdicts", "verdict"),
    [
        (["reproduced", "reproduced"], "reproduced"),
        (["reproduced", "refuted"], "in part"),
        (["refuted", "not reproduced"], "refuted"),
        (["reproduced", "open"], "open"),
        (["in part", "not reproduced"], "not reproduced"),
    ],
)
def test_the_rule_of_several_parts(verdicts, verdict):
    assert claims.together(verdicts) == verdict


def test_too_few_seeds_and_too_short_a_budget_decide_nothing():
    part = {"experiment": "table-5.2", "metric": "fate", "of": "", "at_most": 0.0}
    part["cell"] = {"task": "Hopper-v5", "method": "erl", "fate": "discarded"}
    found = claims.found(part)
    assert (found.verdict, found.seeds) == ("open", 2)
    part = {"experiment": "fig-3.9a", "metric": "success", "of": "", "at_least": 1.0}
    part |= {"cell": {"preset": "ours", "depth": 6}}
    found = claims.found(part)
    assert (found.verdict, found.share) == ("open", 0.05)  # 500 of 10,000 generations
    assert claims.found(part | {"at_least": 0.01}).verdict == "reproduced"
    failing = {name: x for name, x in part.items() if name != "at_least"} | {"at_most": 0.5}
    assert claims.found(failing).verdict == "open"
    with pytest.raises(ValueError, match="no row"):
        claims.found(part | {"metric": "sucess"})


def test_who_had_more_of_its_budget_does_not_win():
    """Evolution had all of its generations, the gradient a fifth of its updates."""
    part = {"experiment": "fig-3.11", "metric": "success", "of": ""}
    part["cell"] = {"preset": "as coded", "depth": 21, "trainer": "evolution"}
    found = claims.found(part | {"above": {"trainer": "gradient"}})
    assert (found.verdict, found.share) == ("open", 0.2)


def test_the_readme_has_the_count():
    first = claims.table()[2:].partition(".**")[0]
    assert f"on {first}." in (ROOT / "README.md").read_text("utf-8")
