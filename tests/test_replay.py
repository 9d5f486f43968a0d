"""Replay: a ring of rows that belong together."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

from credo import replay, tree
from credo.replay import Replay, Sampling
from credo.types import Transition

CAPACITY = 5
ROW = Transition(
    jnp.zeros(2),
    jnp.zeros(1),
    {"a": jnp.float32(0.0), "b": jnp.float32(0.0)},
    jnp.zeros(2),
    jnp.bool_(False),
    jnp.bool_(False),
)


def rows(numbers):
    """Rows that say their number in every field."""
    i = np.asarray(numbers, np.float32)
    obs = np.stack([i, -i], axis=1)
    return Transition(obs, 10 * i[:, None], {"a": i, "b": 2 * i}, obs + 0.5, i % 3 == 0, i % 5 == 0)


def numbers(transitions):
    """The numbers of rows, whose fields must agree."""
    found = np.asarray(transitions.obs)[:, 0]
    jax.tree.map(np.testing.assert_array_equal, transitions, rows(found))
    return found.tolist()


def held(ring):
    """What is stored, slot by slot; the rest is as it was at first."""
    size = int(ring.size)
    for leaf in jax.tree.leaves(ring.data):
        assert not np.asarray(leaf[size:]).any()
    return numbers(jax.tree.map(lambda x: x[:size], ring.data))


class Ring:
    """The same in plain Python."""

    def __init__(self, capacity):
        self.slots, self.written, self.capacity = {}, 0, capacity

    def extend(self, numbers):
        for number in numbers:
            self.slots[self.written % self.capacity] = number
            self.written += 1

    def held(self):
        return [self.slots[i] for i in range(len(self.slots))]


def test_a_fresh_one_is_empty():
    ring = Replay.empty(ROW, CAPACITY)
    assert (ring.capacity, int(ring.position), int(ring.size)) == (CAPACITY, 0, 0)
    assert ring.data.obs.shape == (CAPACITY, 2)
    assert ring.data.rewards["b"].shape == (CAPACITY,)
    assert ring.data.terminated.dtype == jnp.bool_


def test_valid_rows_follow_in_order_and_the_oldest_is_overwritten():
    ring, by_hand = Replay.empty(ROW, CAPACITY), Ring(CAPACITY)
    masks = [[1, 0, 1, 1], [0, 0, 0, 0], [0, 1, 0, 0], [1, 1, 1, 1], [0, 1, 1, 0], [1, 0, 0, 1]]
    for turn, mask in enumerate(np.array(masks, bool)):
        new = 4 * turn + np.arange(1, 5)
        ring = replay.extend(ring, jax.tree.map(jnp.asarray, rows(new)), jnp.asarray(mask))
        by_hand.extend(new[mask].tolist())
        assert held(ring) == by_hand.held()
        assert int(ring.position) == by_hand.written % CAPACITY
        assert int(ring.size) == min(by_hand.written, CAPACITY)
    assert by_hand.written == 12  # it went round twice


@pytest.mark.parametrize("before", [0, 3])
def test_of_more_rows_than_capacity_the_last_ones_stay(before):
    ring, by_hand = Replay.empty(ROW, CAPACITY), Ring(CAPACITY)
    first, new = np.arange(1, 4), np.arange(10, 22)
    valid = new % 4 > 0  # 9 of 12
    for some, mask in ((first, np.arange(3) < before), (new, valid)):
        ring = replay.extend(ring, rows(some), jnp.asarray(mask))
        by_hand.extend(some[mask].tolist())
    assert held(ring) == by_hand.held()
    assert set(held(ring)) == {15, 17, 18, 19, 21}
    assert int(ring.written) == before + 9


@pytest.mark.parametrize("sizes", [(1,), (4,), (3, 5), (11,), (0, 2), (9, 9)])
def test_rows_from_the_host_come_in_blocks(monkeypatch, sizes):
    monkeypatch.setattr(replay, "BLOCK", 4)
    ring, by_hand, last = Replay.empty(ROW, 7), Ring(7), 0
    for size in sizes:
        new = np.arange(last + 1, last + size + 1)
        ring, last = replay.extend(ring, rows(new)), last + size
        by_hand.extend(new.tolist())
    assert held(ring) == by_hand.held()
    assert int(ring.written) == sum(sizes)


def test_the_number_of_rows_is_data_and_the_old_buffer_is_gone():
    ring = replay.extend(Replay.empty(ROW, 3000), rows(np.arange(1, 6)))
    on_device, valid = jax.tree.map(jnp.asarray, rows(np.arange(1, 9))), np.arange(8)
    ring = replay.extend(ring, on_device, jnp.asarray(valid < 8))
    masks = [jnp.asarray(valid < n) for n in (1, 5)]
    with compilations() as events:
        jax.jit(lambda x: x + 3.25)(np.float32(1.0))
    assert events  # the count sees a compilation
    old = ring
    with compilations() as events:
        for n in (1, 700, 1024, 1025, 2500):
            ring = replay.extend(ring, rows(np.ones(n)))
        for mask in masks:
            ring = replay.extend(ring, on_device, mask)
        jax.block_until_ready(ring)
    assert events == []
    assert int(ring.written) == 5 + 8 + 1 + 700 + 1024 + 1025 + 2500 + 1 + 5
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(old))


@pytest.mark.parametrize("written", [3, 12])
def test_samples_are_uniform_over_the_filled_rows(written):
    ring = replay.extend(Replay.empty(ROW, CAPACITY), rows(np.arange(1, written + 1)))
    n = 6000
    drawn = numbers(jax.jit(lambda key: ring.sample(n, key=key)[0])(jax.random.key(0)))
    filled = held(ring)
    assert len(filled) == min(written, CAPACITY)
    found, counts = np.unique(drawn, return_counts=True)
    assert found.tolist() == sorted(filled)
    expected = n / len(filled)
    # The 0.999 quantile of chi-squared with at most 4 degrees of freedom.
    assert np.sum((counts - expected) ** 2 / expected) < 18.5
    again = numbers(ring.sample(20, key=jax.random.key(1))[0])
    assert again != drawn[:20]
    assert len(set(again)) < 20  # with replacement


def test_too_little_memory_is_told_with_both_numbers(monkeypatch):
    assert replay.row_bytes(ROW) == 8 + 4 + 4 + 4 + 8 + 1 + 1 + 8  # the largest twice
    monkeypatch.setattr(replay, "_free", lambda: 3_000_000_000)
    said = r"200,000,000.*7,600,000,000 bytes.*3,000,000,000 more.*at most 78,947,368"
    with pytest.raises(ValueError, match=said):
        Replay.empty(ROW, 200_000_000)
    monkeypatch.setattr(replay, "SMALL", 0)
    monkeypatch.setattr(replay, "_free", lambda: 38 * CAPACITY)
    assert Replay.empty(ROW, CAPACITY).capacity == CAPACITY
    with pytest.raises(ValueError, match="at most 5"):
        Replay.empty(ROW, CAPACITY + 1)
    with pytest.raises(ValueError, match="capacity is 0"):
        Replay.empty(ROW, 0)


def test_shapes_alone_need_no_memory(monkeypatch):
    """A policy can be read where its run's buffer would not fit."""
    monkeypatch.setattr(replay, "SMALL", 0)
    monkeypatch.setattr(replay, "_free", lambda: 1)
    with replay.shapes_alone():
        shapes = eqx.filter_eval_shape(lambda: Replay.empty(ROW, 1000))
    assert shapes.data.obs.shape[0] == 1000
    with pytest.raises(ValueError, match="give a smaller capacity"):
        jax.jit(lambda: Replay.empty(ROW, 1000))()  # as a run starts


