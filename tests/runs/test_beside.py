"""Champions of tasks outside JAX are tested beside the next generation's episodes: that changes
when a score is known, and no number of any row."""

import dataclasses

import numpy as np
import pytest

import credo
from credo.algorithms.erl import ERL
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments import foreign
from credo.environments.gymnasium import Gymnasium
from credo.networks.mlp import MLP
from credo.playing import players
from credo.runs import loop

TASK = Gymnasium("Pendulum-v1", max_episode_steps=10)
NETWORK = MLP(hidden=(8,))
EA = ERL.ea(TASK, NETWORK, population_size=4, test_episodes=2, elite_fraction=0.25)
ALGORITHMS = {
    "every generation": EA,
    "every third": dataclasses.replace(EA, test_every=3),
    "neuroevolution": Neuroevolution(TASK, NETWORK, population_size=4, episodes=2),
    "normalised": dataclasses.replace(EA, normalize_observations=True),
}
FILES = ("metrics.csv", "champion.safetensors", "best.safetensors")


@pytest.fixture(scope="module", autouse=True)
def _environments():
    yield
    foreign.close_all()


@pytest.fixture
def together(monkeypatch):
    """How many parts were played together, rollout by rollout."""
    seen, play = [], players.Players._play

    def counting(self, asked):
        seen.append(len(asked))
        play(self, asked)

    monkeypatch.setattr(players.Players, "_play", counting)
    return seen


def trained(algorithm, path, **changes):
    options = {"generations": 7, "tensorboard": False, "progress": False, "processes": 1}
    run = credo.train(algorithm, path=path, **options | changes)
    return [(run.path / name).read_bytes() for name in FILES]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_beside_the_next_generation_or_alone_is_the_same(name, tmp_path, together):
    algorithm = ALGORITHMS[name]
    beside = trained(algorithm, tmp_path / "beside")
    assert 2 in together  # the test beside the population
    together.clear()
    assert beside == trained(algorithm, tmp_path / "alone", checkpoint_every=0.0)
    assert set(together) == {1}
    trained(algorithm, tmp_path / "twice", generations=4)
    credo.resume(tmp_path / "twice", generations=7, progress=False)
    assert beside == [(tmp_path / "twice" / name).read_bytes() for name in FILES]


def test_the_best_policy_is_that_of_the_highest_score(tmp_path, together):
    run = credo.train(EA, path=tmp_path / "run", generations=7, progress=False)
    assert 2 in together
    scores = run.metrics["champion_score"]
    assert np.isfinite(scores).all()
    assert len(set(scores.tolist())) > 1
    generation, score = run.best_test
    assert generation == int(np.argmax(scores)) + 1
    assert np.float32(score) == np.float32(scores.max())


def test_a_budget_of_frames_and_a_score_end_where_they_should(tmp_path):
    run = credo.train(EA, path=tmp_path / "frames", frames=100, progress=False)
    assert run.metrics["frames"].tolist() == [40, 80, 120]
    scores = credo.train(EA, path=tmp_path / "all", generations=6, progress=False).metrics
    first = int(np.argmax(scores["champion_score"] >= scores["champion_score"][1:4].max()))
    stop = float(scores["champion_score"][first])
    run = credo.train(EA, path=tmp_path / "score", generations=6, stop_at=stop, progress=False)
    assert len(run.metrics["generation"]) == first + 1


def test_a_callback_hears_of_a_generation_when_it_is_over(tmp_path):
    heard = []

    def third(run, generation, metrics):
        heard.append(metrics["champion_score"])
        return generation == 3

    run = credo.train(EA, path=tmp_path / "run", generations=6, progress=False, callbacks=(third,))
    assert np.allclose(run.metrics["champion_score"], heard)
    assert len(heard) == 3


def test_a_dispatch_ends_when_a_checkpoint_is_due(tmp_path, together):
    trained(EA, tmp_path / "run", generations=3, checkpoint_every=0.0)
    assert set(together) == {1}


def test_a_dispatch_that_goes_on_is_reported(tmp_path, monkeypatch, together):
    silent = trained(EA, tmp_path / "silent", generations=5)
    monkeypatch.setattr(loop, "PATIENCE", 0.0)
    told = list[int]()
    report = loop._Training.report

    def reported(self, rows, now):
        told.append(len(rows))
        return report(self, rows, now)

    monkeypatch.setattr(loop._Training, "report", reported)
    run = trained(EA, tmp_path / "run", generations=5)
    assert told == [1, 1, 1, 1, 1]  # each when its champion has been tested
    assert 2 in together  # which is beside the next one
    assert run == silent
