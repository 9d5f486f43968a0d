"""`credo train ALGORITHM TASK`.

A task, a network and an algorithm are made of their words, in this order, and each takes the flags
of its fields before the next is made of it; then one run is trained, or one for each seed.
"""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

from .. import require
from ..executors import Place
from ..runs.ending import say
from ..runs.options import RunOptions
from .line import Line
from .names import ALGORITHMS, CATALOGUE, NETWORKS, fail, load

FEW = 5  # generations


@dataclasses.dataclass
class Train:
    """Train an algorithm of `credo list` on a task: one of `credo list`, an id of Gymnasium such as
    Hopper-v5, a team of PettingZoo such as mpe2.simple_spread_v3, or package.module:name of your
    own."""

    algorithm: str = ""
    task: str = ""
    _: dataclasses.KW_ONLY
    network: str | None = None
    """Network of the policy, one of `credo list networks`; of a team one for each agent. None: the
    algorithm's own."""
    preset: str | None = None
    """Settings to start from, one of `credo list presets`. None: the published ones."""
    delayed: bool = False
    """Pay the whole return of an episode at its last step, and nothing before."""
    hide: str | None = None
    """Entries of an observation that the policy does not see, counted from 0, as in 2,3; or
    velocities, of tasks of which these are known. None: it sees all."""
    last_step: bool = False
    """Observations end with the last action and the last reward, zeros at the start."""
    from_: str | None = None
    """Warm start: the folder of a run whose policy this one starts from. Task and network must have
    the same sizes. None: new weights."""
    seed: int = 0
    """Seed, 0 to 2^32 - 1. Everything random follows from it: on the same machine it gives the
    same run."""
    seeds: int = 1
    """Number of runs, at least 1, with --seed and the seeds after it. Several have a process each,
    one per core at a time, unless --on names another place or --devices a device for each."""
    path: pathlib.Path | None = None
    """Folder of the run, new or empty; of several runs the folder of theirs. None:
    runs/ALGORITHM-TASK-SEED."""
    kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)
    """NAME=VALUE …: what a task of Gymnasium or PettingZoo is made with, such as g=9.8. Values are
    read as Python: 8, 0.5, False, None, (1, 2); anything else is a string."""
    rewards: tuple[str, ...] = ()
    """Rewards of the task by name, the first is what training maximises; of a team of PettingZoo
    NAME=MODULE:FUNCTION …, rewards of your own. None given: the task's own."""
    config: str | None = None
    """TOML file with any of these settings, as --save-config writes them. What is typed overrides
    it."""
    save_config: pathlib.Path | None = None
    """TOML file to write all settings to, for --config. None: no file."""
    print_config: bool = False
    """Print all settings as TOML, and train nothing."""
    trust: bool = False
    """Import the code that the file of --config names. Without this such a file is refused: to
    import a module is to execute it."""
    place: Place = Place()  # noqa: RUF009
    options: RunOptions = RunOptions()  # noqa: RUF009

    def __post_init__(self):
        require_seeds(self.seed, max(self.seeds, 1))
        require.at_least("seeds", self.seeds, 1)

    def __call__(self, line: Line) -> None:
        """Train, or show or write the settings; without a task or algorithm, say what is missing.
        A task that is not ours is checked first."""
        if self.algorithm not in ALGORITHMS and self.task in ALGORITHMS:
            fail(f"the algorithm comes first: credo train {self.task} {self.algorithm}")
        if self.algorithm and self.algorithm not in ALGORITHMS:
            fail(f"no algorithm {self.algorithm!r}", self.algorithm, ALGORITHMS)
        if not (self.task or (line.help and self.algorithm)):
            if self.algorithm and not line.help:
                words = f"{self.algorithm} {_examples(self.algorithm)[0]}"
                say(f"credo: a task is missing, as in credo train {words}\n")
            line.end()
        algorithm = _algorithm(line, self)
        line.done()
        from . import settings, tasks

        tasks.require_sound(self.task, algorithm.env)
        text = settings.written(self, algorithm)
        if self.save_config:
            self.save_config.write_text(text, "utf-8")
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
    """`algorithm_of` the command, which ends if that raises."""
    return or_fail(lambda: algorithm_of(line, command))


