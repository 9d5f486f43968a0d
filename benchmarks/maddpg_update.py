"""MADDPG updates per second of one core, beside BenchMARL's.

Five agents with VMAS discovery's sizes: 19 observations and 2 actions each. One update is one
gradient step of every agent's actor and critic, targets and minibatch included.

Equal in the first comparison: sizes, an actor and a critic of each agent's own, 2 × 256 tanh,
batch 128 drawn uniformly, Adam with its rates, clipping to a norm of 5, τ and γ. Not equal: in the
actors' loss all of BenchMARL's agents act anew, here each one beside the others' remembered actions
(the products are as many); BenchMARL has no target of the actor, and its step copies losses and
norms for its log. What is in the buffers does not matter to the time.

BenchMARL's default shares one actor and one critic: a fifth of the critics' work. Credo has no
shared critic and is compared with its own shared actor and five critics.
"""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from credo.learners.base import learn
from credo.learners.td3 import TD3, maddpg
from credo.networks.mlp import MLP, Critic
from credo.networks.team import JointCritic, Team
from credo.replay import Replay, extend
from credo.types import Transition

from . import peers
from .td3_update import seconds

AGENTS, OBS, ACT, BATCH, ROWS, UPDATES, ROUNDS = 5, 19, 2, 128, 20_000, 50, 5
HIDDEN = (256, 256)
STEPS = "100"  # of BenchMARL
SHAPES: dict[str, Literal["nothing", "everything"]] = {"own": "nothing", "shared": "everything"}
NAMES = {"own": "an actor of each agent's own", "shared": "one actor for all"}


def learner() -> TD3:
    """With BenchMARL's constants."""
    return maddpg(
        critic=JointCritic(Critic(hidden=HIDDEN, activation="tanh")),
        gamma=0.99,
        actor_lr=5e-5,
        critic_lr=5e-5,
        tau=0.005,
        actor_max_norm=5.0,
        critic_max_norm=5.0,
        batch_size=BATCH,
    )


def filled() -> Replay:
    rng = np.random.default_rng(0)
    obs, next_obs = rng.normal(size=(2, ROWS, AGENTS, OBS)).astype(np.float32)
    action = rng.uniform(-1, 1, (ROWS, AGENTS, ACT)).astype(np.float32)
    rewards = {"reward": rng.normal(size=ROWS).astype(np.float32)}
    rows = Transition(obs, action, rewards, next_obs, *np.zeros((2, ROWS), bool))
    row = jax.tree.map(lambda x: jnp.asarray(x[0]), rows)
    return extend(Replay.empty(row, ROWS), rows)


def rates() -> dict[str, float]:
    """Updates per CPU second, the median of rounds in turn."""
    replay, rule = filled(), learner()
    states = {
        name: rule.init(
            Team(trunk=HIDDEN, head=MLP(hidden=(), initializer="uniform"), sharing=sharing),
            OBS,
            ACT,
            AGENTS,
            key=jax.random.key(0),
        )
        for name, sharing in SHAPES.items()
    }

    def update(state):
        key, count = jax.random.key(1), jnp.int32(UPDATES)
        return learn(rule, state, replay, count, signal="reward", key=key)

    times = {name: [] for name in states}
    for state in states.values():
        jax.block_until_ready(update(state))
    for _ in range(ROUNDS):
        for name, state in states.items():
            times[name].append(seconds(lambda state=state: update(state)))
    return {name: UPDATES / float(np.median(t)) for name, t in times.items()}


def check(theirs: dict[str, Any]) -> None:
    """That BenchMARL measured what is compared here."""
    wanted = {"shape": [AGENTS, OBS, ACT], "batch": BATCH, "hidden": list(HIDDEN)}
    given = {name: theirs[name] for name in wanted}
    if given != wanted:
        raise RuntimeError(f"BenchMARL's task is {given}; compared is {wanted}")


def main() -> None:
    print(
        f"MADDPG updates of {AGENTS} agents, {OBS} observations, {ACT} actions, 2 × 256 units, "
        f"batch {BATCH}, one core"
    )
    ours = rates()
    for name, rate in ours.items():
        print(f"  Credo, {NAMES[name]:<34}{rate:8.0f} updates per CPU second", flush=True)
    label = {"own": "actors and critics of their own", "shared": "one of both for all"}
    answer = peers.ask("benchmarl", "benchmarl_maddpg.py", STEPS)
    if answer:
        for name, theirs in answer.items():
            check(theirs)
            rate, ratio = theirs["rate"], ours[name] / theirs["rate"]
            print(
                f"  BenchMARL, {label[name]:<34}{rate:4.0f} optimiser steps per CPU second: "
                f"{ratio:.1f} ×"
            )


if __name__ == "__main__":
    main()
