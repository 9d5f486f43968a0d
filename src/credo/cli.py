"""The command line: the only place where names are looked up.

Nothing here imports JAX before a command needs it: `credo --help` answers at once.
"""

import dataclasses
import importlib
import os
import pathlib
import re
import sys
import traceback
import warnings
from typing import Any, NamedTuple

from .experiments.catalogue import EXPERIMENTS
from .runs import ending
from .runs.arguments import (
    fail,
    in_range,
    parse,
    plain_integer,
    pop_changes,
    pop_option,
    pop_pairs,
    pop_switch,
    seconds,
)
from .runs.ending import say


class Entry(NamedTuple):
    """An algorithm that can be named."""

    path: str  # package.module:Class
    preset: str  # of its `presets()`; "": the class itself
    network: str | None  # None: the algorithm's own choice
    text: str


ALGORITHMS = {
    "neuroevolution": Entry(
        "credo.algorithms.neuroevolution:Neuroevolution",
        "",
        "mmu",
        "evolve a population of networks (Algorithm 2)",
    ),
    **{
        name: Entry("credo.algorithms.erl:ERL", name, None, text)
        for name, text in {
            "erl": "a population and a gradient learner with one replay buffer (Algorithm 6)",
            "cerl": "the same with a portfolio of learners that compete for frames",
            "ea": "the population of erl without its learner",
        }.items()
    },
    **{
        name: Entry("credo.algorithms.off_policy:OffPolicy", name, None, text)
        for name, text in {
            "td3": "twin delayed deterministic policy gradient, alone",
            "ddpg": "deep deterministic policy gradient, alone",
            "sac": "soft actor-critic, alone",
        }.items()
    },
}
ALGORITHMS["merl"] = Entry(
    "credo.algorithms.merl:MERL",
    "merl",
    None,
    "teams: evolution on the common goal, gradient on each agent's own reward (Algorithm 13)",
)
ALGORITHMS |= {
    name: Entry("credo.algorithms.off_policy:OffPolicy", name, None, text)
    for name, text in {
        "matd3": "TD3 for teams, with critics that see the whole team",
        "maddpg": "DDPG for teams, with critics that see the whole team",
    }.items()
}
ALGORITHMS["ccea"] = Entry(
    "credo.algorithms.ccea:CCEA",
    "ccea",
    None,
    "cooperative coevolution, a population per agent (Algorithm 4)",
)
ALGORITHMS["bptt"] = Entry(
    "credo.algorithms.bptt:BPTT",
    "as-written",
    "mmu",
    "one network by gradient through time, on labelled sequences (3.4)",
)
ALGORITHMS["ppo"] = Entry(
    "credo.algorithms.ppo:PPO", "ppo", None, "proximal policy optimization, on fresh frames alone"
)
TASKS = {
    "sequence-classification": (
        "credo.environments.sequence_classification:SequenceClassification",
        "more +1 than -1 so far? Signals between long gaps (3.2)",
    ),
    "sequence-recall": (
        "credo.environments.sequence_recall:SequenceRecall",
        "hear directions, take them in order: deep T-maze (3.3)",
    ),
    "rover": (
        "credo.environments.rover:Rover",
        "teams look for points of interest, n rovers at once to see one (7.4)",
    ),
    "extended-tmaze": (
        "credo.environments.extended_tmaze:ExtendedTMaze",
        "robots look for a reward that moves; with a static robot or without (4.1)",
    ),
    "server-fleet": (
        "credo.environments.server_fleet:ServerFleet",
        "servers find out which devices are nefarious (4.2)",
    ),
    "simple-spread": (
        "credo.environments.simple_spread:SimpleSpread",
        "a team covers landmarks: mpe2.simple_spread_v3 in JAX",
    ),
}
GYMNASIUM = "credo.environments.gymnasium:Gymnasium"  # any other task, by its id there
PARALLEL = "pettingzoo.utils.env.ParallelEnv"
PETTINGZOO = "credo.environments.pettingzoo:PettingZoo"  # or a team of PettingZoo
NETWORKS = {
    "mmu": ("credo.networks.mmu:MMU", {}, "gated memory (equations 3.1-3.5)"),
    "rnn": ("credo.networks.recurrent:Recurrent", {"cell": "rnn"}, "Elman network"),
    "gru": ("credo.networks.recurrent:Recurrent", {"cell": "gru"}, "gated recurrent unit"),
    "lstm": ("credo.networks.recurrent:Recurrent", {"cell": "lstm"}, "long short-term memory"),
    "mlp": ("credo.networks.mlp:MLP", {}, "feed-forward, no memory"),
    "dmmu": ("credo.networks.dmmu:DMMU", {}, "a team's gates on one shared memory (4.2.1)"),
    "lstmsm": (
        "credo.networks.dmmu:DMMU",
        {"cell": "lstm"},
        "a team's LSTMs with one cell (4.2.3)",
    ),
    "cnf": ("credo.networks.team:Centralized", {}, "one network acts for a whole team (4.2.3)"),
}
PRESETS = {
    "as-written": "Algorithm 2, or section 3.4, as printed (the default)",
    "as-coded": "the author's operators of 2017",
    "ours": "the best settings found: start here for a task of your own; of erl, for late rewards",
    "dmmu": "Algorithm 5: teams, whose agents change places too",
}
OF_TASKS = ("--kwargs", "--rewards")  # flags that are no fields
POPPED = ("--network", "--preset", "--delayed", "--from", *OF_TASKS)
COMMANDS = {
    "list": "tasks, algorithms, networks, presets and experiments",
    "train": "train an algorithm on a task: credo train neuroevolution sequence-classification",
    "resume": "go on with a run, also to a larger budget",
    "evaluate": "play fresh episodes with a run's champion",
    "watch": "show a champion: credo watch RUN [page.html|film.gif|film.mp4]",
    "export": "a champion in one file that acts without JAX: credo export RUN policy.safetensors",
    "reproduce": "rerun a figure or table of the dissertation: credo reproduce fig-3.4a",
    "report": "one HTML page about one or more runs",
    "check": "look for mistakes in an environment: credo check my_module:MyTask",
}


