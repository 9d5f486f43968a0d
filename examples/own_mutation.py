"""A mutation of your own, beside the library's, on the same task and budget.

python examples/own_mutation.py
"""

import jax

import credo
from credo import tree


class Cauchy(credo.AbstractMutation):
    """Add Cauchy noise to every weight: mostly small steps, now and then a huge one."""

    scale: float = 0.05  # half the steps are smaller than this

    def __call__(self, genome, *, key):
        w, unravel, _ = tree.ravel(genome)
        return unravel(w + self.scale * jax.random.cauchy(key, w.shape))


if __name__ == "__main__":
    task, network = credo.SequenceClassification(depth=3), credo.MMU(hidden=5)
    for name, mutation in {"library": credo.MatrixMutation(), "Cauchy": Cauchy()}.items():
        algorithm = credo.Neuroevolution.as_written(task, network, mutation=mutation)
        run = credo.train(algorithm, generations=100, path=f"runs/own-mutation-{name.lower()}")
        print(name, "mean score of the last 20 champions:",
              run.metrics["champion_score"][-20:].mean())  # fmt: skip
