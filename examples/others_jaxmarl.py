"""JaxMARL's interface around a team of ours, and a policy gradient that learns through it.

    pip install jaxmarl
    python examples/others_jaxmarl.py --frames 1600000

JaxMARL's own training scripts are in its repository, not in its package.
"""

import argparse

import jax
import jax.numpy as jnp
import optax
from jaxmarl.environments.multi_agent_env import MultiAgentEnv
from jaxmarl.environments.spaces import Box

import credo

ROVERS, COPIES = credo.Rover(rovers=2, coupling=1, pois=4, max_steps=25, size=15.0), 64


class Team(MultiAgentEnv):
    """A team task of ours; agents are paid the reward named `signal`."""

    def __init__(self, env: credo.AbstractEnvironment, signal: str = "local"):
        super().__init__(env.agents)
        self.env, self.signal = env, signal
        self.observation_spaces = dict.fromkeys(self.agents, Box(*env.obs_range, (env.obs_size,)))
        self.action_spaces = dict.fromkeys(self.agents, Box(-1.0, 1.0, (env.action_size,)))

    def named(self, rows):
        return dict(zip(self.agents, rows, strict=True))

    def reset(self, key):
        state, now = self.env.reset(key=key)
        return self.named(now.obs), state

    def step_env(self, key, state, actions):
        act = jnp.stack([actions[agent] for agent in self.agents])
        state, now = self.env.step(state, jnp.clip(act, -1.0, 1.0), key=key)
        paid = jnp.broadcast_to(now.rewards[self.signal], self.num_agents)
        over = dict.fromkeys([*self.agents, "__all__"], now.terminated | now.truncated)
        return self.named(now.obs), state, self.named(paid), over, {}


def main(frames: int) -> None:
    """Train for so many frames, and say what episodes return in the first and last ten rounds."""
    env, adam = Team(ROVERS), optax.adam(0.01)

    def played(policy, key):
        def step(carry, key):
            (obs, state), (act_key, step_key) = carry, jax.random.split(key)
            middle = jnp.stack([obs[agent] for agent in env.agents]) @ policy[:-1] + policy[-1]
            act = jax.lax.stop_gradient(middle + 0.5 * jax.random.normal(act_key, middle.shape))
            obs, state, paid, *_ = env.step(step_key, state, env.named(act))
            likely = -2.0 * jnp.sum((act - middle) ** 2, axis=1)
            return (obs, state), (likely, jnp.stack([paid[agent] for agent in env.agents]))

        return jax.lax.scan(step, env.reset(key), jax.random.split(key, ROVERS.max_steps))[1]

    def loss(policy, key):
        likely, paid = jax.vmap(played, (None, 0))(policy, jax.random.split(key, COPIES))
        later = jnp.cumsum(paid[:, ::-1], axis=1)[:, ::-1]  # what is paid from here on
        gain = (later - later.mean(axis=0)) / (later.std(axis=0) + 1e-6)
        return -jnp.mean(likely * gain), paid.sum(axis=1).mean()

    def update(carry, key):
        slope, score = jax.grad(loss, has_aux=True)(carry[0], key)
        change, memory = adam.update(slope, carry[1])
        return (carry[0] + change, memory), score

    first = jnp.zeros((ROVERS.obs_size + 1, ROVERS.action_size))  # linear; agents share it
    keys = jax.random.split(jax.random.key(0), max(frames // (COPIES * ROVERS.max_steps), 2))
    scores = jax.lax.scan(update, (first, adam.init(first)), keys)[1]
    print(f"JaxMARL, {frames} frames: return {scores[:10].mean():.1f} -> {scores[-10:].mean():.1f}")


if __name__ == "__main__":
    (parser := argparse.ArgumentParser()).add_argument("--frames", type=int, default=1_600_000)
    main(parser.parse_args().frames)
