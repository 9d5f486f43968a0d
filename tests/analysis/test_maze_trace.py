"""A trace of the T-maze says what a plain replay says, and what evaluation pays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.analysis.maze_trace import trace_maze
from credo.environments.extended_tmaze import ExtendedTMaze
from credo.networks.base import AbstractPolicy
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.networks.team import Centralized, Team
from credo.rollout import evaluate

TASKS = {
    "fsp": ExtendedTMaze(depth=2, objective="spread"),
    "resp": ExtendedTMaze(depth=1, robots=3, objective="spread", partner="resp", corridor=(1, 3)),
    "alone": ExtendedTMaze(depth=2, robots=2, partner=None, corridor=(1, 2), rewards=("score",)),
    "as coded": ExtendedTMaze(
        depth=1, robots=2, presence="as-coded", feedback="own", shaping=True, moves="as-coded"
    ),
}
HEADS = {
    "mmu": MMU(hidden=4, output_activation="tanh"),
    "lstm": Recurrent("lstm", 3),
    "gru": Recurrent("gru", 2),
    "ff": MLP(hidden=(3,)),
}


def team(env, head="mmu", seed=0):
    network = Team(trunk=(), head=HEADS[head], sharing="nothing")
    return network.init(*env.sizes, key=jax.random.key(seed))


class Always(AbstractPolicy):
    """Every robot turns the same way."""

    turn: jax.Array

    def start(self, *, key):
        return ()

    def __call__(self, obs, carry):
        return jnp.broadcast_to(self.turn, (obs.shape[0], 1)), carry


def replayed(env, policy, trace):
    """Endpoints and memory of every trial, step by step in Python, where the trace has the reward
    and the static robot go; corridors are those of the same key."""
    start_keys = jax.random.split(jax.random.key(7))
    reset_key = jax.random.split(jax.random.split(start_keys[0], 1)[0])[0]
    state, now = env.reset(key=reset_key)
    assert state.goals.tolist() == trace.goal[:: env.endpoints].tolist()
    act = jax.jit(lambda obs, carry: policy(obs, carry))
    step = jax.jit(lambda state, action: env.step(state, action, key=jax.random.key(0)))
    carry, endpoint, memory = policy.start(key=jax.random.key(0)), [], []
    for t in range(env.max_steps):
        before = int(state.trial)
        action, carry = act(now.obs, carry)
        state, now = step(state, action)
        if int(state.trial) > before:
            endpoint.append(state.endpoint.tolist())
            memory.append(np.asarray(carry[1]))
        if now.terminated:
            return endpoint, memory, t + 1
    raise AssertionError("the episode has no end")


@pytest.mark.parametrize("name", TASKS)
def test_a_trace_is_what_a_plain_replay_does(name):
    env = TASKS[name]
    policy = team(env)
    trace = jax.tree.map(np.asarray, trace_maze(env, policy, key=jax.random.key(7)))
    endpoint, memory, steps = replayed(env, policy, trace)
    assert trace.endpoint.tolist() == endpoint
    assert len(np.unique(trace.endpoint, axis=0)) > 1  # it does not stand still
    np.testing.assert_allclose(trace.memory, memory, rtol=1e-5, atol=1e-5)
    played = evaluate(env, tree.stack(policy), 1, key=jax.random.key(7))
    assert played.steps.item() == steps
    assert trace.observed.mean() == pytest.approx(played.returns["score"].item())


@pytest.mark.parametrize("name", TASKS)
def test_what_happens_follows_from_the_endpoints(name):
    env = TASKS[name]
    n = env.endpoints
    for seed in range(3):
        trace = trace_maze(env, team(env, seed=seed), key=jax.random.key(seed))
        trace = jax.tree.map(np.asarray, trace)
        assert (trace.partner is None) == (env.partner is None)
        for t in range(env.trials):
            assert trace.goal[t] == trace.goal[t // n * n]
            mine = trace.endpoint[t].tolist()
            everybody = mine if trace.partner is None else [*mine, trace.partner[t]]
            there = [at == trace.goal[t] for at in everybody]
            observed = all(there) if env.objective == "converge" else any(there)
            assert trace.observed[t] == observed
            same = len(set(everybody)) == 1
            coded = env.presence == "as-coded"
            company = [same if coded else everybody.count(at) > 1 for at in mine]
            assert trace.company[t].tolist() == company
            free = observed or env.feedback == "own"
            assert trace.reward[t].tolist() == [at and free for at in there[: env.robots]]
            if trace.partner is not None and t > 0:
                before = trace.partner[t - 1]
                own = env.objective == "spread" or env.feedback == "own" or trace.observed[t - 1]
                stays = before == trace.goal[t - 1] and own
                assert (trace.partner[t] == before) == stays


def test_who_always_turns_one_way_is_at_one_end():
    env = TASKS["fsp"]
    for turn, end in ((-1.0, 0), (0.0, 3), (jnp.nan, 3)):
        trace = trace_maze(env, Always(jnp.float32(turn)), key=jax.random.key(0))
        assert trace.endpoint.tolist() == [[end]] * 12
        assert trace.memory is None


@pytest.mark.parametrize(("head", "cells"), [("mmu", 4), ("lstm", 3), ("gru", 2), ("ff", None)])
def test_memory_is_that_of_each_robot_if_it_has_one(head, cells):
    env = TASKS["alone"]
    trace = trace_maze(env, team(env, head), key=jax.random.key(0))
    if cells is None:
        assert trace.memory is None
    else:
        assert trace.memory.shape == (12, 2, cells)
        assert np.abs(trace.memory[0, 0] - trace.memory[0, 1]).max() > 0.01


def test_one_network_for_all_has_no_memory_of_each_robot():
    env = TASKS["alone"]
    policy = Centralized(HEADS["gru"]).init(*env.sizes, key=jax.random.key(0))
    assert trace_maze(env, policy, key=jax.random.key(0)).memory is None