def or_fail(make: Callable[[], Any]) -> Any:
    """What `make` makes; the command ends with what it says of values that cannot be."""
    try:
        return make()
    except ValueError as error:
        fail(str(error))


def algorithm_of(line: Line, command: Train) -> Any:
    """The algorithm of a task and network, with all that was typed about them. Raises what they
    raise about their settings, or about one another."""
    word = command.algorithm
    _leave_out(line, command)
    build, fields = _builder(word, command.preset)
    line.reserved |= fields
    env = _task(line, command)
    if command.hide:
        from ..environments.hidden import hidden

        env = hidden(env, command.hide)
    if command.delayed:
        from ..environments import wrappers

        env = wrappers.delayed(env)
    if command.last_step:  # around all else: it tells what was paid, and no more
        from ..environments.last_step import with_last_step

        env = with_last_step(env)
    network = _network(line, command.network or ALGORITHMS[word].get("network"), word, env)
    made = build(env, network)
    # What only a task knows comes first: an algorithm refuses a network that lacks it.
    fitted = line.inside(made.network, "network").fitted(env)
    if fitted != made.network:
        made = dataclasses.replace(made, network=fitted)
    return line.take(made)


def _task(line: Line, command: Train) -> Any:
    """The task, with its flags. Where none is named, as help may be asked for without, it is a
    small one whose flags are not shown."""
    from . import tasks

    word = command.algorithm
    if not command.task:
        line.skipped = {"env"}
        line.text += f" Flags of a task are shown with it: credo train {word} TASK --help-all."
        return load(_examples(word)[1])()
    line.skipped = {"id"}  # the task is a word
    env = line.take(tasks.task(command.task, command.kwargs, command.rewards), "env.")
    if ALGORITHMS[word].get("learns") == "a team" and env.agents is None:
        fail(
            f"{word} trains teams and {command.task} has one agent: give a team (rover, "
            "simple-spread, mpe2.simple_spread_v3, one of your own), or train erl"
        )
    return env


def _examples(word: str) -> tuple[str, str]:
    """The name of a task that an algorithm can learn, and where a small one for help is."""
    return CATALOGUE["examples"][ALGORITHMS[word].get("learns", "one agent")]


def _leave_out(line: Line, command: Train) -> None:
    """Flags of the command that the algorithm has no use for: no help shows them, and who gives one
    is told why."""
    word, entry = command.algorithm, ALGORITHMS[command.algorithm]
    without = {}
    if not entry.get("presets"):
        without["preset"] = f"{word} has no presets"
    if own := entry.get("topology"):
        without["network"] = f"{word} {own}, so that no --network can be given"
    if not hasattr(_class(word), "warm"):
        able = ", ".join(other for other in ALGORITHMS if hasattr(_class(other), "warm"))
        without["from_"] = f"{word} cannot start from another run's champion: {able} can"
    for name, why in without.items():
        if getattr(command, name) is not None:
            fail(why)
        line.flags.pop(name, None)


def _class(word: str) -> type:
    """Of an algorithm."""
    module, _, name = ALGORITHMS[word]["path"].partition(":")
    return load(f"{module}:{name.partition('.')[0]}")


def _builder(word: str, preset: str | None) -> tuple[Any, set[str]]:
    """What makes the algorithm of a task and a network, and the names of its fields as flags."""
    entry = ALGORITHMS[word]
    cls, presets = _class(word), entry.get("presets", ())
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
    fields = NETWORKS[name].get("fields", {})
    if ALGORITHMS[algorithm].get("gradient"):
        fields = fields | NETWORKS[name].get("gradient", {})
    network = load(NETWORKS[name]["path"])(**fields)
    if env.agents is not None and not network.team and algorithm != "ccea":
        from ..networks.team import Team

        network = Team(trunk=(), head=network, sharing="nothing")
    network = line.take(network, "network.").fitted(env)
    if algorithm == "ccea":
        return network
    from ..networks.choosing import choosing

    return choosing(env, network)