def main(argv: list[str] | None = None) -> None:
    """Entry point of `credo`. Whatever happens ends in a line and an exit code (see `ending`)."""
    ending.open_streams()
    words = list(sys.argv[1:] if argv is None else argv)
    ending.run(lambda: _command(words), alone=argv is None)


def _command(argv: list[str]) -> None:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(overview())
        return
    if argv[0] in ("--version", "-V"):
        from importlib.metadata import version

        print("credo", version("credo"))
        return
    command, *rest = argv
    if command not in COMMANDS:
        fail(f"no command {command!r}", command, COMMANDS)
    rest = [plain_integer(token) for token in rest]
    warnings.showwarning = lambda message, *_args, **_kw: say(f"warning: {message}")
    # Environments of users lie where they work.
    sys.path.insert(0, _here())
    globals()[f"_{command}"](rest)


def _here() -> str:
    try:
        return os.getcwd()
    except OSError as error:
        say(f"credo: this folder is not there any more ({error.strerror}): go to another with cd")
        raise SystemExit(1) from None


def overview() -> str:
    width = max(map(len, COMMANDS)) + 2
    lines = ["usage: credo COMMAND …", "", "credit assignment by evolution and gradient", ""]
    lines += [f"  {name:<{width}}{text}" for name, text in COMMANDS.items()]
    lines += ["", "credo COMMAND --help shows a command's flags with units and defaults."]
    return "\n".join(lines)


# ------------------------------------------------------------------------------------ commands


def _list(argv: list[str]) -> None:
    sections = {
        "tasks": {name: text for name, (_, text) in TASKS.items()},
        "algorithms": {name: entry.text for name, entry in ALGORITHMS.items()},
        "networks": {name: text for name, (_, _, text) in NETWORKS.items()},
        "presets": PRESETS,
        "experiments": EXPERIMENTS,
    }
    if argv and argv[0] in ("-h", "--help"):
        print(f"usage: credo list [{'|'.join(sections)}]")
        return
    if argv and argv[0] not in sections:
        fail(f"nothing called {argv[0]!r} to list", argv[0], sections)
    if len(argv) > 1:
        fail(f"credo list takes one word, and {argv[1]!r} is another")
    for title in argv[:1] or sections:
        print(title)
        width = max(map(len, sections[title])) + 2
        for name, text in sections[title].items():
            print(f"  {name:<{width}}{text}")
    if not argv or argv[0] == "tasks":
        print("  Hopper-v5, …            any task that Gymnasium knows and whose actions are a box")
        print("  mpe2.simple_spread_v3   any team of PettingZoo (ParallelEnv) with Box actions")
        print("  package.module:name     a task of your own (see examples/own_environment.py): its")
        print(
            "                          class, a gymnasium.Env or pettingzoo.ParallelEnv class, or"
        )
        print("                          a function that makes one of these two")


