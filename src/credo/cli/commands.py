"""The commands: dataclasses whose fields are words and, behind `_`, flags. A call does what the
command is for: it takes the line, for flags of other objects, and says when all of them are known.

What imports JAX is imported in the calls, so that help and completion need not wait for it.
"""

import dataclasses
import os
import pathlib
from typing import Any, Literal

from .. import require
from ..executors import Place
from ..experiments.catalogue import EXPERIMENTS
from ..runs.ending import say
from .line import Line
from .names import CATALOGUE, fail
from .resume import Resume as Resume
from .sweep import Sweep as Sweep
from .train import Train as Train
from .train import require_seeds


@dataclasses.dataclass
class PolicyOf:
    """What commands about the policy of a run have in common."""

    run: str
    _: dataclasses.KW_ONLY
    best: bool = False
    """Take the policy with the highest test score, instead of the last generation's."""
    trust: bool = False
    """Import the code that the run's record names, although the run was made elsewhere: to import a
    module is to execute it."""

    def only(self, command: str) -> Any:
        """The only run of the folder; of several one must be named."""
        from ..runs import folder
        from ..runs.store import Run

        runs = folder.runs_in(self.run)
        if len(runs) > 1:
            told = f"{self.run} holds {len(runs)} runs: name one of them, as in credo {command}"
            fail(f"{told} {runs[0]}", "", map(str, runs))
        return Run(runs[0], trust=self.trust, best=self.best)


@dataclasses.dataclass
class Evaluate(PolicyOf):
    """Fresh episodes for a run's policy, or for those of every run of a folder that --seeds made.
    Flags of the task change the task: credo evaluate RUN --depth 101."""

    _: dataclasses.KW_ONLY
    episodes: int | None = None
    """Episodes to play, at least 1. None: 1000, and 20 of a task outside JAX."""
    seed: int = 0
    """Seed of the episodes, 0 to 2^32 - 1. They are others than those of training."""
    horizon: tuple[int, ...] | None = None
    """Score where something has to be remembered this many times as long, such as 1,10,1000; with
    no number behind it 1,2,5,10,100. Of tasks that say what that is: T-mazes, sequence tasks."""
    kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)
    """NAME=VALUE …: what a task of Gymnasium or PettingZoo is made with, such as g=9.8. Values are
    read as Python: 8, 0.5, False, None, (1, 2); anything else is a string."""

    def __post_init__(self):
        require.at_least("episodes", self.episodes, 1)
        require_seeds(self.seed)
        for times in self.horizon or ():
            require.at_least("horizon", times, 1)

    def __call__(self, line: Line) -> None:
        """Play, run by run, and print the mean of each metric, of several runs also over runs."""
        from ..runs import evaluation, folder
        from ..runs.store import Run

        results = []
        for path in folder.runs_in(self.run):
            run = Run(path, trust=self.trust, best=self.best)
            task = self._task(line, run.algorithm.env)
            line.done()
            if self.horizon is not None:
                for told in evaluation.horizon(run, task, self.horizon, self.episodes, self.seed):
                    print(told, flush=True)
                continue
            lines, result = evaluation.describe(run, task, self.episodes, self.seed)
            print(*lines, sep="\n")
            results += [] if result is None else [result]
        if len(results) > 1:
            print(*evaluation.summary(pathlib.Path(self.run), results), sep="\n")

    def _task(self, line: Line, env: Any) -> Any:
        """The run's task with what was typed, if the policy can act there."""
        from .tasks import with_settings

        task = line.take(with_settings(env, self.kwargs), "env.")
        if task != env and task.sizes != env.sizes:
            words = ("numbers in an observation", "numbers in an action", "agents")
            sizes = zip(words, task.sizes, env.sizes, strict=False)  # who plays alone has two
            told = " and ".join(f"{now} {what}" for what, now, then in sizes if now != then)
            fail(f"with these flags the task has {told}: its champion cannot act there")
        return task


@dataclasses.dataclass
class Watch(PolicyOf):
    """Show a run's policy: rovers, mazes, fleets and sequences in a page that plays (.html); tasks
    of Gymnasium, PettingZoo and your own that can draw themselves in a video (.gif, .mp4)."""

    file: str | None = None
    _: dataclasses.KW_ONLY
    episodes: int = 1
    """Episodes to show, at least 1, one after the other."""
    seed: int = 0
    """Seed of the first episode, 0 to 2^32 - 1; the next ones count up."""
    fps: float | None = None
    """Steps shown per second, above 0. None: in real time; 5 of rovers, 30 where the task
    does not say."""
    size: tuple[int, int] = (480, 480)
    """Width and height of a video in pixels, where the task lets them be chosen."""

    def __post_init__(self):
        require.at_least("episodes", self.episodes, 1)
        require_seeds(self.seed)
        if self.fps is not None and not 0 < self.fps < float("inf"):
            raise ValueError(f"fps is {self.fps}: it must be more than 0")

    def __call__(self, line: Line) -> None:
        """Write the page or video, and say where."""
        line.done()
        from ..report import watch

        given = {name: getattr(self, name) for name in ("episodes", "seed", "fps", "size")}
        print(f"wrote {watch.watch(self.only('watch'), self.file, **given)}")


