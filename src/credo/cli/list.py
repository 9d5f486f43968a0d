"""`credo list`."""

import dataclasses

from ..experiments.catalogue import EXPERIMENTS
from .line import Line
from .names import CATALOGUE, fail

OTHERS = {
    "Hopper-v5, …": "any task that Gymnasium knows",
    "mpe2.simple_spread_v3": "any team of PettingZoo (ParallelEnv) with Box actions",
    "package.module:name": "your own (see examples/own_environment.py): its class, or a function "
    "that makes a gymnasium.Env or pettingzoo.ParallelEnv",
}


@dataclasses.dataclass
class List:
    """What there is: tasks, algorithms, networks, presets, experiments, or one of these."""

    kind: str | None = None


def run(line: Line) -> None:
    """Print names with a line about each."""
    command = line.command(List)
    line.done()
    tables = {name: CATALOGUE[name] for name in ("tasks", "algorithms", "networks", "presets")}
    sections = {
        name: {word: entry if isinstance(entry, str) else entry["text"] for word, entry in items}
        for name, items in ((name, table.items()) for name, table in tables.items())
    }
    sections["tasks"] |= OTHERS
    sections["experiments"] = EXPERIMENTS
    if command.kind is not None and command.kind not in sections:
        fail(f"nothing called {command.kind!r} to list", command.kind, sections)
    for title in [command.kind] if command.kind else sections:
        print(title)
        width = max(map(len, sections[title])) + 2
        for name, text in sections[title].items():
            print(f"  {name:<{width}}{text}")
