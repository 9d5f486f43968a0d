"""Episodes of the population that are cut short, with the critic's value behind them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.algorithms.aid import play_ahead
from credo.algorithms.erl import ERL
from credo.algorithms.merl import MERL
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy, Meet
from credo.environments.wrappers import delayed
from credo.evolution.breeder import draw
from credo.learners.base import act, scaled
from credo.learners.credit import Even
from credo.learners.horizon import Truncated
from credo.learners.share import Fixed
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.networks.team import Team
from credo.normalization import behind
from credo.rollout import Experience, collect
from credo.types import Batch, Evaluation, Transition

NETWORK = MLP((4,))
LEARNER = TD3(critic=Critic(hidden=(4,)), batch_size=8, reward_scale=0.5)
SMALL = {"population_size": 4, "elite_fraction": 0.25, "warmup_frames": 0, "sync_period": 1}


def test_a_task_in_jax_is_cut_after_as_many_steps_as_data_say():
    env, key = Copy(), jax.random.key(1)
    population = draw(NETWORK, env.sizes, 3, key=jax.random.key(0))
    play = jax.jit(lambda limit, key: collect(env, population, 2, limit=limit, key=key))
    _, whole = play(jnp.int32(99), key)
    played, new = play(jnp.int32(4), key)
    assert play._cache_size() == 1
    assert np.all(played.steps == 4)
    rewards = np.asarray(whole.transitions.rewards["reward"]).reshape(3, 2, 10)
    np.testing.assert_allclose(played.returns["reward"], rewards[..., :4].sum(axis=2), rtol=1e-5)
    last = new.last(played)
    assert np.all(last.truncated)
    assert not np.any(last.terminated)
    obs = np.asarray(whole.transitions.next_obs).reshape(6, 10, 1)
    np.testing.assert_array_equal(last.next_obs, obs[:, 3])


def test_a_task_outside_jax_is_cut_too_unless_it_terminates_before():
    env, key = Gymnasium("InvertedPendulum-v5", in_process=True), jax.random.key(1)
    population = draw(NETWORK, env.sizes, 3, key=jax.random.key(0))
    whole, rows = collect(env, population, 2, key=key)
    limit = int(np.median(whole.steps))
    played, new = collect(env, population, 2, limit=jnp.int32(limit), key=key)
    np.testing.assert_array_equal(played.steps, np.minimum(whole.steps, limit))
    last = new.last(played)
    fell = np.asarray(whole.steps).reshape(-1) <= limit
    np.testing.assert_array_equal(last.terminated, fell)
    np.testing.assert_array_equal(last.truncated, ~fell)
    ends = np.cumsum(np.asarray(whole.steps).reshape(-1))
    starts = ends - np.asarray(whole.steps).reshape(-1)
    at = starts + np.asarray(played.steps).reshape(-1) - 1
    np.testing.assert_allclose(last.next_obs, rows.transitions.next_obs[at], rtol=1e-6)


@pytest.fixture(scope="module")
def played():
    erl = ERL.erl(Copy(), NETWORK, learners=(LEARNER,), horizon=Truncated(3), **SMALL)
    state, metrics = jax.jit(erl.generation)(erl.init(key=jax.random.key(0)), key=jax.random.key(1))
    assert metrics["frames"] == 5 * 10  # nothing was learned yet, so episodes are whole
    return erl, state


def kept(state):
    """With a buffer that can be given away."""
    return replace(state, replay=jax.tree.map(jnp.copy, state.replay))


TEAM = Team(trunk=(4,), head=MLP(hidden=()), initializer="normal")
CASES = {
    "JAX": lambda: ERL.erl(Copy(), NETWORK, learners=(LEARNER,), horizon=Truncated(3), **SMALL),
    "JAX, a short view": lambda: ERL.erl(
        Copy(),
        NETWORK,
        learners=(replace(LEARNER, gamma=0.5),),
        horizon=Truncated(3),
        **SMALL,
    ),
    "Gymnasium, normalised": lambda: ERL.erl(
        Gymnasium("InvertedPendulum-v5", in_process=True),
        NETWORK,
        learners=(LEARNER,),
        horizon=Truncated(4),
        normalize_observations=True,
        **SMALL,
    ),
    "a team, normalised": lambda: MERL.merl(
        Meet(),
        TEAM,
        learners=(replace(LEARNER, signal="local"),),
        population_size=4,
        elite_fraction=0.25,
        horizon=Truncated(3),
        warmup_frames=0,
        fitness="local",
        normalize_observations=True,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_rest_is_worth_the_lesser_of_two_accounts(case):
    """In units of the reward, of which critics see half: the value of the last state; or the mean
    reward of the second half for as many steps as are left or a discount looks ahead, and the value
    of the last state less the mean of those before."""
    algorithm = CASES[case]()
    state, _ = algorithm.generation(algorithm.init(key=jax.random.key(0)), key=jax.random.key(1))
    env, learner, limit = algorithm.env, algorithm.learners[0], algorithm.horizon.steps
    given, key = (state.population, 2), jax.random.key(5)
    _, ahead = play_ahead(algorithm, kept(state), *given, key=key)
    acting = behind(state.moments, state.population)
    played, new = collect(env, acting, 2, limit=jnp.int32(limit), key=key)
    rows, steps = new.transitions, np.asarray(played.steps).reshape(-1)
    starts = np.cumsum(steps) - steps if new.valid is None else np.arange(8) * env.max_steps
    found = np.asarray(ahead.of(algorithm.reward)).reshape(-1)
    returns = np.asarray(played.of(algorithm.reward)).reshape(-1)
    least = []
    for i in range(8):
        member = tree.take(state.population, i // 2)
        at = starts[i] + np.arange(steps[i])
        obs = np.concatenate([np.asarray(rows.obs)[at], np.asarray(rows.next_obs)[at[-1:]]])
        values = []
        for one in obs:
            if state.moments is not None:
                mean, std = (np.asarray(x) for x in state.moments.used)
                one = np.clip((one - mean) / std, -10.0, 10.0)
            one = jnp.asarray(one, jnp.float32)[None]
            off = jnp.zeros(one.shape[:-1], bool)
            batch = Batch(one, act(member, one), off.astype(jnp.float32), one, off, off)
            value = learner.value(state.learners[0], member, batch)
            values.append(float(np.mean(np.asarray(value))) / 0.5)
        rewards = np.asarray(rows.rewards[algorithm.reward])[at].reshape(steps[i], -1).mean(axis=1)
        ahead = min(env.max_steps - limit, 1 / (1 - learner.gamma))
        gain = rewards[limit // 2 :].mean() if steps[i] == limit else 0.0
        accounts = values[-1], gain * ahead + values[-1] - np.mean(values[:-1])
        over = np.asarray(rows.terminated)[at[-1]].all()
        rest = min(accounts) if steps[i] == limit and not over else 0.0
        least.append(int(np.argmin(accounts)))
        assert found[i] == pytest.approx(returns[i] + rest, rel=1e-4, abs=1e-4)
    assert case != "JAX" or set(least) == {0, 1}  # both accounts were the lesser one


@pytest.mark.parametrize(
    "env", [Copy(), Gymnasium("InvertedPendulum-v5", in_process=True)], ids=["JAX", "Gymnasium"]
)
def test_the_first_transitions_of_every_episode(env):
    population = draw(NETWORK, env.sizes, 3, key=jax.random.key(0))
    played, new = collect(env, population, 2, limit=jnp.int32(8), key=jax.random.key(1))
    seen = np.asarray(new.first(new.transitions.obs, played, 5))
    assert seen.shape == (6, 5, *new.transitions.obs.shape[1:])
    rows = np.asarray(new.transitions.obs)
    steps = np.asarray(played.steps).reshape(-1)
    starts = np.cumsum(steps) - steps if new.valid is None else np.arange(6) * 10
    for i in range(6):
        lived = min(5, steps[i])
        np.testing.assert_array_equal(seen[i, :lived], rows[starts[i] : starts[i] + lived])


def test_the_population_plays_less_and_learners_play_on(played):
    erl, state = played
    after, metrics = jax.jit(erl.generation)(state, key=jax.random.key(2))
    assert metrics["frames"] == 4 * 3 + 10
    assert after.frames == state.frames + metrics["frames"]
    assert after.replay.written == after.frames
    long = replace(erl, horizon=Truncated(10))  # as long as an episode: nothing is added
    _, whole = play_ahead(long, kept(state), state.population, 1, key=jax.random.key(5))
    plain, _ = collect(erl.env, state.population, 1, key=jax.random.key(5))
    np.testing.assert_allclose(whole.returns["reward"], plain.returns["reward"], rtol=1e-6)


def test_a_learner_that_scales_rewards_asks_by_the_scale_it_learned_with(played):
    """That of the buffer before this generation, which is gone once the new one is made."""
    erl, state = played
    given = (state.population, 1)
    learner = replace(LEARNER, reward_scale=None)
    by_hand = scaled(learner, state.replay, "reward")
    ahead = [
        play_ahead(replace(erl, learners=(one,)), kept(state), *given, key=jax.random.key(5))[1]
        for one in (learner, by_hand, replace(LEARNER, reward_scale=1.0))
    ]
    one, same, other = (np.asarray(x.returns["reward"]) for x in ahead)
    np.testing.assert_allclose(one, same, rtol=1e-5)
    assert not np.allclose(one, other, rtol=1e-3)


@pytest.mark.parametrize(
    "env", [Copy(), Gymnasium("InvertedPendulum-v5", in_process=True)], ids=["JAX", "Gymnasium"]
)
def test_late_rewards_alone_may_be_spread_where_episodes_are_cut(env):
    fields = {"learners": (LEARNER,), "horizon": Truncated(3), "share": Fixed(0.1), **SMALL}
    erl = ERL.erl(env, NETWORK, redistribute=Even(late_only=True), episodes=1, **fields)
    state = erl.init(key=jax.random.key(0))
    assert bool(state.late)
    state, _ = erl.generation(state, key=jax.random.key(1))
    assert not bool(state.late)  # it pays at every step
    _, ahead = play_ahead(erl, state, state.population, 1, key=jax.random.key(2))
    assert np.all(np.asarray(ahead.steps) == 3)


def test_episodes_are_whole_where_all_is_paid_at_their_last_step():
    fields = {"learners": (LEARNER,), "horizon": Truncated(3), **SMALL}
    erl = ERL.erl(delayed(Copy()), NETWORK, redistribute=Even(late_only=True), **fields)
    state = erl.init(key=jax.random.key(0))
    for step in range(3):
        state, metrics = erl.generation(state, key=jax.random.key(step))
        assert metrics["frames"] == 5 * 10
    assert bool(state.learned)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Truncated(0), "steps is 0"),
        (lambda: ERL.ea(Copy(), horizon=Truncated()), "there is no learner"),
        (
            lambda: ERL.erl(Copy(), horizon=Truncated(), redistribute=Even()),
            "the first learner is paid by a redistribution",
        ),
    ],
)
def test_bad_horizons_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_a_lost_episode_leaves_no_rows_and_the_others_keep_theirs():
    """Three episodes outside JAX, of which the second was lost: rows of the first and third."""
    column = np.arange(5, dtype=np.float32)
    off = np.zeros(5, bool)
    rows = Transition(
        column[:, None], column[:, None], {"reward": column}, column[:, None], off, off
    )
    returns = np.array([[3.0], [np.nan], [7.0]], np.float32)
    played = Evaluation({"reward": returns}, np.array([[3], [4], [2]], np.int32))
    found = Experience(rows, None).first(rows.obs, played, 3)[..., 0]
    assert found.shape == (3, 3)
    np.testing.assert_array_equal(found[0], [0, 1, 2])
    np.testing.assert_array_equal(found[2, :2], [3, 4])
