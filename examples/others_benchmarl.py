"""BenchMARL trains on a team of ours: MAPPO drives rovers.

    pip install benchmarl
    python examples/others_benchmarl.py --frames 60000

`credo.to_pettingzoo` makes a `ParallelEnv` of any team; TorchRL wraps it, BenchMARL takes that.
"""

import argparse
import tempfile

from benchmarl.algorithms import MappoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from pettingzoo.utils import BaseParallelWrapper
from torchrl.envs import PettingZooWrapper

import credo

TEAM = credo.Rover(rovers=2, coupling=1, pois=4, max_steps=50, size=15.0)


class Bare(BaseParallelWrapper):
    """Without infos: ours hold all rewards by name, and TorchRL takes no dict inside a dict."""

    def reset(self, seed=None, options=None):
        obs, infos = super().reset(seed, options)
        return obs, {agent: {} for agent in infos}

    def step(self, actions):
        *told, infos = super().step(actions)
        return *told, {agent: {} for agent in infos}


class Rovers(PettingZooClass):
    """Two rovers that look for four points of interest, each paid its `local` reward."""

    def get_env_fun(self, num_envs, continuous_actions, seed, device):
        team = credo.to_pettingzoo(TEAM)
        return lambda: PettingZooWrapper(Bare(team), device=device, seed=seed)

    def supports_continuous_actions(self):
        return True

    def has_state(self):
        return False

    def max_steps(self, env):
        return TEAM.max_steps


def main(frames: int) -> None:
    """Train for so many frames, and say what episodes return at the first and the last test."""
    config = ExperimentConfig.get_from_yaml()
    config.max_n_iters, config.max_n_frames = None, frames
    config.on_policy_collected_frames_per_batch = batch = min(2000, frames)
    config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = min(400, batch), 10
    config.on_policy_n_envs_per_worker = 1
    config.evaluation_interval, config.evaluation_episodes = batch, 10
    config.render, config.loggers, config.share_policy_params = False, [], True
    config.save_folder = tempfile.mkdtemp()
    experiment = Experiment(
        task=Rovers("ROVER", {}),
        algorithm_config=MappoConfig.get_from_yaml(),
        model_config=MlpConfig.get_from_yaml(),
        critic_model_config=MlpConfig.get_from_yaml(),
        seed=0,
        config=config,
    )
    experiment.run()
    print(f"BenchMARL, {frames} frames: mean return {experiment.mean_return:.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=60_000)
    main(parser.parse_args().frames)
