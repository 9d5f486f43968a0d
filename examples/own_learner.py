"""A learner of your own in ERL: it descends its own gradient on everybody's experience.

python examples/own_learner.py      # needs MuJoCo: pip install '.[mujoco]'
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

import credo
from credo.learners.base import act, adam, adam_state


class State(eqx.Module):
    actor: credo.AbstractPolicy
    critic: credo.AbstractCriticNetwork
    actor_opt: tuple
    critic_opt: tuple


class PolicyGradient(credo.AbstractLearner):
    """Deterministic policy gradient, as short as it can be: no target networks."""

    metrics: ClassVar[tuple[str, ...]] = ("error",)  # what `update` reports, recorded in the run

    gamma: float = 0.98
    rate: float = 1e-3
    batch_size: int = eqx.field(static=True, default=128)
    signal: str | None = eqx.field(static=True, default=None)  # the task's first reward

    def init(self, network, obs_size, action_size, *, key):
        actor = network.init(obs_size, action_size, key=key)
        critic = credo.Critic(normalization="before").init(obs_size, action_size, key=key)
        return State(actor, critic, adam_state(actor), adam_state(critic))

    def update(self, state, batch, *, key):
        """One step on a minibatch, leaves [batch_size, ...]."""
        next_q = state.critic(batch.next_obs.T, act(state.actor, batch.next_obs).T)
        target = batch.reward + self.gamma * jnp.where(batch.terminated, 0.0, next_q)

        def error(critic):
            return jnp.mean((critic(batch.obs.T, batch.action.T) - target) ** 2)

        def loss(actor):
            return -jnp.mean(state.critic(batch.obs.T, act(actor, batch.obs).T))

        value, gradient = eqx.filter_value_and_grad(error)(state.critic)
        critic, critic_opt = adam(state.critic, gradient, state.critic_opt, self.rate)
        gradient = eqx.filter_grad(loss)(state.actor)
        actor, actor_opt = adam(state.actor, gradient, state.actor_opt, self.rate)
        return State(actor, critic, actor_opt, critic_opt), {"error": value}

    def actor(self, state):
        return state.actor

    def explorer(self, state, random):
        noise = credo.GaussianNoise(0.1)
        return credo.Explorer(state.actor, noise, random, state.critic.action_size)

    def warm(self, state, actor):
        return eqx.tree_at(lambda s: s.actor, state, actor)


if __name__ == "__main__":
    task = credo.Gymnasium("InvertedPendulum-v5")
    algorithm = credo.ERL.erl(task, learners=(PolicyGradient(),), sync_period=1)
    run = credo.train(algorithm, frames=20_000, path="runs/own-learner", stop_at=1000.0)
    m = run.metrics
    print("champion:", m["champion_score"][-1], "of 1000 after", m["frames"][-1], "frames")
    print("injected actors that became elite:", int(m["elite_0"].sum()))
