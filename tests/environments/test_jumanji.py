"""Tasks of Jumanji: the numbers of its own steps, masks of every form, and ends told apart."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

if importlib.util.find_spec("jumanji") is None:  # one that cannot be imported is no reason to skip
    pytest.skip("an extra: pip install credo[jumanji]", allow_module_level=True)

from credo import rollout
from credo.environments import checks
from credo.environments.jumanji import Jumanji, jumanji
from credo.environments.others import making, permissive
from credo.networks.mlp import MLP

KEY = jax.random.key(0)
KINDS = [  # one mask; one of all combinations; a row for each choice; none; a Box
    ("Game2048-v1", (20, 4), (4,), True, 1000),
    ("Tetris-v0", (157, 40), (40,), True, 400),
    ("Cleaner-v0", (119, 12), (4, 4, 4), True, 100),
    ("RubiksCube-partly-scrambled-v0", (55, 10), (6, 1, 3), False, 20),
    ("SearchAndRescue-v0", (774, 4), (), False, 400),
]


def own(action, choices, mask, shape):
    """What an action means, written out in NumPy; a mask of combinations has an axis for each."""
    flat = np.ones(sum(choices), bool) if mask is None else np.ravel(mask)
    ends = np.cumsum(choices)
    parts = [
        int(np.argmax(np.where(flat[e - n : e], action[e - n : e], -2.0)))
        for n, e in zip(choices, ends, strict=True)
    ]
    if mask is not None and len(choices) == 1 and np.ndim(mask) > 1:
        parts = np.unravel_index(parts[0], np.shape(mask))
    return jnp.asarray(parts, jnp.int32).reshape(shape)


@pytest.mark.parametrize(("id", "sizes", "choices", "masked", "steps"), KINDS)
def test_steps_are_those_of_jumanji(id, sizes, choices, masked, steps):
    """Up to 50 steps from the same start, with the same actions."""
    ours = Jumanji(id)
    assert (ours.sizes, ours.choices, ours.masked, ours.max_steps) == (
        sizes,
        choices,
        masked,
        steps,
    )
    with making():
        theirs = jumanji.make(id)
    state, now = ours.reset(key=KEY)
    with permissive():
        inner, told = jax.jit(theirs.reset)(jax.random.key_data(KEY))
        their_step = jax.jit(theirs.step)
    step = jax.jit(lambda state, action: ours.step(state, action, key=KEY))
    random, taken = np.random.default_rng(0), 0
    while taken < 50 and int(told.step_type) != 2:
        fields = told.observation._asdict()
        mask = fields.pop("action_mask", None)
        numbers = [np.ravel(x) for x in jax.tree.leaves(fields)]
        numbers = numbers if mask is None else [np.ravel(mask), *numbers]
        np.testing.assert_allclose(now.obs, np.concatenate(numbers), atol=1e-4)
        action = random.uniform(-1, 1, ours.action_size).astype(np.float32)
        shape = theirs.action_spec.shape
        given = own(action, choices, mask, shape) if choices else jnp.asarray(action.reshape(shape))
        with permissive():
            inner, told = their_step(inner, given)
        state, now = step(state, jnp.asarray(action))
        assert float(now.rewards["reward"]) == pytest.approx(float(jnp.sum(told.reward)), abs=1e-4)
        taken += 1
        assert bool(now.terminated | now.truncated) == (int(told.step_type) == 2)
    assert taken >= 10


@pytest.mark.parametrize("id", ["Game2048-v1", "Tetris-v0", "Cleaner-v0", "Snake-v1"])
def test_no_action_is_played_that_is_not_allowed(id):
    """In 10,000 random steps, episodes after one another."""
    env = Jumanji(id)

    def allowed(state, action):
        options = env._made.options
        parts = jnp.ravel(env._own(action, state.allowed))
        if env.choices == options:
            starts = np.cumsum((0, *options))[:-1]
            return jnp.all(state.allowed[parts + starts]), jnp.any(state.allowed)
        at = jnp.ravel_multi_index(tuple(parts), options, mode="clip")
        return state.allowed[at], jnp.any(state.allowed)

    def advance(carry, key):
        state, now = carry
        keys = jax.random.split(key, 3)
        action = jax.random.uniform(keys[0], (env.action_size,), minval=-1.0)
        over = now.terminated | now.truncated
        new = jax.lax.cond(
            over, lambda: env.reset(key=keys[1]), lambda: env.step(state, action, key=keys[2])
        )
        return new, (*allowed(state, action), over)

    def play(key):
        return jax.lax.scan(advance, env.reset(key=key), jax.random.split(key, 200))[1]

    may, any_may, over = map(np.asarray, jax.jit(jax.vmap(play))(jax.random.split(KEY, 50)))
    assert may[~over & any_may].all()
    assert any_may[~over].all()


@pytest.mark.parametrize("id", ["Game2048-v1", "Snake-v1", "Cleaner-v0", "Tetris-v0"])
def test_our_check_finds_nothing(id):
    assert checks.check_environment(Jumanji(id, max_episode_steps=30)) == []


def test_the_end_terminates_and_the_clock_truncates():
    """A knapsack is full some time; a maze of four steps has a clock."""
    env = Jumanji("Knapsack-v1")
    played = rollout.record(env, MLP((2,)).init(*env.sizes, key=KEY), key=KEY)
    assert 0 < int(played.length) <= 50
    assert (bool(played.terminated), bool(played.truncated)) == (True, False)
    env = Jumanji("Maze-v0", {"time_limit": 4})
    assert env.max_steps == 4
    played = rollout.record(env, MLP((2,)).init(*env.sizes, key=KEY), key=KEY)
    assert int(played.length) == 4
    assert (bool(played.terminated), bool(played.truncated)) == (False, True)


def test_a_population_plays_it():
    env = Jumanji("Game2048-v1", max_episode_steps=9)
    policies = jax.vmap(lambda key: MLP((4,)).init(*env.sizes, key=key))(jax.random.split(KEY, 3))
    played = rollout.evaluate(env, policies, 2, key=KEY)
    assert played.returns["reward"].shape == (3, 2)
    assert np.asarray(played.steps).tolist() == [[9, 9]] * 3


def test_what_jumanji_does_not_have_is_refused():
    with pytest.raises(ValueError, match="id is 'Snak-v1'"):
        Jumanji("Snak-v1")
    with pytest.raises(ValueError, match="Snake-v1 was not made: TypeError"):
        Jumanji("Snake-v1", {"gravty": 1.0})


def test_an_image_is_found_behind_the_mask():
    env = Jumanji("Snake-v1")
    assert env.image == (4, 12, 12, 5)
    with permissive():
        _, told = jumanji.make("Snake-v1").reset(jax.random.key_data(KEY))
    start, *shape = env.image
    _, first = env.reset(key=KEY)
    seen = first.obs[start : start + np.prod(shape)].reshape(shape)
    np.testing.assert_array_equal(seen, told.observation.grid)
    assert Jumanji("Game2048-v1").image is None
