"""What is played and trained on one to eight devices, as JSON: for a process of its own, since JAX
reads how many there are when it starts."""

import functools
import hashlib
import json
import os
import pathlib
import signal
import sys
import threading
import time

import equinox as eqx
import jax
import numpy as np
from compilations import compilations

import credo
from credo import compilation, executors, rollout
from credo.algorithms.erl import ERL
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.simple_spread import SimpleSpread
from credo.environments.wrappers import Given
from credo.executors import Job
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.networks.mmu import MMU
from credo.networks.team import Team
from credo.playing import devices
from credo.runs import config
from credo.runs.loop import Interrupted

FILES = ("metrics.csv", "champion.safetensors", "best.safetensors")
SEQUENCES = SequenceClassification(depth=3, min_gap=1, max_gap=3)
QUIET = {"progress": False, "tensorboard": False, "checkpoint_every": 0.0}
EVOLUTION = {"elite_fraction": 0.2, "episodes": 2, "test_episodes": 3}
LEARNER = TD3(critic=Critic(hidden=(8,)), batch_size=16)
LEARN = {"replay_capacity": 500, "warmup_frames": 10, "updates_per_frame": 0.2, "sync_period": 1}
ALGORITHMS = {
    "sequences": Neuroevolution.ours(SEQUENCES, MMU(hidden=3), population_size=10, **EVOLUTION),
    "team": Neuroevolution(SimpleSpread(), Team(trunk=(4,)), population_size=5, episodes=2),
    "learner": ERL.erl(
        *(Copy(), MLP(hidden=(4,))), learners=(LEARNER,), population_size=10, **EVOLUTION | LEARN
    ),
}
NUMBERS = {"sequences": 8, "team": 3, "learner": 2}


def population(env, network, n):
    return eqx.filter_vmap(lambda key: network.init(*env.sizes, key=key))(
        jax.random.split(jax.random.key(0), n)
    )


def played(env, network, n, number, **how):
    """Arrays of `evaluate` and `collect`, on so many devices."""
    members, key = population(env, network, n), jax.random.key(1)
    with devices.using(number):
        found = rollout.evaluate(env, members, 4, key=key, **how)
        told, kept = rollout.collect(env, members, 4, wanted=3, key=key, **how)
    found, told, kept = jax.tree.map(np.asarray, (found, told, kept))
    # Behind an episode's end there is what its device still played until the last one ended there.
    lived = jax.tree.map(lambda x: x[kept.valid], kept.transitions)
    return found, told, kept.valid, lived


def apart(one, other) -> float:
    """The largest difference; 0.0 is the same bits, of NaN too."""
    pairs = list(zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))
    assert all(a.shape == b.shape and a.dtype == b.dtype for a, b in pairs)
    if all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs):
        return 0.0
    return max(float(np.max(np.abs(a.astype(float) - b.astype(float)))) for a, b in pairs)


def rollouts():
    """How far episodes on several devices are from those on one."""
    found = {}
    for name, env, network in (
        ("sequences", SEQUENCES, MMU(hidden=3)),
        ("steps", Copy(), MLP(hidden=(4,))),
    ):
        for n, number in ((5, 3), (16, 8)):
            for common in (True, False):
                one = played(env, network, n, None, common=common)
                more = played(env, network, n, number, common=common)
                found[f"{name} {n} {'common' if common else 'own'}"] = apart(one, more)
    return found


def given():
    """The same for sequences that are given."""
    keys = jax.random.split(jax.random.key(2), 6)
    env = Given(SEQUENCES, eqx.filter_vmap(lambda key: SEQUENCES.sample(key=key))(keys))
    members, key = population(SEQUENCES, MMU(hidden=3), 7), jax.random.key(1)
    one = rollout.evaluate(env, members, 6, key=key)
    with devices.using(3):
        return apart(*(jax.tree.map(np.asarray, (one, rollout.evaluate(env, members, 6, key=key)))))


