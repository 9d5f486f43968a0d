"""Offspring that a critic chooses."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.algorithms.aid import Preselecting, agreement, preselect
from credo.algorithms.erl import ERL
from credo.environments.probes import Copy
from credo.evolution.cem import CEM
from credo.evolution.descent import Descent
from credo.evolution.islands import Islands
from credo.learners.surrogate import AbstractSurrogate, Preselection
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic

LEARNER = TD3(critic=Critic(hidden=(4,)), batch_size=8)
SMALL = {"population_size": 4, "elite_fraction": 0.25, "warmup_frames": 0, "sync_period": 1}


def rows(population):
    return np.asarray(tree.packed(population)[0][0])


class Scripted(AbstractSurrogate):
    """Says of each member its only weight."""

    candidates: int = 3

    def __call__(self, learner, state, members, replay, **how):
        return members[:, 0]


class Lots(CEM):
    """Breeds members of one weight that the key decides, behind an elite."""

    def elites(self, population):
        return 1

    def next(self, memory, population, fitness, draw, *, key):
        drawn = jax.random.normal(key, (4, 1)).at[0].set(-9.0)
        descent = Descent.unchanged((drawn[:, 0] * 1e6).astype(jnp.int32), False, 1)
        return drawn, descent, memory


@pytest.mark.parametrize("ready", [True, False])
def test_each_slot_gets_the_best_of_its_candidates_with_its_descent(ready):
    key = jax.random.key(0)
    breeder = Preselecting(Lots(), Scripted(), (None, None, None, {}, None), jnp.bool_(ready))
    old = jnp.zeros((4, 1))
    chosen, descent, _ = breeder.next(None, old, jnp.zeros(4), None, key=key)
    each = [Lots().next(None, old, None, None, key=one)[0] for one in jax.random.split(key, 3)]
    expected = np.max(each, axis=0) if ready else np.array(each[0])
    expected[0] = -9.0  # the elite is nobody's choice
    np.testing.assert_array_equal(chosen, expected)
    assert descent.parent.tolist() == (expected[:, 0] * np.float32(1e6)).astype(int).tolist()


@pytest.fixture(scope="module")
def played():
    """A hybrid with a surrogate, and its state after a generation."""
    erl = ERL.erl(
        Copy(), MLP((4,)), learners=(LEARNER,), surrogate=Preselection(3, states=64), **SMALL
    )
    state, metrics = jax.jit(erl.generation)(erl.init(key=jax.random.key(0)), key=jax.random.key(1))
    assert -1.0 <= metrics["surrogate_agreement"] <= 1.0
    return erl, state


def test_values_are_the_critics_mean_over_states(played):
    erl, state = played
    how = {"signal": "reward", "moments": None, "sampling": erl.sampling}
    asked = Preselection(states=4096)
    given = (LEARNER, state.learners[0], state.population, state.replay)
    values = asked(*given, **how, key=jax.random.key(0))
    obs = state.replay.data.obs[: int(state.replay.size)]
    for i in range(4):
        member = tree.take(state.population, i)
        actions = jax.vmap(lambda x, member=member: member(x, None)[0])(obs)
        expected = float(jnp.mean(state.learners[0].critics[0](obs.T, actions.T)))
        assert float(values[i]) == pytest.approx(expected, abs=0.02)


def test_offspring_promise_more_than_those_of_one_breeding(played):
    erl, state = played
    how = {"signal": "reward", "moments": None, "sampling": erl.sampling}

    def promised(population):
        given = (LEARNER, state.learners[0], population, state.replay)
        return np.asarray(erl.surrogate(*given, **how, key=jax.random.key(9)))

    fitness, key = jnp.arange(4.0), jax.random.key(3)
    after, metrics = preselect(erl, state, fitness, key=key)
    wait = replace(state, learned=jnp.bool_(False))
    plain, _ = preselect(erl, wait, fitness, key=key)
    gain = promised(after.population) - promised(plain.population)
    assert gain[0] == 0.0
    assert np.sum(gain[1:]) > 0.0
    assert {"surrogate_agreement", "champion_maker"} <= set(metrics)


def test_agreement_is_that_of_ranks():
    a = jnp.asarray([1.0, 2.0, 30.0, 4.0])
    assert agreement(a, a**3) == pytest.approx(1.0)
    assert agreement(a, -a) == pytest.approx(-1.0)
    assert agreement(a, jnp.asarray([1.0, 3.0, 4.0, 2.0])) == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Preselection(1), "candidates is 1"),
        (lambda: Preselection(states=0), "states is 0"),
        (lambda: ERL.ea(Copy(), surrogate=Preselection()), "there is no learner"),
        (
            lambda: ERL.erl(
                Copy(), surrogate=Preselection(), islands=Islands(2), elite_fraction=0.2
            ),
            "leave islands out",
        ),
    ],
)
def test_bad_surrogates_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
