"""docs/runs.md names a test for each of its promises: all of them are there."""

import pathlib
import re

ROOT = pathlib.Path(__file__).parents[1]


def test_every_promise_names_tests_that_exist():
    there = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^ *def (test_\w+)", path.read_text(encoding="utf-8"), re.M)
    }
    table = (ROOT / "docs/runs.md").read_text(encoding="utf-8").split("| fault |")[1]
    rows = [line for line in table.splitlines()[2:] if line.startswith("|")]
    named = [set(re.findall(r"`(test_\w+)`", row)) for row in rows]
    assert len(rows) > 15
    assert [row for row, names in zip(rows, named, strict=True) if not names] == []
    assert set().union(*named) - there == set()
