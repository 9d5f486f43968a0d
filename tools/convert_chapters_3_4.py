"""Results of chapters 3 and 4 in the format before rows: what their names and structures mean.

`CONVERTERS` has a function for each experiment, from an old record to `Results`. Here alone names
of cells are read.
"""

import copy
import re
from collections.abc import Callable, Iterator
from typing import Any

from credo.experiments.base import grid
from credo.experiments.memories import ROLES
from credo.experiments.memories import names as memory_cells
from credo.report.rows import Results, Row, Series, concat, rows, series

Found = Iterator[Row | Series]
Labels = dict[str, Any]

# Keys of old measurements whose leaves are axes and labels now, not values.
AXES = {"generation", "instances", "gaps", "depths", "depth", "permutations", "sums"}
AXES |= {"rows", "noise", "cell", "where", "network"}

ONLY = {  # what `--only` says of cells by their names of today
    "3 robots|^synchronous, dmmu$": "robots 3|synchronous, dmmu$",
    "converge 2-deep": "converge, depth 2",
    "2-deep, 3 robots": "depth 2, robots 3",
}


def labels_3(name: str) -> Labels:
    """`recall 6-deep ours by gradient, lstm`."""
    found = re.fullmatch(
        r"(?P<task>\w+) (?P<depth>\d+)-deep (?P<preset>as written|as coded|ours)"
        r"(?P<gradient> by gradient)?(?P<equal> at equal instances)?"
        r"( (?P<change>with.*?))?(?P<free>, ties free)?"
        r"(, (?P<network>\w+)( \d+×(?P<memory>\d+))?)?",
        name,
    )
    assert found, name
    told = found.groupdict()
    labels: Labels = {k: told[k] for k in ("task", "depth", "preset")}
    labels["depth"] = int(labels["depth"])
    labels["trainer"] = "gradient" if told["gradient"] else "evolution"
    labels["network"] = told["network"] or "mmu"
    labels |= {"memory": int(told["memory"])} if told["memory"] else {}
    labels |= {"at equal instances": True} if told["equal"] else {}
    labels |= {"ties free": True} if told["free"] else {}
    return labels | ({"change": told["change"]} if told["change"] else {})


def labels_4(name: str) -> Labels:
    """`spread 2-deep, 3 robots, mmu on difference`, `synchronous, dmmu in noise 0.5`."""
    head, *middle, network = name.split(", ")
    if head == "case study":
        return {"task": head, "network": network}
    network, *noise = network.split(" in noise ")
    if head in ("synchronous", "asynchronous"):
        told = {"task": "server fleet", "timing": head, "network": network}
        return told | ({"noise": float(noise[0])} if noise else {})
    task, depth = head.split(" ")
    labels: Labels = {"task": task, "depth": int(depth.removesuffix("-deep"))}
    (place,) = middle
    partner = place in ("fsp", "resp")
    labels |= {"partner": place} if partner else {"robots": int(place.removesuffix(" robots"))}
    network, *fitness = network.split(" on ")
    return labels | {"network": network} | ({"fitness": fitness[0]} if fitness else {})


def results(
    old: dict[str, Any],
    labels: Callable[[str], Labels],
    read: Callable[..., Found],
    together: bool = False,
) -> Results:
    """A record whose measurements are by cell or, `together`, of its only cell. Asserts that
    nothing of them is left over."""
    prune(old["measured"])
    measured = copy.deepcopy(old["measured"])
    cells, parts = [], []
    for name, cell in old["cells"].items():
        told, first = labels(name), cell.get("first seed", 0)
        seeds = list(range(first, first + cell["runs"]))
        limits = ("generations", "frames", "stop_at")
        budget = {k: cell[k] for k in limits if cell.get(k) is not None}
        record = {"labels": told, "seeds": seeds, "budget": budget}
        machine = cell.get("machine", old["machine"])
        cells.append(record | {"algorithm": cell["algorithm"], "machine": machine})
        given = measured if together else measured.pop(name)
        if together:
            assert given.pop("cell", name) == name
        parts.append(list(read(given, told, seeds)))
        assert not given, (old["experiment"], name, list(given))
    assert not measured, list(measured)
    found, curves = concat(parts)
    command = old["command"]
    for before, now in ONLY.items():
        command = command.replace(f"--only '{before}'", f"--only '{now}'")
    return Results(old["experiment"], old["budget"], command, cells, found, curves)