@dataclasses.dataclass
class TrainOptions:
    """The run.

    Beside the flags below: --network NAME, --preset NAME, --delayed (the task pays the whole return
    at its last step), --from RUN (start from the champion of another run); of tasks of Gymnasium
    and PettingZoo --kwargs NAME=VALUE … (what they are made with), and of teams
    --rewards NAME=MODULE:FUNCTION … (rewards of your own).
    """

    generations: int | None = None  # budget; with no budget given, the algorithm's own
    frames: int | None = None  # budget in environment steps, such as 1e6; ends the generation
    seed: int = 0  # everything random follows from it
    seeds: int = 1  # runs, with this seed and the ones after it, one process per core
    path: str | None = None  # the run's folder; None: runs/<algorithm>-<task>-<seed>
    stop_at: float | None = None  # end once the champion's score reaches this
    wall_clock: str | None = None  # end and save after this time: 90s, 30m, 2h
    checkpoint_every: float = 60.0  # seconds between checkpoints
    keep: int = 3  # checkpoints kept on disk
    tensorboard: bool = True  # write TensorBoard events


def _train(argv: list[str]) -> None:
    names = [token for token in argv[:2] if not token.startswith("-")]
    if names and names[0] not in ALGORITHMS:
        fail(f"no algorithm {names[0]!r}", names[0], ALGORITHMS)
    if len(names) < 2:
        print(_train_usage())
        raise SystemExit(0 if {"-h", "--help"} & set(argv) else 2)
    entry = ALGORITHMS[names[0]]
    network_name, argv = pop_option(argv[2:], "--network", entry.network or "")
    preset, argv = pop_option(argv, "--preset", entry.preset)
    warm_start, argv = pop_option(argv, "--from", "")
    delayed, argv = pop_switch(argv, "--delayed")
    if network_name and network_name not in NETWORKS:
        fail(f"no network {network_name!r}", network_name, NETWORKS)
    settings, argv = _settings(argv)
    env = _limited(_task(names[1], settings), argv)
    build, network = _builder(names[0], preset), None
    if network_name:
        path, fields, _ = NETWORKS[network_name]
        try:
            network = _on_a_team(names[0], env, _load(path)(**fields))
        except ValueError as error:  # a task that cannot be opened
            fail(str(error))
    prog = f"credo train {names[0]} {names[1]}"
    if delayed:
        from .environments import wrappers

        env = wrappers.delayed(env)
    algorithm, options = _configured(prog, build, env, network, argv)
    in_range(options, options.seeds)
    _require_sound(names[1], algorithm.env)
    fields = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    fields |= {"wall_clock": seconds(options.wall_clock), "warm_start": warm_start or None}
    label = _label(names[0], names[1]) + "-delayed" * delayed
    if not warm_start:
        _note_start(algorithm, options.frames)
    _start(algorithm, label, **fields)


def _limited(env: Any, argv: list[str]) -> Any:
    """A task outside JAX with the time limit that is among the flags: an algorithm may have to
    open it (for how many agents?) before the flags are read."""
    limit = plain_integer(pop_option(argv, "--max-episode-steps", "")[0])
    fields = {f.name for f in dataclasses.fields(env)}
    if not limit.isdigit() or int(limit) < 1 or "max_episode_steps" not in fields:
        return env  # what is wrong with it is said where flags are read
    return dataclasses.replace(env, max_episode_steps=int(limit))


def _on_a_team(algorithm: str, env: Any, network: Any) -> Any:
    """A network of one agent for every agent of a task; CCEA has them one by one anyway."""
    if env.agents is None or network.team or algorithm == "ccea":
        return network
    from .networks.team import Team

    return Team(trunk=(), head=network, sharing="nothing")


