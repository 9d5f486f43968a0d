"""What people call a run: the command line's word for its algorithm, and its task's name.

Both are read from the object tree that a run records (`config.to_tree`), so that folders and the
legends of pages say the same, whoever started the run. Nothing here imports JAX.
"""

from collections.abc import Mapping
from typing import Any

WRAPPERS = {"Delayed": "delayed", "Hidden": "hidden", "Last": "last-step"}


def run_name(algorithm: Mapping[str, Any]) -> str:
    """`erl-Hopper-v5` or `cerl-Swimmer-v5-delayed`, for the object tree of an algorithm."""
    return f"{algorithm_word(algorithm)}-{task_word(algorithm['env'])}"


def algorithm_word(algorithm: Mapping[str, Any]) -> str:
    """The word that `credo train` has for an algorithm: `td3`, `erl`, `cerl`, `ea`, …; of a class
    of your own its name in lower case."""
    name = _class(algorithm)
    if name == "ERL":
        return _hybrid_word(algorithm, len(algorithm.get("learners", ())))
    if name == "Neuroevolution" and _class(algorithm.get("breeder") or {"class": ""}) == "Strategy":
        return "es"
    return _learner_word(algorithm["learner"]) if name == "OffPolicy" else name.lower()


def _hybrid_word(algorithm: Mapping[str, Any], learners: int) -> str:
    """Presets of ERL by what tells them apart."""
    if learners and algorithm.get("share"):
        return "hybrid"
    return "cerl" if algorithm.get("manager") or learners > 1 else ("erl" if learners else "ea")


def task_word(env: Mapping[str, Any]) -> str:
    """A task's id in Gymnasium or PettingZoo without its package, or the name of its class; with
    `-delayed` where its reward comes at the end of an episode, `-hidden` where a part of it is not
    seen, `-last-step` where the last action and reward are."""
    told = ""
    while "env" in env:  # a wrapper
        known = [word for name, word in WRAPPERS.items() if _class(env).startswith(name)]
        told = "".join(f"-{word}" for word in known) + told
        env = env["env"]
    return str(env.get("id") or _class(env)).rpartition(":")[2] + told


def _learner_word(learner: Mapping[str, Any]) -> str:
    name = _class(learner)
    if name != "TD3":
        return name.lower().removeprefix("discrete")  # SAC is one word
    team = "ma" if _class(learner["critic"]) == "JointCritic" else ""
    return team + ("td3" if learner["critics"] > 1 else "ddpg")


def _class(tree: Mapping[str, Any]) -> str:
    return str(tree["class"]).rpartition(":")[2]
