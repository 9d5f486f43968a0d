"""One small task twice: in JAX, and outside it in NumPy."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from credo.environments.base import AbstractEnvironment
from credo.environments.host import AbstractCopies, AbstractHostEnvironment, HostStep
from credo.types import TimeStep

START, PACE, LENGTH = 0.25, 0.5, 6


class Walk(AbstractEnvironment):
    """Walk on a line from 0.25. Beyond ±1 the task ends, after 6 steps the clock does.

    Observation: position and time. `reward`: the position; `effort`: minus the squared action.
    """

    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 1
    max_steps: ClassVar[int] = LENGTH
    signals: ClassVar[tuple[str, ...]] = ("reward", "effort")

    def reset(self, *, key):
        return self._at(jnp.float32(START), jnp.int32(0), jnp.float32(0.0), jnp.float32(0.0))

    def step(self, state, action, *, key):
        x, t = state
        x = x + PACE * action[0]
        return self._at(x, t + 1, x, -(action[0] ** 2))

    def _at(self, x, t, reward, effort):
        obs = jnp.stack([x, 0.1 * t.astype(jnp.float32)])
        rewards = {"reward": reward, "effort": effort}
        terminated = jnp.abs(x) > 1.0
        return (x, t), TimeStep(obs, rewards, terminated, ~terminated & (t >= LENGTH))


class HostWalk(AbstractHostEnvironment):
    """The same outside JAX."""

    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 1
    max_steps: ClassVar[int] = LENGTH
    signals: ClassVar[tuple[str, ...]] = ("reward", "effort")
    spread: float = eqx.field(static=True, default=0.0)  # of the start, which the seed decides

    def copies(self, n):
        return Walkers(n, self.spread)


class Walkers(AbstractCopies):
    def __init__(self, n, spread):
        self.n, self._spread = n, np.float32(spread)
        self.x, self.t = np.zeros(n, np.float32), np.zeros(n, np.int32)

    def reset(self, seeds, active):
        assert seeds.dtype == np.uint32
        assert seeds.shape == active.shape == (self.n,)
        start = START + self._spread * (seeds / 2**32 - 0.5)
        self.x = np.where(active, start, 0.0).astype(np.float32)
        self.t = np.zeros(self.n, np.int32)
        return self._obs()

    def step(self, actions, active):
        assert actions.shape == (self.n, 1)
        assert np.isfinite(actions).all()
        action = actions[:, 0]
        self.x = np.where(active, self.x + np.float32(PACE) * action, self.x)
        self.t = self.t + active
        rewards = {"reward": self.x.copy(), "effort": -(action**2)}
        terminated = np.abs(self.x) > 1.0
        return HostStep(self._obs(), rewards, terminated, ~terminated & (self.t >= LENGTH))

    def _obs(self):
        return np.stack([self.x, np.float32(0.1) * self.t.astype(np.float32)], axis=1)
