"""What `credo watch` makes of a run's best policy: an HTML page that plays, or a video."""

import itertools
import math
import pathlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from .. import require
from ..compilation import float32
from ..environments.foreign import AbstractForeignEnvironment
from ..environments.host import AbstractHostEnvironment
from ..environments.rover import Rover
from ..rollout import record
from ..runs.policy import champion
from ..runs.record import RunError
from ..runs.store import Run
from ..types import Trace
from . import films, viewer

FASTEST = 50  # pictures per second: browsers slow a gif down that has more
STEPS = 30  # per second, where an environment does not say


@float32()
def watch(
    run: Run,
    output: str | pathlib.Path | None = None,
    *,
    episodes: int = 1,
    seed: int = 0,
    fps: float | None = None,
    size: tuple[int, int] = (480, 480),
) -> pathlib.Path:
    """Show episodes of a run's best policy, without a window.

    A task with a `viewer()` (rovers, T-mazes, server fleets, sequences) is an HTML page that plays
    in the browser. Videos are of rovers, of a JAX task with `render(state)`, and of a task of
    Gymnasium or PettingZoo that draws "rgb_array", which is opened in this process.

    **Arguments:**

    - `output`: a file that ends in .html, .gif, or .mp4, which needs imageio-ffmpeg;
      None: `champion.html` in the run's folder, or `champion.gif` where there is no page.
    - `episodes`: one after the other, with seeds `seed`, `seed` + 1, …
    - `fps`: environment steps shown per second; None: in real time, as far as the environment
      tells, else the viewer's. Above 50 a video leaves some steps out. The speed of a page can be
      changed in the page.
    - `size`: width and height of a video in pixels, where the environment lets us choose (MuJoCo's
      and rovers do).

    **Returns:** `output`. What was there is replaced once the new file is whole.

    **Raises:** `RunError` if the task or this machine cannot draw; `ValueError`.
    """
    require.at_least("episodes", episodes, 1)
    require.at_least("width", size[0], 2)
    require.at_least("height", size[1], 2)
    if fps is not None and not 0 < fps < math.inf:
        raise ValueError(f"fps is {fps}: it must be more than 0")
    env = run.algorithm.env
    shown, played = env.viewer(), isinstance(env.unwrapped, AbstractForeignEnvironment)
    output, seeds = _target(run, output, shown is not None), range(seed, seed + episodes)
    if shown is not None and output.suffix.lower() == ".html":
        policy = champion(run)
        traces = {f"seed {s}": record(env, policy, key=jax.random.key(s)) for s in seeds}
        title = f"Credo: {run.path.name}"
        viewer.write(shown, traces, output, title=title, speed=fps)
    elif played:
        _film_played(run, output, seeds, fps, size)
    else:
        _film_states(run, output, seeds, fps or (shown.speed if shown else STEPS), size)
    return output


def _target(run: Run, output: str | pathlib.Path | None, page: bool) -> pathlib.Path:
    """The file to write; `page`: whether the task has one that plays. Raises `RunError` if nothing
    of the task can be drawn, `ValueError` for a kind of file that cannot be made of it."""
    task = run.algorithm.env.unwrapped
    drawn = not isinstance(task, AbstractHostEnvironment) and hasattr(task, "render")
    filmed = drawn or isinstance(task, AbstractForeignEnvironment)
    kinds = [".html"] * page + [".mp4", ".gif"] * filmed
    if not kinds:
        raise RunError(_nothing_to_see(run))
    if output is None:
        return run.path / ("champion.html" if page else "champion.gif")
    output = pathlib.Path(output)
    if output.suffix.lower() not in kinds:
        names = " or ".join(filter(None, [", ".join(kinds[:-1]), kinds[-1]]))
        raise ValueError(f"the output is to be {str(output)!r}: its name must end in {names}")
    return output


def _nothing_to_see(run: Run) -> str:
    """What is said of a task that cannot be drawn: which can, and what else shows the run."""
    return (
        f"{type(run.algorithm.env.unwrapped).__name__} has nothing to draw: what can be watched "
        "are rovers, T-mazes (up to 6 deep), server fleets, sequence-classification and "
        "sequence-recall, tasks of Gymnasium and PettingZoo, and JAX tasks with viewer() or with "
        "render(state), which returns a picture [height, width, 3]. "
        f"`credo report {run.path}` shows what the run has learned"
    )


def _film_states(
    run: Run, output: pathlib.Path, seeds: range, rate: float, size: tuple[int, int]
) -> None:
    """A video of a task in JAX, from traces: every `stride`-th step, and the last one, at no more
    than `FASTEST` pictures per second. `rate`: steps per second."""
    env, policy, stride = run.algorithm.env, champion(run), math.ceil(rate / FASTEST)
    with films.film(output, rate / stride) as add:
        for seed in seeds:
            trace = record(env, policy, key=jax.random.key(seed))
            moments = [*range(0, trace.length, stride), int(trace.length)]
            for picture in _pictures(env, trace, f"seed {seed}", moments, size):
                add(picture)


def _pictures(
    env: Any, trace: Trace, name: str, moments: list[int], size: tuple[int, int]
) -> Iterator[np.ndarray]:
    """An episode at these moments: of rovers as we draw them, of another task as it does."""
    task = env.unwrapped
    if isinstance(task, Rover):
        from . import trajectories  # matplotlib

        yield from trajectories.pictures(task, env.viewer().episode(trace), name, moments, size)
        return
    states = env.bare(trace.states)
    for t in moments:
        state = jax.tree.map(lambda x, t=t: x[t], states)
        yield films.draw(lambda state=state: task.render(state), type(task).__name__)


def _film_played(
    run: Run, output: pathlib.Path, seeds: range, fps: float | None, size: tuple[int, int]
) -> None:
    """A video of a task that draws itself, made while it is played. `fps`: steps per second; None:
    those that the environment names, else `STEPS`."""
    task, policy = run.algorithm.env.unwrapped, champion(run)
    with films.drawing(task, size) as (opened, env):
        rate = fps or getattr(env, "metadata", {}).get("render_fps") or STEPS
        stride = math.ceil(rate / FASTEST)
        with films.film(output, rate / stride) as add:
            for seed in seeds:
                moments = itertools.count()

                def see(over: bool, moments=moments) -> None:
                    if next(moments) % stride == 0 or over:
                        add(films.draw(env.render, task.id, env))

                record(opened, policy, key=jax.random.key(seed), seed=seed % 2**32, see=see)
