"""`credo train ALGORITHM TASK`."""

import dataclasses
import pathlib
from typing import Any

from .. import require
from ..runs.ending import say
from ..runs.options import RunOptions
from .line import Line
from .names import ALGORITHMS, CATALOGUE, NETWORKS, fail, load


@dataclasses.dataclass
class Train:
    """Train an algorithm of `credo list` on a task: one of `credo list`, an id of Gymnasium such as
    Hopper-v5, a team of PettingZoo such as mpe2.simple_spread_v3, or package.module:name of your
    own."""

    algorithm: str = ""
    task: str = ""
    _: dataclasses.KW_ONLY
    network: str | None = None  # one of `credo list networks`; None: the algorithm's own
    preset: str | None = None  # other settings, of `credo list presets`; None: the published ones
    delayed: bool = False  # pay the whole return of an episode at its last step
    from_: str | None = None  # folder of a run whose policy this one starts from; None: of none
    seed: int = 0  # 0 to 2^32 - 1; everything random follows from it
    seeds: int = 1  # runs, at least 1, with this seed and the next ones; one process per core
    path: str | None = None  # the run's folder; None: runs/ALGORITHM-TASK-SEED
    kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)
    """NAME=VALUE …: what a task of Gymnasium or PettingZoo is made with."""
    rewards: tuple[str, ...] = ()
    """Rewards of the task by name, the first is what training maximises; of a team of PettingZoo
    NAME=MODULE:FUNCTION …, rewards of your own. None given: the task's own."""
    config: str | None = None  # TOML file with any of these settings; what is typed comes first
    save_config: str | None = None  # TOML file to write all settings to; None: none
    print_config: bool = False  # print all settings as TOML and train nothing
    trust: bool = False  # the file of --config names code of others: import it
    options: RunOptions = RunOptions()  # noqa: RUF009

    def __post_init__(self):
        require_seeds(self.seed, max(self.seeds, 1))
        require.at_least("seeds", self.seeds, 1)

    @property
    def entry(self) -> dict[str, Any]:
        """What the catalogue says of the algorithm."""
        return ALGORITHMS[self.algorithm]

    @property
    def example(self) -> tuple[str, str]:
        """A task that the algorithm can learn, and the path of a small one for help."""
        return CATALOGUE["examples"][self.entry.get("learns", "one agent")]

    def __call__(self, line: Line) -> None:
        """Train, or show or write the settings; without a task or algorithm, say what is missing.
        A task that is not ours is checked first."""
        if self.algorithm and self.algorithm not in ALGORITHMS:
            fail(f"no algorithm {self.algorithm!r}", self.algorithm, ALGORITHMS)
        if not (self.task or (line.help and self.algorithm)):
            if self.algorithm and not line.help:
                words = f"{self.algorithm} {self.example[0]}"
                say(f"credo: a task is missing, as in credo train {words}\n")
            line.end()
        algorithm = _algorithm(line, self)
        line.done()
        from . import settings, tasks

        tasks.require_sound(self.task, algorithm.env)
        text = settings.written(self, algorithm)
        if self.save_config:
            pathlib.Path(self.save_config).write_text(text, "utf-8")
        if self.print_config:
            print(text, end="")
        else:
            _start(self, algorithm)


def require_seeds(first: int, number: int = 1) -> None:
    """Raise `ValueError` if one of so many seeds from the first on is not in 0 … 2^32 - 1."""
    if not 0 <= first <= first + number - 1 < 2**32:
        last = f" … {first + number - 1}" if number > 1 else ""
        raise ValueError(f"seed is {first}{last}: a seed must lie in 0 … {2**32 - 1}")


