"""The page of claims: what the dissertation says, what is committed here, and a verdict by rule.

python docs/extensions/claims.py      # writes docs/results/claims.md and the README's count anew

Claims are in `docs/results/claims.toml`, whose head says what a part may hold. A verdict is never
written by hand: it follows from the committed rows by the rule that the page states.
"""

import functools
import itertools
import json
import pathlib
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from blocks import Block

from credo.analysis.statistics import bootstrap_interval, probability_of_improvement
from credo.experiments import base

ROOT = pathlib.Path(__file__).resolve().parents[2]
RESULTS, PAGE = ROOT / "results", ROOT / "docs" / "results" / "claims.md"
SOURCE, README = PAGE.with_suffix(".toml"), ROOT / "README.md"
BLOCK = Block.of(PAGE, "claims", "docs/extensions/claims.py")
BUDGETS = ("published", "million", "full", "quick")  # the largest first
FEWEST = 3  # seeds of a cell that decides
ENOUGH = 5  # seeds by which a difference that is not seen counts as none
LEVEL = 0.05  # of the rank test
NEVER = 1e30  # in place of None, where a run did not get there
VERDICTS = ("reproduced", "in part", "not reproduced", "refuted", "open")
REDUCE = {"mean": np.mean, "max": np.max, "min": np.min, "count": len}
PLAIN = ("episode",)  # columns that number repetitions within a run


class Found(NamedTuple):
    """What one part of a claim comes to."""

    verdict: str
    text: str
    seeds: int = 0
    path: pathlib.Path | None = None
    share: float = 1.0  # of the published budget


def claims() -> list[dict[str, Any]]:
    return tomllib.loads(SOURCE.read_text("utf-8"))["claims"]


