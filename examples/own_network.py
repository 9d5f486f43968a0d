"""A network of your own with memory, evolved beside the library's, on the same task and budget.

python examples/own_network.py
"""

import equinox as eqx
import jax
import jax.numpy as jnp

import credo


class LeakyPolicy(credo.AbstractPolicy):
    """Units that each forget at a rate of their own. The arrays are the genome."""

    w: jax.Array  # [hidden, obs_size]
    rate: jax.Array  # [hidden]; memory moves by sigmoid(rate) of the way
    z: jax.Array  # [action_size, hidden]

    def start(self, *, key):
        return jnp.zeros_like(self.rate)  # the memory before the first step

    def __call__(self, obs, memory):
        share = jax.nn.sigmoid(self.rate)
        memory = (1.0 - share) * memory + share * (self.w @ obs)
        return jnp.tanh(self.z @ jnp.tanh(memory)), memory  # an action in [-1, 1]


class Leaky(credo.AbstractNetwork):
    """The settings of such a network."""

    hidden: int = eqx.field(static=True, default=5)

    def init(self, obs_size, action_size, *, key):
        w_key, rate_key, z_key = jax.random.split(key, 3)
        return LeakyPolicy(
            jax.random.normal(w_key, (self.hidden, obs_size)),
            jax.random.normal(rate_key, (self.hidden,)),
            jax.random.normal(z_key, (action_size, self.hidden)),
        )


if __name__ == "__main__":
    task = credo.SequenceClassification(depth=3)
    for name, network in {"MMU": credo.MMU(hidden=5), "Leaky": Leaky()}.items():
        algorithm = credo.Neuroevolution.ours(task, network)
        run = credo.train(algorithm, generations=100, path=f"runs/own-network-{name.lower()}")
        print(name, "score of the last champion:", run.metrics["champion_score"][-1])
