"""Attribution on metrics whose answer is known by hand."""

import numpy as np
import pytest

from credo.algorithms.lineage import INJECTED, MAKERS, MUTATED
from credo.analysis import attribution

TWO = {  # two learners, four generations
    "generation": np.arange(1.0, 5.0),
    "frames": np.array([10.0, 20.0, 30.0, 40.0]),
    "workers_0": np.array([2.0, 1.0, 3.0, 0.0]),
    "workers_1": np.array([2.0, 3.0, 1.0, 4.0]),
    "elite_0": np.array([0.0, 1.0, 0.0, 1.0]),
    "selected_0": np.array([0.0, 0.0, 1.0, 0.0]),
    "discarded_0": np.array([0.0, 0.0, 0.0, 1.0]),
    "elite_1": np.zeros(4),
    "selected_1": np.zeros(4),
    "discarded_1": np.zeros(4),
    "champion_maker": np.array([0.0, MUTATED, INJECTED, MUTATED]),
    "champion_share_0": np.array([0.0, 0.0, 1.0, 0.5]),
    "champion_share_1": np.array([0.0, 0.0, 0.0, 0.25]),
}
NONE = {name: TWO[name] for name in ("generation", "frames", "champion_maker")}


def test_fates_are_shares_of_the_actors_that_were_judged():
    np.testing.assert_allclose(attribution.injected(TWO), [4, 0])
    np.testing.assert_allclose(attribution.fates(TWO), [[0.5, 0.25, 0.25], [np.nan] * 3])


def test_allocation_is_cumulative():
    np.testing.assert_allclose(
        attribution.allocation(TWO), [[0.5, 3 / 8, 0.5, 6 / 16], [0.5, 5 / 8, 0.5, 10 / 16]]
    )


def test_ancestry_adds_up_to_one():
    ancestry = attribution.ancestry(TWO)
    np.testing.assert_allclose(ancestry, [[0, 0, 1, 0.5], [0, 0, 0, 0.25], [1, 1, 0, 0.25]])


def test_makers_are_a_moving_share():
    made = attribution.makers(TWO)  # a tenth of four generations: one
    assert [MAKERS[i] for i in made.argmax(axis=0)] == ["drawn", "mutation", "learner", "mutation"]
    long = {"champion_maker": np.repeat([0.0, MUTATED], 20)}  # windows of four
    np.testing.assert_allclose(attribution.makers(long)[MUTATED, 19:25], [0, 0.25, 0.5, 0.75, 1, 1])


def test_a_run_without_learners_has_makers_alone():
    assert attribution.known(NONE)
    assert not attribution.known({"generation": np.ones(1)})
    found = attribution.summary([NONE], points=4)
    assert found["frames"] == [10, 20, 30, 40]
    assert found["allocation"] == found["fates"] == [[]]
    assert found["ancestry"] == [[[1.0] * 4]]
    assert found["makers"][0][0] == [1.0, 0.0, 0.0, 0.0]


def test_a_summary_is_plain_and_ends_where_its_runs_do():
    short = {name: column[:3] for name, column in TWO.items()}
    found = attribution.summary([TWO, short], points=8)
    assert found["frames"] == [5, 10, 15, 20, 25, 30, 35, 40]
    assert found["allocation"][0][0] == [None, 0.5, 0.5, 0.375, 0.375, 0.5, 0.5, 0.375]
    assert found["allocation"][1][0][-1] == 0.5  # of a shorter run, the last
    assert found["fates"] == [
        [[0.5, 0.25, 0.25], [None, None, None]],
        [[0.5, 0.5, 0.0], [None, None, None]],
    ]
    assert found["injected"] == [[4, 0], [2, 0]]
    assert found["allocated"][1] == [0.5, 0.5]


@pytest.mark.parametrize(("points", "grid"), [(3, [4, 7, 10]), (100, list(range(1, 11)))])
def test_an_axis_has_whole_numbers(points, grid):
    assert attribution.axis([[5.0, 10.0], [3.0]], points).tolist() == grid
