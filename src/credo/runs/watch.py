"""What `credo watch` makes: a film of a champion, a page that plays in the browser, or pictures."""

import contextlib
import importlib.util
import inspect
import itertools
import math
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np

from .. import require
from ..environments import worker
from ..environments.extended_tmaze import ExtendedTMaze
from ..environments.gymnasium import Gymnasium
from ..environments.host import AbstractHostEnvironment
from ..environments.rover import Rover
from ..environments.wrappers import DelayedHostReward, DelayedReward
from . import files, maze_page, replay_page
from .loop import Policy, Run, RunError

FASTEST = 50  # pictures per second: browsers slow a gif down that has more
STEPS = 30  # per second, where an environment does not say
ROVER_STEPS = 5  # per second; in real time it would be one


def watch(
    run: Run,
    output: str | pathlib.Path | None = None,
    *,
    episodes: int = 1,
    seed: int = 0,
    fps: float | None = None,
    size: tuple[int, int] = (480, 480),
) -> pathlib.Path:
    """Show episodes of a run's champion, without a window: on a Gymnasium task or with rovers as a
    film, with rovers also as a page that plays in the browser, in a T-maze as a page of pictures.

    A Gymnasium environment is made in this process.

    **Arguments:**

    - `output`: a file that ends in .gif, in .mp4, which needs the extra `credo[video]`, with
      rovers also in .html, and of a T-maze in .html alone; None: `champion.html` in the run's
      folder with rovers and of a T-maze, else `champion.gif`.
    - `episodes`: one after the other, with seeds `seed`, `seed` + 1, …
    - `fps`: environment steps shown per second; None: in real time, as far as the environment
      tells, and 5 with rovers. Above 50 a film leaves some steps out. The speed of a page can be
      changed in the page. Of a T-maze nothing moves.
    - `size`: width and height of a film in pixels, where the environment lets us choose (MuJoCo's
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
    rovers, maze, task = rover_task(env), maze_task(env), gymnasium_task(env)
    paged = rovers is not None or maze is not None
    default = run.path / ("champion.html" if paged else "champion.gif")
    output = default if output is None else pathlib.Path(output)
    seeds = range(seed, seed + episodes)
    if maze is not None:
        return _show_maze(run, maze, output, seeds)
    if rovers is not None:
        return _watch_rovers(run, rovers, output, seeds, fps or ROVER_STEPS, size)
    write = _writer(output)
    if task is None:
        raise RunError(_nothing_to_see(run))
    with opened(task, **_drawing(task, size)) as copy:
        rate = fps or copy._envs[0].metadata.get("render_fps") or STEPS
        stride = math.ceil(rate / FASTEST)
        pictures = _pictures(copy, task.id, run.policy(), seeds, stride)
        return _film(write, output, pictures, rate / stride)


def _watch_rovers(
    run: Run,
    env: Rover,
    output: pathlib.Path,
    seeds: range,
    rate: float,
    size: tuple[int, int],
) -> pathlib.Path:
    page = output.suffix.lower() == ".html"
    write = None if page else _writer(output, "in .html, .mp4 or .gif")
    episodes = replay_page.play(env, run.champion, seeds)
    if write is None:
        title = f"Credo: {run.path.name}"
        lead = (
            f"The champion with {env.agents} rovers, {env.pois} POIs and coupling {env.coupling}."
        )
        return replay_page.write(env, episodes, output, title=title, lead=lead, speed=rate)
    from . import trajectories  # matplotlib, for a film alone

    stride = math.ceil(rate / FASTEST)
    pictures = trajectories.pictures(env, episodes, size, stride)
    return _film(write, output, pictures, rate / stride)


def _show_maze(run: Run, env: ExtendedTMaze, output: pathlib.Path, seeds: range) -> pathlib.Path:
    if output.suffix.lower() != ".html":
        raise ValueError(f"the output is to be {str(output)!r}: of a T-maze it must end in .html")
    return maze_page.write(env, run.champion, seeds, output, title=f"Credo: {run.path.name}")


def _film(
    write: "Writer", output: pathlib.Path, pictures: Iterator[np.ndarray], rate: float
) -> pathlib.Path:
    """Pictures in a file that is there once it is whole."""
    with files.whole(output) as draft:
        write(draft, pictures, rate)
    return output


def rover_task(env: Any) -> Rover | None:
    """The rover domain itself, without what pays its rewards later; None if it is another task."""
    while isinstance(env, DelayedReward):
        env = env.env
    return env if isinstance(env, Rover) else None


def maze_task(env: Any) -> ExtendedTMaze | None:
    """The T-maze itself, without what pays its rewards later; None if it is another task."""
    while isinstance(env, DelayedReward):
        env = env.env
    return env if isinstance(env, ExtendedTMaze) else None


def gymnasium_task(env: Any) -> Gymnasium | None:
    """The task of Gymnasium itself, without what pays its rewards later; None if it is another."""
    while isinstance(env, DelayedHostReward):
        env = env.env
    return env if isinstance(env, Gymnasium) else None


@contextlib.contextmanager
def opened(task: Gymnasium, **kwargs: Any) -> Iterator[worker.Environments]:
    """One copy of a task in this process, with further arguments, behind the flat arrays that its
    worker has."""
    limit = task.max_episode_steps
    spec = {"id": task.id, "kwargs": dict(task.kwargs) | kwargs, "max_episode_steps": limit}
    copy = None
    try:
        copy = worker.Environments(spec, 1)
        yield copy
    except worker.Fault as fault:
        chosen = os.environ.get("MUJOCO_GL", "")  # its library is loaded with MuJoCo
        hint = f"; MUJOCO_GL is {chosen!r}" if "OpenGL" in fault.what else ""
        raise RunError(f"{task.id} {fault.what}: {fault.fix}{hint}") from fault
    finally:
        if copy is not None:
            copy.close()


def _nothing_to_see(run: Run) -> str:
    env = run.algorithm.env
    name = type(env).__name__
    seen = "what can be watched are rovers, T-mazes and tasks of Gymnasium"
    if isinstance(env, AbstractHostEnvironment):
        return f"{name} cannot be drawn: {seen}"
    return (
        f"{name} has nothing to draw: its observations are plain numbers; {seen}. "
        f"`credo report {run.path}` shows what the run has learned"
    )


def _drawing(task: Gymnasium, size: tuple[int, int]) -> dict[str, Any]:
    """Arguments with which the task can be drawn."""
    with opened(task) as copy:
        env = copy._envs[0].unwrapped
    modes = env.metadata.get("render_modes", [])
    if not _takes(type(env), "render_mode") or "rgb_array" not in modes:
        raise RunError(
            f"{task.id} cannot be drawn: for that its class {type(env).__name__} must take "
            "render_mode, name 'rgb_array' among the render_modes of its metadata, and return "
            f"an array [height, width, 3] from render(); it names {list(modes)}"
        )
    sized = _takes(type(env), "width") and _takes(type(env), "height")
    return {"render_mode": "rgb_array"} | ({"width": size[0], "height": size[1]} if sized else {})


def _takes(cls: type, name: str) -> bool:
    """Whether a class can be made with an argument of this name, its own or handed on."""
    for base in cls.__mro__:
        if "__init__" in vars(base):
            parameters = inspect.signature(vars(base)["__init__"]).parameters
            if name in parameters:
                return True
            if all(p.kind != inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
                return False
    return False


def _pictures(
    copy: worker.Environments, name: str, policy: Policy, seeds: range, stride: int
) -> Iterator[np.ndarray]:
    """`[height, width, 3]`, uint8: the start and the end of every episode, and every `stride`-th
    step between."""
    env, active = copy._envs[0], np.ones(1, np.bool_)
    for seed in seeds:
        policy.reset()
        frame = copy.reset(np.array([seed % 2**32], np.uint32), active)
        yield _draw(env, name)
        step, ended = 0, False
        while not ended:
            frame = copy.step(policy(frame.obs[0])[None], active)
            step += 1
            ended = bool(frame.terminated[0] or frame.truncated[0])
            if ended or step % stride == 0:
                yield _draw(env, name)


def _draw(env: gymnasium.Env, name: str) -> np.ndarray:
    try:
        picture: Any = env.render()
    except Exception as error:  # an environment's own code, and a graphics library's
        told = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        raise RunError(f"{name} cannot be drawn here ({told}): {_advice(env)}") from error
    picture = np.asarray(picture)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise RunError(
            f"{name} drew an array of shape {picture.shape} and dtype {picture.dtype}: its "
            "render() must return [height, width, 3], uint8"
        )
    return picture


def _advice(env: gymnasium.Env) -> str:
    mujoco = sys.modules.get("gymnasium.envs.mujoco.mujoco_env")
    if mujoco is not None and isinstance(env.unwrapped, mujoco.MujocoEnv):
        return (
            "without a display set the environment variable MUJOCO_GL=egl (it needs libEGL, from "
            "the graphics driver or Mesa) or MUJOCO_GL=osmesa (it needs libOSMesa) beforehand"
        )
    return "install what it names, or mend its render()"


Writer = Callable[[pathlib.Path, Iterator[np.ndarray], float], None]


def _writer(output: pathlib.Path, kinds: str = "in .mp4 or .gif") -> Writer:
    """What writes pictures to such a file."""
    kind = output.suffix.lower()
    if kind == ".gif":
        return _write_gif
    if kind != ".mp4":
        raise ValueError(f"the output is to be {str(output)!r}: its name must end {kinds}")
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise RunError(
            f"cannot write {output}: imageio-ffmpeg is not installed; "
            '`pip install "credo[video]"`, or ask for a .gif'
        )
    return _write_mp4


def _write_gif(path: pathlib.Path, pictures: Iterator[np.ndarray], rate: float) -> None:
    from PIL import Image

    images = (Image.fromarray(picture) for picture in pictures)
    hundredths = max(2, round(100 / rate))  # the format counts time in these
    next(images).save(
        path, "GIF", save_all=True, append_images=images, duration=10 * hundredths, loop=0
    )


def _write_mp4(path: pathlib.Path, pictures: Iterator[np.ndarray], rate: float) -> None:
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    # Started here: that package would fork, which a process with JAX in it must not.
    first = next(pictures)
    height, width = (n - n % 2 for n in first.shape[:2])  # colours are stored for 2 x 2 pixels
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate} -i -".split()
    film = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-y", str(path.absolute())]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *source, *film]
    with tempfile.TemporaryFile() as told:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=told, stderr=told)
        with contextlib.suppress(BrokenPipeError), process:  # if it ends early it says why
            assert process.stdin is not None
            for picture in itertools.chain([first], pictures):
                process.stdin.write(np.ascontiguousarray(picture[:height, :width]).data)
        told.seek(0)
        if process.returncode != 0:
            words = told.read().decode(errors="replace").strip()
            raise RunError(f"cannot write {path}: ffmpeg says {words!r}; or ask for a .gif")
