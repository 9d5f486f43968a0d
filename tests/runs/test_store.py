"""What a run says of itself in a line."""

import numpy as np
import pytest

from credo.runs.store import _last_test


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({}, ""),
        ({"test_every": 1, "population_size": 4}, ""),
        ({"test_every": 2, "population_size": 4}, ""),  # generations 1, 3 and 5
        ({"test_every": 3, "population_size": 4}, " at the last test, after 40 frames,"),
        ({"test_every": 25}, ""),  # frames 0, 25 and 50 lie in generations 1, 3 and 5
        ({"test_every": 30}, " at the last test, after 30 frames,"),
        ({"test_every": 1000}, " at the last test, after 10 frames,"),
    ],
)
def test_a_score_says_of_when_it_is(settings, told):
    columns = {"generation": np.arange(1, 6), "frames": 10 * np.arange(1, 6)}
    assert _last_test(columns, settings) == told
