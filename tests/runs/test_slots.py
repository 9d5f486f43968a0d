"""What a hybrid's slots know is in its checkpoints."""

import pytest
import safetensors.numpy

from credo.algorithms.erl import ERL
from credo.environments.probes import Copy
from credo.evolution.cem import CEM
from credo.learners.coach import Coached
from credo.learners.horizon import Truncated
from credo.learners.manager import Progress
from credo.learners.surrogate import Preselection
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.runs import loop

LEARNER = TD3(critic=Critic(hidden=(4,)), batch_size=8)
EVERYTHING = ERL.erl(
    Copy(),
    MLP((4,)),
    learners=(LEARNER, LEARNER),
    breeder=CEM(),
    coach=Coached(0.34),
    surrogate=Preselection(2, states=16),
    horizon=Truncated(5),
    manager=Progress(),
    workers=2,
    population_size=6,
    warmup_frames=0,
    sync_period=1,
    replay_capacity=300,
    test_episodes=1,
)
QUIET = {"tensorboard": False, "progress": False}


def results(path):
    champion = safetensors.numpy.load_file(path / "champion.safetensors")
    named = {name: array.tobytes() for name, array in champion.items()}
    return named | {"metrics": (path / "metrics.csv").read_bytes()}


@pytest.mark.slow
def test_stopped_and_resumed_is_bit_for_bit_the_straight_run(tmp_path):
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    run = loop.train(EVERYTHING, generations=4, path=straight, **QUIET)
    loop.train(EVERYTHING, generations=2, path=stopped, **QUIET)
    loop.resume(stopped, generations=4, **QUIET)
    assert results(straight) == results(stopped)
    metrics = run.metrics
    assert (metrics["coach_updates"] > 0).all()
    assert (metrics["frames"][2:] - metrics["frames"][1:-1]).max() < metrics["frames"][0]
