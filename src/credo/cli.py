"""The command line: the only place where names are looked up.

Nothing here imports JAX before a command needs it: `credo --help` answers at once.
"""

import dataclasses
import difflib
import importlib
import os
import pathlib
import re
import sys
import traceback
import warnings
from typing import Annotated, Any, NoReturn

ALGORITHMS = {
    "neuroevolution": (
        "credo.algorithms.neuroevolution:Neuroevolution",
        "evolve a population of networks (Algorithm 2)",
    ),
}
TASKS = {
    "sequence-classification": (
        "credo.environments.sequence_classification:SequenceClassification",
        "more +1 than -1 so far? Signals between long gaps (3.2)",
    ),
    "sequence-recall": (
        "credo.environments.sequence_recall:SequenceRecall",
        "hear directions, take them in order: deep T-maze (3.3)",
    ),
}
NETWORKS = {
    "mmu": ("credo.networks.mmu:MMU", {}, "gated memory (equations 3.1-3.5)"),
    "rnn": ("credo.networks.recurrent:Recurrent", {"cell": "rnn"}, "Elman network"),
    "gru": ("credo.networks.recurrent:Recurrent", {"cell": "gru"}, "gated recurrent unit"),
    "lstm": ("credo.networks.recurrent:Recurrent", {"cell": "lstm"}, "long short-term memory"),
    "mlp": ("credo.networks.mlp:MLP", {}, "feed-forward, no memory"),
}
EXPERIMENTS = {
    "fig-3.4a": "success by depth, sequence classification",
    "fig-3.5a": "generalization to 0..101 distractors",
    "fig-3.5b": "generalization to depth 101",
    "table-3.1": "final memory of the 8 permutations of depth 3",
    "table-3.2": "counting study: -1 x 10^5, then +1 x 10^6",
    "fig-3.6": "write heat map, depth 3",
    "fig-3.7": "write heat map, depth 21",
    "alg-3.3": "the pseudo-algorithm a champion runs",
    "fig-3.9a": "success by depth, sequence recall",
    "fig-3.10": "recall in corridors of 1..101 steps",
    "ablation-3.4a": "our settings less one ingredient, 21-deep",
}
PRESETS = {
    "as-written": "Algorithm 2 as printed (the default)",
    "as-coded": "the author's operators of 2017",
    "ours": "the best settings found: start here for a task of your own",
}
COMMANDS = {
    "list": "tasks, algorithms, networks, presets and experiments",
    "train": "train an algorithm on a task: credo train neuroevolution sequence-classification",
    "resume": "go on with a run, also to a larger budget",
    "evaluate": "play fresh episodes with a run's champion",
    "reproduce": "rerun a figure or table of the dissertation: credo reproduce fig-3.4a",
    "report": "one HTML page about one or more runs",
    "check": "look for mistakes in an environment: credo check my_module:MyTask",
}


def main(argv: list[str] | None = None) -> None:
    """Entry point of `credo`. Wrong use ends with a suggestion and exit code 2."""
    argv = list(sys.argv[1:] if argv is None else argv)
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
    rest = [_plain_integer(token) for token in rest]
    warnings.showwarning = lambda message, *_args, **_kw: print(
        f"warning: {message}", file=sys.stderr
    )
    # Environments of users lie where they work.
    sys.path.insert(0, os.getcwd())
    globals()[f"_{command}"](rest)


def overview() -> str:
    width = max(map(len, COMMANDS)) + 2
    lines = ["usage: credo COMMAND …", "", "credit assignment by evolution and gradient", ""]
    lines += [f"  {name:<{width}}{text}" for name, text in COMMANDS.items()]
    lines += ["", "credo COMMAND --help shows a command's flags with units and defaults."]
    return "\n".join(lines)


def fail(message: str, given: str = "", known: Any = ()) -> NoReturn:
    """One line on what is wrong, one on what to do, exit code 2."""
    print(f"credo: {message}", file=sys.stderr)
    close = difflib.get_close_matches(given, list(known), n=1, cutoff=0.5)
    if close:
        print(f"       did you mean {close[0]!r}?", file=sys.stderr)
    elif known:
        print(f"       choose one of: {', '.join(known)}", file=sys.stderr)
    raise SystemExit(2)


def _plain_integer(token: str) -> str:
    """`1e6` is a valid integer."""
    if re.fullmatch(r"\d+(\.\d+)?e\+?\d+", token) and float(token).is_integer():
        return str(int(float(token)))
    return token


# ------------------------------------------------------------------------------------ commands


