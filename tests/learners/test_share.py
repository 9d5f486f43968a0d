"""Who gets the frames."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.algorithms.erl import ERL
from credo.algorithms.hybrid import balance
from credo.algorithms.lineage import COACHED, DRAWN, INJECTED, MAKERS
from credo.environments.probes import Copy
from credo.learners.share import Earned, Fixed
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.runs.loop import resume, train

LEARNER = TD3(critic=Critic(hidden=(4,)), batch_size=4)
SMALL = {"population_size": 4, "elite_fraction": 0.25, "warmup_frames": 0, "sync_period": 1}


def test_what_learners_earn_halves_with_each_better_member_that_evolution_made():
    share = Earned(0.2, 0.8, memory=0.5)
    fitness = jnp.asarray([3.0, 1.0, 2.0, 0.0])
    guests = jnp.asarray([False, False, True, True])
    bred = ~guests
    # One is better than the best of two: the aim is 0.2 + 0.6/2, and half of the way is gone.
    assert share.after(jnp.float32(0.4), fitness, guests, bred) == pytest.approx(0.45)
    # The best of all, also in a draw; then two are better: the aim is 0.2 + 0.6/4.
    level, two = fitness.at[0].set(2.0), fitness.at[1].set(2.5)
    assert share.after(jnp.float32(0.4), level, guests, bred) == pytest.approx(0.6)
    assert share.after(jnp.float32(0.4), two, guests, bred) == pytest.approx(0.375)
    # An actor that joined earlier and was changed by nobody is the learners' own work.
    none = jnp.zeros(4, bool)
    assert share.after(jnp.float32(0.4), two, guests, none) == pytest.approx(0.6)
    assert share.after(jnp.float32(0.4), fitness, none, bred) == pytest.approx(0.4)
    assert share.first() == pytest.approx(0.5)
    assert Fixed(0.3).after(jnp.float32(0.3), fitness, guests, bred) == pytest.approx(0.3)


def test_only_what_evolution_made_counts_against_learners():
    """Actors that joined, and members that a critic's gradient moved, are the learners' work."""
    erl = ERL.erl(Copy(), MLP((4,)), learners=(LEARNER,), share=Earned(0.2, 0.8), **SMALL)
    state = erl.init(key=jax.random.key(0))
    guest = jnp.array([-1, -1, -1, 0])
    fitness = jnp.array([3.0, 0.0, 0.0, 1.0])
    shares = []
    for maker in range(len(MAKERS)):
        made = jnp.array([maker, DRAWN, DRAWN, INJECTED])
        lineage = dataclasses.replace(state.lineage, guest=guest, maker=made)
        after = balance(erl, dataclasses.replace(state, lineage=lineage), fitness)
        shares.append(float(after.share))
    most, half = 0.65, 0.5
    expected = [most if m in (INJECTED, COACHED) else half for m in range(len(MAKERS))]
    assert shares == pytest.approx(expected)


@pytest.mark.parametrize(("learners", "rounds"), [(0.0, 1), (0.5, 4), (0.75, 12)])
def test_learners_play_in_rounds_until_they_have_their_share(learners, rounds):
    """Every episode of the task has as many frames: four members beside so many rounds of one."""
    erl = ERL.erl(
        Copy(), MLP((4,)), learners=(LEARNER,), share=Fixed(learners), episodes=1, **SMALL
    )
    state = erl.init(key=jax.random.key(0))
    state, metrics = jax.jit(erl.generation)(state, key=jax.random.key(1))
    frames = erl.env.max_steps
    assert metrics["learner_rounds"] == rounds
    assert state.frames == metrics["frames"] == frames * (4 + rounds)
    assert metrics["updates"] == frames * (4 + rounds)
    assert state.episodes == 4 + rounds
    assert state.replay.written == state.frames
    assert np.isfinite(metrics["critic_loss_0"])
    assert frames * (4 + rounds) <= erl.most_frames


def test_learners_stop_where_the_budget_of_a_run_does(tmp_path):
    """A generation has 40 frames of the population and 120 of the learner: of the second, budgets
    leave less, and one round of 10 at least. A larger budget moves the end."""
    erl = ERL.erl(Copy(), MLP((4,)), learners=(LEARNER,), share=Fixed(0.75), **SMALL)

    def frames(run):
        return run.metrics["frames"].astype(int).tolist()

    run = train(erl, path=tmp_path / "a", frames=250)
    assert frames(run) == [160, 250]
    assert frames(train(erl, path=tmp_path / "b", frames=170)) == [160, 210]
    assert run.algorithm.share.until is None  # as the user said
    assert frames(resume(run.path, frames=500)) == [160, 250, 410, 500]
    own = dataclasses.replace(erl, share=Fixed(0.75, until=200.0))
    assert frames(train(own, path=tmp_path / "c", frames=250)) == [160, 210, 260]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Fixed(1.0), "learners is 1.0"),
        (lambda: Earned(0.5, 0.4), "least is 0.5"),
        (lambda: Earned(memory=2.0), "memory is 2.0"),
    ],
)
def test_bad_shares_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