def test_this_machine_says_its_memory():
    with pytest.raises(ValueError, match="give a smaller capacity"):
        Replay.empty(ROW, 10**15)


# Teams: one row is a joint frame.

AGENTS = 3
TEAM_ROW = Transition(
    jnp.zeros((AGENTS, 2)),
    jnp.zeros((AGENTS, 1)),
    {"global": jnp.float32(0.0), "local": jnp.zeros(AGENTS)},
    jnp.zeros((AGENTS, 2)),
    jnp.bool_(False),
    jnp.bool_(False),
    jnp.zeros(AGENTS, bool),
)


def frames(numbers):
    """Joint frames that say their number in every field, and in private ones the agent."""
    i = np.asarray(numbers, np.float32)
    own = i[:, None] + np.arange(AGENTS, dtype=np.float32) / 4
    obs = np.stack([own, -own], axis=2)
    rewards = {"global": 2 * i, "local": 3 * own}
    acts = (i[:, None] + np.arange(AGENTS)) % 2 == 0
    return Transition(obs, 10 * own[:, :, None], rewards, obs + 0.5, i % 3 == 0, i % 5 == 0, acts)


def assert_frames(sample):
    """That every entry is the agent's own part of one frame: the frames' numbers, `[n, agents]`."""
    found = np.floor(np.asarray(sample.obs)[:, :, 0])
    n = len(found)
    expected = frames(found.ravel())
    for agent in range(AGENTS):
        part = np.arange(n) * AGENTS + agent  # this agent's frames
        jax.tree.map(
            lambda x, y, agent=agent, part=part: np.testing.assert_array_equal(
                x[:, agent], y[part] if y.ndim == 1 else y[part, agent]
            ),
            sample,
            expected,
        )
    return found.astype(int)


