"""MADDPG of BenchMARL on VMAS's discovery: optimiser steps per CPU second.

Run by the benchmarks in an environment that has benchmarl and vmas: `python benchmarl_maddpg.py
STEPS`; prints a JSON line. Measured are an actor and a critic of each agent's own, and BenchMARL's
default, one of both for all agents. Everything else is its default, but for the size of the
collected batch, logs and evaluation.
"""

import json
import sys
import tempfile
import time

import torch
from benchmarl.algorithms import MaddpgConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

FRAMES = 1_000  # in the buffer
WARM = 20  # steps before the clock counts


class Clock(Callback):
    """CPU seconds at the end of each optimiser step, sampling from the buffer included."""

    def __init__(self):
        super().__init__()
        self.times = []

    def on_train_step(self, batch, group):
        self.times.append(time.process_time())


def measure(shared, steps, folder):
    config = ExperimentConfig.get_from_yaml()
    config.loggers, config.create_json, config.evaluation = [], False, False
    config.save_folder = folder
    config.off_policy_collected_frames_per_batch = FRAMES
    config.off_policy_n_optimizer_steps = WARM + steps
    config.max_n_iters, config.max_n_frames = 1, None
    config.exploration_anneal_frames = FRAMES
    config.share_policy_params = shared
    algorithm = MaddpgConfig.get_from_yaml()
    algorithm.share_param_critic = shared
    model, clock = MlpConfig.get_from_yaml(), Clock()
    experiment = Experiment(
        task=VmasTask.DISCOVERY.get_from_yaml(),
        algorithm_config=algorithm,
        model_config=model,
        critic_model_config=model,
        seed=0,
        config=config,
        callbacks=[clock],
    )
    experiment.run()
    agents, obs = experiment.observation_spec["agents", "observation"].shape
    return {
        "rate": steps / (clock.times[-1] - clock.times[-1 - steps]),
        "shape": [agents, obs, experiment.action_spec["agents", "action"].shape[-1]],
        "batch": config.off_policy_train_batch_size,
        "hidden": list(model.num_cells),
    }


if __name__ == "__main__":
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as path:
        results = {
            name: measure(shared, int(sys.argv[1]), path)
            for name, shared in (("own", False), ("shared", True))
        }
    print(json.dumps(results))
