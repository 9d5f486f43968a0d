"""Resource managers: ledgers and chances computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.learners.manager import UCB, Ledger, Progress, Thompson, Uniform, even


def ledger_of(value, count, square=None):
    square = np.square(value) if square is None else square
    return Ledger(
        jnp.asarray(value, jnp.float32),
        jnp.asarray(square, jnp.float32),
        jnp.asarray(count, jnp.int32),
        jnp.asarray(count) > 0,
    )


def observe(manager, ledger, i, returns, played=None):
    returns = jnp.asarray(returns, jnp.float32)
    played = jnp.ones(returns.shape, bool) if played is None else jnp.asarray(played)
    return manager.observe(ledger, i, returns, played)


def test_the_first_return_is_the_value_and_others_weigh_a_fifth():
    ledger = observe(UCB(), Ledger.empty(2), 1, [10.0])
    assert ledger.value.tolist() == [0.0, 10.0]
    assert ledger.count.tolist() == [0, 1]
    ledger = observe(UCB(), ledger, 1, [20.0, 0.0])
    # 0.2·20 + 0.8·10 = 12, then 0.8·12 = 9.6; squares 100, 160, 128.
    np.testing.assert_allclose(ledger.value, [0.0, 9.6], rtol=1e-6)
    np.testing.assert_allclose(ledger.square, [0.0, 128.0], rtol=1e-6)
    assert ledger.count.tolist() == [0, 3]
    half = observe(UCB(memory=0.5), ledger, 1, [0.0])
    np.testing.assert_allclose(half.value, [0.0, 4.8], rtol=1e-6)


def test_episodes_that_were_not_played_do_not_count():
    ledger = observe(UCB(), Ledger.empty(1), 0, [7.0, 3.0, 5.0], [False, True, False])
    assert (ledger.value.tolist(), ledger.count.tolist()) == ([3.0], [1])
    ledger = observe(UCB(), ledger, 0, [jnp.nan, 1.0], [False, False])
    assert (ledger.value.tolist(), ledger.count.tolist()) == ([3.0], [1])


def test_bounds_are_those_of_equation_6_1():
    bounds = UCB().bounds(ledger_of([1.0, 3.0, 2.0], [2, 5, 3]))
    values = np.array([0.0, 2.0, 1.0]) / 3.1
    curiosity = 0.9 * np.sqrt(np.log(10) / np.array([2, 5, 3]))
    np.testing.assert_allclose(bounds, values + curiosity, rtol=1e-4)
    greedy = UCB(exploration=0.0).bounds(ledger_of([1.0, 3.0, 2.0], [2, 5, 3]))
    np.testing.assert_allclose(greedy, values, atol=1e-5)


def test_bounds_are_a_distribution_before_anything_is_known():
    for ledger in (Ledger.empty(3), ledger_of([5.0, 5.0], [1, 0])):
        for c in (0.0, 0.9):
            bounds = np.asarray(UCB(exploration=c).bounds(ledger))
            assert (bounds > 0).all()
            assert np.isfinite(bounds).all()
            np.testing.assert_allclose(bounds / bounds.sum(), 1 / len(bounds), rtol=1e-5)


def shares(manager, ledger, workers=10, draws=2000):
    """How often each learner gets a worker."""
    allocate = jax.jit(lambda key: manager.allocate(ledger, workers, key=key))
    drawn = np.asarray(jax.vmap(allocate)(jax.random.split(jax.random.key(0), draws)))
    assert drawn.shape == (draws, workers)
    counts = np.bincount(drawn.ravel(), minlength=ledger.value.shape[0])
    return counts / drawn.size


def test_workers_are_drawn_in_proportion_to_the_bounds():
    ledger = ledger_of([1.0, 3.0, 2.0], [2, 5, 3])
    bounds = np.asarray(UCB().bounds(ledger))
    np.testing.assert_allclose(shares(UCB(), ledger), bounds / bounds.sum(), atol=0.012)
    # Each worker by itself: some generation has two of them at different learners.
    drawn = UCB().allocate(ledger, 10, key=jax.random.key(1))
    assert len(np.unique(drawn)) > 1


def test_the_uniform_manager_does_not_look():
    assert shares(Uniform(), ledger_of([1.0, 9.0], [2, 5])) == pytest.approx([0.5, 0.5], abs=0.015)


def test_thompson_prefers_the_better_the_surer_it_is():
    """Two means one apart: the chance is Φ(1 / √(spread² + spread²))."""
    for variance, count, chance in ((1.0, 1, 0.76), (1.0, 9, 0.983), (0.0, 9, 1.0)):
        ledger = ledger_of([0.0, 1.0], [count] * 2, [variance, 1.0 + variance])
        assert shares(Thompson(), ledger)[1] == pytest.approx(chance, abs=0.015)
    # A running mean never rests on more than (2 - α)/α = 9 returns.
    assert shares(Thompson(), ledger_of([0.0, 1.0], [900] * 2, [9.0, 10.0]))[1] == pytest.approx(
        0.760, abs=0.015
    )


def test_at_first_workers_go_in_turn():
    assert even(10, 4).tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 0, 1]
    assert even(2, 1).tolist() == [0, 0]


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="exploration is -1"):
        UCB(exploration=-1.0)
    with pytest.raises(ValueError, match="memory is 2"):
        UCB(memory=2.0)
    for manager in (UCB, Uniform, Thompson, Progress):
        with pytest.raises(ValueError, match=r"memory is 0.0: it must lie in \(0, 1\]"):
            manager(memory=0.0)


@pytest.mark.parametrize("manager", [UCB(), Thompson()])
def test_a_return_that_is_no_number_costs_a_turn_and_nothing_else(manager):
    ledger = observe(manager, Ledger.empty(2), 0, [3.0])
    ledger = observe(manager, ledger, 1, [5.0, np.nan, np.inf])
    assert ledger.value.tolist() == [3.0, 5.0]
    assert ledger.count.tolist() == [1, 3]
    never = observe(manager, observe(manager, Ledger.empty(2), 0, [3.0]), 1, [np.nan])
    assert never.comparable.tolist() == [3.0, 3.0]
    workers = manager.allocate(never, 200, key=jax.random.key(0))
    assert 40 < int(jnp.sum(workers)) < 160


def test_thompson_tries_a_learner_of_which_nothing_is_known():
    ledger = observe(Thompson(), Ledger.empty(2), 0, [1000.0, 1001.0])
    assert Thompson().allocate(ledger, 5, key=jax.random.key(0)).tolist() == [1] * 5


def test_progress_is_the_lead_of_the_fast_mean_over_the_slow_one():
    """By hand: two returns 0, 10 of the first learner, 10, 8 of the second, 5 of the third."""
    manager = Progress(slow=0.1, memory=0.5)
    ledger = Ledger.empty(3)
    for i, returns in enumerate(([0.0, 10.0], [10.0, 8.0], [5.0])):
        ledger = observe(manager, ledger, i, returns)
    np.testing.assert_allclose(ledger.value, [5.0, 9.0, 5.0], rtol=1e-6)
    np.testing.assert_allclose(ledger.before, [1.0, 9.8, 5.0], rtol=1e-6)
    # A fifth of all chances is even; the rest is in proportion to rises 4, 0, 0.
    np.testing.assert_allclose(manager.chances(ledger), [0.2 / 3 + 0.8] + [0.2 / 3] * 2, atol=1e-6)
    changes = Progress(kind="change", slow=0.1, memory=0.5).chances(ledger)
    expected = 0.2 / 3 + 0.8 * np.array([4.0, 0.8, 0.0]) / 4.8
    np.testing.assert_allclose(changes, expected, atol=1e-6)
    workers = manager.allocate(ledger, 4000, key=jax.random.key(0))
    assert np.mean(np.asarray(workers) == 0) == pytest.approx(0.867, abs=0.02)


def test_progress_is_even_at_first_and_ignores_what_is_no_number():
    manager = Progress()
    np.testing.assert_allclose(manager.chances(Ledger.empty(4)), [0.25] * 4)
    ledger = observe(manager, Ledger.empty(2), 0, [3.0, np.nan, 7.0])
    np.testing.assert_allclose(ledger.before, [3.2, 0.0], rtol=1e-6)
    # Of the second learner nothing is known: it counts as the one with the most progress.
    np.testing.assert_allclose(manager.chances(ledger), [0.5, 0.5])
    with pytest.raises(ValueError, match=r"slow is 0.3: it must lie above 0 and below memory"):
        Progress(slow=0.3)
    with pytest.raises(ValueError, match="kind is 'fall'"):
        Progress(kind="fall")
