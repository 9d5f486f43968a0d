"""Bring `results.json` of Credo 0.1.0 before the change to rows into today's format.

    python tools/convert_results.py OLD.json [NEW.json]   one file, onto itself without NEW
    python tools/convert_results.py                       all of results/, and results/CONVERSION.md

Old files have a tree `measured` of the experiment's own; what is where in it, and what the names of
cells mean, is known in `convert_chapters_3_4` and `convert_chapters_5_7`, and nowhere else. Nothing
is written unless every value is there before and after: see `compare`. Run it from an installed
checkout.
"""

import json
import re
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
from modern_settings import modern

from credo.experiments import base
from credo.report.rows import Results, write
from credo.report.sections import Section, Summary, Table, Tracks

RESULTS = Path(__file__).parents[1] / "results"
NUMBER = re.compile(r"-?\d[\d,]*(?:\.\d+)?")
LOG_HEAD = """# Results in rows: before and after

`results.json` of Credo 0.1.0 had a tree for each experiment; now all have rows and curves.
`python tools/convert_results.py` brought the committed ones over; nothing was run again. Values are
the entries of rows and the points of curves, with their sum. All other leaves of an old file are
the axes of its curves and labels. The last columns count the numbers in the tables of the old
`report.html`, and those of them that are on the new page or follow from the runs that a cell there
shows (mean, median, range, standard deviation, standard error, interval of Student's t), rounded as
they were. What is missing are runs that were numbered 0 to 9 and are named by their seeds now.

| file | leaves | axes, labels | values | sum before | sum after | equal | old page | new page |
|---|---|---|---|---|---|---|---|---|
"""


def converters() -> dict[str, Callable[[dict[str, Any]], Results]]:
    """By the id of the experiment."""
    parts = ("convert_chapters_3_4", "convert_chapters_5_7")
    return {name: f for part in parts for name, f in import_module(part).CONVERTERS.items()}


def convert(path: Path) -> tuple[Results, dict[str, Any]]:
    """A file in today's format, and its line of the log. Raises `ValueError` if a value is lost."""
    old = json.loads(path.read_text())
    new = converters()[old["experiment"]](old)
    cells = [cell | {"algorithm": modern(cell["algorithm"])} for cell in new.cells]
    new = replace(new, cells=cells)
    words = shlex.split(new.command)
    for pattern in [words[i + 1] for i, word in enumerate(words) if word == "--only"]:
        if not any(re.search(pattern, base.named(x["labels"]), re.IGNORECASE) for x in cells):
            raise ValueError(f"{path}: no cell has {pattern!r} in its name any more")
    line = compare(old, new)
    page = path.with_name("report.html")
    return new, line | (pages(page.read_text(), new) if page.exists() else {})


# ----------------------------------------------------------------------------- values before, after


def compare(old: dict[str, Any], new: Results) -> dict[str, Any]:
    """What an old tree has and new rows have. Raises `ValueError` unless every leaf is one value,
    or else lies on the axis of a curve, is a label or a part of a cell's old name, or stood under a
    key that has become a label; and no value is new."""
    measured = old["measured"]
    before = Counter(map(tagged, leaves(measured)))
    values = [row.value for row in new.rows] + [y for curve in new.curves for y in curve.values]
    after = Counter(map(tagged, leaves(values)))
    rest = before - after
    places = {tagged(x) for curve in new.curves for x in curve.at}
    places |= {tagged(x) for item in [*new.rows, *new.curves] for x in item.labels.values()}
    names = words(" ".join(old["cells"]))

    places |= {("str", text) for kind, text in rest if kind == "str" and words(text) <= names}
    places |= set(map(tagged, leaves(list(named_leaves(measured)))))
    added, lost = after - before, [x for x in rest if x not in places]
    if added or lost:
        raise ValueError(f"{new.experiment}: new values {list(added)[:9]}, lost {lost[:9]}")
    sums = [total((before - rest).elements()), total(after.elements())]
    return {
        "before": before.total(),
        "rest": rest.total(),
        "after": after.total(),
        "sums": sums,
        "equal": before - rest == after,
    }


def named_leaves(tree: Any) -> Iterator[Any]:
    """What stands under keys that have become labels."""
    for key, inner in tree.items() if isinstance(tree, dict) else ():
        if key in import_module("convert_chapters_3_4").AXES:
            yield inner
    for inner in (
        tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    ):
        yield from named_leaves(inner)


def words(text: str) -> set[str]:
    """Without commas."""
    return set(re.findall(r"[^\s,]+", text))