def parts(claim: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The parts of a claim, those with `over` once for each of its combinations."""
    for part in claim["parts"]:
        over = part.get("over", {})
        for values in itertools.product(*over.values()):
            new = dict(zip(over, values, strict=True))
            told = part.get("of", ", ".join(str(x) for x in values))
            yield part | {"cell": part.get("cell", {}) | new, "of": told}


def record(experiment: str, cells: list[dict[str, Any]]) -> tuple[pathlib.Path, dict] | None:
    """The largest committed budget of an experiment that has all these cells."""
    for budget in BUDGETS:
        path = RESULTS / experiment / budget / "results.json"
        if path.exists():
            found = json.loads(path.read_text("utf-8"))
            if all(labels_of(found, cell) is not None for cell in cells):
                return path, found
    return None


def labels_of(found: Mapping[str, Any], cell: Mapping[str, Any]) -> dict[str, Any] | None:
    """All labels of the cell of which a claim names those that tell it apart, and of rows of it;
    of several cells that with the fewest labels. None: there is none."""
    cells = sorted((x["labels"] for x in found["cells"]), key=len)
    known = set().union(*cells)
    wanted = {name: None if value == "none" else value for name, value in cell.items()}
    for labels in cells:
        if all(labels.get(name) == value for name, value in wanted.items() if name in known):
            return {name: x for name, x in (labels | wanted).items() if x is not None}
    return None


def values(
    found: Mapping[str, Any], part: Mapping[str, Any], cell: Mapping[str, Any]
) -> np.ndarray:
    """A number of each seed: the mean of its rows of one metric, or its curve at one place."""
    wanted, columns = labels_of(found, cell), found["columns"]
    if "at" in part:
        curves = [
            x for x in found["curves"] if x["labels"] == wanted and x["metric"] == part["metric"]
        ]
        if not curves or part["at"] not in curves[0]["at"]:
            raise ValueError(f"{part}: no such curve of {wanted}, or no such place")
        curve = curves[0]
        seeds = np.array([[_number(x) for x in values] for values in curve["seeds"].values()])
        picked = seeds[:, curve["at"].index(part["at"])]
        if "minus" in part:  # of the same run
            picked = picked - seeds[:, curve["at"].index(part["minus"])]
        return picked
    pooled = (*PLAIN, *part.get("pool", ()))
    runs: dict[Any, list[float]] = {}
    if part.get("reduce") == "count":  # a run may have none
        seeds = next(x for x in found["cells"] if x["labels"].items() <= wanted.items())["seeds"]
        runs = {seed: [] for seed in seeds}
    for row in found["rows"]:
        told = dict(zip(columns, row, strict=True))
        seed, metric, value = (told.pop(name) for name in ("seed", "metric", "value"))
        told = {name: x for name, x in told.items() if x is not None and name not in pooled}
        if metric == part["metric"] and told == wanted:
            runs.setdefault(seed, []).append(_number(value))
    return np.array([REDUCE[part.get("reduce", "mean")](x) for x in runs.values()])


def _number(x: Any) -> float:
    return NEVER if x is None else float(x)


def found(part: Mapping[str, Any]) -> Found:
    """The verdict on one part."""
    cell = part["cell"]
    named = part.get("above", part.get("relative"))
    other = None if named is None else cell | named
    elsewhere = part.get("than", part["experiment"]) != part["experiment"]
    committed = record(part["experiment"], [cell] + ([other] if other and not elsewhere else []))
    second = record(part["than"], [other]) if other and elsewhere else committed
    if committed is None or second is None:
        return Found("open", f"{part['of']}: no data".removeprefix(": "))
    path, data = committed
    mine, had = values(data, part, cell), share(part["experiment"], data, cell)
    if not mine.size:
        raise ValueError(f"{part}: no row of {path} fits")
    if other is None or "relative" in part:
        unit = 1.0 if other is None else values(second[1], part, other).mean()
        verdict, text, seeds = level(mine / unit, part)
        # What was reached in less time is reached; that something fails takes all of it.
        whole = had >= 1.0 or (verdict == "reproduced" and not fails(part))
    else:
        theirs = values(second[1], part, other)
        verdict, text, seeds = comparison(mine, theirs, part.get("less", False), scale(part))
        loser = share(part.get("than", part["experiment"]), second[1], other)
        whole = had >= 1.0 if verdict != "reproduced" else loser >= had
        had = min(had, loser)
    exact = part.get("single", False)
    if not exact and (not whole or seeds < FEWEST):
        verdict = "open"
    had = 1.0 if exact else had
    return Found(verdict, f"{part['of']}: {text}".removeprefix(": "), seeds, path, had)


def fails(part: Mapping[str, Any]) -> bool:
    """Whether it is claimed that something does not get far, rather than that it does."""
    return "at_most" in part and not part.get("low", False)


@functools.cache
def planned(experiment: str) -> list[Any]:
    """The cells of an experiment, at every budget that it has."""
    made = base.find(experiment)
    return [cell for budget in made.budgets for cell in made.cells(budget)]


def share(experiment: str, data: Mapping[str, Any], cell: Mapping[str, Any]) -> float:
    """How much of its largest planned budget, the published one where there is one, a committed
    cell had, at most 1: in generations or frames, and in updates for each frame."""
    wanted = labels_of(data, cell) or {}
    here = next(x for x in data["cells"] if x["labels"].items() <= wanted.items())
    every = [x for x in planned(experiment) if x.labels == here["labels"]]
    shares = [1.0]
    for limit, n in here["budget"].items():
        most = max((x.budget.get(limit) or 0 for x in every), default=0)
        if limit in ("generations", "frames") and most:
            shares.append(n / most)
    updates = here.get("algorithm", {}).get("updates_per_frame")
    most = max((getattr(x.algorithm, "updates_per_frame", 0) for x in every), default=0)
    return min(shares) * (min(updates / most, 1.0) if updates and most else 1.0)


def scale(part: Mapping[str, Any]) -> float:
    return 100.0 if part.get("unit") == "%" else 1.0


def level(x: np.ndarray, part: Mapping[str, Any]) -> tuple[str, str, int]:
    """A number against one that it must reach, or must not pass."""
    factor, n, low_is_good = scale(part), len(x), "at_most" in part
    if part.get("best", False):
        x = x[[np.argmin(x) if low_is_good else np.argmax(x)]]
    if (x >= NEVER).any():  # some runs did not get there: what counts is how many did
        there = int((x <= part["at_most"]).sum())
        verdict = "reproduced" if there == n else "in part" if there else "not reproduced"
        return verdict, "; ".join(_one(y, factor) for y in x), n
    mean = float(np.mean(x))
    low, high = (float(y) for y in bootstrap_interval(x)) if len(x) > 1 else (mean, mean)
    if np.isnan(low):  # of values that are all alike there is no other
        low = high = mean
    text = _shown(mean, low, high, factor)
    if part.get("positive", False):
        above, below, against = low > 0.0, high < 0.0, "refuted"
        return "reproduced" if above else against if below else "not reproduced", text, n
    if low_is_good:
        goal, against = part["at_most"], "not reproduced" if part.get("low", False) else "refuted"
        reached, possible = mean <= goal, low <= goal
    else:
        goal, against = part["at_least"] - part.get("error", 0.0), "not reproduced"
        reached, possible = mean >= goal, high >= goal
    verdict = "reproduced" if reached else "in part" if possible and n >= ENOUGH else against
    return verdict, text, n


def comparison(x: np.ndarray, y: np.ndarray, less: bool, factor: float) -> tuple[str, str, int]:
    """Whether a run of the first is above one of the second; with `less`, below."""
    sign, n = -1.0 if less else 1.0, min(len(x), len(y))
    better = probability_of_improvement(sign * x, sign * y)
    chance, reverse = rank_test(sign * x, sign * y), rank_test(sign * y, sign * x)
    means = " against ".join(_one(float(np.mean(z)), factor) for z in (x, y))
    verdict = "reproduced" if chance <= LEVEL else "refuted" if reverse <= LEVEL else ""
    if not verdict:  # that nothing is seen in a few runs says nothing
        verdict = "not reproduced" if n >= ENOUGH else "open"
    text = f"{means}; P {better:.2f}"
    return verdict, text + (f", p {min(chance, reverse):.2g}" if n > 1 else ""), n


def rank_test(x: np.ndarray, y: np.ndarray) -> float:
    """The probability that runs which do not differ would be told apart as these are, or more: the
    exact one-sided test of Mann and Whitney, ties sharing their ranks."""
    ranks = scipy.stats.rankdata(np.concatenate([x, y]))
    sums = ranks[_choices(len(ranks), len(x))].sum(axis=1)
    return float(np.mean(sums >= ranks[: len(x)].sum() - 1e-9))


@functools.cache
def _choices(n: int, k: int) -> np.ndarray:
    """Every choice of k of n."""
    return np.array(list(itertools.combinations(range(n), k)))


def _one(x: float, factor: float) -> str:
    if x >= NEVER:
        return "never"
    return f"{x * factor:.3g}" if abs(x * factor) < 1e3 else f"{x * factor:,.0f}"


def _shown(mean: float, low: float, high: float, factor: float) -> str:
    if low == high:
        return _one(mean, factor)
    return f"{_one(mean, factor)} ({_one(low, factor)} to {_one(high, factor)})"


def together(verdicts: list[str]) -> str:
    """The verdict on a claim from those on its parts."""
    kinds = set(verdicts)
    if len(kinds) == 1:
        return verdicts[0]
    if "open" in kinds:
        return "open"
    if "reproduced" in kinds:
        return "in part"
    return "refuted" if "refuted" in kinds else "not reproduced"


def row(number: int, claim: Mapping[str, Any]) -> tuple[str, str]:
    """A line of the table, and its verdict."""
    every = [found(part) for part in parts(claim)]
    there = [x for x in every if x.path]
    verdict = together([x.verdict for x in every])
    ours = "; ".join(x.text for x in there) or "no data"
    if there and claim["parts"][0].get("unit") == "%":
        ours += " %"
    if there and len(there) < len(every):
        ours += f"; {len(every) - len(there)} of {len(every)} without data"
    if least := [x.share for x in there if x.share < 1.0]:
        ours += f" *({min(least):.0%} of the published budget)*"
    if against := [x.text.partition(":")[0] for x in every if x.verdict == "refuted"]:
        refuted = f", refuted for {', '.join(against)}" if verdict != "refuted" else ""
    else:
        refuted = ""
    seeds = sorted({x.seeds for x in there})
    cost = f", {claim.get('hours', 0):g} core-hours" if verdict == "open" else ""
    cells = (
        str(number),
        claim["where"],
        claim["claim"] + (f" *{claim['note']}*" if "note" in claim else ""),
        claim["published"],
        ours,
        " to ".join(str(n) for n in dict.fromkeys((seeds[0], seeds[-1]))) if seeds else "",
        f"**{verdict}**{refuted}{cost}",
        ", ".join(links(x.path for x in there) or sources(claim)),
    )
    return "| " + " | ".join(cells) + " |", verdict


def links(paths: Iterable[pathlib.Path | None]) -> list[str]:
    """To the data, each once."""
    return [
        f"[{path.parent.parent.name} {path.parent.name}](../../{path.relative_to(ROOT).as_posix()})"
        for path in dict.fromkeys(paths)
        if path is not None
    ]


def sources(claim: Mapping[str, Any]) -> list[str]:
    """The experiments that would have the data, each once."""
    return [f"`{name}`" for name in dict.fromkeys(part["experiment"] for part in claim["parts"])]


def table() -> str:
    """The counts, and all claims by chapter."""
    rows: dict[int, list[str]] = {}
    counted: dict[bool, Counter[str]] = {False: Counter(), True: Counter()}
    for number, claim in enumerate(claims(), start=1):
        line, verdict = row(number, claim)
        rows.setdefault(claim["chapter"], []).append(line)
        counted[claim.get("ours", False)][verdict] += 1
    lines = [f"**{count(counted[False])}.** With settings of ours, {count(counted[True])}.", ""]
    for chapter, told in sorted(rows.items()):
        lines += [
            f"## Chapter {chapter}",
            "",
            "| | where | claim | published | ours | seeds | verdict | data |",
            "|---|---|---|---|---|---|---|---|",
            *told,
            "",
        ]
    return "\n".join(lines)


def count(counted: Mapping[str, int]) -> str:
    """How many claims have which verdict, in one line."""
    told = ", ".join(f"{counted[name]} {name}" for name in VERDICTS)
    return f"{sum(counted.values())} claims: {told}"


if __name__ == "__main__":
    written = table()
    BLOCK.write(written)
    told = f"on {written[2:].partition('.**')[0]}."
    README.write_text(re.sub(r"on \d+ claims: .*", told, README.read_text("utf-8")), "utf-8")
    sys.stdout.write(written.partition("\n")[0] + "\n")
