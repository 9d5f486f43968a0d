"""ERL on the Hopper of Brax with one update per frame: frames per CPU second, beside EvoRL's ERL.

Settings as in `erl_hopper`: population 10 and one learner, 2 × 256 ReLU, batch 256, TD3, one critic
update per frame, no tests. Both play the same simulation, compiled with the policies, and only
frames before the end of an episode count. EvoRL plays on to the time limit of 1,000 steps.

Credo's Python needs Brax; `make test-all` makes an environment that has it.
"""

import time

from . import peers
from .erl_hopper import EPISODES, measure

SECONDS, GOAL = "60", 2.0


def main() -> None:
    try:
        from credo.environments.brax import Brax
    except ModuleNotFoundError as error:
        print(f"  (not measured: {error})")
        return
    began = time.time()
    ours = measure(float(SECONDS), Brax("hopper"))
    rate, length = ours["rate"], ours["length"]
    print(f"  Credo, episodes of {length:.0f} frames: {rate:.0f} frames per CPU second")
    print(f"    {ours['ratio']:.3f} updates per frame; {time.time() - began:.0f} s")
    evorl = peers.ask("evorl", "evorl_erl.py", SECONDS)
    if evorl is not None:
        frames = EPISODES * length
        theirs = frames / (evorl["collect"] + frames * evorl["update"])
        print(f"  EvoRL at that length: {theirs:.0f}; ratio {rate / theirs:.2f} (goal {GOAL})")
        print(
            f"    its own episodes of {evorl['length']:.0f} frames: {evorl['rate']:.0f}; a "
            f"generation plays {evorl['collect']:.2f} CPU s, "
            f"an update takes {1e3 * evorl['update']:.2f} ms"
        )


if __name__ == "__main__":
    main()
