"""Checks of arguments: each says what was given and what is allowed."""

import dataclasses
import difflib
import math
from collections.abc import Iterable
from typing import Any, Literal, get_args, get_origin

FEW = 12  # names that are read faster than one that was meant is looked for


def choice(name: str, value: str, allowed: Iterable[str]) -> None:
    """Raise unless `value` is one of `allowed`."""
    if value not in (allowed := sorted(allowed)):
        meant = suggestion(str(value), allowed) if len(allowed) > FEW else ""
        raise ValueError(f"{name} is {value!r}{meant}: it must be one of {', '.join(allowed)}")


def literals(config: Any) -> None:
    """Raise unless every field that is annotated as a `Literal` has one of its values, or None
    where the annotation allows it."""
    for field in dataclasses.fields(config):
        kinds = (field.type, *get_args(field.type))
        none = getattr(config, field.name) is None and type(None) in kinds
        for kind in kinds:
            if get_origin(kind) is Literal and not none:
                choice(field.name, getattr(config, field.name), get_args(kind))


def suggestion(name: str, known: Iterable[str]) -> str:
    """` (did you mean …?)` with the nearest of the known names, or nothing."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def at_least(name: str, value: Any, minimum: float) -> None:
    """Raise if `value` is a number below `minimum`. Arrays pass: they may be traced."""
    if isinstance(value, int | float) and not value >= minimum:
        raise ValueError(f"{name} is {value}: it must be at least {minimum}")


def above(name: str, value: Any, limit: float) -> None:
    """Raise if `value` is a number that is not above `limit`. Arrays pass: they may be traced."""
    if isinstance(value, int | float) and not value > limit:
        raise ValueError(f"{name} is {value}: it must be above {limit:g}")


def within(name: str, value: Any, low: float, high: float, without: float | None = None) -> None:
    """Raise if `value` is a number outside [low, high], or is `without`, one of its ends. Arrays
    pass: they may be traced."""
    if isinstance(value, int | float) and (not low <= value <= high or value == without):
        begins, ends = "(" if without == low else "[", ")" if without == high else "]"
        raise ValueError(f"{name} is {value}: it must lie in {begins}{low:g}, {high:g}{ends}")


def signal(given: str | None, known: tuple[str, ...]) -> None:
    """A reward signal of the task, or None."""
    if given is not None and given not in known:
        raise ValueError(f"no reward signal {given!r}: this task has {', '.join(known)}")


def memory(capacity: int, size: int, free: int) -> None:
    """Raise if a replay buffer of transitions of `size` bytes needs more than is `free`."""
    if capacity * size > free:
        raise ValueError(
            f"a replay buffer of {capacity:,} transitions needs {capacity * size:,} bytes, and "
            f"this process may take {free:,} more: give a smaller capacity, at most "
            f"{free // size:,}; runs at the same time (--seeds) share them"
        )


def fits(env: Any, network: Any, *learners: Any) -> None:
    """A network that acts for as many agents as the task has, and learners that can learn it."""
    team = env.agents is not None
    unfit = [learner for learner in learners if team and not learner.teams]
    if unfit:
        has, instead = f"{env.agents} agents", "Teams learn by TD3 (credo train merl, matd3), PPO"
        raise ValueError(_cannot_learn(env, has, instead, unfit))
    made = getattr(network, "choices", None)
    if made is not None and (made, network.masked) != (tuple(env.choices), env.masked):
        raise ValueError(_other_choices(env, network))
    if network.team != team:
        raise ValueError(_other_team(env, network))
    if not team and any(getattr(learner, "together", False) for learner in learners):
        raise ValueError(_one_alone(env))


def named(network: Any) -> str:
    """What people call a network: the class of the one within, if there is one."""
    return type(getattr(network, "network", network)).__name__


def actions(env: Any, network: Any, *learners: Any) -> None:
    """Learners that can learn a task's kind of actions. It opens a task outside JAX."""
    for learner in learners:
        if learner.discrete or env.choices:
            choices(env, network, learner, single=True)


def choices(env: Any, network: Any, learner: Any, single: bool = False) -> None:
    """Discrete actions that a learner can learn, a `single` choice or several, by a network that
    chooses as the task asks."""
    if not env.choices:
        raise ValueError(_cannot_learn(env, "Box actions", "Give TD3, DDPG or SAC", [learner]))
    if not env.discrete:
        others = "Give a task that has the one or the other"
        raise ValueError(_cannot_learn(env, "choices beside a Box", others, [learner]))
    if not learner.discrete:
        others = "Give DQN or DiscreteSAC (credo train dqn, sac, erl, cerl, merl), or PPO (ppo)"
        raise ValueError(_cannot_learn(env, "Discrete actions", others, [learner]))
    if single and len(env.choices) > 1:
        others = "Train it by ppo"
        told = f"{len(env.choices)} choices at a step"
        raise ValueError(_cannot_learn(env, told, others, [learner]))
    if getattr(network, "choices", None) is None:
        task, name = getattr(env, "id", type(env).__name__), type(network).__name__
        raise ValueError(
            f"{task} has Discrete actions, which are learned by a network that chooses: give "
            f"choosing(task, {name}(...)) of credo.networks.choosing, which needs MLP, RNN, GRU, "
            "LSTM, MMU, NTM or DNC, for a team on a Team"
        )


def _other_choices(env: Any, network: Any) -> str:
    def told(of: Any) -> str:
        return f"choices of {tuple(of.choices) or 'nothing'}" + ", masked" * bool(of.masked)

    task = getattr(env, "id", type(env).__name__)
    return (
        f"{task} has {told(env)}, and the network makes {told(network)}: give choosing(task, "
        "network) of that task, or for Box actions the network alone"
    )


def _other_team(env: Any, network: Any) -> str:
    task, name = getattr(env, "id", type(env).__name__), type(network).__name__
    if network.team:
        return (
            f"{name} acts for a team and {task} has one agent: give a network of one, MLP(...), to "
            "an algorithm for one (erl, td3)"
        )
    return (
        f"{name} acts for one agent and {task} has {env.agents}: put it on a team, as in "
        f"Team(head={name}(...))"
    )


def _one_alone(env: Any) -> str:
    return (
        f"{getattr(env, 'id', type(env).__name__)} has one agent and the critic is one of a team: "
        "give Critic(...), as td3 and ddpg have"
    )


def _cannot_learn(env: Any, has: str, instead: str, learners: Iterable[Any]) -> str:
    task, names = getattr(env, "id", type(env).__name__), (type(x).__name__ for x in learners)
    return (
        f"{task} has {has}: {', '.join(names)} cannot learn that. {instead}, or evolve without a "
        "learner (credo train ea)"
    )


def room(
    elite_fraction: float, population: int, learners: int, of: str = "members", least: int = 1
) -> None:
    """A population with `least` elites or more, and slots for the actors of learners."""
    if not least <= int(elite_fraction * population) <= population - max(1, learners):
        enough = math.ceil(1000 * least / population) / 1000
        raise ValueError(
            f"elite_fraction is {elite_fraction} of {population} {of}: that must be at least "
            f"{least}, and leave {max(1, learners)} for offspring; give {enough:g} or more, or a "
            "larger population"
        )