def _train_usage() -> str:
    return f"""\
usage: credo train ALGORITHM TASK [--network NAME] [--preset NAME] [--delayed] [--from RUN]
                                  [--kwargs NAME=VALUE …] [--rewards NAME=MODULE:FUNCTION …] [flags]

algorithms: {", ".join(ALGORITHMS)}
tasks:      {", ".join(TASKS)}
            or one of Gymnasium, such as Hopper-v5
            or a team of PettingZoo, such as mpe2.simple_spread_v3
            or package.module:name of a class of your own, or of a function that makes a task
networks:   {", ".join(NETWORKS)} (default: the algorithm's own)
            each agent of a team has a network of its own, unless it is one for teams
presets:    as-written (the default), as-coded, ours, of neuroevolution and bptt; dmmu, of
            neuroevolution
            ours, of erl: for a reward that comes late

credo train ALGORITHM TASK --help lists every flag with its unit and default."""


def _builder(name: str, preset: str) -> Any:
    """What makes an algorithm of a task and a network."""
    algorithm_class = _load(ALGORITHMS[name].path)
    if not preset:
        return algorithm_class
    presets = algorithm_class.presets()
    if preset not in presets:
        fail(f"no preset {preset!r} of {name}", preset, presets)
    return presets[preset]


def _configured(prog: str, build: Any, env: Any, network: Any, argv: list[str]) -> list[Any]:
    """The algorithm that `build` makes of a task and network with these flags, and the options."""
    try:
        first, _ = parse(prog, build(env, network), TrainOptions, argv, popped=POPPED)
        # What a preset derives from the task must follow from the one asked for, not its defaults.
        return parse(prog, build(first.env, first.network), TrainOptions, argv, popped=POPPED)
    except ValueError as error:  # a task and an algorithm that do not go together
        fail(str(error))


def _label(algorithm: str, task: str) -> str:
    """A run's name before its seed."""
    task = TASKS[task][0] if task in TASKS else task
    return f"{algorithm}-{task.rpartition(':')[2]}"


def _start(
    algorithm: Any,
    label: str,
    *,
    seed: int,
    seeds: int,
    path: str | None,
    warm_start: str | None,
    **fields: Any,
):
    """One run here, or several in processes of their own."""
    from .executors import local
    from .runs import loop
    from .runs.options import RunOptions
    from .runs.store import Run

    options = RunOptions(**fields)
    if seeds == 1:
        folder = path or loop.free_name(algorithm, seed, label)
        start = {"seed": seed, "path": folder, "warm_start": warm_start}
        print(_summary(loop.train(algorithm, options, **start)))
        return
    base = pathlib.Path(path) if path else loop.free_name(algorithm, "seeds", label)
    jobs = [
        local.Job(base / f"seed-{s}", algorithm, s, options, warm_start)
        for s in range(seed, seed + seeds)
    ]
    local.run(jobs)
    for job in jobs:
        print(_summary(Run(job.path)))
    print(f"compare them: credo report {base}/seed-*")


@dataclasses.dataclass
class ResumeOptions:
    """Go on with a run, or with every unfinished run of a folder that `--seeds` made.

    Beside the flags below: --set FIELD=VALUE (go on with another setting, such as
    learner.actor_lr=1e-4; may be given several times), --trust (the run was made elsewhere and
    names code of somebody's own: import it), --without-replay (start with an empty replay buffer,
    where the one that was saved is damaged).
    """

    generations: int | None = None  # a larger budget; with none given, the run's own
    frames: int | None = None  # a larger budget in environment steps, such as 2e6
    stop_at: float | None = None  # end once the champion's score reaches this
    wall_clock: str | None = None  # end and save after this time: 90s, 30m, 2h
    checkpoint_every: float = 60.0  # seconds between checkpoints
    keep: int = 3  # checkpoints kept on disk


