"""Flip random bits in every file of a run that a result depends on, and see whether each is named.

    python tests/runs/flips.py --times 600

A flip is `named` if reading the run raises or warns with the file's or the checkpoint's name,
`harmless` if everything that is read is what it was (a space in JSON), and `silent` if a number
changed without a word. There must be none of the last. The clock, events, the lock and pages are
left out: no result depends on them.
"""

import argparse
import hashlib
import pathlib
import random
import tempfile
import warnings
from collections import Counter

import equinox as eqx
import jax
import numpy as np

from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.networks.mmu import MMU
from credo.runner import Runner
from credo.runs import loop
from credo.runs.checkpoint import CheckpointError
from credo.runs.export import export

LEFT_OUT = ("timing.csv", "lock", "tensorboard")
POLICY = "policy.safetensors"


def make(folder: pathlib.Path) -> list[pathlib.Path]:
    """A run with a population and one with a replay buffer."""
    quiet = {"progress": False, "tensorboard": False, "checkpoint_every": 0.0}
    mmu = Neuroevolution(SequenceClassification(depth=3), MMU(hidden=3), population_size=8)
    td3 = OffPolicy(
        Copy(),
        MLP(hidden=(8,)),
        TD3(critic=Critic(hidden=(8,)), batch_size=8),
        start_frames=20,
        replay_capacity=300,
        test_episodes=2,
    )
    runs = [
        loop.train(mmu, generations=6, path=folder / "mmu", **quiet),
        loop.train(td3, frames=200, path=folder / "td3", **quiet),
    ]
    for run in runs:
        export(run, run.path / POLICY)
    return [run.path for run in runs]


def targets(run: pathlib.Path) -> list[pathlib.Path]:
    """Every file that a result depends on."""
    found = sorted(path for path in run.rglob("*") if path.is_file())
    return [path for path in found if not set(path.relative_to(run).parts) & set(LEFT_OUT)]


def numbers(tree) -> str:
    """A hash of all arrays in a tree."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array)):
        key = eqx.is_array(leaf) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        digest.update(np.asarray(jax.random.key_data(leaf) if key else leaf).tobytes())
    return digest.hexdigest()


def read(run: pathlib.Path) -> dict[str, object]:
    """All that a run says, as `report`, `evaluate`, `resume` and a policy's user read it."""
    here = loop.Run(run)
    saved = loop._load(here, loop.fitted(here.algorithm, loop.Budget(**here.config["budget"])))
    runner = Runner.load(run / POLICY)
    obs = np.linspace(-1.0, 1.0, runner.obs_size)
    return {
        "metrics": {name: column.tobytes() for name, column in here.metrics.items()},
        "champion": numbers(here.champion),
        "state": (saved.generation, saved.counters, numbers(saved.state)),
        "action": np.asarray(runner(obs)).tobytes(),
        "record": {k: v for k, v in here.config.items() if k not in ("signature", "sha256")},
    }


def judge(run: pathlib.Path, path: pathlib.Path, right: dict[str, object]) -> str:
    """What became of a flip in `path`."""
    names = (path.name, path.parent.name if path.parent.parent.name == "checkpoints" else path.name)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            found = read(run)
        except (loop.RunError, CheckpointError, ValueError, OSError) as error:
            return "named" if any(name in str(error) for name in names) else f"unnamed: {error}"
    if any(name in str(warning.message) for warning in told for name in names):
        return "named"
    return "harmless" if found == right else "silent"


def flip(path: pathlib.Path, rng: random.Random) -> bytes:
    """Flip one bit; what was there before."""
    before = path.read_bytes()
    after = bytearray(before)
    after[rng.randrange(len(after))] ^= 1 << rng.randrange(8)
    path.write_bytes(after)
    return before


def count(
    folder: pathlib.Path, times: int, seed: int = 0, only: str = ""
) -> dict[str, Counter[str]]:
    """What became of `times` flips in each file with `only` in its name, by that."""
    rng, counts = random.Random(seed), {}
    for run in make(folder):
        right = read(run)
        older = {name.parent for name in targets(run) if name.name == "COMMIT"}
        newest = max(older, key=lambda one: one.name)
        for path in targets(run):
            if path.parent in older - {newest}:
                continue  # an older checkpoint is read only once a newer one is damaged
            name = f"{run.name}/{path.relative_to(run)}"
            if only not in name:
                continue
            counts[name] = Counter()
            for _ in range(times):
                before = flip(path, rng)
                counts[name][judge(run, path, right)] += 1
                path.write_bytes(before)
            print(name, dict(counts[name]), flush=True)
        assert read(run) == right
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--times", type=int, default=600, help="in each file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="files with this in their name")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        counts = count(pathlib.Path(folder), arguments.times, arguments.seed, arguments.only)
    total = sum(counts.values(), Counter())
    print(f"{total.total()} flips in {len(counts)} files: {dict(total)}")
    raise SystemExit(bool(set(total) - {"named", "harmless"}))


if __name__ == "__main__":
    main()
