"""A policy reads inputs, step by step, without a task."""

import jax

from credo.compilation import jit


@jit
def read(policy, inputs):
    """Actions `[time, act]` and the carry after each step, leaves `[time, ...]`."""

    def body(carry, x):
        action, carry = policy(x, carry)
        return carry, (action, carry)

    return jax.lax.scan(body, policy.start(key=jax.random.key(0)), inputs)[1]