def leaves(tree: Any) -> Iterator[Any]:
    """Numbers, texts, truth values and nulls of a tree of JSON."""
    if isinstance(tree, dict | list | tuple):
        for inner in tree.values() if isinstance(tree, dict) else tree:
            yield from leaves(inner)
    else:
        yield tree


def tagged(leaf: Any) -> tuple[str, Any]:
    """So that true is not 1."""
    return ("number" if type(leaf) in (int, float) else type(leaf).__name__, leaf)


def total(leaves: Iterable[tuple[str, Any]]) -> float:
    """The sum of the numbers among leaves."""
    return float(np.sum(np.sort([x for kind, x in leaves if kind == "number"])))


# --------------------------------------------------------------------------- numbers of their pages


class Cells(HTMLParser):
    """The texts of a page's table cells."""

    def __init__(self, html: str):
        super().__init__()
        self.texts: list[str] = []
        self.open = False
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: Any):
        if tag == "td":
            self.open = True
            self.texts.append("")

    def handle_endtag(self, tag: str):
        self.open = self.open and tag != "td"

    def handle_data(self, data: str):
        if self.open:
            self.texts[-1] += data.replace("−", "-")


def pages(html: str, new: Results) -> dict[str, Any]:
    """How many numbers the tables of an old page have, and those that the new one does not."""
    shown = [x for text in Cells(html).texts for x in NUMBER.findall(text)]
    sections = base.sections(base.find(new.experiment), new)
    known = np.array(sorted({*numbers(sections)}))
    return {"shown": len(shown), "missing": sorted({x for x in shown if not found(x, known)})}


def found(text: str, known: np.ndarray) -> bool:
    """Whether a number that was rounded to these digits is one of those known."""
    digits = len(text.partition(".")[2])
    value = float(text.replace(",", ""))
    return bool(np.any(np.abs(known - value) <= 0.500001 * 10.0**-digits))


def numbers(sections: Iterable[Section]) -> Iterator[Any]:
    """Everything that the tables of a page say, and what follows from the runs in a cell."""
    tables = [x.table if isinstance(x, Tracks) else x for x in sections]
    for section in tables:
        for cell in [x for row in section.rows for x in row] if isinstance(section, Table) else []:
            if isinstance(cell, Summary):
                yield from of_runs(cell)
            elif isinstance(cell, str):
                yield from (float(x.replace(",", "")) for x in NUMBER.findall(cell))
            elif cell is not None:
                yield float(cell)


def of_runs(cell: Summary) -> Iterator[Any]:
    """Every run, and statistics of them."""
    x = cell.scale * np.array([v for v in cell.values if v is not None], np.float64)
    yield from x
    yield from (np.mean(x), np.median(x), np.sum(x))
    if len(x) > 1:
        error = np.std(x, ddof=1) / np.sqrt(len(x))
        half = scipy.stats.t.ppf(0.975, len(x) - 1) * error
        yield from (np.std(x, ddof=1), np.std(x), error, x.mean() - half, x.mean() + half)


# -------------------------------------------------------------------------------------- the command


def line(path: Path, x: dict[str, Any]) -> str:
    """Of the log."""
    sums = [f"{value:.10g}" for value in x["sums"]]
    there = f"{x['shown'] - len(x['missing'])}" if "shown" in x else "–"
    told = [path.parent.relative_to(RESULTS).as_posix(), x["before"], x["rest"], x["after"]]
    told += [*sums, "yes" if x["equal"] else "NO", x.get("shown", "–"), there]
    missing = f" (missing: {', '.join(x['missing'])})" if x.get("missing") else ""
    return f"| {' | '.join(map(str, told))}{missing} |\n"


def main(arguments: list[str]) -> None:
    sys.path.insert(0, str(Path(__file__).parent))
    if arguments:
        new, told = convert(Path(arguments[0]))
        write(new, Path(arguments[-1]))
        print(told)
        return
    log, known = RESULTS / "CONVERSION.md", converters()
    text = log.read_text().removeprefix(LOG_HEAD) if log.exists() else ""
    lines = {x.split(" |")[0]: x for x in text.splitlines(True)}
    for path in sorted(RESULTS.glob("*/*/results.json")):
        old = json.loads(path.read_text())
        if "measured" in old and old["experiment"] in known:
            new, told = convert(path)
            write(new, path)
            made = line(path, told)
            lines[made.split(" |")[0]] = made
            print(made, end="")
    log.write_text(LOG_HEAD + "".join(lines[name] for name in sorted(lines)))


if __name__ == "__main__":
    main(sys.argv[1:])
