"""A Gymnasium task of your own, trained by ERL and played in its own units.

    python examples/own_gymnasium.py

or, from the folder of this file:

    credo check own_gymnasium:Heating
    credo train erl own_gymnasium:Heating --max-episode-steps 96 --frames 1e4 --seeds 3
"""

import gymnasium
import numpy as np
from gymnasium.spaces import Box

import credo


class Heating(gymnasium.Env):
    """Keep a room at 20 °C for a day, in steps of a quarter of an hour."""

    observation_space = Box(-50.0, 80.0, (2,))  # °C inside and outside
    action_space = Box(0.0, 3000.0, (1,))  # heating power in watts

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.outside = self.np_random.uniform(-10.0, 10.0)
        self.inside, self.steps = self.outside, 0
        return self._observation(), {}

    def step(self, action):
        power = float(action[0])
        self.inside += 0.1 * (self.outside - self.inside) + 0.001 * power
        self.steps += 1
        reward = -abs(self.inside - 20.0) / 10.0
        return self._observation(), reward, False, self.steps >= 96, {}

    def _observation(self):
        return np.array([self.inside, self.outside], np.float32)


def main():
    task = credo.Gymnasium(Heating, max_episode_steps=96)
    algorithm = credo.ERL.erl(task, normalize_observations=True, updates_per_frame=0.2)
    run = credo.train(algorithm, frames=10_000, path="runs/heating")

    policy, env = run.policy(), Heating()
    observation, _ = env.reset(seed=0)
    policy.reset()  # a policy with memory forgets the episode before
    for _step in range(96):
        power = policy(observation)  # watts, as Heating wants them
        observation, *_ = env.step(power)
    print(f"after a day: {observation[0]:.1f} °C inside, {power[0]:.0f} W")


if __name__ == "__main__":  # the task runs in a process that imports this file
    main()
