"""The endless T-maze pays what its docstring says, corridor by corridor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.endless_tmaze import EndlessTMaze

KEY = jax.random.key(0)


def walk(env, policy, key=KEY):
    """Observations, rewards and how it ended, of `policy(obs, corridor, step, sides)`."""
    state, now = env.reset(key=key)
    step = jax.jit(env.step)
    seen, paid = [now.obs], []
    while not (now.terminated or now.truncated):
        action = policy(
            np.asarray(now.obs), int(state.corridor), len(paid), np.asarray(state.sides)
        )
        state, now = step(state, jnp.float32(jnp.array(action)), key=key)
        seen.append(now.obs)
        paid.append({name: float(x) for name, x in now.rewards.items()})
    sums = {name: sum(x[name] for x in paid) for name in env.signals}
    return np.array(seen), sums, (bool(now.terminated), bool(now.truncated)), len(paid), state


def remembers(obs, corridor, step, sides):
    return 1.0, sides[corridor]


def test_who_remembers_the_last_sign_has_all():
    env = EndlessTMaze(3, 2, 4)
    _, sums, ended, steps, state = walk(env, remembers)
    assert steps == int(state.lengths.sum()) + 3
    assert sums["reward"] == pytest.approx(3 - 0.01 * steps, abs=1e-5)
    assert sums["turns"] == pytest.approx(1.0)
    assert sums["success"] == 1.0
    assert ended == (True, False)


def test_each_sign_is_seen_once_where_its_corridor_begins():
    env = EndlessTMaze(3, 2, 2)
    seen, _, _, _, state = walk(env, remembers)
    signs, junctions = seen[:9].T
    assert signs[[0, 3, 6]].tolist() == np.asarray(state.sides).tolist()
    assert np.flatnonzero(signs).tolist() == [0, 3, 6]
    assert np.flatnonzero(junctions).tolist() == [2, 5, 8]


def test_a_wrong_turn_ends_it_and_costs_one():
    env = EndlessTMaze(3, 2, 2)
    wrong = lambda obs, corridor, step, sides: (1.0, sides[corridor] * (1 - 2 * (corridor == 1)))  # noqa: E731
    _, sums, ended, steps, _ = walk(env, wrong)
    assert (steps, ended) == (6, (True, False))
    assert sums["reward"] == pytest.approx(1 - 1 - 0.06, abs=1e-6)
    assert sums["turns"] == pytest.approx(1 / 3)
    assert sums["success"] == 0.0


def test_standing_still_hides_the_sign_and_runs_into_the_clock():
    env = EndlessTMaze(2, 2, 2)
    seen, sums, ended, steps, _ = walk(env, lambda *_: (-1.0, 1.0))
    assert np.flatnonzero(seen[:, 0]).tolist() == [0]
    assert (steps, ended) == (env.max_steps, (False, True))
    assert sums["reward"] == pytest.approx(-0.01 * 6, abs=1e-6)


def test_no_turn_at_a_junction_waits_there():
    env = EndlessTMaze(2, 1, 1)
    waits = lambda obs, corridor, step, sides: (1.0, 0.0 if step == 1 else sides[corridor])  # noqa: E731
    seen, sums, ended, *_ = walk(env, waits)
    assert seen[1:3, 1].tolist() == [1.0, 1.0]
    assert sums["success"] == 0.0
    assert ended == (False, True)


def test_lengths_are_drawn_from_all_that_are_allowed():
    env = EndlessTMaze(4, 2, 4)
    states, _ = jax.vmap(lambda key: env.reset(key=key))(jax.random.split(KEY, 200))
    values, counts = np.unique(np.asarray(states.lengths), return_counts=True)
    assert values.tolist() == [2, 3, 4]
    assert (counts > 200).all()
    assert set(np.unique(np.asarray(states.sides)).tolist()) == {-1.0, 1.0}


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ((0, 1, 2), "corridors is 0"),
        ((1, 0, 2), r"corridors of 0..2 steps: needs 1 <="),
        ((1, 3, 2), r"corridors of 3..2 steps: needs 1 <="),
    ],
)
def test_impossible_mazes_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        EndlessTMaze(*fields)
