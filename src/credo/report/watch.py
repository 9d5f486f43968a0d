"""What `credo watch` makes of a run's best policy: an HTML page that plays, or a video."""

import math
import pathlib
from typing import Any

import jax

from .. import require
from ..compilation import float32
from ..environments.foreign import AbstractForeignEnvironment
from ..environments.host import AbstractHostEnvironment
from ..environments.rover import Rover
from ..rollout import record
from ..runs.policy import champion
from ..runs.record import RunError
from ..runs.store import Run
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

    - `output`: a file that ends in .html, .gif, or .mp4, which needs the extra `credo[video]`;
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
    shown, filmed = env.viewer(), _filmed(env)
    if shown is None and not filmed:
        raise RunError(_nothing_to_see(run))
    default = run.path / ("champion.gif" if shown is None else "champion.html")
    output = default if output is None else pathlib.Path(output)
    _check(output, shown is not None, filmed)
    seeds = range(seed, seed + episodes)
    if shown is not None and output.suffix.lower() == ".html":
        policy = champion(run)
        traces = {f"seed {s}": record(env, policy, key=jax.random.key(s)) for s in seeds}
        title = f"Credo: {run.path.name}"
        return viewer.write(shown, traces, output, title=title, speed=fps)
    if isinstance(env.unwrapped, AbstractForeignEnvironment):
        return _film_outside(run, output, seeds, fps, size)
    return _film_states(run, output, seeds, fps or (shown.speed if shown else STEPS), size)


def _filmed(env: Any) -> bool:
    """Whether there can be a video of it."""
    task = env.unwrapped
    if isinstance(task, AbstractHostEnvironment):
        return isinstance(task, AbstractForeignEnvironment)
    return hasattr(task, "render")


def _check(output: pathlib.Path, page: bool, filmed: bool) -> None:
    kinds = [".html"] * page + [".mp4", ".gif"] * filmed
    if output.suffix.lower() not in kinds:
        *others, last = kinds
        told = f"{', '.join(others)} or {last}" if others else last
        raise ValueError(f"the output is to be {str(output)!r}: its name must end in {told}")


def _nothing_to_see(run: Run) -> str:
    return (
        f"{type(run.algorithm.env.unwrapped).__name__} has nothing to draw: what can be watched "
        "are rovers, T-mazes (up to 6 deep), server fleets, sequences, tasks of Gymnasium and "
        "PettingZoo, and JAX tasks with viewer() or with render(state), which returns a picture "
        "[height, width, 3]. "
        f"`credo report {run.path}` shows what the run has learned"
    )


def _film_states(
    run: Run, output: pathlib.Path, seeds: range, rate: float, size: tuple[int, int]
) -> pathlib.Path:
    """A video of a task in JAX, from traces."""
    env, policy, stride = run.algorithm.env, champion(run), math.ceil(rate / FASTEST)
    task = env.unwrapped
    with films.film(output, rate / stride) as add:
        for seed in seeds:
            trace = record(env, policy, key=jax.random.key(seed))
            moments = [t for t in range(trace.length) if t % stride == 0] + [int(trace.length)]
            if isinstance(task, Rover):
                from . import trajectories  # matplotlib

                shown = env.viewer().episode(trace)
                for picture in trajectories.pictures(task, shown, f"seed {seed}", moments, size):
                    add(picture)
                continue
            states = env.bare(trace.states)
            for t in moments:
                state = jax.tree.map(lambda x, t=t: x[t], states)
                add(films.draw(lambda state=state: task.render(state), type(task).__name__))
    return output


def _film_outside(
    run: Run, output: pathlib.Path, seeds: range, fps: float | None, size: tuple[int, int]
) -> pathlib.Path:
    """A video of a task that draws itself, made while it is played."""
    task, policy = run.algorithm.env.unwrapped, champion(run)
    with films.drawing(task, size) as (opened, env):
        rate = fps or getattr(env, "metadata", {}).get("render_fps") or STEPS
        stride = math.ceil(rate / FASTEST)
        with films.film(output, rate / stride) as add:
            for seed in seeds:
                moment = iter(range(task.max_steps + 1))

                def see(over: bool, moment=moment) -> None:
                    if next(moment) % stride == 0 or over:
                        add(films.draw(env.render, task.id, env))

                record(opened, policy, key=jax.random.key(seed), seed=seed % 2**32, see=see)
    return output