@pytest.mark.parametrize("together", [True, False])
def test_a_teams_sample_has_an_axis_of_agents_everywhere(together):
    ring = replay.extend(Replay.empty(TEAM_ROW, 8), frames(np.arange(1, 7)))
    sample = ring.sample(40, together=together, key=jax.random.key(0))[0]
    shapes = jax.tree.map(jnp.shape, sample)
    assert shapes.obs == shapes.next_obs == (40, AGENTS, 2)
    assert shapes.action == (40, AGENTS, 1)
    assert shapes.rewards == {"global": (40, AGENTS), "local": (40, AGENTS)}
    assert shapes.terminated == shapes.truncated == shapes.active == (40, AGENTS)
    found = assert_frames(sample)
    assert set(found.ravel().tolist()) == set(range(1, 7))
    assert (found == found[:, :1]).all() == together


def test_each_agent_draws_frames_of_its_own():
    """Uniformly, and independently of the others."""
    ring = replay.extend(Replay.empty(TEAM_ROW, CAPACITY), frames(np.arange(1, CAPACITY + 1)))
    n = 5000
    apart, joint = (
        assert_frames(ring.sample(n, together=together, key=jax.random.key(2))[0]) - 1
        for together in (False, True)
    )
    pairs = [np.bincount(CAPACITY * x[:, 0] + x[:, 2], minlength=25) for x in (apart, joint)]
    expected = n / CAPACITY**2
    # The 0.999 quantile of chi-squared with 24 degrees of freedom.
    assert np.sum((pairs[0] - expected) ** 2 / expected) < 51.2
    assert np.sum((pairs[1] - expected) ** 2 / expected) > 10 * n / CAPACITY
    counts = np.bincount(joint[:, 0], minlength=CAPACITY)
    assert np.sum((counts - n / CAPACITY) ** 2 / (n / CAPACITY)) < 18.5


def test_a_ring_of_joint_frames_goes_round():
    ring, by_hand = Replay.empty(TEAM_ROW, CAPACITY), Ring(CAPACITY)
    for turn, mask in enumerate(np.array([[1, 0, 1], [1, 1, 1], [0, 1, 1], [0, 0, 1]], bool)):
        new = 3 * turn + np.arange(1, 4)
        ring = replay.extend(ring, jax.tree.map(jnp.asarray, frames(new)), jnp.asarray(mask))
        by_hand.extend(new[mask].tolist())
        kept = by_hand.held()
        filled = tree.take(ring.data, jnp.arange(len(kept)))
        jax.tree.map(np.testing.assert_array_equal, filled, frames(kept))
    assert (by_hand.written, int(ring.position), int(ring.size)) == (8, 3, CAPACITY)
    found = assert_frames(ring.sample(60, key=jax.random.key(0))[0])
    assert set(found.ravel().tolist()) == set(by_hand.held())