def _list(argv: list[str]) -> None:
    sections = {
        "tasks": {name: text for name, (_, text) in TASKS.items()},
        "algorithms": {name: text for name, (_, text) in ALGORITHMS.items()},
        "networks": {name: text for name, (_, _, text) in NETWORKS.items()},
        "presets": PRESETS,
        "experiments": EXPERIMENTS,
    }
    if argv and argv[0] in ("-h", "--help"):
        print(f"usage: credo list [{'|'.join(sections)}]")
        return
    if argv and argv[0] not in sections:
        fail(f"nothing called {argv[0]!r} to list", argv[0], sections)
    for title in argv[:1] or sections:
        print(title)
        width = max(map(len, sections[title])) + 2
        for name, text in sections[title].items():
            print(f"  {name:<{width}}{text}")
    if not argv or argv[0] == "tasks":
        print("  package.module:Class    a task of your own (see examples/own_environment.py)")


@dataclasses.dataclass
class TrainOptions:
    """The run."""

    generations: int = 1000  # budget, in generations
    seed: int = 0  # everything random follows from it
    seeds: int = 1  # runs, with this seed and the ones after it, one process per core
    path: str | None = None  # the run's folder; None: runs/<algorithm>-<task>-<seed>
    stop_at: float | None = None  # end once the champion's score reaches this
    wall_clock: str | None = None  # end and save after this time: 90s, 30m, 2h
    checkpoint_every: float = 60.0  # seconds between checkpoints
    keep: int = 3  # checkpoints kept on disk
    tensorboard: bool = True  # write TensorBoard events


def _train(argv: list[str]) -> None:
    usage = "usage: credo train ALGORITHM TASK [--network NAME] [--preset NAME] [flags]"
    names = [token for token in argv[:2] if not token.startswith("-")]
    if names and names[0] not in ALGORITHMS:
        fail(f"no algorithm {names[0]!r}", names[0], ALGORITHMS)
    if len(names) < 2:
        print(usage)
        print("\nalgorithms:", ", ".join(ALGORITHMS), "\ntasks:     ", ", ".join(TASKS))
        print("            or package.module:Class\nnetworks:  ", ", ".join(NETWORKS))
        print("presets:   ", ", ".join(PRESETS), "(default: as-written)")
        print("\ncredo train ALGORITHM TASK --help lists every flag with its unit and default.")
        raise SystemExit(0 if {"-h", "--help"} & set(argv) else 2)
    network_name, argv = _pop_option(argv[2:], "--network", "mmu")
    preset, argv = _pop_option(argv, "--preset", "")
    if network_name not in NETWORKS:
        fail(f"no network {network_name!r}", network_name, NETWORKS)
    env = _task(names[1])
    if ":" in names[1]:
        problems = _problems(env)
        if problems:
            print("\n".join(f"- {problem}" for problem in problems), file=sys.stderr)
            fail(f"{names[1]} cannot be trained on before this is mended")
    path, fields, _ = NETWORKS[network_name]
    algorithm_class = _load(ALGORITHMS[names[0]][0])
    build: Any = algorithm_class
    if preset:
        presets = algorithm_class.presets()
        if preset not in presets:
            fail(f"no preset {preset!r} of {names[0]}", preset, presets)
        build = presets[preset]
    prog = f"credo train {names[0]} {names[1]}"
    algorithm, options = _configured(prog, build, env, _load(path)(**fields), argv)
    seconds = _seconds(options.wall_clock)
    for name in ("generations", "seeds", "keep"):
        if getattr(options, name) < 1:
            fail(f"--{name} is {getattr(options, name)}: it must be at least 1")

    from .runs import loop

    def start(seed: int, folder: str | None) -> None:
        run = loop.train(
            algorithm,
            generations=options.generations,
            seed=seed,
            path=folder,
            stop_at=options.stop_at,
            wall_clock=seconds,
            checkpoint_every=options.checkpoint_every,
            keep=options.keep,
            tensorboard=options.tensorboard,
        )
        print(_summary(run))

    if options.seeds == 1:
        _guarded(lambda: start(options.seed, options.path))
    else:
        _guarded(lambda: _train_seeds(algorithm, options, seconds))


def _configured(prog: str, build: Any, env: Any, network: Any, argv: list[str]) -> list:
    """The algorithm that `build` makes of a task and network with these flags, and the options."""
    first, _ = _parse(prog, build(env, network), TrainOptions, argv)
    # What a preset derives from the task must follow from the one asked for, not its defaults.
    return _parse(prog, build(first.env, first.network), TrainOptions, argv)


