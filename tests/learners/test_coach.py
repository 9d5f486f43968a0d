"""Members that are moved by the gradient of a learner's critic."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.algorithms.aid import coached, offspring
from credo.algorithms.erl import ERL
from credo.algorithms.lineage import COACHED, INJECTED
from credo.algorithms.merl import MERL
from credo.environments.probes import Copy, Meet
from credo.evolution.breeder import Breeder
from credo.evolution.islands import Islands
from credo.learners.coach import Coached
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.networks.team import Team

LEARNER = TD3(critic=Critic(hidden=(4,)), batch_size=8)
SMALL = {"population_size": 6, "elite_fraction": 0.2, "warmup_frames": 0, "sync_period": 1}
COACH = Coached(0.5, per_update=0.3, learning_rate=1e-2)


def rows(population):
    return np.asarray(tree.packed(population)[0][0])


@pytest.fixture(scope="module")
def played():
    """A hybrid and its state after a generation without a coach."""
    erl = ERL.erl(Copy(), MLP((4,)), learners=(LEARNER,), **SMALL)
    state, _ = jax.jit(erl.generation)(erl.init(key=jax.random.key(0)), key=jax.random.key(1))
    return replace(erl, coach=COACH), state


def value(erl, state, member):
    """Of what a member does, by the first critic, over the whole buffer."""
    n = int(state.replay.size)
    obs = state.replay.data.obs[:n]
    critic = state.learners[0].critics[0]
    return float(jnp.mean(critic(obs.T, jax.vmap(lambda x: member(x, None)[0])(obs).T)))


def test_some_offspring_climb_the_critic_and_nobody_else_moves(played):
    erl, state = played
    after, metrics = coached(erl, state, {"updates": jnp.int32(500)}, key=jax.random.key(2))
    assert metrics["coach_updates"] == 3 * 50  # 500·0.3 steps of three members together
    moved = np.any(rows(after.population) != rows(state.population), axis=1)
    assert moved.sum() == 3
    assert not moved[0]  # the elite
    assert not moved[-1]  # the learner's actor
    assert (np.asarray(after.lineage.maker) == COACHED).tolist() == moved.tolist()
    assert after.lineage.maker[-1] == INJECTED
    for i in np.flatnonzero(moved):
        members = (tree.take(s.population, i) for s in (state, after))
        before, now = (value(erl, state, member) for member in members)
        assert now > before


def test_nothing_happens_before_the_learner_has_learned(played):
    erl, state = played
    for updates in (jnp.int32(0), jnp.int32(5)):  # 5·0.3 is less than one step each
        after, metrics = coached(erl, state, {"updates": updates}, key=jax.random.key(2))
        assert metrics["coach_updates"] == 0
        np.testing.assert_array_equal(rows(after.population), rows(state.population))
    after, _ = jax.jit(lambda s, n: coached(erl, s, {"updates": n}, key=jax.random.key(2)))(
        state, jnp.int32(0)
    )
    np.testing.assert_array_equal(rows(after.population), rows(state.population))
    assert not np.any(after.lineage.maker == COACHED)


def test_a_generation_coaches_and_counts_it(played):
    erl, state = played
    after, metrics = jax.jit(erl.generation)(state, key=jax.random.key(1))
    steps = int(0.3 * int(metrics["updates"])) // 3
    assert metrics["coach_updates"] == 3 * steps > 0
    assert np.sum(after.lineage.maker == COACHED) == 3


@pytest.mark.slow
def test_teams_are_coached_too():
    learner = TD3(critic=Critic(hidden=(4,)), batch_size=8, signal="global")
    merl = MERL.merl(
        Meet(), Team(trunk=(4,)), learners=(learner,), coach=Coached(), population_size=6,
        episodes=1, workers=1, warmup_frames=0, updates_per_frame=1.0, test_episodes=1,
    )  # fmt: skip
    state, metrics = jax.jit(merl.generation)(
        merl.init(key=jax.random.key(0)), key=jax.random.key(1)
    )
    assert metrics["coach_updates"] > 0
    assert np.sum(state.lineage.maker == COACHED) == 3


def test_elites_stand_first_on_every_island():
    breeder = Breeder(elite_fraction=0.25, islands=Islands(2))
    assert offspring(breeder, 8).tolist() == [False, True, True, True] * 2
    assert offspring(replace(breeder, islands=None), 8).tolist() == [False] * 2 + [True] * 6


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Coached(1.5), "share is 1.5"),
        (lambda: Coached(per_update=-1.0), "per_update is -1.0"),
        (lambda: ERL.ea(Copy(), coach=Coached()), "there is no learner"),
        (lambda: ERL.erl(Copy(), coach=Coached(0.9)), r"at most 8; give a share of up to 0.8"),
    ],
)
def test_bad_coaches_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
