"""Tidy rows: arrays become rows, files hold them, questions are answered."""

import json

import numpy as np
import pytest

from credo.report.rows import Results, Row, Series, concat, plain, read, rows, series, write

LABELS = {"task": "A"}


def made(found, curves=(), cells=()):
    return Results("x", "quick", "credo x", list(cells), list(found), list(curves))


def test_an_array_becomes_rows_by_its_axes():
    found = rows("return", [[1.0, 2.0], [3.0, np.nan]], LABELS, seed=[7, 8], episode=None)
    assert found == [
        Row({"task": "A", "episode": 0}, 7, "return", 1.0),
        Row({"task": "A", "episode": 1}, 7, "return", 2.0),
        Row({"task": "A", "episode": 0}, 8, "return", 3.0),
        Row({"task": "A", "episode": 1}, 8, "return", None),
    ]
    assert rows("bound", np.float32(0.5), LABELS) == [Row(LABELS, None, "bound", 0.5)]
    with pytest.raises(ValueError, match=r"'return' has shape .* name every dimension"):
        rows("return", [[1.0, 2.0]], LABELS, seed=[7, 8], episode=None)


def test_the_last_dimension_of_series_is_its_points():
    found = series("share", "frames", [10, 20], np.ones((2, 3, 2)), LABELS, seed=[0, 1], who="abc")
    assert len(found) == 6
    assert found[-1] == Series(
        {"task": "A", "who": "c"}, 1, "share", "frames", [10, 20], [1.0, 1.0]
    )


def test_a_file_has_a_line_for_each_row_and_gives_it_back(tmp_path):
    found = [*rows("a", [1, None], LABELS, seed=[0, 1]), Row({"depth": 2.5}, None, "b", "text")]
    curves = series("c", "frames", [1, 2], [[0.5, None], [1, 2]], LABELS, seed=[0, 1])
    curves += series("d", "step", [1], [3], {"depth": 2.5})
    results = made(found, curves, [{"labels": LABELS, "seeds": [0, 1]}])
    write(results, tmp_path / "results.json")
    assert read(tmp_path / "results.json") == results
    record = json.loads((tmp_path / "results.json").read_text())
    assert record["columns"] == ["task", "depth", "seed", "metric", "value"]
    assert record["rows"][2] == [None, 2.5, None, "b", "text"]
    assert record["curves"][0]["seeds"] == {"0": [0.5, None], "1": [1, 2]}
    lines = (tmp_path / "results.json").read_text().splitlines()
    assert '["A", null, 1, "a", null],' in lines


@pytest.mark.parametrize("text", ["{", "{}", '{"measured": {}}', "[]"])
def test_another_file_is_none(tmp_path, text):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(ValueError, match="is no record of results"):
        read(tmp_path / "results.json")


def test_questions_of_results():
    found = [
        *rows("a", [[1, 2], [3, 4]], {"task": "A"}, seed=[0, 1], depth=[2, 5]),
        *rows("a", [9], {"task": "B"}, seed=[0]),
        Row({"task": "A"}, None, "bound", 7),
    ]
    results = made(found, cells=[{"labels": {"task": "A"}}, {"labels": {"task": "B"}}])
    assert results.levels("task") == ["A", "B"]
    assert results.levels("task", "depth") == [("A", 2), ("A", 5)]
    assert len(results.where(task=("A", "B"), depth=(2, 5)).rows) == 4
    assert [row.value for row in results.where(depth=None).rows] == [9, 7]
    assert results.where(task="B").cells == [{"labels": {"task": "B"}}]
    assert results.by_seed("a", task="A") == {0: [1, 2], 1: [3, 4]}
    assert results.value("bound") == 7
    assert results.value("none", default=0) == 0
    with pytest.raises(ValueError, match="'a' has 5 values here: ask for more labels"):
        results.value("a")
    array = results.array("a", "seed", "depth", task="A")
    assert array.tolist() == [[1, 2], [3, 4]]
    curves = series("c", "frames", [1, 2, 3], [[1, 2, 3], [4, 5, 6]], LABELS, seed=[0, 1])
    assert made([], curves).array("c", "seed").tolist() == [[1, 2, 3], [4, 5, 6]]
    mixed = [*curves, *series("c", "frames", [1], [7], LABELS)]
    with pytest.raises(ValueError, match=r"series of \[1, 3\] points"):
        made([], mixed).array("c", "seed")


def test_numbers_are_plain():
    assert plain({"a": np.float32(0.5), 1: [np.inf, "x", None, np.int64(3)]}) == {
        "a": 0.5,
        "1": [None, "x", None, 3],
    }
    found, curves = concat([[Row(LABELS, 0, "a", 1)], series("c", "x", [1], [2], LABELS)])
    assert (len(found), len(curves)) == (1, 1)
