"""What is shown while a run goes on: how far, how fast, how long still."""

import numpy as np
import pytest

from credo.runs import log
from credo.runs.budget import Budget, short
from credo.runs.options import RunOptions
from credo.runs.progress import Progress, clock

ROW = {"champion_score": 0.5, "fitness_max": 12.345}


def updated(budget, tmp_path, capsys, *, frames):
    with Progress(tmp_path / "run", 0, 0, budget) as bar:
        bar.update(1, ROW | {"frames": frames}, 10.0)  # compiles
        bar.line.last = -10.0
        bar.update(2, ROW | {"frames": 2 * frames}, 1.0)
        return capsys.readouterr().err.splitlines()


def test_a_budget_of_frames_is_shown_in_frames(tmp_path, capsys):
    first, second = updated(Budget(frames=1_000_000), tmp_path, capsys, frames=1000)
    assert first == "run: 1k/1M frames  left …  champion 0.5  best fitness 12.35  100 frames/s"
    # 998,000 frames are left at 1000 in a second
    assert second == "run: 2k/1M frames  left 16:38  champion 0.5  best fitness 12.35  1k frames/s"


def test_a_budget_of_generations_is_shown_in_generations(tmp_path, capsys):
    _, second = updated(Budget(generations=62), tmp_path, capsys, frames=1000)
    assert second.startswith("run: generation 2/62  left 1:00  champion 0.5")


def test_of_two_limits_the_nearer_one_tells_the_time_left(tmp_path, capsys):
    budget = Budget(generations=10_000, frames=5_000)
    _, second = updated(budget, tmp_path, capsys, frames=1000)
    assert "2k/5k frames  left 0:03" in second
    assert budget.share(2, 2000) == 0.4
    assert budget.share(9000, 2000) == 0.9


def test_nothing_is_said_unless_asked(tmp_path, capsys):
    with Progress(tmp_path, 0, 0, Budget(generations=2), shown=False) as bar:
        bar.start([])
        bar.update(1, ROW | {"frames": 3}, 1.0)
    assert capsys.readouterr().err == ""
    assert (bar.generation, bar.frames) == (1, 3)


@pytest.mark.parametrize(
    ("generation", "frames", "score", "reached"),
    [
        (3, 99, 0.0, None),
        (3, 100, 0.0, "100 of 100 frames"),
        (4, 0, 0.0, "4 of 4 generations"),
        (3, 99, np.float32(49) / np.float32(50), "champion score 0.98 of 0.98"),
        (3, 99, np.nan, None),
    ],
)
def test_a_budget_is_reached_by_its_first_limit(generation, frames, score, reached):
    budget = Budget(generations=4, frames=100, stop_at=0.98)
    assert budget.reached(generation, frames, score) == reached


def test_a_budget_has_a_limit():
    with pytest.raises(ValueError, match="give generations, frames or both"):
        Budget()
    assert Budget.of(None, RunOptions(frames=1e6)) == Budget(frames=1_000_000)
    assert Budget.of(None, RunOptions()) == Budget(generations=1000)


def test_short_numbers_and_clocks():
    assert [short(x) for x in (3.14159, 999, 12_345, 1e6, 2.5e9)] == [
        "3.14",
        "999",
        "12.3k",
        "1M",
        "2.5G",
    ]
    assert [clock(s) for s in (59.9, 3723)] == ["0:59", "1:02:03"]


def test_the_last_row_is_found_without_reading_the_file(tmp_path):
    journal = log.Log(tmp_path, 0)
    path = tmp_path / "metrics.csv"
    assert log.last(path) == {}
    for first in range(1, 20_000, 100):
        rows = [{"generation": g, "frames": 10 * g, "x": 0.5} for g in range(first, first + 100)]
        journal.append(rows, 1.0, 1.0)
    assert path.stat().st_size > 2**17
    expected = {"generation": "20000", "frames": "200000", "x": "0.5"}
    assert log.last(path) == expected
    with path.open("a") as file:
        file.write("20001,2000")
    assert log.last(path) == expected