def shares():
    """How many members each device has, and what they are."""
    seen = []

    @functools.partial(jax.jit, static_argnums=0)
    @devices.shared
    def twice(task, members):
        seen.append(len(members))
        return 2 * members, jax.numpy.repeat(members, 3)

    found = []
    for n in (2, 3, 16, 17):
        with devices.using(8):
            doubled, rows = twice(None, np.arange(n) + jax.numpy.int32(0))
        assert doubled.tolist() == [2 * i for i in range(n)]
        assert rows.tolist() == [i for i in range(n) for _ in range(3)]
        found.append((n, seen[-1], len(doubled.sharding.device_set)))
    return found


def trained(name, path, number, generations=6):
    """Hashes of a run's files, and how many programs were compiled, or loaded, by the end of each
    generation."""
    counts = []
    with compilations() as events:
        run = credo.train(
            *(ALGORITHMS[name], credo.RunOptions(**QUIET)),
            generations=generations,
            devices=number,
            path=path,
            callbacks=(lambda run, generation, metrics: counts.append(len(events)),),
        )
    return hashes(run), counts


def hashes(run):
    return [hashlib.sha256((run.path / name).read_bytes()).hexdigest() for name in FILES]


def runs(folder: pathlib.Path):
    return {
        f"{name} {which}": trained(name, folder / f"{name}-{which}", number)
        for name, many in NUMBERS.items()
        for which, number in (("on one", None), ("on many", many))
    }


def resumed(folder: pathlib.Path):
    """Two generations each on eight devices, on one and on eight."""
    trained("sequences", folder / "on", 8, 2)
    credo.resume(folder / "on", generations=4, **QUIET)
    return hashes(credo.resume(folder / "on", generations=6, devices=8, **QUIET))


LONG = 2_000  # generations, of which a signal comes in the first: nobody is done by then


def seeds(folder: pathlib.Path):
    """Three seeds on two devices, and one of a task that cannot be, stopped by a signal and gone on
    with; and what became of them, with a run of each alone."""
    made, broken = ALGORITHMS["sequences"], config.to_tree(ALGORITHMS["sequences"])
    broken["env"] = broken["env"] | {"depth": 0}
    options = credo.RunOptions(generations=LONG, devices=2, tensorboard=False)
    jobs = [Job(folder / f"seed-{n}", made, n, options) for n in range(3)]
    jobs.insert(1, Job(folder / "broken", broken, 0, options))
    codes = []

    def stop():
        while not (folder / "seed-0" / "metrics.csv").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=stop, daemon=True).start()
    try:
        executors.run(jobs)
    except Interrupted as error:
        codes.append(error.code)
    left = [job.finished() for job in jobs]
    try:
        executors.run(jobs)
    except executors.RunsFailed as error:
        codes.append(str(error).replace(str(folder), ""))
    alone = [
        credo.train(made, generations=LONG, seed=n, path=folder / f"alone-{n}", **QUIET)
        for n in (0, 2)
    ]
    together = [credo.Run(folder / f"seed-{n}") for n in (0, 2)]
    same = [hashes(one) == hashes(other) for one, other in zip(alone, together, strict=True)]
    return {"codes": codes, "left": left, "same": same, "done": [job.finished() for job in jobs]}


def every(folder: pathlib.Path):
    """Metrics of three generations of every algorithm, on one device and on two."""
    from test_flags import MAKE, rows

    quiet = {"devices": 2, "generations": 3, "progress": False, "tensorboard": False, "seed": 3}
    found = {}
    for name, make in MAKE.items():
        run = credo.train(make(), path=folder / f"{name}-2", **quiet)
        found[name] = rows(name, folder / name), (run.path / "metrics.csv").read_text()
    return found


def main(folder: pathlib.Path, all_algorithms: bool) -> None:
    compilation.enable_cache()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")
    if all_algorithms:
        print(json.dumps(every(folder)))
        return
    found = {"rollouts": rollouts(), "given": given(), "shares": shares(), "runs": runs(folder)}
    print(json.dumps(found | {"resumed": resumed(folder), "seeds": seeds(folder)}))


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), "every" in sys.argv[2:])
