"""`credo train ALGORITHM TASK`."""

import dataclasses
import pathlib
from typing import Any

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
        if not 0 <= self.seed <= self.seed + max(self.seeds, 1) - 1 < 2**32:
            last = f" … {self.seed + self.seeds - 1}" if self.seeds > 1 else ""
            raise ValueError(f"seed is {self.seed}{last}: a seed must lie in 0 … {2**32 - 1}")
        if self.seeds < 1:
            raise ValueError(f"seeds is {self.seeds}: it must be at least 1")


def run(line: Line) -> None:
    """Train, or say with which flags."""
    if files := [values for name, values in line.given if name == "config" and values]:
        from . import settings

        said = [values for name, values in line.given if name == "trust"]
        trust = bool(said) and said[-1][:1] in ([], ["True"], ["true"])
        line.filed = settings.read(files[-1][0], trust=trust)
        saved = dict(line.filed)
        words = [*saved.get("algorithm", []), *saved.get("task", [])]
        line.words, line.used = line.words + words[len(line.words) :], {"algorithm", "task"}
    command = line.command(Train)
    if command.algorithm and command.algorithm not in ALGORITHMS:
        fail(f"no algorithm {command.algorithm!r}", command.algorithm, ALGORITHMS)
    if not (command.task or (line.help and command.algorithm)):
        if command.algorithm and not line.help:
            tasks = {"a team": "rover", "labelled sequences": "sequence-recall"}
            task = tasks.get(ALGORITHMS[command.algorithm].get("learns", ""), "Hopper-v5")
            say(f"credo: a task is missing, as in credo train {command.algorithm} {task}\n")
        line.end()
    algorithm = _algorithm(line, command)
    line.done()
    from . import settings, tasks

    tasks.require_sound(command.task, algorithm.env)
    text = settings.written(command, algorithm)
    if command.save_config:
        pathlib.Path(command.save_config).write_text(text, "utf-8")
    if command.print_config:
        print(text, end="")
    else:
        _start(command, algorithm)


def _algorithm(line: Line, command: Train) -> Any:
    """The algorithm of a task and network, with all that was typed about them."""
    from . import tasks

    entry, word = ALGORITHMS[command.algorithm], command.algorithm
    module, _, rest = entry["path"].partition(":")
    cls, build = load(f"{module}:{rest.partition('.')[0]}"), load(entry["path"])
    if command.preset:
        presets = entry.get("presets", ())
        if command.preset not in presets:
            what = (
                f"no preset {command.preset!r} of {word}" if presets else f"{word} has no presets"
            )
            fail(what, command.preset, presets)
        build = cls.presets()[command.preset]
    line.reserved |= {f.name.replace("_", "-") for f in dataclasses.fields(cls)}
    line.skipped = {"id"}  # the task is a word
    example = CATALOGUE["examples"][entry.get("learns", "one agent")]
    try:
        given = (command.task, command.kwargs, command.rewards)
        env = tasks.task(*given) if command.task else load(example)()
        env = line.take(env, "env.")
        if entry.get("learns") == "a team" and env.agents is None:
            fail(
                f"{word} trains teams and {command.task} has one agent: give a team (rover, "
                "simple-spread, mpe2.simple_spread_v3, one of your own), or train erl"
            )
        network = _network(line, command.network or entry.get("network"), word, env)
        if command.delayed:
            from ..environments import wrappers

            env = wrappers.delayed(env)
        return line.take(build(env, network))
    except ValueError as error:  # a task and an algorithm that do not go together
        fail(str(error))


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
    """One run here, or several in processes of their own."""
    from ..executors import local
    from ..runs import folder, loop
    from ..runs.store import Run

    frames, learns = command.options.frames, getattr(algorithm, "learners", True)
    flag = next((x for x in ("start_frames", "warmup_frames") if hasattr(algorithm, x)), "")
    start = getattr(algorithm, flag, -1)
    if learns and not command.from_ and frames is not None and frames <= start:
        say(
            f"credo: note: nothing is learned by gradient in the first {start:,} frames, and this "
            f"run ends after {frames:,}: give more --frames, or fewer --{flag.replace('_', '-')}"
        )
    number = command.seed if command.seeds == 1 else "seeds"
    path = pathlib.Path(command.path) if command.path else folder.free_name(algorithm, number)
    seeds = range(command.seed, command.seed + command.seeds)
    if len(seeds) == 1:
        given = {"seed": command.seed, "path": path, "warm_start": command.from_}
        print(loop.train(algorithm, command.options, **given).summary)
        return
    local.run(
        [
            local.Job(path / f"seed-{seed}", algorithm, seed, command.options, command.from_)
            for seed in seeds
        ],
        again="the same command" + f" with --path {path}" * (not command.path),
    )
    for seed in seeds:
        print(Run(path / f"seed-{seed}").summary)
    print(f"compare them: credo report {path}/seed-*")
