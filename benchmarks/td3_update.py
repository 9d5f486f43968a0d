"""TD3 updates per second of one core: 2 × 256 units, batch 256, a HalfCheetah's sizes.

Beside the machine's own matrix products, eager PyTorch and SBX; and four learners of a portfolio
against one at a time.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from credo.learners.base import learn
from credo.learners.td3 import TD3, TD3_NETWORK
from credo.replay import Replay, extend
from credo.types import Transition

from . import peers

OBS, ACT, WIDTH, BATCH, ROWS, UPDATES, ROUNDS, GOAL = 17, 6, 256, 256, 20_000, 200, 9, 0.7
SECONDS = "5"


def operations() -> float:
    """Floating point operations of one update's matrix products, the actor's every second time."""
    actor = [OBS * WIDTH, WIDTH * WIDTH, WIDTH * ACT]
    critic = [(OBS + ACT) * WIDTH, WIDTH * WIDTH, WIDTH]
    forward, weights = 2.0, 2.0  # a multiplication and an addition per weight and sample
    target = forward * (sum(actor) + 2 * sum(critic))
    # Back: the gradient of every weight, and of the input of every layer but the first.
    learn_critics = 2 * ((forward + weights) * sum(critic) + 2.0 * sum(critic[1:]))
    learn_actor = (forward + weights) * sum(actor) + 2.0 * sum(actor[1:])
    learn_actor += (forward + 2.0) * sum(critic)
    return BATCH * (target + learn_critics + learn_actor / 2)


def filled() -> Replay:
    rng = np.random.default_rng(0)
    obs, next_obs = (rng.normal(size=(ROWS, OBS)).astype(np.float32) for _ in range(2))
    action = rng.uniform(-1, 1, (ROWS, ACT)).astype(np.float32)
    rewards = {"reward": rng.normal(size=ROWS).astype(np.float32)}
    rows = Transition(obs, action, rewards, next_obs, *np.zeros((2, ROWS), bool))
    row = jax.tree.map(lambda x: jnp.asarray(x[0]), rows)
    return extend(Replay.empty(row, ROWS), rows)


def seconds(run) -> float:
    """Of this process on its core: others may use the machine too."""
    began = time.process_time()
    jax.block_until_ready(run())
    return time.process_time() - began


def main() -> None:
    replay = filled()
    learners = [TD3(gamma=γ) for γ in (0.9, 0.99, 0.997, 0.9995)]
    states = [
        learner.init(TD3_NETWORK, OBS, ACT, key=jax.random.key(i))
        for i, learner in enumerate(learners)
    ]

    def update(i):
        return learn(
            learners[i],
            states[i],
            replay,
            jnp.int32(UPDATES),
            signal="reward",
            key=jax.random.key(i),
        )

    a = jnp.asarray(np.random.default_rng(1).normal(size=(512, 512)), jnp.float32)
    products = jax.jit(lambda a: jax.lax.fori_loop(0, 30, lambda i, x: 0.04 * (a @ x), a))
    everything = {
        "one": lambda: update(1),
        "four": lambda: [update(i) for i in range(4)],
        "product": lambda: products(a),
    }
    times = {name: [] for name in everything}
    for run in everything.values():
        run()
    for _ in range(ROUNDS):
        for name, run in everything.items():
            times[name].append(seconds(run))
    one, four, product = (np.array(times[name]) for name in everything)
    rate = UPDATES / np.median(one)
    peak = 30 * 2 * 512**3 / product
    share = np.median(operations() * UPDATES / one / peak)
    print("TD3 updates, 2 × 256 units, batch 256, one core")
    print(f"  {'Credo':<34}{rate:8.0f} updates per CPU second")
    print(f"  {'matrix products of the machine':<34}{np.median(peak) / 1e9:8.0f} GFLOP/s")
    print(f"  {'share of them in an update':<34}{100 * share:8.0f} %   goal {100 * GOAL:.0f} %")
    print(f"  {'four learners against one, per update':<34}{np.median(four / one) / 4:8.2f}")
    for peer, script in (("torch", "torch_td3.py"), ("sbx", "sbx_td3.py")):
        answer = peers.ask(peer, script, "update", SECONDS)
        if answer:
            theirs = answer["update"]
            print(f"  {peer:<34}{theirs:8.0f} updates per CPU second: {rate / theirs:.1f} ×")


if __name__ == "__main__":
    main()