def _resume(argv: list[str]) -> None:
    path, argv = _positional(argv, "resume RUN", "the run's folder, or one with runs in it")
    changes, argv = pop_changes(argv, "--set")
    trust, argv = pop_switch(argv, "--trust")
    without_replay, argv = pop_switch(argv, "--without-replay")
    popped = ("--set", "--trust", "--without-replay")
    (options,) = parse("credo resume RUN", None, ResumeOptions, argv, popped=popped)
    in_range(options)
    fields = vars(options) | {"wall_clock": seconds(options.wall_clock)}
    fields |= {"set": changes, "trust": trust, "without_replay": without_replay}
    runs = _runs(path)
    for run in runs if changes else ():
        _require_changes(run, changes, trust)
    _go_on(pathlib.Path(path), runs, **fields)


def _require_changes(path: pathlib.Path, changes: dict[str, Any], trust: bool) -> None:
    """End if an algorithm has no such fields, or none with such values: nothing was begun yet."""
    from .runs import config
    from .runs.store import Run

    algorithm = Run(path, trust=trust).algorithm
    try:
        config.replaced(algorithm, changes)
    except ValueError as error:
        fail(f"--set: {error}")


@dataclasses.dataclass
class EvaluateOptions:
    """Fresh episodes for a champion, or for that of every run of a folder that `--seeds` made.

    Flags of the task, such as --depth 101, change the task; --kwargs NAME=VALUE … those of
    Gymnasium and PettingZoo. --trust: the run was made elsewhere and names code of somebody's own:
    import it.
    """

    episodes: int | None = None  # episodes, all fresh; None: 1000, outside JAX 20
    seed: int = 0  # of the episodes


def _evaluated(run: Any, argv: list[str]) -> list[Any]:
    """The task of a run with what the flags change, and the options."""
    settings, argv = _settings(argv)
    env = run.algorithm.env
    task, options = parse(
        "credo evaluate RUN",
        _with_settings(env, settings),
        EvaluateOptions,
        argv,
        flat=True,
        popped=("--trust", *OF_TASKS),
    )
    in_range(options)
    if task != env and task.sizes != env.sizes:
        words = ("numbers in an observation", "numbers in an action", "agents")
        sizes = zip(words, task.sizes, env.sizes, strict=False)  # who plays alone has two
        told = [f"{now} {what}" for what, now, then in sizes if now != then]
        fail(f"with these flags the task has {', and '.join(told)}: its champion cannot act there")
    return [task, options]


def _evaluate(argv: list[str]) -> None:
    path, argv = _positional(argv, "evaluate RUN", "the run's folder, or one with runs in it")
    trust, argv = pop_switch(argv, "--trust")
    from .runs import evaluation
    from .runs.store import Run

    results = []
    for each in _runs(path):
        run = Run(each, trust=trust)
        task, options = _evaluated(run, argv)
        lines, result = evaluation.describe(run, task, options.episodes, options.seed)
        print("\n".join(lines))
        results += [] if result is None else [result]
    if len(results) > 1:
        print("\n".join(evaluation.summary(pathlib.Path(path), results)))


@dataclasses.dataclass
class WatchOptions:
    """Show a champion: rovers in a page that plays, a T-maze in a page of pictures, tasks of
    Gymnasium in a film.

    --trust: the run was made elsewhere and names code of somebody's own: import it.
    """

    episodes: int = 1  # one after the other
    seed: int = 0  # of the first episode; the next ones count up
    fps: float | None = None  # steps shown per second; None: in real time, of rovers 5
    size: tuple[int, int] = (480, 480)  # width and height in pixels, where a task lets us choose


def _watch(argv: list[str]) -> None:
    path, argv = _positional(argv, "watch RUN [FILE]", "the run's folder; .html, .gif or .mp4")
    film, argv = (argv[0], argv[1:]) if argv and not argv[0].startswith("-") else ("", argv)
    trust, argv = pop_switch(argv, "--trust")
    (options,) = parse("credo watch RUN [FILE]", None, WatchOptions, argv, popped=("--trust",))
    in_range(options, options.episodes)
    from .report import watch
    from .runs.store import Run

    run = Run(_one_run("watch", path), trust=trust)
    target = pathlib.Path(film) if film else None
    print(f"wrote {watch.watch(run, target, **vars(options))}")


