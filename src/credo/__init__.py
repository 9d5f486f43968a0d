"""Credo: credit assignment by evolution and gradient.

import credo

task = credo.SequenceClassification(depth=5)
algorithm = credo.Neuroevolution.ours(task, credo.MMU(hidden=5))
run = credo.train(algorithm, generations=300)
policy = run.policy()
action = policy(observation)
"""

import importlib

_EXPORTS = {
    "SequenceClassification": "environments.sequence_classification",
    "SequenceRecall": "environments.sequence_recall",
    "AbstractEnvironment": "environments.base",
    "AbstractSequenceTask": "environments.base",
    "check_environment": "environments.checks",
    "MMU": "networks.mmu",
    "Recurrent": "networks.recurrent",
    "MLP": "networks.mlp",
    "AbstractNetwork": "networks.base",
    "AbstractPolicy": "networks.base",
    "Breeder": "evolution.breeder",
    "AbstractSelection": "evolution.selection",
    "AbstractMutation": "evolution.mutation",
    "AbstractCrossover": "evolution.crossover",
    "Curriculum": "environments.curriculum",
    "Parsimony": "algorithms.fitness",
    "Tournament": "evolution.selection",
    "Truncation": "evolution.selection",
    "MatrixMutation": "evolution.mutation",
    "GaussianMutation": "evolution.mutation",
    "MaskedCrossover": "evolution.crossover",
    "OnePointCrossover": "evolution.crossover",
    "AgentCrossover": "evolution.agents",
    "Homogenize": "evolution.agents",
    "Mutations": "evolution.mutation",
    "Extinction": "evolution.extinction",
    "Islands": "evolution.islands",
    "Neuroevolution": "algorithms.neuroevolution",
    "Sequence": "types",
    "TimeStep": "types",
    "evaluate": "rollout",
    "train": "runs.loop",
    "resume": "runs.loop",
    "Run": "runs.loop",
    "Policy": "runs.loop",
    "ERL": "algorithms.erl",
    "OffPolicy": "algorithms.off_policy",
    "MERL": "algorithms.merl",
    "CCEA": "algorithms.ccea",
    "DMMU": "networks.dmmu",
    "ExtendedTMaze": "environments.extended_tmaze",
    "ServerFleet": "environments.server_fleet",
    "Team": "networks.team",
    "Centralized": "networks.team",
    "JointCritic": "networks.team",
    "Rover": "environments.rover",
    "SimpleSpread": "environments.simple_spread",
    "PettingZoo": "environments.pettingzoo",
    "to_pettingzoo": "environments.pettingzoo",
    "matd3": "learners.td3",
    "maddpg": "learners.td3",
    "AbstractLearner": "learners.base",
    "TD3": "learners.td3",
    "ddpg": "learners.td3",
    "SAC": "learners.sac",
    "PPO": "algorithms.ppo",
    "BPTT": "algorithms.bptt",
    "AbstractCritic": "networks.mlp",
    "AbstractCriticNetwork": "networks.mlp",
    "Critic": "networks.mlp",
    "ResidualCritic": "networks.mlp",
    "Explorer": "networks.exploration",
    "GaussianNoise": "networks.exploration",
    "OrnsteinUhlenbeck": "networks.exploration",
    "AbstractManager": "learners.manager",
    "UCB": "learners.manager",
    "Uniform": "learners.manager",
    "Thompson": "learners.manager",
    "AbstractHostEnvironment": "environments.host",
    "Gymnasium": "environments.gymnasium",
    "delayed": "environments.wrappers",
    "NoisyObservations": "environments.wrappers",
    "Runner": "runner",
    "export": "runs.export",
    "watch": "report.watch",
}
__all__ = sorted(_EXPORTS)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    # Imported on first use, so that `credo --help` need not wait for JAX.
    if name not in _EXPORTS:
        raise AttributeError(f"module 'credo' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_EXPORTS[name]}", __name__), name)


def __dir__():
    return __all__
