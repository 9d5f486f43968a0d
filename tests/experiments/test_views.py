"""Views of rows, against sections made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from credo.experiments.base import Experiment, Value, grid
from credo.experiments.base import sections as sections_of
from credo.experiments.views import (
    SEED,
    Curves,
    Table,
    count,
    each,
    known,
    mean,
    plain,
    published,
)
from credo.report import sections
from credo.report.rows import Results, rows, series

SEEDS = [3, 4, 5]


@pytest.fixture
def results():
    """Two tasks and two methods, three runs of two episodes; random policies differ by task."""
    cells, found, curves = [], [], []
    for i, labels in enumerate(grid(task=["A", "B"], method=["erl", "ea"])):
        cells.append({"labels": labels})
        returns = 10 * i + np.arange(6.0).reshape(3, 2)  # means by seed: 0.5, 2.5, 4.5
        found += rows("return", returns, labels, seed=SEEDS, episode=None)
        found += rows("random", float(labels["task"] == "B"), labels)
        found += rows("solved after", [5, None, 7000], labels, seed=SEEDS)
        curves += series("score", "frames", [1, 2, 3], np.ones((3, 3)) * i, labels, seed=SEEDS)
    return Results("x", "quick", "c", cells, found, curves)


VALUES = [
    Value("~5", "return", "text", {"method": "erl"}),
    Value(4702.0, "return", "Figure 1", {"method": "erl", "task": "B"}, "± 356.5"),
]


def test_a_table_has_a_row_for_each_combination(results):
    columns = {
        "return": mean("return"),
        "median": plain("return", of=np.median),
        "solved": count("solved after", np.isfinite),
        "after": each("solved after"),
        "random": known("random", 100),
        "published": published("return"),
        "nothing": known("no such metric"),
    }
    (table,) = Table("Scores", ["task", "method"], columns, titles={"task": "of"})(results, VALUES)
    assert table.columns == [
        "of",
        "method",
        "return",
        "median",
        "solved",
        "after",
        "random",
        "published",
    ]
    assert [row[:2] for row in table.rows] == [["A", "erl"], ["A", "ea"], ["B", "erl"], ["B", "ea"]]
    assert list(table.rows[1][2].values) == [10.5, 12.5, 14.5]
    assert list(table.rows[1][2].seeds) == SEEDS
    assert table.rows[1][3:] == [12.5, "2 of 3", "5, never, 7,000", 0.0, None]
    assert table.rows[2][-2:] == [100.0, "4,702 ± 356.5"]
    assert table.rows[0][-1] == "~5"


def test_a_published_number_is_a_level_or_has_its_spread(results):
    here = results.where(task="B")
    assert published("return", number=True)(here, VALUES) == 4702.0
    assert published("return")(here, VALUES) == "4,702 ± 356.5"
    assert published("return")(here.where(method="ea"), VALUES) is None
    assert published("return", method="erl")(results.where(task="A"), VALUES) == "~5"


def test_rows_without_content_and_views_without_rows_are_left_out(results):
    (table,) = Table("Scores", ["method"], {"score": mean("score")}, where={"task": "A"})(
        results, ()
    )
    assert [row[0] for row in table.rows] == ["erl", "ea"]
    assert list(Table("T", ["task"], {"x": mean("no such metric")})(results, ())) == []
    assert list(Curves("no such metric", "frames", ["method"])(results, ())) == []


def test_curves_have_a_panel_and_a_line_for_their_labels(results):
    view = Curves("score", "frames", ["method"], ["task"], levels={"random": known("random")})
    first, second = view(results, ())
    assert (first.title, second.title) == ("A", "B")
    assert [curve.label for curve in second.curves] == ["erl", "ea"]
    np.testing.assert_array_equal(second.curves[1].runs, 3 * np.ones((3, 3)))
    assert second.references == [sections.Reference("random", 1.0)]
    titled = Curves("score", "frames", ["method"], ["task"], title="{panel}: task {task}")
    assert next(iter(titled(results, ()))).title == "A: task A"


def test_curves_over_a_label_have_a_point_for_each_of_its_numbers():
    found = [
        row
        for depth, values in ((5, [0.1, 0.2]), (2, [0.3, None]))
        for row in rows("success", values, {"depth": depth}, seed=[0, 1])
    ]
    (figure,) = Curves("success", "depth", [])(Results("x", "", "", [], found, []), ())
    (curve,) = figure.curves
    assert list(curve.x) == [2, 5]
    np.testing.assert_allclose(curve.runs, [[0.3, 0.1], [np.nan, 0.2]])


def test_notes_say_what_is_true_of_the_page(results):
    notes = [("always", {}), ("of A", {"task": "A"}), ("of C", {"task": ["C", "D"]})]
    experiment = Experiment(lambda budget: [], (), (), notes=notes)
    (text,) = sections_of(experiment, results)
    assert (text.title, text.paragraphs) == ("How to read it", ["always", "of A"])
    assert sections_of(replace(experiment, notes=notes[2:]), results) == []


def test_a_table_has_a_row_for_each_run_and_a_panel_for_each_label(results):
    view = Table("{panel}", [SEED], {"return": each("return")}, panel=["task", "method"])
    first, *others = view(results, ())
    assert (first.title, len(others)) == ("A, erl", 3)
    assert first.rows == [["3", "0.0, 1.0"], ["4", "2.0, 3.0"], ["5", "4.0, 5.0"]]
