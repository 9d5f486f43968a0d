"""The passive T-maze pays what its docstring says, to who remembers and to who does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.passive_tmaze import PassiveTMaze

KEYS = jax.random.split(jax.random.key(0), 400)


def play(env, policy):
    """Returns, steps and ends of `policy(obs, sign, step)`, which is told the sign."""

    def one(key):
        state, first = env.reset(key=key)
        sign = first.obs[0]

        def advance(loop, _):
            state, seen, total, steps, active = loop
            action = jnp.stack([jnp.float32(x) for x in policy(seen.obs, sign, steps)])
            state, now = env.step(state, action, key=key)
            paid = jax.tree.map(lambda x: jnp.where(active, x, 0.0), now.rewards)
            total = jax.tree.map(jnp.add, total, paid)
            ended = active & (now.terminated | now.truncated)
            steps = steps + active.astype(jnp.int32)
            return (state, now, total, steps, active & ~ended), (now.terminated, active)

        start = (state, first, first.rewards, jnp.int32(0), jnp.bool_(True))
        loop, (terminated, active) = jax.lax.scan(advance, start, None, env.max_steps)
        return loop[2], loop[3], jnp.any(terminated & active)

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(KEYS))


@pytest.mark.parametrize("length", [1, 10])
def test_who_remembers_the_sign_has_all(length):
    returns, steps, turned = play(PassiveTMaze(length), lambda obs, sign, _: (1.0, sign))
    assert (returns["reward"] == 1.0).all()
    assert (returns["success"] == 1.0).all()
    assert (steps == length + 1).all()
    assert turned.all()


def test_who_does_not_has_half():
    for turn in (1.0, -1.0):
        returns, *_ = play(PassiveTMaze(5), lambda obs, sign, _, turn=turn: (1.0, turn))
        assert set(returns["success"].tolist()) == {0.0, 1.0}
        assert returns["success"].mean() == pytest.approx(0.5, abs=0.08)
        assert (returns["reward"] == returns["success"]).all()


def test_a_step_not_taken_costs_and_never_arrives():
    """It stands still at step 2 of 5."""
    stands = lambda obs, sign, t: (jnp.where(t == 2, -1.0, 1.0), sign)  # noqa: E731
    returns, steps, turned = play(PassiveTMaze(5), stands)
    np.testing.assert_allclose(returns["reward"], -1 / 5, rtol=1e-6)
    assert not returns["success"].any()
    assert (steps == 6).all()
    assert not turned.any()


def test_who_never_walks_pays_for_every_step():
    returns, *_ = play(PassiveTMaze(4), lambda obs, sign, _: (0.0, 1.0))
    np.testing.assert_allclose(returns["reward"], -5 / 4, rtol=1e-6)


def test_the_sign_is_seen_once_and_the_junction_at_the_end():
    env = PassiveTMaze(3)
    state, seen = env.reset(key=KEYS[0])
    shown = [seen.obs]
    for _ in range(3):
        state, seen = env.step(state, jnp.array([0.5, 0.0]), key=KEYS[0])
        shown.append(seen.obs)
    signs, junctions = np.array(shown).T
    assert abs(signs[0]) == 1
    assert signs[1:].tolist() == [0, 0, 0]
    assert junctions.tolist() == [0, 0, 0, 1]


def test_no_turn_at_the_junction_is_the_end_by_the_clock():
    returns, steps, turned = play(PassiveTMaze(3), lambda obs, sign, _: (1.0, 0.0))
    assert not returns["reward"].any()
    assert (steps == 4).all()
    assert not turned.any()


def test_a_corridor_without_steps_is_refused():
    with pytest.raises(ValueError, match="length is 0"):
        PassiveTMaze(0)
