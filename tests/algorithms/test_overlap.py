"""Learners that learn while a generation is played: a lag of one generation, whoever plays."""

import dataclasses

import jax
import numpy as np
import pytest

import credo
from credo.algorithms import overlap
from credo.algorithms.erl import ERL
from credo.algorithms.merl import MERL
from credo.environments import foreign
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy
from credo.environments.simple_spread import SimpleSpread
from credo.learners.horizon import Truncated
from credo.learners.share import Fixed
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.playing import players

SMALL = {"population_size": 4, "warmup_frames": 0, "replay_capacity": 500, "test_episodes": 2}
LEARNER = TD3(critic=Critic(hidden=(8,)), batch_size=4)
GIVEN = {**SMALL, "elite_fraction": 0.25, "learners": (LEARNER,), "overlap": True}
OUTSIDE = ERL.erl(
    Gymnasium("Pendulum-v1", max_episode_steps=10), MLP(hidden=(8,)), **GIVEN, sync_period=2
)
TEAM = MERL.merl(
    SimpleSpread(max_steps=5), **GIVEN | {"learners": MERL.merl(SimpleSpread()).learners}
)
FILES = ("metrics.csv", "champion.safetensors", "best.safetensors")


@pytest.fixture(scope="module", autouse=True)
def _environments():
    yield
    foreign.close_all()


def generations(algorithm, n):
    """States, the first before any generation, and metrics."""
    states, rows = [algorithm.init(key=jax.random.key(0))], []
    for g in range(n):
        state, metrics = algorithm.generation(states[-1], key=jax.random.key(g + 1))
        states.append(jax.tree.map(np.asarray, state))
        rows.append({name: np.asarray(x).item() for name, x in metrics.items()})
    return states, rows


def same(a, b) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


@pytest.mark.parametrize(
    "algorithm",
    [ERL.erl(Copy(), MLP(hidden=(8,)), **GIVEN, updates_per_frame=0.5), OUTSIDE, TEAM],
    ids=["jax", "outside", "team"],
)
def test_updates_are_those_of_the_generation_before(algorithm):
    states, rows = generations(algorithm, 3)
    frames = [0, *(row["frames"] for row in rows)]
    assert [row["updates"] for row in rows] == [
        int(n * algorithm.updates_per_frame) for n in frames[:-1]
    ]
    assert [int(state.owed) for state in states] == frames
    assert [int(state.frames) for state in states] == np.cumsum([0, *frames[:-1]]).tolist()
    assert same(states[0].learners[0].actor, states[1].learners[0].actor)
    assert not same(states[1].learners[0].actor, states[2].learners[0].actor)
    assert int(states[3].replay.written) == sum(frames)
    assert states[0].owed.dtype == np.int32


def test_the_first_generation_plays_as_without():
    # Nobody has learned yet, so populations are the same one generation long.
    with_lag, without = (
        generations(dataclasses.replace(OUTSIDE, overlap=x), 1)[0][1] for x in (True, False)
    )
    assert same(with_lag.population, without.population)
    assert same(with_lag.replay, without.replay)
    assert without.owed is None


def test_any_number_of_processes_and_any_stop_give_the_same_run(tmp_path, monkeypatch):
    monkeypatch.setattr(players, "PATIENCE", 0.0)
    away, improve = [], overlap.improve

    def watched(*given, **how):
        away.append(players._CURRENT.players._away is not None)
        return improve(*given, **how)

    monkeypatch.setattr(overlap, "improve", watched)
    found = {}
    for n in (1, 2, 3):
        options = {"generations": 6, "processes": n, "progress": False, "tensorboard": False}
        run = credo.train(OUTSIDE, path=tmp_path / str(n), **options)
        found[n] = [(run.path / name).read_bytes() for name in FILES]
        assert all(away) if n > 1 else not any(away)  # whether it learned while others played
        away.clear()
    assert found[1] == found[2] == found[3]
    credo.train(OUTSIDE, path=tmp_path / "short", generations=3, progress=False, tensorboard=False)
    credo.resume(tmp_path / "short", generations=6, progress=False, tensorboard=False)
    assert found[1] == [(tmp_path / "short" / name).read_bytes() for name in FILES]


@pytest.mark.parametrize(
    "fields", [{"learners": ()}, {"share": Fixed(0.5)}, {"horizon": Truncated(5)}]
)
def test_what_does_not_go_with_it_is_refused(fields):
    with pytest.raises(ValueError, match="overlap is for hybrids with learners, without"):
        dataclasses.replace(OUTSIDE, **fields)
