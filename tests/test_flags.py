"""JAX's flags that others set: what they change of a run is nothing."""

import functools

import jax
import pytest

from credo.algorithms.bptt import BPTT
from credo.algorithms.ccea import CCEA
from credo.algorithms.erl import ERL
from credo.algorithms.merl import MERL
from credo.algorithms.neat import NEAT
from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.algorithms.ppo import PPO
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy, Meet, Remember
from credo.learners.horizon import Truncated
from credo.learners.sac import SAC
from credo.learners.td3 import TD3, ddpg, maddpg, matd3
from credo.networks.graph import Graph
from credo.networks.mlp import MLP, Critic
from credo.networks.mmu import MMU
from credo.networks.team import JointCritic, Team
from credo.runs.loop import train

NETWORK, CRITIC = MLP(hidden=(2,)), Critic(hidden=(2,))
TEAM, JOINT = Team(trunk=(2,)), JointCritic(CRITIC)
TINY = {"critic": CRITIC, "batch_size": 2}
EVOLUTION = {"population_size": 4, "elite_fraction": 0.25, "episodes": 1, "test_episodes": 1}
LEARN = {"replay_capacity": 64, "updates_per_frame": 0.1, "test_episodes": 1}
ALONE = LEARN | {"start_frames": 5}
HYBRID = EVOLUTION | LEARN | {"warmup_frames": 5, "workers": 1}
COPY, MEET = Copy(max_steps=4), Meet()
MAKE = {
    "neuroevolution": lambda: Neuroevolution.as_written(COPY, NETWORK, **EVOLUTION),
    "neat": lambda: NEAT(
        COPY, Graph(hidden=2), population_size=4, connections=4, episodes=1, test_episodes=1
    ),
    "bptt": lambda: BPTT(Remember(2), MMU(hidden=2), batch_size=2, test_episodes=1),
    "ccea": lambda: CCEA.ccea(MEET, NETWORK, teams=1, **EVOLUTION),
    "erl": lambda: ERL.erl(COPY, NETWORK, learners=(ddpg(**TINY),), **HYBRID),
    "cerl": lambda: ERL.cerl(COPY, NETWORK, learners=(TD3(**TINY),), **HYBRID),
    "ea": lambda: ERL.ea(COPY, NETWORK, **HYBRID),
    "merl": lambda: MERL.merl(MEET, TEAM, learners=(TD3(signal="local", **TINY),), **HYBRID),
    "td3": lambda: OffPolicy.td3(COPY, NETWORK, learner=TD3(**TINY), **ALONE),
    "ddpg": lambda: OffPolicy.ddpg(COPY, NETWORK, learner=ddpg(**TINY), **ALONE),
    "sac": lambda: OffPolicy.sac(COPY, NETWORK, learner=SAC(**TINY), **ALONE),
    "ppo": lambda: PPO.ppo(
        COPY, NETWORK, critic=CRITIC, horizon=8, copies=2, batch_size=4, epochs=1, test_episodes=1
    ),
    "matd3": lambda: OffPolicy.matd3(
        MEET, TEAM, learner=matd3(**TINY | {"critic": JOINT}), **ALONE
    ),
    "maddpg": lambda: OffPolicy.maddpg(
        MEET, TEAM, learner=maddpg(**TINY | {"critic": JOINT}), **ALONE
    ),
}
OUTSIDE = {  # tasks that do not run in JAX
    "a horizon": lambda: ERL.erl(
        Gymnasium("InvertedPendulum-v5", in_process=True),
        NETWORK,
        learners=(TD3(**TINY),),
        horizon=Truncated(4),
        **HYBRID,
    ),
}
QUIET = {"progress": False, "tensorboard": False, "seed": 3}


def rows(name: str, path) -> str:
    """The metrics of three generations: the first learns nothing."""
    train((MAKE | OUTSIDE)[name](), generations=3, path=path, **QUIET)
    return (path / "metrics.csv").read_text()


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """What a run says without flags."""
    return functools.cache(lambda name: rows(name, tmp_path_factory.mktemp("plain") / name))


@pytest.mark.parametrize("flag", [jax.enable_x64, jax.debug_nans])
@pytest.mark.parametrize("name", MAKE | OUTSIDE)
def test_every_algorithm_runs_with_the_flag_as_without(name, flag, plain, tmp_path):
    expected = plain(name)
    with flag(True):
        assert rows(name, tmp_path / "run") == expected
