"""A shortened task is the whole one up to its n-th question; a delayed one pays at the end; a noisy
one is the same world, told with errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout, tree
from credo.environments.checks import check_environment
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Meet
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.server_fleet import ServerFleet
from credo.environments.wrappers import (
    DelayedHostReward,
    DelayedReward,
    NoisyObservations,
    Shortened,
    delayed,
)
from credo.networks.mmu import MMU

TASKS = {
    "classification": SequenceClassification(depth=4, min_gap=1, max_gap=3),
    "recall": SequenceRecall(depth=4, min_corridor=1, max_corridor=3),
}
KEYS = jax.random.split(jax.random.key(0), 16)
FLEET = ServerFleet(servers=3, devices=4, requests=2, nefarious=2, max_steps=5)


def sample(task):
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda key: task.sample(key=key)))(KEYS))


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("questions", [1, 2, 3, 4, 5, 100])
def test_it_asks_that_many_questions_and_ends_with_the_last(name, questions):
    whole, short = sample(TASKS[name]), sample(Shortened(TASKS[name], questions))
    np.testing.assert_array_equal(short.inputs, whole.inputs)
    np.testing.assert_array_equal(short.targets, whole.targets)
    for i in range(len(KEYS)):
        asked = np.flatnonzero(whole.scored[i])[:questions]
        assert np.flatnonzero(short.scored[i]).tolist() == asked.tolist()
        assert len(asked) == min(questions, 4)
        assert short.length[i] == (asked[-1] + 1 if questions <= 4 else whole.length[i])


def test_sizes_and_rewards_are_those_of_the_task():
    task = TASKS["recall"]
    short = Shortened(task, 2)
    assert (short.obs_size, short.max_steps) == (task.obs_size, task.max_steps)
    assert short.signals == task.signals
    arguments = (jnp.float32(0.5), jnp.float32(1.0), jnp.bool_(True), jnp.bool_(True))
    assert short.reward(*arguments) == task.reward(*arguments) == pytest.approx(0.75 / 4)


def test_the_number_of_questions_is_data():
    """A level traced in one program gives what each level gives alone."""
    task = TASKS["classification"]
    lengths = jax.jit(
        lambda n: jax.vmap(lambda key: Shortened(task, n).sample(key=key).length)(KEYS)
    )
    for n in (1, 3):
        np.testing.assert_array_equal(lengths(jnp.int32(n)), sample(Shortened(task, n)).length)
    assert lengths._cache_size() == 1


def test_what_is_cut_off_is_not_played():
    task = TASKS["classification"]
    population = tree.stack(MMU(hidden=3).init(1, 1, key=jax.random.key(1)))
    steps = rollout.evaluate(
        Shortened(task, jnp.int32(1)), population, 8, key=jax.random.key(2)
    ).steps
    assert np.asarray(steps).tolist() == [[1] * 8]  # the first signal is at step 0


def play(env, key, act):
    """Rewards by signal `[time, ...]` of one episode, and its last time step."""
    state, now = env.reset(key=key)
    step, rewards = jax.jit(lambda state, t: env.step(state, act(t), key=key)), []
    for t in range(env.max_steps):
        state, now = step(state, jnp.float32(t))
        rewards.append(now.rewards)
        if now.terminated | now.truncated:
            break
    return {name: np.array([r[name] for r in rewards]) for name in env.signals}, now


@pytest.mark.parametrize("name", TASKS)
def test_a_delayed_task_pays_its_return_at_the_last_step(name):
    task = TASKS[name]
    plain, _ = play(task, KEYS[0], lambda t: jnp.cos(t)[None])
    late, last = play(delayed(task), KEYS[0], lambda t: jnp.cos(t)[None])
    assert last.terminated
    assert any(np.count_nonzero(rewards) > 1 for rewards in plain.values())
    for signal, rewards in plain.items():
        assert len(late[signal]) == len(rewards)
        assert not late[signal][:-1].any()
        np.testing.assert_allclose(late[signal][-1], rewards.sum(), rtol=1e-6)


def test_a_delayed_team_keeps_private_rewards():
    task = Meet()
    shape = (task.agents, task.action_size)
    plain, _ = play(task, KEYS[1], lambda t: jnp.full(shape, 0.5))
    late, _ = play(delayed(task), KEYS[1], lambda t: jnp.full(shape, 0.5))
    for signal, rewards in plain.items():
        assert late[signal].shape == rewards.shape
        assert not late[signal][:-1].any()
        np.testing.assert_allclose(late[signal][-1], rewards.sum(axis=0), rtol=1e-6)


def test_a_delayed_task_keeps_the_contract():
    task = delayed(TASKS["recall"])
    assert isinstance(task, DelayedReward)
    assert (task.signals, task.max_steps) == (task.env.signals, task.env.max_steps)
    assert check_environment(task) == []
    host = delayed(Gymnasium("Pendulum-v1", in_process=True))
    assert isinstance(host, DelayedHostReward)
    assert (host.obs_size, host.action_size, host.max_steps) == (3, 1, 200)
    assert check_environment(host) == []


def test_a_delayed_host_task_pays_its_return_at_the_last_step():
    env = delayed(Gymnasium("broken:Tiny", max_episode_steps=9, in_process=True))
    copies = env.copies(3)
    assert env.copies(3) is copies
    action, seeds = np.zeros((3, 1), np.float32), np.zeros(3, np.uint32)
    everyone, first = np.ones(3, bool), np.arange(3) == 0
    copies.reset(seeds, everyone)
    for _ in range(2):
        assert copies.step(action, first).rewards["reward"].tolist() == [0.0] * 3
    paid = [copies.step(action, everyone).rewards["reward"].tolist() for _ in range(4)]
    assert paid == [[0.0] * 3] * 3 + [[6 * 1.5, 0.0, 0.0]]  # six steps of 1.5
    paid = [copies.step(action, ~first).rewards["reward"].tolist() for _ in range(2)]
    assert paid == [[0.0] * 3, [0.0, 9.0, 9.0]]
    copies.reset(seeds, first)  # nothing of the episode before is paid again
    paid = [copies.step(action, first).rewards["reward"][0] for _ in range(6)]
    assert paid == [0.0] * 5 + [9.0]


def test_the_wrong_kind_of_task_is_refused():
    with pytest.raises(ValueError, match=r"Gymnasium is no JAX task: use delayed\(env\)"):
        DelayedReward(Gymnasium("Pendulum-v1"))
    with pytest.raises(ValueError, match=r"Meet is no host task: use delayed\(env\)"):
        DelayedHostReward(Meet())


@pytest.fixture(scope="module")
def told():
    """500 episodes of a fleet, and the same told with noise: time steps `[episodes, steps, ...]`,
    and of the noisy ones also the states."""

    def episode(key, std):
        env = NoisyObservations(FLEET, std, spared=1)
        reset_key, step_key = jax.random.split(key)

        def advance(states, t):
            key = jax.random.fold_in(step_key, t)
            action = jax.random.uniform(jax.random.fold_in(key, 7), (3, 4))
            state, now = FLEET.step(states[0], action, key=jax.random.split(key)[0])
            noisy_state, noisy = env.step(states[1], action, key=key)
            return (state, noisy_state), (now, noisy, state, noisy_state)

        start, first = FLEET.reset(key=jax.random.split(reset_key)[0])
        noisy_start, noisy_first = env.reset(key=reset_key)
        _, steps = jax.lax.scan(advance, (start, noisy_start), jnp.arange(FLEET.max_steps))
        begun = (first, noisy_first, start, noisy_start)
        return jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), begun, steps)

    play = jax.jit(jax.vmap(episode, (0, None)))
    keys = jax.random.split(jax.random.key(3), 500)
    found = {std: jax.tree.map(np.asarray, play(keys, std)) for std in (0.0, 0.5)}
    assert play._cache_size() == 1  # how much noise there is is data
    return found


def test_a_noisy_world_is_the_same_one(told):
    for std in (0.0, 0.5):
        now, noisy, state, noisy_state = told[std]
        for x, y in zip(jax.tree.leaves(state), jax.tree.leaves(noisy_state), strict=True):
            np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(noisy.rewards["net"], now.rewards["net"])
        np.testing.assert_array_equal(noisy.active, now.active)
        np.testing.assert_array_equal(noisy.truncated, now.truncated)
    assert np.any(now.rewards["net"] != 0)
    now, noisy, _, _ = told[0.0]
    np.testing.assert_array_equal(noisy.obs, now.obs)


def test_noise_is_normal_and_of_every_entry_its_own_but_spares_the_status(told):
    now, noisy, _, _ = told[0.5]
    np.testing.assert_array_equal(noisy.obs[..., -1], now.obs[..., -1])
    noise = (noisy.obs - now.obs)[..., :-1]  # [episodes, steps, servers, entries]
    count = noise.size
    assert abs(noise.mean()) < 4 * 0.5 / count**0.5
    assert noise.std() == pytest.approx(0.5, abs=4 * 0.5 / (2 * count) ** 0.5)
    assert np.mean(np.abs(noise) > 2 * 0.5) == pytest.approx(0.0455, abs=0.003)
    # By step, server and entry, of all episodes: no two go together.
    rows = np.corrcoef(noise.reshape(len(noise), -1).T)
    assert np.abs(rows - np.eye(len(rows))).max() < 5.5 / len(noise) ** 0.5


def test_a_noisy_task_keeps_the_contract():
    env = NoisyObservations(FLEET, 0.5, spared=1)
    assert check_environment(env) == []
    assert env.sizes == FLEET.sizes == (9, 4, 3)
    assert (env.signals, env.max_steps, env.reported) == (("net",), 5, "net")
    assert env.obs_range == (-np.inf, np.inf)
    assert check_environment(delayed(env)) == []
    alone = NoisyObservations(TASKS["recall"], 0.1)
    assert check_environment(alone) == []
    policy = MMU(hidden=3).init(alone.obs_size, 1, key=jax.random.key(1))
    returns = rollout.evaluate(alone, tree.stack(policy), 8, key=jax.random.key(2)).returns
    assert {x.shape for x in returns.values()} == {(1, 8)}


def test_noise_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"std is -0\.1: it must be at least 0"):
        NoisyObservations(FLEET, -0.1)
    with pytest.raises(ValueError, match=r"std is nan"):
        NoisyObservations(FLEET, float("nan"))
    for spared in (-1, 9):  # of nine entries
        with pytest.raises(ValueError, match=rf"spared is {spared}: it must lie in \[0, 8\]"):
            NoisyObservations(FLEET, 0.5, spared=spared)
    with pytest.raises(ValueError, match="Gymnasium is no JAX task: noise is added to those"):
        NoisyObservations(Gymnasium("Pendulum-v1"), 0.5)
