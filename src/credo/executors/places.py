"""The places where runs can be trained. Nothing here imports JAX."""

import dataclasses
from typing import Any

from .. import require

KINDS = ("local", "slurm", "ray")
WARNING = "B:USR1@120"  # the signal before the limit of time of Slurm, to the first process alone
OURS = ("array", "job_name")  # options of sbatch that Credo needs to know runs by


@dataclasses.dataclass(frozen=True)
class Place:
    """Where runs are trained, and what is to be known of it. Raises `ValueError` for a place that
    there is not, and for settings that are another place's."""

    on: str = "local"
    """Where to train: local, a process for each run on this machine; slurm, a task of a job array
    for each run; ray, a task of Ray for each run, on this machine; ray:ADDRESS, the same on the Ray
    cluster at HOST:PORT, or with auto on the one that this machine belongs to."""

    submit: bool = False
    """Submit the job array of --on slurm by sbatch. False: write its script, to be looked at and
    submitted by hand."""

    slurm: dict[str, Any] = dataclasses.field(default_factory=dict)
    """NAME=VALUE …: options of sbatch for --on slurm, by their long names, such as
    partition=short time=4:00:00 mem=8G gres=gpu:1. None given: one core for each run, and what the
    cluster has by default."""

    ray: dict[str, Any] = dataclasses.field(default_factory=dict)
    """NAME=VALUE …: what a run on --on ray needs, by the names of Ray, such as num_gpus=1
    num_cpus=4. None given: one core for each run."""

    def __post_init__(self):
        client = self.address.startswith("ray://")
        if self.on not in KINDS and (self.kind != "ray" or client or not self.address):
            raise ValueError(
                f"on is {self.on!r}: runs are trained on {', '.join(KINDS)} or ray:HOST:PORT"
                f"{require.suggestion(self.on, KINDS)}"
                f"{'; on a machine of the cluster give ray:auto' * client}"
            )
        for name, kind in (("submit", "slurm"), ("slurm", "slurm"), ("ray", "ray")):
            if getattr(self, name) and self.kind != kind:
                raise ValueError(f"{name} is for runs on {kind}: give --on {kind} with it")
        self._require_free()
        for name in ("num_cpus", "num_gpus"):
            number = self.ray.get(name, 1)
            if isinstance(number, bool) or not (isinstance(number, int | float) and number >= 0):
                raise ValueError(f"ray sets {name} to {number!r}: it must be a number, at least 0")

    @property
    def kind(self) -> str:
        """The place without its address."""
        return self.on.partition(":")[0]

    @property
    def address(self) -> str:
        """That of a cluster; "" if none is given."""
        return self.on.partition(":")[2]

    def _require_free(self) -> None:
        """Raise if an option of sbatch is one that Credo itself must choose."""
        for name in [name.replace("-", "_") for name in self.slurm]:
            if name in OURS:
                raise ValueError(f"slurm cannot set {name}: Credo knows its runs by it")
        signal = str(self.slurm.get("signal", WARNING))
        if not signal.startswith("B:USR1@"):
            raise ValueError(
                f"slurm sets signal to {signal}: it must be B:USR1@SECONDS, by which a run saves "
                f"before the limit of time ({WARNING} if none is given)"
            )
