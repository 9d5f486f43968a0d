"""Committed results: they are those of before (results/CONVERSION.md), and make their pages."""

import pathlib
import re
import shlex
import sys

import numpy as np
import pytest

from credo.experiments import base
from credo.report import pages as page
from credo.report.rows import read

ROOT = pathlib.Path(base.__file__).parents[3]
sys.path.insert(0, str(ROOT / "tools"))
import convert_chapters_5_7 as chapters  # noqa: E402
import convert_results as tool  # noqa: E402

RESULTS = sorted((ROOT / "results").glob("*/*/results.json"))
LINES = {
    line.split(" | ")[0].strip("| "): [part.strip() for part in line.strip("| \n").split(" | ")]
    for line in (ROOT / "results" / "CONVERSION.md").read_text().splitlines()
    if re.match(r"\| \S+/", line)
}
CONVERTED = {  # of files that have had other cells since, those that were converted
    f"{name}/full": {"preset": "ours"} for name in ("table-3.1", "alg-3.3", "fig-3.6", "fig-3.7")
}
IDS = [path.parent.relative_to(ROOT / "results").as_posix() for path in RESULTS]


def test_every_converted_file_is_still_there():
    assert set(LINES) <= set(IDS)
    assert len(LINES) == 39
    for _, before, rest, after, was, now, equal, shown, found in LINES.values():
        assert int(before) - int(rest) == int(after)
        assert (was, equal) == (now, "yes")
        missing = re.findall(r"\d+", found.partition("(missing: ")[2])
        assert all(int(x) < 10 for x in missing)  # runs that have names now
        assert len(missing) <= int(shown) - int(found.split()[0])


@pytest.mark.parametrize("name", IDS)
def test_its_values_are_those_of_before_and_its_page_renders(name):
    results = read(ROOT / "results" / name / "results.json")
    if name in LINES:
        before = results.where(**CONVERTED.get(name, {}))
        values = [row.value for row in before.rows]
        values += [y for curve in before.curves for y in curve.values]
        leaves = list(map(tool.tagged, tool.leaves(values)))
        assert len(leaves) == int(LINES[name][3])
        assert f"{tool.total(leaves):.10g}" == LINES[name][5]
    described = base.describe(results)
    assert len(described.sections) >= 1
    assert ">nan" not in page.render(described)


@pytest.mark.parametrize("name", IDS)
def test_its_commands_choose_its_cells(name):
    results = read(ROOT / "results" / name / "results.json")
    every = base.find(results.experiment).cells(results.budget)
    chosen = []
    for command in results.command.split(" && "):
        words = shlex.split(command)
        only = words[words.index("--only") + 1] if "--only" in words else ""
        chosen += [cell.name for cell in base.matching(every, only, name)]
    assert {base.named(cell["labels"]) for cell in results.cells} <= set(chosen)


def old(name, **measured):
    cells = {x: {"runs": 2, "first seed": 7, "frames": 9, "algorithm": {}} for x in measured}
    record = {"experiment": name, "budget": "full", "command": "credo", "machine": {}}
    return record | {"cells": cells, "measured": measured}


SCORES = {
    "task": "Hopper-v5",
    "label": "td3 gamma 0.9",
    "frames": [3, 6],
    "score": [[None, 1.5], [2.5, 3.5]],
    "last": [1.5, 3.5],
    "last smoothed": [1.0, 3.0],
    "final": [[1.0, 2.0], [3.0, 4.0]],
    "played": [9, 9],
    "updates per frame": [1.0, 1.0],
    "floor": [0.25, 0.01],
}


def test_a_tree_becomes_rows():
    record = old("fig-6.5", **{"td3 gamma 0.9 Hopper-v5": SCORES})
    new = chapters.CONVERTERS["fig-6.5"](record)
    (cell,) = new.cells
    assert cell["labels"] == {"method": "td3", "gamma": 0.9, "task": "Hopper-v5"}
    assert (cell["seeds"], cell["budget"]) == ([7, 8], {"frames": 9})
    assert new.by_seed("return") == {7: [1.0, 2.0], 8: [3.0, 4.0]}
    assert new.value("random") == 0.25
    assert list(new.curves[0].values) == [None, 1.5]
    told = tool.compare(record, new)
    assert (told["before"], told["rest"], told["after"], told["equal"]) == (22, 4, 18, True)


def test_a_value_that_is_lost_or_new_is_an_error():
    record = old("fig-6.5", **{"td3 gamma 0.9 Hopper-v5": SCORES})
    new = chapters.CONVERTERS["fig-6.5"](record)
    record["measured"]["td3 gamma 0.9 Hopper-v5"]["last"][0] = 77.0
    with pytest.raises(ValueError, match=r"new values \[.*1.5.*lost \[.*77.0"):
        tool.compare(record, new)


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        ("cerl gamma 0 1 Hopper-v5", {"method": "cerl of gamma 0 and 1", "task": "Hopper-v5"}),
        ("cerl c 5 Humanoid-v5", {"method": "cerl", "exploration": 5.0, "task": "Humanoid-v5"}),
        ("ea of cerl Hopper-v5", {"method": "ea of cerl", "task": "Hopper-v5"}),
        (
            "cerl sac ucb Hopper-v5",
            {"method": "cerl with sac", "manager": "ucb", "task": "Hopper-v5"},
        ),
        (
            "ddpg spread InvertedDoublePendulum-v5 delayed",
            {"method": "ddpg spread", "task": "InvertedDoublePendulum-v5", "delayed": True},
        ),
        ("erl untested X-v5", {"method": "erl", "task": "X-v5", "untested": True}),
    ],
)
def test_old_names_on_mujoco_are_read(name, labels):
    assert chapters.on_mujoco(name) == labels


def test_old_names_have_the_labels_of_todays_cells():
    for experiment, names in {
        "fig-6.4": ["cerl c 0 Humanoid-v5", "cerl Humanoid-v5", "cerl c 5 Humanoid-v5"],
        "fig-5.4": ["erl HalfCheetah-v5", "erl no selection HalfCheetah-v5"],
        "note-5.5": ["erl untested HalfCheetah-v5", "ddpg untested HalfCheetah-v5"],
        "beyond-6": ["cerl sac thompson Hopper-v5", "sac bronet Hopper-v5"],
    }.items():
        today = [cell.labels for cell in base.find(experiment).cells("full")]
        assert all(chapters.on_mujoco(name) in today for name in names)
    for experiment, names in {
        "fig-7.1": ["td3 mixed, motivating example"],
        "fig-7.4": ["merl, coupling 4, author's dynamics and sensors", "maddpg mixed, coupling 7"],
        "fig-7.5": ["merl, coupling 3, paths, partly trained", "matd3 mixed, coupling 3, paths"],
        "beyond-7": ["merl / nothing shared, coupling 4, all rewards"],
        "check-spread": ["matd3, simple spread"],
    }.items():
        today = [cell.labels for cell in base.find(experiment).cells("full")]
        assert all(chapters.on_rovers(name) in today for name in names)


def test_numbers_of_an_old_page_are_found_as_they_were_rounded():
    known = np.array([1234.5, -0.0449, 7.0])
    assert [tool.found(x, known) for x in ("1,234", "-0.04", "7.00", "7.1")] == [True] * 3 + [False]
    assert tool.Cells("<table><td>a −1</td><th>2</th><td><b>3</b> ± 4</td></table>").texts == [
        "a -1",
        "3 ± 4",
    ]
