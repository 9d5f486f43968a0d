"""When does a hybrid win: the table that says it; and its ingredients."""

from collections import defaultdict

import pytest

from credo.experiments import ingredients
from credo.experiments.hybrids import BETTER, EVOLUTION, HYBRID, LEARNER
from credo.report.rows import Results, Row


def test_the_hybrid_stands_beside_each_of_its_parts():
    scores = {HYBRID: (30.0, 50.0), LEARNER: (20.0, 40.0), EVOLUTION: (-1.0, -3.0)}
    rows = [
        Row({"method": method, "task": "Hopper-v5", "episode": episode}, seed, "return", value)
        for method, runs in scores.items()
        for seed, value in enumerate(runs)
        for episode in (0, 1)
    ]
    (table,) = BETTER(Results("", "", "", [], rows, []), ())
    assert table.columns[:3] == ["task", "beside", "ratio of means"]
    assert table.columns[3:] == ["P(hybrid is better)", "95 % interval"]
    learner, evolution = table.rows
    # 30 > 20, 30 < 40, 50 > both: three of four pairs; the ratio of 40 to 30.
    assert learner[:4] == ["Hopper-v5", LEARNER, "1.33", "0.75"]
    assert learner[4] == "0.00 to 1.00"
    # A ratio to a negative mean says nothing.
    assert evolution == ["Hopper-v5", EVOLUTION, None, "1.00", "1.00 to 1.00"]


@pytest.mark.parametrize("name", ["hybrid-learner", "hybrid-ingredients"])
def test_every_ingredient_changes_the_algorithm_and_no_two_are_the_same(name):
    tasks = defaultdict(dict)
    for cell in ingredients.EXPERIMENTS[name].cells("full"):
        tasks[cell.labels["task"]][cell.labels["change"]] = cell.algorithm
    assert len(tasks) == 2
    for algorithms in tasks.values():
        assert next(iter(algorithms)) == ingredients.WHOLE
        assert len({repr(x) for x in algorithms.values()}) == len(algorithms) > 10
