"""Baselines of the passive T-maze beside episodes that are played."""

import jax
import jax.numpy as jnp
import pytest

from credo import rollout
from credo.analysis import bounds
from credo.environments.passive_tmaze import PassiveTMaze
from credo.networks.base import AbstractPolicy


class Scripted(AbstractPolicy):
    kind: str

    def start(self, *, key):
        return key

    def __call__(self, obs, carry):
        key, draw = jax.random.split(carry)
        drawn = jax.random.uniform(draw, (2,), minval=-1.0, maxval=1.0)
        return drawn if self.kind == "random" else jnp.ones(2), key


@pytest.mark.parametrize(("kind", "name"), [("random", "random"), ("on", "walks without memory")])
def test_baselines_are_what_is_played(kind, name):
    env, key = PassiveTMaze(2), jax.random.key(0)
    policy = Scripted(kind)
    keys = jax.random.split(key, 2000)
    traces = jax.jit(
        jax.vmap(lambda k: rollout.record(env, policy, key=k, padded=True).rewards["success"])
    )(keys)
    won = jnp.max(traces, axis=1).mean()
    assert float(won) == pytest.approx(bounds.baselines(env)[name], abs=0.03)


def test_the_best_is_one():
    env = PassiveTMaze(7)
    assert bounds.exact(env)
    assert bounds.upper_bound(env).value == 1.0
    assert bounds.best_baseline(env) == ("walks without memory", 0.5)