def _export(argv: list[str]) -> None:
    path, argv = _positional(argv, "export RUN [FILE]", "the run's folder; policy.safetensors")
    trust, argv = pop_switch(argv, "--trust")
    if len(argv) > 1 or (argv and argv[0].startswith("-")):
        print("usage: credo export RUN [FILE] [--trust]\n")
        print("  the champion for credo.runner, without JAX; --trust: the run was made elsewhere")
        print("  and names code of somebody's own: import it")
        raise SystemExit(0 if argv in (["-h"], ["--help"]) else 2)
    from .runs import export
    from .runs.store import Run

    run = Run(_one_run("export", path), trust=trust)
    target = argv[0] if argv else run.path / "policy.safetensors"
    print(f"policy: {export.export(run, pathlib.Path(target))}")


@dataclasses.dataclass
class ReproduceOptions:
    """Rerun an experiment. What has been run already is not run again."""

    budget: str = "quick"  # smoke (seconds), quick (minutes), full; some: million, published
    runs: int | None = None  # independent runs per cell; None: what the budget says
    only: str | None = None
    """Cells whose name has this regular expression, as '2-deep, fsp'; a word that is in none lists
    them. What was measured of other cells stays."""
    jobs: int | None = None  # processes; None: one per core
    output: str = "reproduced"  # folder for the page and its data
    work: str = "runs/reproduce"  # folder for the runs behind them


def _reproduce(argv: list[str]) -> None:
    name, argv = _positional(argv, "reproduce EXPERIMENT", "an experiment of `credo list`")
    if name not in EXPERIMENTS:
        fail(f"no experiment {name!r}", name, EXPERIMENTS)
    (options,) = parse(f"credo reproduce {name}", None, ReproduceOptions, argv)
    in_range(options)
    budgets = ("smoke", "quick", "full", "million", "published")
    if options.budget not in budgets:
        fail(f"no budget {options.budget!r}", options.budget, budgets)
    from .experiments import base

    page = base.reproduce(
        name,
        options.budget,
        runs=options.runs,
        only=options.only,
        jobs=options.jobs,
        output=pathlib.Path(options.output),
        work=pathlib.Path(options.work),
    )
    print(f"page: {page}")


def _report(argv: list[str]) -> None:
    output, argv = pop_option(argv, "--output", "", "-o")
    asked = {"-h", "--help"} & set(argv)
    for token in argv if not asked else ():
        if token.startswith("-"):
            fail(f"credo report has no flag {token!r}", token, ("--output", "-o"))
    if asked or not argv:
        print("usage: credo report RUN [RUN …] [-o report.html]\n\n  one page about finished or")
        print(
            "  running runs, or folders of runs; runs that differ only in their seed are one curve"
        )
        raise SystemExit(0 if asked else 2)
    from .report import run_page as report

    named = [pathlib.Path(token) for token in argv]
    paths = [run for path in named for run in _runs(path)]
    folder = named[0] if len(named) == 1 else _common(named)
    target = pathlib.Path(output) if output else folder / "report.html"
    print(f"page: {report.write(paths, target)}")


def _common(paths: list[pathlib.Path]) -> pathlib.Path:
    """The folder in which all of these lie: a page about several runs belongs to none of them."""
    return pathlib.Path(os.path.relpath(os.path.commonpath([p.absolute().parent for p in paths])))


@dataclasses.dataclass
class CheckOptions:
    """Look for mistakes in a task. Flags of the task, such as --max-episode-steps, change it;
    --kwargs NAME=VALUE … is what a task of Gymnasium or PettingZoo is made with."""


def _check(argv: list[str]) -> None:
    name, argv = _positional(argv, "check TASK", "a task's name or package.module:name")
    settings, argv = _settings(argv)
    env, _ = parse(
        "credo check TASK", _task(name, settings), CheckOptions, argv, flat=True, popped=OF_TASKS
    )
    from .environments import checks
    from .environments.host import AbstractHostEnvironment

    if isinstance(env, AbstractHostEnvironment):
        say(f"{name}: it is opened and plays for {checks.HOST_SECONDS:g} seconds, at most")
    problems = _problems(env)
    for problem in problems:
        print(f"- {problem}")
    print(f"{name}: {len(problems)} problem{'s' * (len(problems) != 1)} found")
    raise SystemExit(1 if problems else 0)


# --------------------------------------------------------------------------------------- helpers