def test_a_team_of_one_draws_as_one_agent_does():
    own = frames(np.arange(1, 6))
    one = jax.tree.map(lambda x: x if x.ndim == 1 else x[:, :1], own)
    alone = jax.tree.map(lambda x: x if x.ndim == 1 else x[:, 0], own)
    samples = []
    for data in (one, alone):
        row = jax.tree.map(lambda x: jnp.asarray(x[0]), data)
        samples.append(
            replay.extend(Replay.empty(row, 5), data).sample(9, key=jax.random.key(1))[0]
        )
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[:, 0], y), *samples)


def returns_by_hand(written, start, steps, gamma):
    """What an n-step transition from the frame with the number `start` has: the discounted sum, the
    number of its last frame, and the discount behind it. Frames up to `written` were written."""
    total, discount, last = 0.0, 1.0, start
    for step in range(steps):
        last = start + step
        total, discount = total + discount * last, gamma * discount
        if last % 3 == 0 or last % 5 == 0 or last == written:  # an end, or the newest frame
            break
    return total, last, discount


@pytest.mark.parametrize("written", [4, 11, 23])
@pytest.mark.parametrize("steps", [2, 3, 6])
def test_transitions_of_several_steps_end_with_episodes_and_with_the_buffer(written, steps):
    """Also where the ring has been overwritten."""
    ring = replay.extend(Replay.empty(ROW, 9), rows(np.arange(1, written + 1)))
    drawn = ring.sample(200, Sampling(steps), 0.5, key=jax.random.key(0))
    sample, discount = jax.tree.map(np.asarray, drawn)
    seen = set()
    for i, start in enumerate(sample.obs[:, 0].astype(int)):
        total, last, behind = returns_by_hand(written, start, steps, 0.5)
        assert sample.rewards["a"][i] == pytest.approx(total)
        assert sample.rewards["b"][i] == pytest.approx(2 * total)
        assert sample.next_obs[i, 0] == last + 0.5
        assert (sample.terminated[i], sample.truncated[i]) == (last % 3 == 0, last % 5 == 0)
        assert discount[i] == pytest.approx(behind)
        assert sample.action[i, 0] == 10 * start
        seen.add(start)
    assert seen == set(range(max(1, written - 8), written + 1))


def test_a_transition_is_drawn_half_as_often_at_its_half_life():
    ring = replay.extend(Replay.empty(ROW, 60), rows(np.arange(1, 101)))
    drawn, _ = ring.sample(40_000, Sampling(half_life=10.0), key=jax.random.key(0))
    age = 100 - np.asarray(drawn.obs)[:, 0].astype(int)
    counts = np.bincount(age, minlength=60)
    expected = 0.5 ** (np.arange(60) / 10)
    expected *= len(age) / expected.sum()
    # The 0.999 quantile of chi-squared with 59 degrees of freedom.
    assert len(counts) == 60
    assert np.sum((counts - expected) ** 2 / expected) < 98.3


def test_the_spread_of_a_reward_counts_what_was_written():
    ring = replay.extend(Replay.empty(ROW, 60), rows(np.arange(1, 5)))
    assert ring.spread("b") == pytest.approx(2 * np.sqrt((1 + 4 + 9 + 16) / 4))


@pytest.mark.parametrize(
    ("given", "said"),
    [({"steps": 0}, "steps is 0"), ({"half_life": 0.0}, "half_life is 0.0: it must be above 0")],
)
def test_bad_sampling_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        Sampling(**given)


def episodes_in(ring):
    """What each slot holds: the number of its episode, and how many steps that had before it."""
    return np.asarray(ring.data.obs)[: int(ring.size)].astype(int)


def told(lengths, memory=True, team=()):
    """Episodes of these lengths, one behind the other: `obs` says number and step of each row."""
    where = np.array([(i, t) for i, n in enumerate(lengths) for t in range(n)], np.float32)
    n, last = len(where), np.cumsum(lengths) - 1
    over = np.isin(np.arange(n), last)
    obs = np.broadcast_to(where.reshape(n, *(1,) * len(team), 2), (n, *team, 2))
    ended = np.broadcast_to(
        (over & (where[:, 0] % 2 == 0)).reshape(n, *(1,) * len(team)), (n, *team)
    )
    return Transition(
        obs,
        obs[..., :1],
        {"a": where[:, 1]},
        obs + 1,
        ended,
        over & (where[:, 0] % 2 == 1),
        memory=100 + obs if memory else None,
    )


