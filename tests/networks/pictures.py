"""A Gymnasium task that shows a picture beside other things. No JAX here."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete


class Pictures(gymnasium.Env):
    observation_space = Dict(
        {
            "a": Discrete(3),
            "b": Box(0, 1, (2,)),
            "c": Box(0, 255, (4, 5, 3), np.uint8),
            "d": Box(0, 1, (1,)),
        }
    )
    action_space = Box(-1, 1, (1,))