def _load(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def _settings(argv: list[str]) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Take `--kwargs` and `--rewards` out of the arguments: fields of a task of others."""
    settings = {}
    for flag in OF_TASKS:
        pairs, argv = pop_pairs(argv, flag)
        if pairs:
            settings[flag.removeprefix("--")] = pairs
    return settings, argv


def _with_settings(env: Any, settings: dict[str, dict[str, Any]]) -> Any:
    """A task with other `kwargs` and `rewards`; what is not named stays."""
    known = {f.name for f in dataclasses.fields(env)}
    if not settings:
        return env
    if "env" in known and not settings.keys() & known:  # a wrapper
        return dataclasses.replace(env, env=_with_settings(env.env, settings))
    for name in settings.keys() - known:
        fail(f"{type(env).__name__} has no --{name}: its settings are flags, see --help")
    old = {name: dict(getattr(env, name) or ()) for name in settings}
    try:
        return dataclasses.replace(env, **{name: old[name] | settings[name] for name in old})
    except ValueError as error:
        fail(str(error))


def _task(name: str, settings: dict[str, dict[str, Any]]) -> Any:
    """A task with its defaults: by our name for it, as `package.module:name`, or by
    Gymnasium's."""
    if name in TASKS:
        return _with_settings(_load(TASKS[name][0])(), settings)
    if re.fullmatch(r"\w+(\.\w+)*:\w+", name):
        return _own_task(name, settings)
    if re.fullmatch(r"\w+(\.\w+)+", name):  # a module with parallel_env
        return _with_settings(_load(PETTINGZOO)(id=name), settings)
    if match := re.fullmatch(r"(?:\./)?(\w+)\.py:(\w+)", name):  # a file in place of its module
        fail(f"{name!r} names a file: name its module, {match[1]}:{match[2]}")
    import gymnasium

    module, _, registered = name.rpartition(":")
    if module:  # package:Name-v0, registered when it is imported
        _of_user(name, lambda: importlib.import_module(module))
    if registered not in gymnasium.registry:
        fail(
            f"no task {name!r}; one of your own is written package.module:name",
            name,
            TASKS,
            gymnasium.registry,
        )
    return _with_settings(_load(GYMNASIUM)(id=name), settings)


def _own_task(name: str, settings: dict[str, dict[str, Any]]) -> Any:
    """A class of one's own, or a plain function that makes an environment: it may be called, since
    it is named on this command line."""
    from .environments import names
    from .environments.base import AbstractEnvironment
    from .environments.host import AbstractHostEnvironment

    found = _of_user(name, lambda: names.find(name))
    if found is None:
        module, _, missing = name.partition(":")
        fail(
            f"cannot import {name!r}: {module} has no {missing}. Start credo in the folder of its "
            "file"
        )
    if isinstance(found, type) and issubclass(found, AbstractEnvironment | AbstractHostEnvironment):
        return _with_settings(_of_user(name, found), settings)
    kind = _of_user(name, lambda: names.kind_of(name, settings.get("kwargs", {})))
    if kind is None:
        fail(
            f"{name} is no task: derive it from credo.AbstractEnvironment or gymnasium.Env, or "
            "name a function that makes a gymnasium.Env or a pettingzoo.ParallelEnv"
        )
    return _with_settings(
        _load({"gymnasium": GYMNASIUM, "pettingzoo": PETTINGZOO}[kind])(id=name), settings
    )


def _of_user(name: str, call: Any) -> Any:
    """Call what imports or makes somebody's task. What it raises ends with where that was."""
    module = repr(name.rpartition(":")[0])
    try:
        return call()
    except SyntaxError as error:
        fail(f"cannot import {module} of {name}: {error.filename}:{error.lineno}: {error.msg}")
    except ImportError as error:
        fail(f"cannot import {name!r}: {error}. Start credo in the folder of its file")
    except SystemExit as error:
        fail(
            f"cannot import {module} of {name}: {ending.place(error)} ends Python (exit code "
            f"{error.code!r}): put that under if __name__ == '__main__'"
        )
    except Exception as error:
        place, what = ending.place(error), f"{type(error).__name__}: {ending.first(error)}"
        if place or not (isinstance(error, TypeError) and isinstance(call, type)):
            fail(f"cannot use {name}: {place or 'it'} raised {what}")
        fail(
            f"{name} cannot be made without arguments ({error}): give every field a default, and "
            "define obs_size and max_steps"
        )


def _require_sound(name: str, env: Any) -> None:
    """End with what is wrong with a task that is not ours, before anything is trained on it."""
    from .environments.host import EnvironmentFailure

    if ":" in name:
        problems = _problems(env)
        if problems:
            say("\n".join(f"- {problem}" for problem in problems))
            fail(f"{name} cannot be trained on before this is mended")
    elif name not in TASKS:
        try:
            env.copies(1)
        except EnvironmentFailure as failure:
            fail(f"cannot make the task {name!r}: {failure}")


def _problems(env: Any) -> list[str]:
    """What `check_environment` finds; an exception of the task's own code is a problem too."""
    from .environments.checks import check_environment

    try:
        return check_environment(env)
    except Exception as error:  # the task is somebody else's code: say where, and what often helps
        own = sys.modules[type(env).__module__].__file__
        frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == own]
        where = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
        first = str(error).partition("\n")[0]
        return [
            f"it raised {type(error).__name__}{where}: {first} (everything runs inside JAX: choose "
            "with jnp.where, not `if`; methods are sample(self, *, key) and reward(self, answer, "
            "target, scored, perfect))"
        ]


