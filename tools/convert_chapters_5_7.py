"""What old results of chapters 5 to 7 and of the checks have where, and what their names mean."""

import re
from collections.abc import Callable
from typing import Any

from credo.algorithms.lineage import MAKERS
from credo.analysis.attribution import FATES
from credo.report.rows import Labels, Results, Row, Series, concat, rows, series

Found = list[Row | Series]
RENAMED = {
    "cerl gamma 0 1": "cerl of gamma 0 and 1",
    "erl no selection": "erl without selection",
}
NUMBERED = {"gamma": "gamma", "c": "exploration"}  # "td3 gamma 0.9", "cerl c 5"
ONLY = {  # a regular expression that a command had for cells, where the names are others now
    "'^((erl|ddpg|ea|erl ours) Inv.*v5$|(ddpg|ddpg spread|ea|erl ours) .* delayed)'": (
        "'^((erl|ddpg|ea|erl ours), Inv.*v5$|(ddpg|ddpg spread|ea|erl ours), .* delayed)'"
    ),
}
METHOD_TASK = re.compile(r"'\^(\w+|\([\w| ]+\)) (?=[A-Z])")  # '^ea Swimmer', now '^ea, Swimmer'


def result(
    old: dict[str, Any],
    labels: Callable[[str], Labels],
    found: Callable[[dict[str, Any], Labels, list[int]], Found],
) -> Results:
    """Rows of every cell, by its labels and seeds."""
    told, parts = [], []
    for name, cell in old["cells"].items():
        first = cell.get("first seed", 0)
        limits = ("generations", "frames", "stop_at")
        record = {
            "labels": labels(name),
            "seeds": list(range(first, first + cell["runs"])),
            "budget": {x: cell[x] for x in limits if cell.get(x) is not None},
            "algorithm": cell["algorithm"],
            "machine": cell.get("machine", old["machine"]),
        }
        told.append(record)
        parts.append(found(old["measured"][name], record["labels"], record["seeds"]))
    command = old["command"]
    for before, after in ONLY.items():
        command = command.replace(before, after)
    command = METHOD_TASK.sub(r"'^\1, ", command)
    return Results(old["experiment"], old["budget"], command, told, *concat(parts))


def per_run(cell: dict[str, Any], names: dict[str, str], labels: Labels, seeds: list[int]) -> Found:
    """What a cell has one number of for each run, by its old and its new name."""
    return [
        row
        for old, metric in names.items()
        if old in cell
        for row in rows(metric, cell[old], labels, seed=seeds)
    ]


# --------------------------------------------------------------------------------- chapters 5 and 6


def on_mujoco(name: str) -> dict[str, Any]:
    """`td3 gamma 0.9 Hopper-v5 delayed`."""
    words = name.split()
    delayed = words[-1] == "delayed"
    words = words[:-1] if delayed else words
    method = " ".join(words[:-1])
    told: dict[str, Any] = {"method": RENAMED.get(method, method)}
    if len(words) == 4 and words[1] in NUMBERED:
        told = {"method": words[0], NUMBERED[words[1]]: float(words[2])}
    if method.startswith("cerl sac "):
        told = {"method": "cerl with sac", "manager": words[2]}
    if method.endswith(" untested"):
        return {"method": words[0], "task": words[-1], "untested": True}
    told["task"] = words[-1]
    return told | ({"delayed": delayed} if "DoublePendulum" in name else {})