@dataclasses.dataclass
class Export(PolicyOf):
    """A run's policy in one file that acts without JAX (`credo.Runner.load(FILE)`); the file is
    policy.safetensors of the run's folder if none is named. One that ends in .onnx is a graph for
    ONNX Runtime (the extra onnx)."""

    file: str | None = None

    def __call__(self, line: Line) -> None:
        """Write the file, and say where it is and how to use it."""
        line.done()
        from ..runs import export

        run = self.only("export")
        target = self.file or run.path / "policy.safetensors"
        if str(target).endswith(".onnx"):
            from ..runs import onnx

            print(f"policy: {onnx.export(run, target)}")
            print(f'use it: onnxruntime.InferenceSession("{target}"), which says its inputs')
            return
        print(f"policy: {export.export(run, target)}")
        print(f'use it: policy = credo.Runner.load("{target}"); action = policy(observation)')


@dataclasses.dataclass
class Report:
    """One page about finished or running runs, or folders of runs; runs that differ only in their
    seed are one curve."""

    runs: tuple[str, ...]
    _: dataclasses.KW_ONLY
    output: pathlib.Path | None = None
    """File of the page (short: -o). None: report.html in the folder of the runs."""
    labels: tuple[str, ...] = ()
    """Names of the curves, one for each, in the order of the runs. None given: their algorithms
    and tasks."""

    def __call__(self, line: Line) -> None:
        """Write the page, and say where. One about several runs belongs to none of them: it goes to
        the folder in which all of them lie."""
        line.done()
        from ..report import run_page
        from ..runs import folder

        runs = [run for path in self.runs for run in folder.runs_in(path)]
        common = self.runs[0]
        if len(self.runs) > 1:
            parents = [pathlib.Path(path).absolute().parent for path in self.runs]
            common = os.path.relpath(os.path.commonpath(parents))
        target = self.output or pathlib.Path(common) / "report.html"
        print(f"page: {run_page.write(runs, target, labels=self.labels or None)}")


@dataclasses.dataclass
class Check:
    """Look for mistakes in a task, and of a team in JAX how often its rewards agree. Flags of the
    task, such as --max-episode-steps, change it."""

    task: str
    _: dataclasses.KW_ONLY
    kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)
    """NAME=VALUE …: what a task of Gymnasium or PettingZoo is made with, such as g=9.8. Values are
    read as Python: 8, 0.5, False, None, (1, 2); anything else is a string."""
    rewards: tuple[str, ...] = ()
    """Rewards of the task by name, the first is what training maximises; of a team of PettingZoo
    NAME=MODULE:FUNCTION …, rewards of your own. None given: the task's own."""

    def __call__(self, line: Line) -> None:
        """List what is wrong; exit code 1 if anything is."""
        from ..analysis import factoredness
        from ..environments import checks
        from ..environments.host import AbstractHostEnvironment
        from . import tasks

        line.skipped = {"id"}  # the task is a word
        env = line.take(tasks.task(self.task, self.kwargs, self.rewards), "env.")
        line.done()
        if isinstance(env, AbstractHostEnvironment):
            say(f"{self.task}: it is opened and plays for {checks.HOST_SECONDS:g} seconds, at most")
        problems = tasks.problems(env)
        for problem in problems:
            print(f"- {problem}")
        for told in [] if problems else factoredness.lines(env):
            print(told)
        print(f"{self.task}: {len(problems)} problem{'s' * (len(problems) != 1)} found")
        raise SystemExit(1 if problems else 0)


@dataclasses.dataclass
class Reproduce:
    """Rerun a figure or table of `credo list experiments`. What was run is not run again."""

    experiment: str
    _: dataclasses.KW_ONLY
    budget: Literal["smoke", "quick", "full", "million", "published"] = "quick"
    """smoke: seconds to minutes, proves nothing; quick: minutes; full: hours; some have million and
    published."""
    runs: int | None = None
    """Independent runs of each cell, at least 1. None: as many as the budget says."""
    only: str | None = None
    """Cells whose name has this regular expression, as '2-deep, fsp'; a word that is in none lists
    them. What was measured of other cells stays. None: all."""
    jobs: int | None = None
    """Runs at a time, at least 1. None: as many as there is room for, here one per core."""
    output: pathlib.Path = pathlib.Path("reproduced")
    """Folder for the page and its data."""
    work: pathlib.Path = pathlib.Path("runs/reproduce")
    """Folder for the runs behind them."""
    place: Place = Place()  # noqa: RUF009

    def __post_init__(self):
        require.at_least("runs", self.runs, 1)
        require.at_least("jobs", self.jobs, 1)

    def __call__(self, line: Line) -> None:
        """Run what is missing, measure, and say where the page is."""
        line.done()
        if self.experiment not in EXPERIMENTS:
            fail(f"no experiment {self.experiment!r}", self.experiment, EXPERIMENTS)
        from ..experiments import base

        names = ("runs", "only", "jobs", "output", "work")
        given = {name: getattr(self, name) for name in names}
        page = base.reproduce(self.experiment, self.budget, on=self.place, **given)
        print(f"page: {page}")


@dataclasses.dataclass
class List:
    """What there is: tasks, algorithms, networks, presets, experiments, or one of these."""

    kind: str | None = None

    def __call__(self, line: Line) -> None:
        """Print names with a line about each."""
        line.done()
        titles = ("tasks", "algorithms", "networks", "presets")
        sections = {title: CATALOGUE[title] for title in titles} | {"experiments": EXPERIMENTS}
        sections["tasks"] = sections["tasks"] | CATALOGUE["elsewhere"]
        if self.kind is not None and self.kind not in sections:
            fail(f"nothing called {self.kind!r} to list", self.kind, sections)
        for title in [self.kind] if self.kind else sections:
            print(title)
            width = max(map(len, sections[title])) + 2
            for name, entry in sections[title].items():
                print(f"  {name:<{width}}{entry if isinstance(entry, str) else entry['text']}")
