"""The probes give what their docstrings promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.probes import Copy, Locked, Meet, Remember, Xor


def play(env, policy, keys):
    """Returns and steps of `policy(obs)`, one episode per key; memory is not needed here."""

    def one(key):
        reset_key, step_key = jax.random.split(key)
        state, first = env.reset(key=reset_key)
        returns = jax.tree.map(jnp.zeros_like, first.rewards)

        def ongoing(loop):
            return ~(loop[1].terminated | loop[1].truncated)

        def advance(loop):
            state, time_step, returns, steps = loop
            key = jax.random.fold_in(step_key, steps)
            state, time_step = env.step(state, policy(time_step.obs), key=key)
            returns = jax.tree.map(jnp.add, returns, time_step.rewards)
            return state, time_step, returns, steps + 1

        start = (state, first, returns, jnp.int32(0))
        _, last, returns, steps = jax.lax.while_loop(ongoing, advance, start)
        return returns, steps, last

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(keys))


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(0), 500)


def test_copy_pays_minus_the_squared_distance(keys):
    env = Copy(size=2, max_steps=4)
    best, steps, last = play(env, lambda obs: obs, keys)
    assert (best["reward"] == 0.0).all()
    assert (steps == 4).all()
    assert last.truncated.all()
    assert not last.terminated.any()
    idle, *_ = play(env, jnp.zeros_like, keys)
    assert idle["reward"].mean() == pytest.approx(-2 * 4 / 3, rel=0.1)
    off, *_ = play(env, lambda obs: obs + 0.5, keys)
    np.testing.assert_allclose(off["reward"], -4 * 2 * 0.25, rtol=1e-5)


def test_xor_pays_the_squared_rest_of_four(keys):
    env = Xor()
    best, steps, last = play(env, lambda obs: jnp.where(obs[:1] != obs[1:], 1.0, -1.0), keys)
    assert (best["fitness"] == 16.0).all()
    assert (best["success"] == 1.0).all()
    assert (steps == 4).all()
    assert last.truncated.all()
    either, *_ = play(env, lambda obs: 2.0 * jnp.max(obs, keepdims=True) - 1.0, keys)
    assert (either["fitness"] == 9.0).all()  # wrong for the pair of ones
    assert (either["success"] == 0.0).all()
    undecided, *_ = play(env, lambda obs: jnp.zeros(1), keys)
    assert (undecided["fitness"] == 4.0).all()
    assert (undecided["success"] == 0.0).all()


def test_copying_is_paid_behind_a_lever_that_was_held(keys):
    env = Locked(size=3, threshold=0.3, hold=4, effort=0.1, max_steps=10)

    def pulled(lever, copies=1.0):
        """Pull in the first part, and copy throughout."""
        return lambda obs: jnp.append(copies * obs[:3], jnp.where(obs[-1] < 0.4, lever, 0.0))

    for lever in (0.31, -0.31):
        returns, steps, last = play(env, pulled(lever), keys)
        np.testing.assert_allclose(returns["reward"], 6.0 - 4 * 0.1 * 0.31, rtol=1e-5)
        assert (steps == 10).all()
        assert last.truncated.all()
        assert not last.terminated.any()
    short, *_ = play(env, pulled(0.29), keys)
    np.testing.assert_allclose(short["reward"], -4 * 0.1 * 0.29, rtol=1e-5)
    alone, *_ = play(env, pulled(0.31, copies=0.0), keys)
    assert alone["reward"].mean() == pytest.approx(3.0 - 0.124, rel=0.05)
    # Held too late, in the second part alone.
    late, *_ = play(env, lambda obs: jnp.append(obs[:3], jnp.where(obs[-1] < 0.4, 0.0, 1.0)), keys)
    np.testing.assert_allclose(late["reward"], -0.6, rtol=1e-5)


def test_remember_asks_at_the_end_for_what_it_showed_first():
    task = Remember(delay=3)
    sequence = task.sample(key=jax.random.key(0))
    signal = float(sequence.inputs[0, 0])
    assert abs(signal) == 1.0
    assert sequence.inputs[:, 0].tolist() == [signal, 0, 0, 0]
    assert sequence.targets.tolist() == [0, 0, 0, signal]
    assert sequence.scored.tolist() == [False, False, False, True]
    assert int(sequence.length) == task.max_steps == 4
    no = jnp.bool_(False)
    assert float(task.reward(jnp.float32(0.5), jnp.float32(-1.0), ~no, no)) == -0.5
    assert float(task.reward(jnp.float32(0.5), jnp.float32(-1.0), no, no)) == 0.0
    draws = jax.vmap(lambda key: task.sample(key=key).inputs[0, 0])(
        jax.random.split(jax.random.key(1), 400)
    )
    assert abs(float(draws.mean())) < 4 / 20


def test_meet_needs_both_agents(keys):
    env = Meet()
    towards = jnp.array([[1.0], [-1.0]])
    both, steps, last = play(env, lambda obs: towards, keys)
    assert (both["global"] == 1.0).all()
    assert set(steps) == {4, 5}
    assert last.terminated.all()
    assert not last.truncated.any()
    assert last.active.all()
    np.testing.assert_allclose(both["local"], 0.2 * np.stack([steps, steps], axis=1), rtol=1e-5)
    for still in (0, 1):
        alone, steps, last = play(env, lambda obs, s=still: towards.at[s].set(0.0), keys)
        assert (alone["global"] == 0.0).all()
        assert (steps == 5).all()
        assert last.truncated.all()
        np.testing.assert_allclose(alone["local"][:, 1 - still], 1.0, rtol=1e-5)
        assert (alone["local"][:, still] == 0.0).all()


def test_meet_shows_each_agent_its_own_side():
    _, first = Meet().reset(key=jax.random.key(0))
    own, way = np.asarray(first.obs).T
    assert -1.0 <= own[0] <= -0.7
    assert 0.7 <= own[1] <= 1.0
    np.testing.assert_allclose(way, own[::-1] - own, rtol=1e-6)


def test_impossible_probes_are_refused():
    with pytest.raises(ValueError, match="size is 0"):
        Copy(size=0)
    with pytest.raises(ValueError, match="max_steps is 0"):
        Copy(max_steps=0)
    with pytest.raises(ValueError, match="hold is 32"):
        Locked(hold=32)
    with pytest.raises(ValueError, match="threshold is -1"):
        Locked(threshold=-1.0)
    with pytest.raises(ValueError, match="delay is 0"):
        Remember(delay=0)