def _start(command: Train, algorithm: Any) -> None:
    """One run here, or several in processes of their own, or any number elsewhere; then how far
    each came, and whether it learned anything by gradient."""
    from .. import executors
    from ..runs import folder, loop
    from ..runs.budget import Budget
    from ..runs.store import Run

    number = command.seed if command.seeds == 1 else "seeds"
    path = command.path or folder.free_name(algorithm, number)
    options, start = command.options, command.from_
    or_fail(lambda: Budget.of(algorithm, options).require_task(algorithm))
    first, late = _warm_up(algorithm)
    if not start and options.frames is not None and options.frames <= first:
        say(f"credo: note: {late}")
    _note_few(algorithm, options)
    if command.seeds == 1 and command.place.on == "local":
        runs = [loop.train(algorithm, options, seed=command.seed, path=path, warm_start=start)]
    else:
        seeds = range(command.seed, command.seed + command.seeds)
        paths = [path / f"seed-{n}" if len(seeds) > 1 else path for n in seeds]
        jobs = [
            executors.Job(at, algorithm, n, options, start)
            for at, n in zip(paths, seeds, strict=True)
        ]
        again = "the same command" + f" with --path {path}" * (not command.path)
        executors.run(jobs, on=command.place, again=again)
        runs = [Run(job.path) for job in jobs]
    for run in runs:
        print(run.summary)
        if late and not run.metrics["updates"].any():
            say(f"credo: no gradient update was made in {run.path}: {late}")
        elif told := _without_injection(algorithm, run) or _bits_alone(algorithm, run):
            say(f"credo: {told}")
    if len(runs) > 1:
        print(f"compare them: credo report {path}/seed-*")


def _note_few(algorithm: Any, options: RunOptions) -> None:
    """Say so if a budget in frames may be used up within a few generations of a population."""
    most, size = getattr(algorithm, "most_frames", None), getattr(algorithm, "population_size", 0)
    if options.frames and most and size and options.frames < FEW * most:
        least = -(-options.frames // most)
        say(
            f"credo: note: a generation takes up to {most:,} frames, so this run may have "
            f"{'one generation' if least == 1 else f'{least} generations'} only: give more --frames"
        )
    often = getattr(algorithm, "test_every", 0)  # of who has no population in frames
    if options.frames and often and not size and options.frames < often:
        say(
            f"credo: note: tests come every {often:,} frames: a run of {options.frames:,} has one, "
            f"after its first generation; give --test-every {max(1, options.frames // 5)}, say"
        )


def _without_injection(algorithm: Any, run: Any) -> str:
    """What to know of a hybrid whose learners never joined its population; "" of any other run."""
    for name in ("sync_period", "migration_period"):
        period, done = getattr(algorithm, name, 0), int(run.metrics["generation"][-1])
        if getattr(algorithm, "learners", ()) and done <= period:
            often = "generation" if period == 1 else f"{period} generations"
            less = "" if period == 1 else f", or fewer --{name.replace('_', '-')}"
            return (
                f"{run.path} is evolution alone: its learners join the population every {often}, "
                f"and it made {done}: give more --frames{less}"
            )
    return ""


def _bits_alone(algorithm: Any, run: Any) -> str:
    """What to know of a run that ended within the generations of its `infomax`; "" of any other."""
    infomax, done = getattr(algorithm, "infomax", None), int(run.metrics["generation"][-1])
    if infomax is None or done > infomax.generations:
        return ""
    return (
        f"{run.path} was evolved for what its memory knows alone, and not for its task: that "
        f"begins after {infomax.generations} generations, and it made {done}: give more "
        "--generations, or fewer --infomax.generations"
    )


def _warm_up(algorithm: Any) -> tuple[int, str]:
    """The frames before learning by gradient begins, and a line that says so; -1 and "" for an
    algorithm that does not learn so, or from the first frame on."""
    for name in ("start_frames", "warmup_frames"):
        if hasattr(algorithm, name) and getattr(algorithm, "learners", True):
            frames, flag = getattr(algorithm, name), name.replace("_", "-")
            told = f"learning by gradient begins with the generation after {frames:,} frames"
            return frames, f"{told}: give more --frames, or fewer --{flag}"
    return -1, ""