def _train_seeds(algorithm: Any, options: TrainOptions, seconds: float | None) -> None:
    from .runs import executor, loop

    base = pathlib.Path(options.path) if options.path else loop.free_name(algorithm, "seeds")
    jobs = [
        executor.Job(
            base / f"seed-{seed}",
            algorithm,
            options.generations,
            seed,
            stop_at=options.stop_at,
            wall_clock=seconds,
            checkpoint_every=options.checkpoint_every,
            keep=options.keep,
            tensorboard=options.tensorboard,
        )
        for seed in range(options.seed, options.seed + options.seeds)
    ]
    executor.run(jobs)
    for job in jobs:
        print(_summary(loop.Run(job.path)))
    print(f"compare them: credo report {base}/seed-*")


@dataclasses.dataclass
class ResumeOptions:
    """Go on with a run."""

    generations: int | None = None  # a larger budget; None: the run's own
    stop_at: float | None = None  # end once the champion's score reaches this
    wall_clock: str | None = None  # end and save after this time: 90s, 30m, 2h
    checkpoint_every: float = 60.0  # seconds between checkpoints
    keep: int = 3  # checkpoints kept on disk


def _resume(argv: list[str]) -> None:
    path, argv = _positional(argv, "resume RUN", "the run's folder")
    (options,) = _parse("credo resume RUN", None, ResumeOptions, argv)

    from .runs import loop

    def go() -> None:
        run = loop.resume(
            path,
            generations=options.generations,
            stop_at=options.stop_at,
            wall_clock=_seconds(options.wall_clock),
            checkpoint_every=options.checkpoint_every,
            keep=options.keep,
        )
        print(_summary(run))

    _guarded(go)


@dataclasses.dataclass
class EvaluateOptions:
    """Fresh episodes for a champion. Flags of the task, such as --depth 101, change the task."""

    episodes: int = 1000  # episodes, all fresh
    seed: int = 0  # of the episodes


def _evaluate(argv: list[str]) -> None:
    path, argv = _positional(argv, "evaluate RUN", "the run's folder")

    def go() -> None:
        from .runs import loop

        run = loop.Run(path)
        task, options = _parse(
            "credo evaluate RUN", run.algorithm.env, EvaluateOptions, argv, flat=True
        )
        from .runs import evaluation

        for line in evaluation.describe(run, task, options.episodes, options.seed):
            print(line)

    _guarded(go)


@dataclasses.dataclass
class ReproduceOptions:
    """Rerun an experiment. What has been run already is not run again."""

    budget: str = "quick"  # smoke (seconds), quick (minutes) or full (as published)
    runs: int | None = None  # independent runs per cell; None: what the budget says
    jobs: int | None = None  # processes; None: one per core
    output: str = "reproduced"  # folder for the page and its data
    work: str = "runs/reproduce"  # folder for the runs behind them


def _reproduce(argv: list[str]) -> None:
    name, argv = _positional(argv, "reproduce EXPERIMENT", "an experiment of `credo list`")
    if name not in EXPERIMENTS:
        fail(f"no experiment {name!r}", name, EXPERIMENTS)
    (options,) = _parse(f"credo reproduce {name}", None, ReproduceOptions, argv)
    if options.budget not in ("smoke", "quick", "full"):
        fail(f"no budget {options.budget!r}", options.budget, ("smoke", "quick", "full"))

    def go() -> None:
        from .experiments import base

        page = base.reproduce(
            name,
            options.budget,
            runs=options.runs,
            jobs=options.jobs,
            output=pathlib.Path(options.output),
            work=pathlib.Path(options.work),
        )
        print(f"page: {page}")

    _guarded(go)


def _report(argv: list[str]) -> None:
    output, argv = _pop_option(argv, "--output", "", "-o")
    if not argv or {"-h", "--help"} & set(argv):
        print("usage: credo report RUN [RUN …] [-o report.html]\n\n  one page about finished or")
        print("  running runs; runs that differ only in their seed are one curve")
        raise SystemExit(0 if argv else 2)

    def go() -> None:
        from .runs import report

        paths = [pathlib.Path(token) for token in argv]
        target = pathlib.Path(output) if output else paths[0] / "report.html"
        print(f"page: {report.write(paths, target)}")

    _guarded(go)


def _check(argv: list[str]) -> None:
    name, argv = _positional(argv, "check TASK", "a task's name or package.module:Class")
    env = _task(name)
    problems = _problems(env)
    for problem in problems:
        print(f"- {problem}")
    print(f"{name}: {len(problems)} problem{'s' * (len(problems) != 1)} found")
    raise SystemExit(1 if problems else 0)


# --------------------------------------------------------------------------------------- helpers