def scores(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Scores of every run; in some experiments fates of actors, or who made the champions."""
    x = "episodes" if "episodes" in cell else "frames"
    names = {
        "solved after": "solved after",
        "episodes played": "episodes",
        "last": "last test",
        "last smoothed": "last test, smoothed",
        "played": "frames",
        "updates per frame": "updates per frame",
    }
    found = rows("return", cell["final"], labels, seed=seeds, episode=None)
    found += series("test score", x, cell[x], cell["score"], labels, seed=seeds)
    found += per_run(cell, names, labels, seeds)
    found += rows("random", cell["floor"][0], labels) + rows(
        "random, s.e.", cell["floor"][1], labels
    )
    if "expected" in cell:
        found += rows("injected", cell["injected"], labels, seed=seeds)
        found += rows("fate", cell["fates"], labels, seed=seeds, fate=FATES)
        found += rows("by chance", cell["expected"], labels, fate=FATES)
        found += rows("sync period", cell["sync period"], labels)
    if "attribution" in cell:
        found += attribution(cell["attribution"], cell["learners"], labels, seeds)
    return found


def attribution(found: dict[str, Any], names: list[str], labels: Labels, seeds: list[int]) -> Found:
    """Who made the champions."""
    curves = {
        "last changed by": ("makers", {"operator": MAKERS}),
        "ancestry": ("ancestry", {"ancestor": [*names, "first draw"]}),
        "allocation so far": ("allocation", {"learner": names}),
    }
    shares = {
        "allocation": ("allocated", {"learner": names}),
        "injected": ("injected", {"learner": names}),
        "fate": ("fates", {"learner": names, "fate": FATES}),
    }
    made: Found = []
    for metric, (key, axes) in curves.items():
        at, told = found["frames"], {"seed": seeds} | axes
        made += series(metric, "frames", at, found[key], labels, **told)
    for metric, (key, axes) in shares.items():
        made += rows(metric, found[key], labels, seed=seeds, **axes)
    return made


def times(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Of note-5.5."""
    names = ("seconds per 1000 frames", "updates per frame", "seconds", "frames")
    return per_run(cell, {name: name for name in names}, labels, seeds)


# ---------------------------------------------------------------------------------------- chapter 7


def on_rovers(name: str) -> dict[str, Any]:
    """`merl, coupling 4, author's dynamics`."""
    method, *where = name.split(", ")
    told: dict[str, Any] = {"method": method.replace(" /", ",")}
    for word in where:
        if word.startswith("coupling "):
            told["coupling"] = int(word.removeprefix("coupling "))
        elif word.startswith("author's"):
            told["dynamics"] = word
        else:
            told |= {"paths": {"paths": True}, "partly trained": {"training": word}}.get(
                word, {"task": word}
            )
    return told


def shares(metric: str) -> Callable[[dict[str, Any], Labels, list[int]], Found]:
    """Scores of every run on rovers or simple_spread."""

    def found(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
        names = {
            "final": metric,
            "played": "frames",
            "updates per frame": "updates per frame",
            "both after": "both after",
        }
        made: Found = [*per_run(cell, names, labels, seeds)]
        made += series("test score", "frames", cell["frames"], cell["score"], labels, seed=seeds)
        for name, value in cell["reference"].items():
            made += rows(name, value, labels)
        return made + (paths(cell, labels, seeds) if "position" in cell else [])

    return found


def paths(cell: dict[str, Any], labels: Labels, seeds: list[int]) -> Found:
    """Of fig-7.5, whose cells have one run."""
    made: Found = []
    steps = list(range(len(cell["position"])))
    for axis, name in enumerate(("x", "y")):
        along = [[place[rover][axis] for place in cell["position"]] for rover in range(6)]
        made += series(name, "step", steps, [along], labels, seed=seeds, rover=None)
        made += rows(f"POI {name}", [poi[axis] for poi in cell["poi"]], labels, poi=None)
    made += rows("observed", [cell["observed"]], labels, seed=seeds, poi=None)
    for name in ("activation distance", "size"):
        made += rows(name, cell[name], labels)
    return made


ON_MUJOCO = (
    *("check-td3", "check-learners", "fig-5.2", "fig-5.3", "fig-5.4", "table-5.2", "beyond-5"),
    *("fig-6.2", "fig-6.3", "fig-6.4", "fig-6.5", "table-6.1", "beyond-6"),
)
ON_ROVERS = ("fig-7.1", "fig-7.4", "fig-7.5", "beyond-7")
CONVERTERS: dict[str, Callable[[dict[str, Any]], Results]] = {
    **dict.fromkeys(ON_MUJOCO, lambda old: result(old, on_mujoco, scores)),
    **dict.fromkeys(ON_ROVERS, lambda old: result(old, on_rovers, shares("share of POIs"))),
    "note-5.5": lambda old: result(old, on_mujoco, times),
    "check-spread": lambda old: result(old, on_rovers, shares("return")),
}
