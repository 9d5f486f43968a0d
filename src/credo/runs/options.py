"""How a run is run: its budget, what it writes and who listens. Declared here and nowhere else."""

import dataclasses
import math
from typing import Any, Literal

from .. import require

LARGEST = 2**63 - 1


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Everything about a run that changes no bit of a generation.

    The same record serves Python, the command line, the processes of several runs and
    `config.json`. Raises `ValueError` for a value outside its range.
    """

    generations: int | None = None
    """Budget in generations, at least 1: the run ends after this one. None: no such limit; with
    neither a limit of generations nor one of frames, the algorithm's own budget, or 1000
    generations."""

    frames: int | None = None
    """Budget in environment steps of everything that plays, at least 1, such as 1e6: the run ends
    after the first generation that reaches it. None: no such limit."""

    stop_at: float | None = None
    """Champion score, in the task's own units, at which the run ends early. None: never."""

    wall_clock: float | None = None
    """Seconds of training after which to save and end, at least 0. None: no limit."""

    processes: int | None = None
    """Processes that play episodes of tasks outside JAX at the same time, at least 1; None: one for
    each core, once this one has played for two seconds. Their number changes no number of a run."""

    rollouts: str = "local"
    """Where these processes are: local, on this machine; ray, tasks of Ray on this machine;
    ray:ADDRESS, tasks of the Ray cluster at HOST:PORT, or with auto of the one that this machine
    belongs to. It changes no number of a run."""

    devices: int | None = None
    """Devices of this machine that share out the episodes of tasks in JAX, by members of the
    population, at least 1; of several runs each is trained on one of them. None: one. Their number
    changes a run by rounding at most (docs, GPUs and several devices)."""

    checkpoint_every: float = 60.0
    """Seconds between two checkpoints, at least 0; 0: after every dispatch."""

    keep: int = 3
    """Checkpoints that stay on disk, at least 1; 2 or more hold two copies of a replay buffer."""

    tensorboard: bool = True
    """Whether to write TensorBoard events, into `tensorboard/` of the run's folder."""

    loggers: tuple[Literal["wandb", "trackio"], ...] = ()
    """Experiment trackers that get every metric: wandb, trackio. Each is a package of its own:
    `pip install wandb`."""

    progress: bool = True
    """Whether to show a progress bar, or a line every ten seconds where there is no terminal."""

    callbacks: tuple[Any, ...] = ()
    """Objects that hear of every generation, test and end (see `credo.Callback`); a plain function
    `f(run, generation, metrics)` stands for `on_generation`. From Python alone: they are neither
    recorded nor sent to the processes of several runs."""

    def __post_init__(self):
        for name in ("generations", "frames"):
            value = getattr(self, name)
            if value is not None:
                require.within(name, value, 1, LARGEST)
                object.__setattr__(self, name, int(value))  # 1e6 is what people write
        for name in ("wall_clock", "checkpoint_every"):
            require.at_least(name, getattr(self, name), 0)
        if self.stop_at is not None and math.isnan(self.stop_at):
            raise ValueError("stop_at is nan: give a champion score, or None to stop at none")
        for name in ("keep", "processes", "devices"):
            require.at_least(name, getattr(self, name), 1)
        kind, colon, address = self.rollouts.partition(":")
        known = kind == "ray" and bool(colon) == bool(address) and not address.startswith("//")
        if not known and self.rollouts != "local":
            raise ValueError(
                f"rollouts is {self.rollouts!r}: episodes are played on local, ray, ray:auto or "
                "ray:HOST:PORT"
            )
        object.__setattr__(self, "callbacks", tuple(self.callbacks))
        object.__setattr__(self, "loggers", tuple(self.loggers))
        for name in self.loggers:
            require.choice("loggers", name, ("wandb", "trackio"))

    def changed(self, changes: dict[str, Any]) -> "RunOptions":
        """These options with other values. Raises `TypeError` for an unknown name."""
        known = [field.name for field in dataclasses.fields(self)]
        for name in changes:
            if name not in known:
                raise TypeError(f"a run has no option {name!r}{require.suggestion(name, known)}")
        return dataclasses.replace(self, **changes)

    def record(self) -> dict[str, Any]:
        """As JSON, for `config.json` and other processes: all but this process's screen and
        callbacks."""
        told = vars(self) | {"loggers": list(self.loggers)}
        return {
            name: value for name, value in told.items() if name not in ("progress", "callbacks")
        }

    @classmethod
    def read(cls, record: dict[str, Any]) -> "RunOptions":
        """The options of a process that has no screen, from what `record` said."""
        return cls(**record, progress=False)
