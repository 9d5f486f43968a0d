"""A run on disk: what it says of itself, its metrics, and its policies."""

import contextlib
import copy
import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from .. import compilation
from ..environments.host import EnvironmentFailure
from ..replay import shapes_alone
from . import checkpoint, config, log, policy, record
from .policy import Policy
from .progress import best_of
from .record import RunError
from .trust import signed_here

CHAMPION, BEST = "champion.safetensors", "best.safetensors"


class Run:
    """A run on disk, finished or not. Reading it changes nothing.

    `path`: its folder. `config`: its record (see `record`), checked and whole. `trusted`: whether
    code of others that it names may be imported.
    """

    def __init__(self, path: str | pathlib.Path, *, trust: bool = False, best: bool = False):
        """`trust`: whether classes and environments of others may be imported that a run
        names which this user did not make. `best`: show the best policy wherever the champion is
        meant. Raises `RunError`."""
        self.path, self._shown = pathlib.Path(path), BEST if best else CHAMPION
        self.config = record.read(self.path)
        self.trusted = trust or signed_here(self.config)

    @property
    def algorithm(self) -> Any:
        """What was recorded, as an object. A team outside JAX is opened for it, no other task."""
        tree = self.config["algorithm"]
        with self.found():
            return config.from_tree(tree, trust=self.trusted, source=str(self.path))

    def part(self, name: str) -> Any:
        """A field of the recorded algorithm as an object (its `env`, `network`, `learners`), made
        of Credo's own classes; None if code of others would have to be imported for it. It
        opens no environment."""
        try:
            return config.from_tree(self.config["algorithm"].get(name), trust=False)
        except ValueError:
            return None

    @property
    def metrics(self) -> dict[str, np.ndarray]:
        """Columns of `metrics.csv`, one entry per generation. Raises `RunError` if it is not what
        the newest checkpoint says it was."""
        self._verify_metrics()
        return log.read(self.path / "metrics.csv")

    @property
    def summary(self) -> str:
        """How far it came, in a line."""
        columns, settings = self.metrics, self.config["algorithm"]
        row = {name: column[-1] for name, column in columns.items()}
        best, value = best_of(row)
        when = _last_test(columns, settings)
        episodes = settings.get("test_episodes")
        when += f" on {episodes} fresh episodes" if episodes is not None else ""
        return (
            f"{self.path}: generation {int(row['generation'])}, {best} {value:.4g}, champion score "
            f"{row['champion_score']:.4g}{when}"
        )

    @property
    @compilation.float32()
    def champion(self) -> PyTree:
        """The policy with the highest fitness of the last generation; of a learner alone, its
        actor. Raises `RunError` if it is another run's, or if the task has other sizes today."""
        algorithm = self.algorithm
        with self.found(), shapes_alone():
            record.check_task(self.config, algorithm.env)
            like = eqx.filter_eval_shape(algorithm.init, key=jax.random.key(0)).champion
        return self.restored(like)

    @property
    def best(self) -> PyTree:
        """The champion with the highest test score of all generations; of equal ones the first.
        Its score is that of one test, so it flatters: evaluate it on fresh episodes. Raises as
        `champion` does, and `RunError` if there is none yet."""
        return self._showing_best().champion

    @property
    def best_test(self) -> tuple[int, float]:
        """The generation of the best policy, and its score in that generation's test."""
        metadata = self._showing_best()._metadata()
        return int(metadata["generation"]), float(metadata["score"])

    def _showing_best(self) -> "Run":
        run = copy.copy(self)
        run._shown = BEST
        return run

    def restored(self, like: PyTree) -> PyTree:
        """The champion, of which `like` has the structure. Raises as `champion` does."""
        self._metadata()
        return checkpoint.import_policy(self.path / self._shown, like)

    def policy(self, raw: bool = False, *, best: bool = False) -> Policy:
        """The champion as a plain callable, in the task's own units; `raw`: in [-1, 1]; `best`: the
        best policy in its place."""
        run = self._showing_best() if best else self
        task = run.config.get("task") if raw else policy.task_of(run)
        return Policy(policy.champion(run), task, raw=raw)

    @property
    def advice(self) -> str:
        """How to go on with this run, as a part of a sentence."""
        if self.config.get("resumable", True):
            return f"`credo resume {self.path}`"
        return f"credo.resume({str(self.path)!r}) in this process, which alone knows its classes"

    @contextlib.contextmanager
    def found(self) -> Iterator[None]:
        """Say where a run began if what it names cannot be found from here."""
        try:
            yield
        except (config.NotFound, EnvironmentFailure) as error:
            home = record.home(self.config)
            if not home:
                raise
            raise RunError(f"{str(error).rstrip('.')}{home}") from error

    def differs(self, sealed: Any) -> str | None:
        """How metrics.csv differs from what a checkpoint sealed, in words."""
        try:
            log.verify(self.path, sealed)
        except (ValueError, KeyError, TypeError) as error:
            return str(error)
        return None

    def _metadata(self) -> dict[str, str]:
        """What a policy's file says of itself. Raises `RunError` if it is another run's."""
        path = self.path / self._shown
        if self._shown == BEST and not path.exists():
            raise RunError(
                f"{path} is not there: no policy was tested since this run began to keep it"
            )
        metadata = checkpoint.read_metadata(path)
        if why := record.stranger(self.config, _json(metadata.get("record"))):
            before = _json(metadata.get("algorithm"))
            lines = config.differences(before, self.config["algorithm"])
            told = f" ({'; '.join(lines[:3])})" if lines else ""
            what = "champion" if self._shown == CHAMPION else "best policy"
            raise RunError(
                f"{path} is not this run's {what}: {why}{told}; {self.advice} writes it again, or "
                "restore it from a copy"
            )
        return metadata

    def _verify_metrics(self) -> None:
        """Raise `RunError` if metrics.csv is not what the newest intact checkpoint says it was."""
        for folder in sorted((self.path / "checkpoints").glob("[0-9]*"), reverse=True):
            seals = checkpoint.seals_of(folder)
            if "metrics" not in seals:
                continue  # damaged, or written by an older version
            why = self.differs(seals["metrics"])
            if why is None:
                return
            ours = record.stranger(self.config, seals.get("record")) is None
            if ours and checkpoint.damage(folder) is None:
                raise RunError(
                    f"{why}; `credo resume` goes on from the newest checkpoint it agrees with"
                )


def _json(text: str | None) -> Any:
    try:
        return json.loads(text or "null")
    except ValueError:
        return None


def _last_test(columns: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """When the score at hand was found, where that was not in the last generation: the champion may
    have learned since. Populations are tested every so many generations, learners alone frames."""
    every = settings.get("test_every", 1)
    if every <= 1:
        return ""
    if "population_size" in settings:
        due = (columns["generation"] - 1) % every == 0
    else:
        due = np.diff(columns["frames"] // every, prepend=-1) > 0
    last = int(np.flatnonzero(due)[-1]) if due.any() else 0
    if last == len(due) - 1:
        return ""
    if "frames" in columns:
        return f" at the last test, after {int(columns['frames'][last]):,} frames,"
    return f" at the last test, after generation {int(columns['generation'][last])},"
