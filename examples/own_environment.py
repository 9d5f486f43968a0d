"""A sequence task of your own, trained in a minute.

    python examples/own_environment.py

or, from the folder of this file:

    credo check own_environment:SameAsFirst
    credo train neuroevolution own_environment:SameAsFirst --preset ours --generations 150
"""

import equinox as eqx
import jax
import jax.numpy as jnp

import credo


class SameAsFirst(credo.AbstractSequenceTask):
    """A cue ±1, a wait, then a probe ±1: answer +1 if both are the same, -1 if not."""

    longest_wait: int = eqx.field(static=True, default=8)  # zeros between cue and probe

    @property
    def obs_size(self) -> int:  # numbers per step
        return 1

    @property
    def max_steps(self) -> int:  # no sequence is longer
        return self.longest_wait + 2

    def sample(self, *, key) -> credo.Sequence:
        """One sequence, padded to `max_steps`. All randomness comes from `key`."""
        signal_key, wait_key = jax.random.split(key)
        cue, probe = jax.random.rademacher(signal_key, (2,), jnp.float32)
        wait = jax.random.randint(wait_key, (), 0, self.longest_wait + 1)
        step = jnp.arange(self.max_steps)
        inputs = jnp.where(step == 0, cue, jnp.where(step == wait + 1, probe, 0.0))
        return credo.Sequence(
            inputs=inputs[:, None],  # [time, obs_size]
            targets=jnp.full(self.max_steps, cue * probe),  # above 0: the answer is +1
            scored=step == wait + 1,  # where the answer counts
            length=wait + 2,  # what comes after is padding
        )

    def reward(self, answer, target, scored, perfect):
        """What one answer in [-1, 1] earns; their sum over a sequence is the fitness."""
        return jnp.where(scored, answer * target, 0.0)


if __name__ == "__main__":
    task = SameAsFirst()
    print("problems found:", credo.check_environment(task))
    algorithm = credo.Neuroevolution.ours(task, credo.MMU(hidden=5))
    run = credo.train(algorithm, generations=150, path="runs/same-as-first")
    print("share of right answers, last generation:", run.metrics["champion_score"][-1])
    policy = run.policy()
    answers = [float(policy([x])[0]) for x in (1.0, 0.0, 0.0, 1.0)]
    print("cue +1, two zeros, probe +1:", answers[-1], "(right if 0 or more)")