def prune(measured: dict[str, Any]) -> None:
    """Take out what says nothing: parts of an episode that are null, and the number of a memory
    cell, which is its place in the list."""
    for cell in measured.values():
        if isinstance(cell, dict) and "episode" in cell:
            kept = {k: x for k, x in (cell.pop("episode") or {}).items() if x is not None}
            cell |= {"episode": kept} if kept else {}
    for cells in measured.get("roles", []):
        assert [role.pop("cell") for role in cells] == list(range(len(cells)))


# -------------------------------------------------------------------------------------- chapter 3


def success(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Figures 3.4, 3.9, 3.11 and 3.12, their relatives, and the ablation."""
    told: dict[str, Any] = {"labels": labels, "seed": seeds}
    if "floor" in cell:
        policy, value = cell.pop("floor")
        yield Row({**labels, "policy": policy}, None, "baseline success", value)
    yield from rows("success", cell.pop("success"), **told)
    curve = cell.pop("curve")
    at = curve.pop("generation")
    for old, new in (("raw", ""), ("smoothed", ", smoothed")):
        yield from series(f"test success{new}", "generation", at, curve.pop(old), **told)
        yield from rows(f"last test success{new}", curve.pop(f"last {old}"), **told)
    assert not curve
    if "by instances" in cell:
        found = cell.pop("by instances")
        axis = ("success by instances", "reinforcement instances", found.pop("instances"))
        yield from series(*axis, found.pop("success"), **told)
        assert not found
    for name in ("distractors", "depths"):
        if name in cell:
            yield from sweep(cell.pop(name), labels, seeds)
    yield from counted(cell, labels, seeds)


def counted(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """What beyond-3 and the ablation add."""
    told: dict[str, Any] = {"labels": labels, "seed": seeds}
    if "weights" in cell:
        yield Row(labels, None, "weights", cell.pop("weights"))
    if "right" in cell:
        yield Row(labels, None, "signals fed", cell.pop("fed"))
        yield from rows("signals right", cell.pop("right"), **told, stream=None)
    if "stream" in cell:
        assert cell.pop("depth") == labels["depth"]
        yield Row(labels, None, "signals fed", cell.pop("stream"))
        yield from rows("signals right", cell.pop("signals right"), **told)
        yield from rows("success at depth 101", cell.pop("success at 101"), **told)


def sweep(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Figures 3.5, 3.10 and 3.13."""
    if "depths" in cell:
        axis = ("success by depth", "depth of the test", cell.pop("depths"))
    elif labels["task"] == "recall":
        axis = ("success by corridor", "steps per corridor", cell.pop("gaps"))
    else:
        axis = ("success by distractors", "distractors between signals", cell.pop("gaps"))
    yield from series(*axis, cell.pop("success"), labels, seed=seeds)


def best(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """The run that the case study shows, and how far each goes."""
    yield Row(labels, None, "best run", cell.pop("champion"))
    if "signals right" in cell:
        yield from rows("signals right", cell.pop("signals right"), labels, seed=seeds)


def memory(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Table 3.1."""
    yield from best(cell, labels, seeds)
    for seed, run in zip(seeds, cell.pop("runs"), strict=True):
        told: dict[str, Any] = {"labels": labels, "seed": [seed]}
        states = [run.pop(k) for k in ("permutations", "sums", "memory", "signatures", "right")]
        cells = memory_cells(len(run["masking costs"]))
        for permutation, total, final, signature, right in zip(*states, strict=True):
            here = {**labels, "permutation": str(permutation), "sum": total}
            yield from rows("memory", [final], here, seed=[seed], cell=cells)
            yield from rows("signature", [signature], here, seed=[seed], rank=None)
            yield Row(here, seed, "right", right)
        yield from rows("needed", [run.pop("needed")], **told, rank=None)
        yield from rows("masking costs", [run.pop("masking costs")], **told, cell=cells)
        for metric in ("spread within equal sums", "signature predicts class"):
            yield from rows(metric, [run.pop(metric)], **told)
        assert not run


def counting(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Table 3.2."""
    signs = ("-1", "+1")
    yield from rows("signals fed", cell.pop("fed"), labels, sign=signs)
    final = cell.pop("memory")
    told: dict[str, Any] = {"seed": seeds, "cell": memory_cells(len(final[0][0]))}
    by_cell = [[list(x) for x in zip(*run, strict=True)] for run in final]
    fed = cell.pop("rows")
    first = sum(plus == 0 for _, plus in fed)
    for i, (sign, part) in enumerate(zip(signs, (slice(first), slice(first, None)), strict=True)):
        at, here = [both[i] for both in fed[part]], {**labels, "sign": sign}
        memory = [[values[part] for values in run] for run in by_cell]
        yield from series("memory", "signals of this sign", at, memory, here, **told)
    counted = [[list(x) for x in zip(*run, strict=True)] for run in cell.pop("counted")]
    yield from rows("signals counted", counted, labels, **told, sign=signs)
    right = cell.pop("random signals right")
    yield from rows("signals right", right, labels, seed=seeds, stream=None)


def writes(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Figures 3.6 and 3.7."""
    seed = seeds[cell["champion"]]
    yield from best(cell, labels, seeds)
    inputs, found = cell.pop("inputs"), cell.pop("writes")
    at = range(1, len(inputs) + 1)
    yield from series("input", "step", at, inputs, labels)
    axes: dict[str, Any] = {"seed": [seed], "cell": memory_cells(len(found))}
    yield from series("write", "step", at, [found], labels, **axes)
    yield from rows("share at signals", cell.pop("share at signals"), labels, seed=seeds)


def roles(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Algorithm 3."""
    yield from best(cell, labels, seeds)
    yield Row(labels, None, "algorithm", cell.pop("algorithm"))
    for seed, cells in zip(seeds, cell.pop("roles"), strict=True):
        for role in cells:
            here = {**labels, "cell": memory_cells(len(cells))[cells.index(role)]}
            yield from (Row(here, seed, ROLES[k], role.pop(k)) for k in ROLES)
            assert not role


# -------------------------------------------------------------------------------------- chapter 4


def learned(cell: dict[str, Any], labels: Labels, seeds: list[int], metric: str) -> Found:
    """Final champions and the curve of their tests."""
    told: dict[str, Any] = {"labels": labels, "seed": seeds}
    where, network = cell.pop("where"), cell.pop("network")
    if "noise" in network or "noise" not in labels:
        assert labels_4(f"{where}, {network}") == labels
    yield from rows(metric, cell.pop("final"), **told)
    at = cell.pop("generation")
    yield from series(f"test {metric}, smoothed", "generation", at, cell.pop("smoothed"), **told)


def maze(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """T-mazes."""
    for policy, share in cell.pop("floors").items():
        yield Row({**labels, "policy": policy}, None, "baseline", share)
    kind, bound = cell.pop("ceiling")
    yield Row({**labels, "kind": kind}, None, "upper bound", bound)
    yield from learned(cell, labels, seeds, "share of trials")
    played = cell.pop("episode", None)
    if played is not None:
        yield from episode(played, labels, seeds)


def episode(played: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """One episode of the best run."""
    run = played.pop("run")
    yield Row(labels, None, "best run", run)
    assert played.pop("depth") == labels["depth"]
    told: dict[str, Any] = {"labels": labels, "seed": [seeds[run]]}
    at = range(1, len(played["goal"]) + 1)
    robots = range(1, len(played["endpoint"]) + 1)
    for metric in ("goal", "observed", "partner"):
        if metric in played:
            yield from series(metric, "trial", at, [played.pop(metric)], **told)
    for metric in ("endpoint", "company", "reward"):
        yield from series(metric, "trial", at, [played.pop(metric)], **told, robot=robots)
    held = played.pop("memory", None)
    if held is not None:
        axes: dict[str, Any] = {"robot": robots, "cell": memory_cells(len(held[0]))}
        yield from series("memory", "trial", at, [held], **told, **axes)
    assert not played


def fleet(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Fleets of servers."""
    told: dict[str, Any] = {"labels": labels, "seed": seeds}
    for policy, value in cell.pop("reference").items():
        yield Row({**labels, "policy": policy}, None, "reference", value)
    yield from learned(cell, labels, seeds, "net requests")
    if "nobody writes" in cell:
        yield from rows("net requests while nobody writes", cell.pop("nobody writes"), **told)
    assert cell.pop("noise", 0.0) == labels.get("noise", 0.0)
    for std, found in cell.pop("in noise", {}).items():
        here = {**labels, "noise of the test": float(std)}
        yield from pairs("net requests in noise", found, here, seeds)
    for name, found in cell.pop("changes", {}).items():
        here = {**labels, "fleet": name}
        yield from pairs("net requests of a fleet", found.pop("ours"), here, seeds)
        yield from pairs("change", found.pop("change"), here, seeds)
        for policy, pair in found.pop("known").items():
            yield from pairs("reference of a fleet", [pair], {**here, "policy": policy}, [None])
        assert not found


def pairs(metric: str, found: list[Any], labels: Labels, seeds: list[Any]) -> Found:
    """Means and standard errors."""
    for name, values in zip((metric, f"{metric}, s.e."), zip(*found, strict=True), strict=True):
        yield from rows(name, values, labels, seed=seeds)


def maze_or_fleet(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Beyond chapter 4."""
    yield from (fleet if labels["task"] == "server fleet" else maze)(cell, labels, seeds)


def case_study(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Table 4.1 and Figure 4.8."""
    configurations = ("GGNN", "NNGG", "NGGN", "GNNG", "GNGN", "NGNG")
    yield Row(labels, None, "best run", cell.pop("best"))
    yield Row(labels, None, "upper bound", cell.pop("discoverable"))
    for policy in ("random", "fixed", "discovering", "oracle"):
        yield Row({**labels, "policy": policy}, None, "reference", cell.pop(policy))
    for seed, run in zip(seeds, cell.pop("runs"), strict=True):
        told = zip(grid(configuration=configurations), run, strict=True)
        for configuration, played in told:
            yield from _played(played, labels | configuration, seed)
            assert not played


def _played(played: dict[str, Any], labels: Labels, seed: int) -> Found:
    yield Row(labels, seed, "reward", played.pop("reward"))
    final = played.pop("memory")
    yield from rows("memory", [final], labels, seed=[seed], cell=memory_cells(len(final)))
    yield from rows("signature", [played.pop("signature")], labels, seed=[seed], rank=None)
    devices = [list(x) for x in zip(*played.pop("devices"), strict=True)]
    at = range(1, len(devices[0]) + 1)
    yield from series("device", "step", at, [devices], labels, seed=[seed], server="AB")
    moved = played.pop("writes")  # [steps][servers][cells]
    by_server = [
        [[step[s][c] for step in moved] for c in range(len(final))] for s in range(len(devices))
    ]
    axes: dict[str, Any] = {"seed": [seed], "server": "AB", "cell": memory_cells(len(final))}
    yield from series("write", "step", at, [by_server], labels, **axes)


# -------------------------------------------------------------------------------------------- all


def _of(labels: Callable[[str], Labels], read: Callable[..., Found], together: bool = False):
    return lambda old: results(old, labels, read, together)


CONVERTERS: dict[str, Callable[[dict[str, Any]], Results]] = {
    **dict.fromkeys(
        ("fig-3.4a", "fig-3.4b", "fig-3.9a", "fig-3.9b", "fig-3.11", "fig-3.12"),
        _of(labels_3, success),
    ),
    **dict.fromkeys(("beyond-3", "ablation-3.4a"), _of(labels_3, success)),
    **dict.fromkeys(("fig-3.5a", "fig-3.5b", "fig-3.10", "fig-3.13"), _of(labels_3, sweep)),
    "table-3.1": _of(labels_3, memory, together=True),
    "table-3.2": _of(labels_3, counting),
    **dict.fromkeys(("fig-3.6", "fig-3.7"), _of(labels_3, writes, together=True)),
    "alg-3.3": _of(labels_3, roles, together=True),
    **dict.fromkeys(("fig-4.2", "fig-4.3", "fig-4.4"), _of(labels_4, maze)),
    "fig-4.7": _of(labels_4, fleet),
    **dict.fromkeys(("table-4.1", "fig-4.8"), _of(labels_4, case_study, together=True)),
    "beyond-4": _of(labels_4, maze_or_fleet),
}
