"""Baselines of the passive T-maze beside episodes that are played."""

import jax
import jax.numpy as jnp
import pytest

from credo import rollout
from credo.analysis import bounds
from credo.environments.distracted_cue import DistractedCue
from credo.environments.endless_tmaze import EndlessTMaze
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


class Remembering(AbstractPolicy):
    """It walks, and turns to the first sign, or to none but the right."""

    first: bool

    def start(self, *, key):
        return jnp.float32(0.0)

    def __call__(self, obs, carry):
        carry = jnp.where(carry == 0, obs[0], carry)
        return jnp.stack([jnp.float32(1.0), carry if self.first else jnp.float32(1.0)]), carry


@pytest.mark.parametrize(
    ("first", "name"), [(False, "walks without memory"), (True, "remembers the first sign")]
)
def test_baselines_of_the_endless_maze_are_what_is_played(first, name):
    env, keys = EndlessTMaze(3, 1, 2), jax.random.split(jax.random.key(0), 2000)
    play = lambda key: rollout.record(env, Remembering(first), key=key, padded=True)  # noqa: E731
    won = jnp.max(jax.jit(jax.vmap(lambda key: play(key).rewards["success"]))(keys), axis=1)
    assert float(won.mean()) == pytest.approx(bounds.baselines(env)[name], abs=0.03)
    assert bounds.upper_bound(env).value == 1.0


def test_a_constant_answer_is_right_in_half_of_the_cues():
    assert bounds.exact(DistractedCue())
    assert bounds.best_baseline(DistractedCue()) == ("constant", 0.5)