def _algorithm(line: Line, command: Train) -> Any:
    """The algorithm of a task and network, with all that was typed about them. Without a task, as
    help may be asked for, the algorithm is that of a small one, whose own flags are not shown."""
    from . import tasks

    word, learns = command.algorithm, command.entry.get("learns")
    build, fields = _builder(word, command.preset)
    line.reserved |= fields
    line.skipped = {"id"}  # the task is a word
    try:
        if command.task:
            env = line.take(tasks.task(command.task, command.kwargs, command.rewards), "env.")
        else:
            env, line.skipped = load(command.example[1])(), {"env"}
            line.text += f" Flags of a task are shown with it: credo train {word} TASK --help-all."
        if learns == "a team" and env.agents is None:
            fail(
                f"{word} trains teams and {command.task} has one agent: give a team (rover, "
                "simple-spread, mpe2.simple_spread_v3, one of your own), or train erl"
            )
        network = _network(line, command.network or command.entry.get("network"), word, env)
        if command.delayed:
            from ..environments import wrappers

            env = wrappers.delayed(env)
        return line.take(build(env, network))
    except ValueError as error:  # a task and an algorithm that do not go together
        fail(str(error))


def _builder(word: str, preset: str | None) -> tuple[Any, set[str]]:
    """What makes the algorithm of a task and a network, and the names of its fields as flags."""
    entry = ALGORITHMS[word]
    module, _, name = entry["path"].partition(":")
    cls, presets = load(f"{module}:{name.partition('.')[0]}"), entry.get("presets", ())
    if preset and not presets:
        fail(f"{word} has no presets")
    if preset and preset not in presets:
        fail(f"no preset {preset!r} of {word}", preset, presets)
    fields = {f.name.replace("_", "-") for f in dataclasses.fields(cls)}
    return cls.presets()[preset] if preset else load(entry["path"]), fields


def _network(line: Line, name: str | None, algorithm: str, env: Any) -> Any:
    """A network by its word. Each agent of a team has its own; CCEA has them one by one anyway."""
    if name is None:
        return None
    if name not in NETWORKS:
        fail(f"no network {name!r}", name, NETWORKS)
    network = load(NETWORKS[name]["path"])(**NETWORKS[name].get("fields", {}))
    if env.agents is not None and not network.team and algorithm != "ccea":
        from ..networks.team import Team

        network = Team(trunk=(), head=network, sharing="nothing")
    return line.take(network, "network.")


def _start(command: Train, algorithm: Any) -> None:
    """One run here, or several in processes of their own; then how far each came, and whether it
    learned anything by gradient."""
    from ..executors import local
    from ..runs import folder, loop
    from ..runs.store import Run

    number = command.seed if command.seeds == 1 else "seeds"
    path = pathlib.Path(command.path) if command.path else folder.free_name(algorithm, number)
    options, start = command.options, command.from_
    first, late = _warm_up(algorithm)
    if not start and options.frames is not None and options.frames <= first:
        say(f"credo: note: {late}")
    if command.seeds == 1:
        runs = [loop.train(algorithm, options, seed=command.seed, path=path, warm_start=start)]
    else:
        seeds = range(command.seed, command.seed + command.seeds)
        jobs = [local.Job(path / f"seed-{n}", algorithm, n, options, start) for n in seeds]
        local.run(jobs, again="the same command" + f" with --path {path}" * (not command.path))
        runs = [Run(job.path) for job in jobs]
    for run in runs:
        print(run.summary)
        if late and not run.metrics["updates"].any():
            say(f"credo: no gradient update was made in {run.path}: {late}")
    if len(runs) > 1:
        print(f"compare them: credo report {path}/seed-*")


def _warm_up(algorithm: Any) -> tuple[int, str]:
    """The frames before learning by gradient begins, and a line that says so; -1 and "" for an
    algorithm that does not learn so, or from the first frame on."""
    for name in ("start_frames", "warmup_frames"):
        if hasattr(algorithm, name) and getattr(algorithm, "learners", True):
            frames, flag = getattr(algorithm, name), name.replace("_", "-")
            told = f"nothing is learned by gradient in the first {frames:,} frames"
            return frames, f"{told}: give more --frames, or fewer --{flag}"
    return -1, ""