def _positional(argv: list[str], usage: str, what: str) -> tuple[str, list[str]]:
    if argv and not argv[0].startswith("-"):
        return argv[0], argv[1:]
    if {"-h", "--help"} & set(argv) and usage.startswith(("resume", "reproduce")):
        return "RUN" if usage.startswith("resume") else next(iter(EXPERIMENTS)), argv
    print(f"usage: credo {usage} [flags]\n\n  {usage.split()[1]}: {what}")
    raise SystemExit(0 if argv else 2)


def _runs(path: str | pathlib.Path) -> list[pathlib.Path]:
    """The run that is this folder, or those that lie in it, as `--seeds` leaves them."""
    from .runs import folder

    return folder.runs_in(pathlib.Path(path))


def _one_run(command: str, path: str) -> pathlib.Path:
    runs = _runs(path)
    if len(runs) > 1:
        first = f"credo {command} {runs[0]}"
        fail(
            f"{path} holds {len(runs)} runs: name one of them, as in {first}", known=map(str, runs)
        )
    return runs[0]


def _go_on(
    base: pathlib.Path,
    runs: list[pathlib.Path],
    *,
    set: dict[str, Any],
    trust: bool,
    without_replay: bool,
    **fields: Any,
) -> None:
    """Go on with a run, or with several in processes of their own."""
    from .executors import local
    from .runs import loop
    from .runs.options import RunOptions
    from .runs.store import Run

    options = RunOptions(**fields)
    again: Any = {"set": set, "trust": trust, "without_replay": without_replay}
    if len(runs) == 1:
        loop.resume(runs[0], options, **again)
    else:
        local.run([local.Job.resumed(path, options, **again) for path in runs], title=base.name)
    for path in runs:
        print(_summary(Run(path, trust=trust)))


def _summary(run: Any) -> str:
    from .runs.progress import best_of

    metrics = run.metrics
    settings = run.config["algorithm"]
    score, episodes = f"{metrics['champion_score'][-1]:.4g}", settings.get("test_episodes")
    if settings.get("test_every", 1) > 1:  # the champion of today need not be the one tested
        score += " at the last test"
    best, value = best_of({name: column[-1] for name, column in metrics.items()})
    return (
        f"{run.path}: generation {int(metrics['generation'][-1])}, {best} "
        f"{value:.4g}, champion score {score}"
        + (f" on {episodes} fresh episodes" if episodes is not None else "")
    )


def _note_start(algorithm: Any, frames: int | None) -> None:
    """Say so if a run will end before anybody learns."""
    flag = next((x for x in ("start_frames", "warmup_frames") if hasattr(algorithm, x)), None)
    if flag is None or frames is None or not getattr(algorithm, "learners", True):
        return
    start = getattr(algorithm, flag)
    if frames <= start:
        say(
            f"credo: note: nothing is learned by gradient in the first {start:,} frames, and this "
            f"run ends after {frames:,}: give more --frames, or fewer --{flag.replace('_', '-')}"
        )


if __name__ == "__main__":
    main()
