"""TorchRL trains on a task of ours: PPO balances two poles.

pip install torchrl
python examples/others_torchrl.py --frames 100000
"""

import argparse

import gymnasium
import torch
from tensordict.nn import InteractionType, TensorDictModule, set_interaction_type
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import credo.environments.gymnasium  # noqa: F401 registers our tasks


def make() -> TransformedEnv:
    """Two poles whose velocities are seen; 1 is paid for each of at most 1,000 steps."""
    env = gymnasium.make("credo/DoublePole-v0", velocities=True, signal="balanced")
    return TransformedEnv(GymWrapper(env), RewardSum()).append_transform(StepCounter())


def networks(obs: int, act: int) -> tuple[ProbabilisticActor, ValueOperator]:
    """Actor and critic, 64 and 64 units each."""

    def layers(out: int) -> list[nn.Module]:
        inner = [nn.Linear(obs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()]
        return [*inner, nn.Linear(64, out)]

    body = nn.Sequential(*layers(2 * act), NormalParamExtractor())
    module = TensorDictModule(body, in_keys=["observation"], out_keys=["loc", "scale"])
    actor = ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    )
    return actor, ValueOperator(nn.Sequential(*layers(1)), in_keys=["observation"])


def played(actor: ProbabilisticActor, episodes: int = 5) -> float:
    """Mean number of steps that the deterministic policy balances."""
    with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
        return sum(len(make().rollout(1000, actor)) for _ in range(episodes)) / episodes


def main(frames: int) -> None:
    """Train for so many frames, and say what five episodes return before and after."""
    torch.manual_seed(0)
    env, batch = make(), min(2048, frames)
    actor, critic = networks(
        env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    )
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    adam = torch.optim.Adam(loss.parameters(), 3e-4)
    before = played(actor)
    for data in Collector(env, actor, frames_per_batch=batch, total_frames=frames):
        for _epoch in range(10):
            with torch.no_grad():
                advantage(data)
            for rows in torch.randperm(batch).split(64):
                terms = loss(data[rows])
                adam.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                adam.step()
    print(f"TorchRL, {frames} frames: steps balanced {before:.0f} -> {played(actor):.0f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=100_000)
    main(parser.parse_args().frames)
