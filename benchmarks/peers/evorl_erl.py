"""ERL with a TD3 learner of EvoRL on Hopper, one critic update per sampled frame.

Run by the benchmarks in an environment that has evorl-jax (measured with 0.1.1) and brax:
`python evorl_erl.py SECONDS`; prints a JSON line.

EvoRL makes a fixed number of updates per generation and plays every episode to its time limit, of
which it samples the frames before the end. So one workflow that hardly learns tells how many
frames a generation samples, and a second one makes as many updates. Episodes grow while it learns:
what is missing to exactly one update per frame is added at the price of an update, the difference
between the two workflows.
"""

import json
import logging
import sys
import time

import jax
from evorl.algorithms.erl.erl_td3.erl_ga import ERLGAWorkflow
from omegaconf import OmegaConf

POPULATION, LIMIT, DELAY = 10, 1_000, 2
EPISODES = POPULATION + 1  # of a generation: one is the learner's
HIDDEN = [256, 256]
CONFIG = {
    "env": {"env_type": "brax", "env_name": "hopper", "max_episode_steps": LIMIT},
    "agent_network": {
        "norm_layer_type": "none",
        "num_critics": 2,
        "actor_hidden_layer_sizes": HIDDEN,
        "critic_hidden_layer_sizes": HIDDEN,
    },
    "optimizer": {"lr": 3e-4, "grad_clip_norm": None},
    "checkpoint": {"enable": False},
    # Collection: one episode per member and one of the learner, with noise.
    "num_envs": 1,
    "num_eval_envs": 1,
    "eval_episodes": 1,
    "eval_interval": 1,
    "pop_size": POPULATION,
    "episodes_for_fitness": 1,
    "rollout_episodes": EPISODES - POPULATION,
    "fitness_with_exploration": False,
    "rl_exploration": True,
    "random_timesteps": 0,
    "warmup_iters": 0,
    "replay_buffer_capacity": 1_000_000,
    "normalize_obs": False,
    # TD3
    "num_rl_agents": 1,
    "batch_size": 256,
    "actor_update_interval": DELAY,
    "discount": 0.99,
    "tau": 5e-3,
    "exploration_epsilon": 0.1,
    "policy_noise": 0.2,
    "clip_policy_noise": 0.5,
    "critics_in_actor_loss": "first",
    # Evolution
    "num_elites": 2,
    "rl_injection_interval": 10,
    "enable_crossover": True,
    "num_crossover_frac": 0.1,
    "num_mutation_frac": 0.1,
    "mut_strength": 0.1,
    "super_mut_strength": 10.0,
    "super_mut_prob": 0.05,
    "reset_prob": 0.05,
    "vec_relative_prob": 0.0,
    "weight_max_magnitude": 1e6,
}


def workflow(updates):
    """ERL that makes `updates` critic updates per generation, an even number."""
    config = OmegaConf.create(CONFIG | {"num_rl_updates_per_iter": updates // DELAY})
    return ERLGAWorkflow.build_from_config(config)


def measure(erl, state, seconds):
    """Generations for so many CPU seconds, at least two, after one that compiles.

    Returns the state, and CPU seconds and sampled frames per generation.
    """
    _, state = jax.block_until_ready(erl.step(state))
    before, cpu, n = int(state.metrics.sampled_timesteps), time.process_time(), 0
    while n < 2 or time.process_time() - cpu < seconds:
        _, state = jax.block_until_ready(erl.step(state))
        n += 1
    cpu = time.process_time() - cpu
    return state, cpu / n, (int(state.metrics.sampled_timesteps) - before) / n


def main(seconds):
    few = DELAY
    erl = workflow(few)
    state = erl.init(jax.random.PRNGKey(0))  # it refuses typed keys
    _, state = jax.block_until_ready(erl.step(state))
    first = time.process_time()
    state, cheap, frames = measure(erl, state, seconds / 4)
    many = DELAY * max(2, round(frames / DELAY))
    state, dear, frames = measure(workflow(many), state, seconds)
    update = (dear - cheap) / (many - few)
    collect = dear - many * update
    return {
        "rate": frames / (collect + frames * update),
        "first": first,
        "length": frames / EPISODES,
        "ratio": many / frames,
        "collect": collect,
        "update": update,
        "padded": EPISODES * LIMIT / dear,
    }


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    print(json.dumps(main(float(sys.argv[1]))))
