"""Recorded settings of algorithms in the fields of today: what a breeder holds now was a field of
each algorithm, and two classes have moved."""

import importlib
from dataclasses import fields
from typing import Any

from credo.evolution.breeder import Breeder
from credo.runs import config

MOVED = {
    "credo.evolution.curriculum:Curriculum": "credo.environments.curriculum:Curriculum",
    "credo.evolution.parsimony:Parsimony": "credo.algorithms.fitness:Parsimony",
}
EVOLVING = {"neuroevolution:Neuroevolution", "ccea:CCEA", "erl:ERL", "merl:MERL"}


def modern(tree: Any) -> Any:
    """A recorded object with the fields and class names of today."""
    if isinstance(tree, list):
        return [modern(value) for value in tree]
    if not isinstance(tree, dict):
        return tree
    tree = {name: modern(value) for name, value in tree.items()}
    name = tree.get("class", "")
    if name in MOVED:
        return tree | {"class": MOVED[name]}
    if name.removeprefix("credo.algorithms.") not in EVOLVING or "breeder" in tree:
        return tree
    module = importlib.import_module(name.partition(":")[0])
    own = {f.name for f in fields(Breeder)} & tree.keys()
    breeder = config.to_tree(getattr(module, "BREEDER", Breeder()))
    breeder |= {field: tree.pop(field) for field in own}
    if (breeder["extinction"] or {}).get("probability") == 0.0:  # it never happened
        breeder["extinction"] = None
    if breeder["crossover"] is None:
        breeder["crossover"] = {"class": "credo.evolution.crossover:NoCrossover"}
    return tree | {"breeder": breeder}