def filled(capacity, *rounds, team=()):
    one = jax.tree.map(lambda x: jnp.zeros_like(x[0]), told([1], team=team))
    ring = Replay.empty(one, capacity)
    for rows in rounds:
        ring = ring.extend(rows, np.ones(len(rows.terminated), bool))
    return ring


@pytest.mark.parametrize("lengths", [[9], [3, 2, 4], [1, 1, 7], [4, 6, 3, 5], [30]])
@pytest.mark.parametrize("burn_in", [0, 2])
def test_windows_stay_in_their_episode(lengths, burn_in):
    """In a ring of 12: more than that were written in the last two cases."""
    ring, n, sampling = filled(12, told(lengths)), 500, Sampling(window=4, burn_in=burn_in)
    draw = jax.jit(lambda key: ring.windows(4 * n, sampling, key=key))
    rows, _, windows = draw(jax.random.key(0))
    counts = rows.active
    length = 4 + burn_in
    assert rows.memory is None
    assert (windows.length, windows.burn_in) == (length, burn_in)
    obs, counts = (np.asarray(x).reshape(n, length, -1) for x in (rows.obs, counts))
    held, seen = {tuple(x) for x in episodes_in(ring)}, set()
    for i in range(n):
        episode, first = obs[i, 0].astype(int)
        assert (episode, first) in held
        assert bool(windows.fresh[i]) == (first == 0)
        np.testing.assert_array_equal(windows.memory[i], 100 + obs[i, 0])
        for t in range(length):
            inside = (episode, first + t) in held
            assert bool(counts[i, t, 0]) == (inside and (first == 0 or t >= burn_in))
            expected = (episode, first + t) if inside else (0, 0)
            assert tuple(obs[i, t].astype(int)) == expected
            if counts[i, t, 0]:
                seen.add((episode, first + t))
        assert counts[i].any() or (first > 0 and burn_in)
        # A window has padding only if it holds all that there is of its episode.
        assert counts[i, -1] or (episode, first - 1) not in held
    # All that can be told from a burn-in counts somewhere.
    late = {(e, t) for e, t in held if (e, 0) in held or (e, t - burn_in) in held}
    assert seen == late


def test_windows_of_a_team_are_each_agents_own_or_of_one_moment():
    ring = filled(40, told([7, 9, 5], team=(2,)), team=(2,))
    sampling = Sampling(window=4, burn_in=1)
    for together in (False, True):
        rows, _, windows = ring.windows(256, sampling, together=together, key=jax.random.key(0))
        counts = rows.active
        assert rows.obs.shape == (64 * 5, 2, 2)
        assert counts.shape == (64 * 5, 2)
        assert windows.fresh.shape == (64, 2)
        assert windows.memory.shape == (64, 2, 2)
        first = np.asarray(rows.obs).reshape(64, 5, 2, 2)[:, 0]
        np.testing.assert_array_equal(windows.memory, 100 + first)
        np.testing.assert_array_equal(windows.fresh, first[..., 1] == 0)
        assert (first[:, 0] == first[:, 1]).all() == together


def test_what_stands_behind_an_end_is_not_told():
    rows = told([3, 4])
    second = np.where(rows.obs[:, :1] == 1, np.nan, rows.obs)
    broken = eqx.tree_at(lambda r: r.obs, rows, second)
    found, *_ = filled(20, broken).windows(150, Sampling(window=3), key=jax.random.key(0))
    first = np.asarray(found.action).reshape(50, -1)[:, 0] == 0
    assert np.isfinite(np.asarray(found.obs).reshape(50, -1)[first]).all()


def test_windows_need_room():
    for fields, told_ in (({"window": 0}, "window is 0"), ({"burn_in": -1}, "burn_in is -1")):
        with pytest.raises(ValueError, match=told_):
            Sampling(**fields)