def _load(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def _task(name: str) -> Any:
    """A task by its name or as `package.module:Class`, with its defaults."""
    if name in TASKS:
        return _load(TASKS[name][0])()
    if not re.fullmatch(r"\w+(\.\w+)*:\w+", name):
        fail(f"no task {name!r}; one of your own is written package.module:Class", name, TASKS)
    try:
        cls = _load(name)
    except (ImportError, AttributeError) as error:
        fail(f"cannot import {name!r}: {error}. Start credo in the folder of its file")
    from .environments.base import AbstractEnvironment

    if not (isinstance(cls, type) and issubclass(cls, AbstractEnvironment)):
        fail(f"{name} is no task: derive it from credo.AbstractEnvironment")
    try:
        return cls()
    except TypeError as error:
        fail(
            f"{name} cannot be made without arguments ({error}): give every field a default, and "
            "define obs_size and max_steps"
        )


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


def _pop_option(argv: list[str], name: str, default: str, short: str = "") -> tuple[str, list[str]]:
    """Take `--name value` or `--name=value` out of the arguments."""
    rest, value, tokens = [], default, iter(argv)
    for token in tokens:
        if token == name or (short and token == short):
            value = next(tokens, "")
            if not value:
                fail(f"{name} needs a value")
        elif token.startswith(f"{name}="):
            value = token.partition("=")[2]
        else:
            rest.append(token)
    return value, rest


def _positional(argv: list[str], usage: str, what: str) -> tuple[str, list[str]]:
    if argv and not argv[0].startswith("-"):
        return argv[0], argv[1:]
    if {"-h", "--help"} & set(argv) and usage.startswith(("resume", "reproduce")):
        return "RUN" if usage.startswith("resume") else next(iter(EXPERIMENTS)), argv
    print(f"usage: credo {usage} [flags]\n\n  {usage.split()[1]}: {what}")
    raise SystemExit(0 if argv else 2)


def _parse(prog: str, default: Any, options: type, argv: list[str], flat: bool = False) -> list:
    """Flags for the fields of `default` (if any) and of `options`.

    A task's own fields need no prefix (`--depth`), those of other parts do (`--network.hidden`).
    """
    import tyro

    arguments = []
    if default is not None:
        if not flat:
            default = _with_plain_task(default)
        plain = Annotated[type(default), tyro.conf.arg(name="")]
        arguments.append(("object", plain, dataclasses.field(default=default)))
    plain = Annotated[options, tyro.conf.arg(name="")]
    arguments.append(("options", plain, dataclasses.field(default_factory=options)))
    command = dataclasses.make_dataclass("Command", arguments)
    command.__doc__ = options.__doc__
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Mutable type")
        try:
            parsed = tyro.cli(command, prog=prog, args=argv, config=(tyro.conf.FlagConversionOff,))
        except ValueError as error:
            fail(str(error))
    result = [parsed.options]
    if default is not None:
        value = parsed.object
        if not flat:
            value = _original(value)
        result.insert(0, value)
    return result


def _with_plain_task(algorithm: Any) -> Any:
    """The algorithm as a class whose `env` flags have no prefix."""
    import tyro

    cls: Any = type(algorithm)
    plain = Annotated[type(algorithm.env), tyro.conf.arg(name="")]
    body = {
        "__annotations__": {"env": plain},
        "__module__": cls.__module__,
        "__doc__": cls.__doc__,
        "original": staticmethod(lambda: cls),
    }
    derived = type(cls)(cls.__name__, (cls,), body)
    return derived(**{f.name: getattr(algorithm, f.name) for f in dataclasses.fields(algorithm)})


def _original(algorithm: Any) -> Any:
    fields = {f.name: getattr(algorithm, f.name) for f in dataclasses.fields(algorithm)}
    return algorithm.original()(**fields)


def _seconds(text: str | None) -> float | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh]?)", text)
    if match is None:
        fail(f"wall-clock is {text!r}: write seconds, minutes or hours as 90s, 30m or 2h")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]


def _summary(run: Any) -> str:
    metrics = run.metrics
    return (
        f"{run.path}: generation {int(metrics['generation'][-1])}, best fitness "
        f"{metrics['fitness_max'][-1]:.4g}, champion score {metrics['champion_score'][-1]:.3f} "
        f"on {run.config['algorithm']['test_episodes']} fresh episodes"
    )


def _guarded(go: Any) -> None:
    """Errors that a user can mend end in one line; an interrupt with the code a shell expects."""
    from .runs.checkpoint import CheckpointError
    from .runs.config import ConfigError
    from .runs.lock import RunLocked
    from .runs.loop import Interrupted, RunError

    try:
        go()
    except Interrupted as stop:
        print(f"credo: {stop}", file=sys.stderr)
        raise SystemExit(stop.code) from None
    except (RunError, ConfigError, CheckpointError, RunLocked, ValueError, OSError) as error:
        print(f"credo: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        print("credo: stopped before the first generation", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
