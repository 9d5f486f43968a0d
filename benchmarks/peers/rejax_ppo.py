"""PPO of rejax on a task of gymnax: environment frames per CPU second.

Run by the benchmarks in an environment that has rejax: `python rejax_ppo.py ROUNDS`; prints a JSON
line. Sizes are those of `benchmarks/ppo_jax.py`. All rounds are one compiled program; its second
call is measured.
"""

import json
import sys
import time

import jax
import rejax

COPIES, STEPS, BATCH, EPOCHS = 32, 200, 64, 10

if __name__ == "__main__":
    frames = int(sys.argv[1]) * COPIES * STEPS
    algorithm = rejax.PPO.create(
        env="Pendulum-v1",
        agent_kwargs={"activation": "tanh", "hidden_layer_sizes": (64, 64)},
        num_envs=COPIES,
        num_steps=STEPS,
        num_minibatches=COPIES * STEPS // BATCH,
        num_epochs=EPOCHS,
        total_timesteps=frames,
        eval_freq=frames,
        skip_initial_evaluation=True,
    )
    algorithm = algorithm.replace(eval_callback=lambda *_: ())
    train = jax.jit(algorithm.train)
    jax.block_until_ready(train(jax.random.PRNGKey(0)))
    began = time.process_time()
    jax.block_until_ready(train(jax.random.PRNGKey(1)))
    print(json.dumps({"frames_per_second": frames / (time.process_time() - began)}))
