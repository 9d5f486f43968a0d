"""What `credo watch` makes of a run's best policy: a video, or an HTML page."""

import contextlib
import functools
import importlib.util
import inspect
import itertools
import math
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

from .. import require
from ..compilation import float32
from ..environments import worker
from ..environments.extended_tmaze import ExtendedTMaze
from ..environments.foreign import AbstractForeignEnvironment
from ..environments.host import AbstractHostEnvironment
from ..environments.rover import Rover
from ..runs import files
from ..runs.policy import Policy, champion, undelayed
from ..runs.record import RunError
from ..runs.store import Run
from . import maze_page, replay_page

FASTEST = 50  # pictures per second: browsers slow a gif down that has more
STEPS = 30  # per second, where an environment does not say
ROVER_STEPS = 5  # per second; in real time it would be one


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
    """Show episodes of a run's best policy, without a window: a video of a task of Gymnasium or
    PettingZoo that draws "rgb_array", of rovers, or of a JAX task with `render(state)`; of rovers
    also a page that plays in the browser, of a T-maze a page of pictures.

    An environment of others is made in this process.

    **Arguments:**

    - `output`: a file that ends in .gif, in .mp4, which needs the extra `credo[video]`, with
      rovers also in .html, and of a T-maze in .html alone; None: `champion.html` in the run's
      folder with rovers and of a T-maze, else `champion.gif`.
    - `episodes`: one after the other, with seeds `seed`, `seed` + 1, …
    - `fps`: environment steps shown per second; None: in real time, as far as the environment
      tells, and 5 with rovers. Above 50 a video leaves some steps out. The speed of a page can be
      changed in the page. Of a T-maze nothing moves.
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
    task = undelayed(run.algorithm.env)
    paged = isinstance(task, Rover | ExtendedTMaze)
    default = run.path / ("champion.html" if paged else "champion.gif")
    output = default if output is None else pathlib.Path(output)
    seeds = range(seed, seed + episodes)
    if isinstance(task, ExtendedTMaze):
        return _show_maze(run, task, output, seeds)
    if isinstance(task, Rover):
        return _watch_rovers(run, task, output, seeds, fps or ROVER_STEPS, size)
    write = _writer(output)
    if isinstance(task, AbstractForeignEnvironment):
        with _drawing(task, size) as copy:
            rate = fps or _clock(copy._envs[0]) or STEPS
            stride = math.ceil(rate / FASTEST)
            pictures = _pictures(copy, task.id, Policy(champion(run)), seeds, stride)
            return _film(write, output, pictures, rate / stride)
    if not hasattr(task, "render") or isinstance(task, AbstractHostEnvironment):
        raise RunError(_nothing_to_see(run))
    rate = fps or STEPS
    stride = math.ceil(rate / FASTEST)
    pictures = _scenes(task, Policy(champion(run)), seeds, stride)
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


@contextlib.contextmanager
def opened(task: AbstractForeignEnvironment, **kwargs: Any) -> Iterator[worker.Environments]:
    """One copy of a task in this process, with further arguments, behind the flat arrays that its
    worker has."""
    spec, copy = task.spec(), None
    try:
        copy = worker.Environments(spec | {"kwargs": spec["kwargs"] | kwargs}, 1)
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
    seen = (
        "what can be watched are rovers, T-mazes, tasks of Gymnasium and PettingZoo, and JAX tasks "
        "with render(state), which returns a picture [height, width, 3]"
    )
    if isinstance(env, AbstractHostEnvironment):
        return f"{name} cannot be drawn: {seen}"
    return (
        f"{name} has nothing to draw: its observations are plain numbers; {seen}. "
        f"`credo report {run.path}` shows what the run has learned"
    )


@contextlib.contextmanager
def _drawing(
    task: AbstractForeignEnvironment, size: tuple[int, int]
) -> Iterator[worker.Environments]:
    """One copy of a task that draws, at this size if it lets us choose."""
    with opened(task) as copy:
        env: Any = copy._envs[0]
        maker, inner = _maker(task.id, env), type(env.unwrapped)
        modes = list(getattr(env, "metadata", {}).get("render_modes", []))
    mode = {"render_mode": "rgb_array"}
    sized = mode | {"width": size[0], "height": size[1]}
    told = (
        f"{task.id} cannot be drawn: for that {_called(maker)} must take render_mode, name "
        "'rgb_array' among the render_modes of its metadata, and return an array "
        f"[height, width, 3] from render(); it names {modes}"
    )
    if "rgb_array" not in modes or not _takes(maker, inner, "render_mode"):
        raise RunError(told)
    choice = all(_takes(maker, inner, side) for side in ("width", "height"))
    with contextlib.ExitStack() as stack:
        for arguments in (sized, mode) if choice else (mode,):
            try:
                copy = stack.enter_context(opened(task, **arguments))
                break
            except RunError as error:  # **kwargs may lead to what does not take them
                if not isinstance(_first(error), TypeError):
                    raise
        else:
            raise RunError(told)
        yield copy


def _first(error: BaseException) -> BaseException:
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def _maker(id: str, env: Any) -> Any:
    """The class or function that made an environment; its modules are imported by now."""
    module, _, path = id.partition(":")
    registered = getattr(getattr(env, "spec", None), "entry_point", None)
    for name in (id, registered if isinstance(registered, str) else "", f"{module}:parallel_env"):
        module, _, path = name.partition(":")
        found = sys.modules.get(module)
        for part in path.split("."):
            found = getattr(found, part, None)
        if callable(found):
            return found
    return registered if callable(registered) else type(env.unwrapped)


def _called(maker: Any) -> str:
    kind = "its class" if inspect.isclass(maker) else "its function"
    return f"{kind} {getattr(maker, '__name__', maker)}"


def _takes(maker: Any, inner: type, name: str) -> bool:
    """Whether what makes an environment takes an argument of this name: its own, or through
    **kwargs a base class's or that of `inner`, the environment within all wrappers."""
    own = _parameters(maker)
    if name in own:
        return True
    if all(p.kind != inspect.Parameter.VAR_KEYWORD for p in own.values()):
        return False
    bases = [vars(base).get("__init__") for base in getattr(maker, "__mro__", ())]
    if any(name in _parameters(base) for base in bases if inspect.isfunction(base)):
        return True
    return maker is not inner and _takes(inner, inner, name)


def _parameters(maker: Any) -> Mapping[str, inspect.Parameter]:
    try:
        return inspect.signature(maker.__init__ if inspect.isclass(maker) else maker).parameters
    except (TypeError, ValueError):  # it is not Python's
        return {}


def _clock(env: Any) -> float | None:
    """Steps per second, if the environment says."""
    return getattr(env, "metadata", {}).get("render_fps")


def _pictures(
    copy: worker.Environments, name: str, policy: Policy, seeds: range, stride: int
) -> Iterator[np.ndarray]:
    """`[height, width, 3]`, uint8: the start and the end of every episode, and every `stride`-th
    step between."""
    env: Any = copy._envs[0]
    active = np.ones(1, np.bool_)
    for seed in seeds:
        policy.reset()
        frame = _sound(copy.reset(np.array([seed % 2**32], np.uint32), active))
        yield _draw(env.render, name, env)
        step, ended = 0, False
        while not ended:
            frame = _sound(copy.step(policy(frame.obs[0])[None], active))
            step += 1
            ended = bool(frame.terminated[0] or frame.truncated[0])
            if ended or step % stride == 0:
                yield _draw(env.render, name, env)


def _sound(frame: worker.Frame) -> worker.Frame:
    for fault in frame.faults.values():
        raise fault
    return frame


def _scenes(task: Any, policy: Policy, seeds: range, stride: int) -> Iterator[np.ndarray]:
    """The same of a JAX task that draws its state."""
    name = type(task).__name__
    reset = jax.jit(lambda key: task.reset(key=key))
    step = jax.jit(lambda state, action, key: task.step(state, action, key=key))
    for seed in seeds:
        policy.reset()
        first_key, key = jax.random.split(jax.random.key(seed % 2**32))
        state, now = reset(first_key)
        yield _draw(functools.partial(task.render, state), name)
        for i in itertools.count(1):
            action = np.clip(policy(now.obs), -1.0, 1.0)
            state, now = step(state, action, jax.random.fold_in(key, i))
            ended = bool(now.terminated | now.truncated)
            if ended or i % stride == 0:
                yield _draw(functools.partial(task.render, state), name)
            if ended:
                break


def _draw(render: Callable[[], Any], name: str, env: Any = None) -> np.ndarray:
    try:
        picture: Any = render()
    except Exception as error:  # an environment's own code, and a graphics library's
        told = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        raise RunError(f"{name} cannot be drawn here ({told}): {_advice(env)}") from error
    picture = np.asarray(picture)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] not in (3, 4):
        raise RunError(
            f"{name} drew an array of shape {picture.shape} and dtype {picture.dtype}: its "
            "render() must return [height, width, 3], uint8"
        )
    return picture if picture.shape[2] == 3 else _on_white(picture)


def _on_white(picture: np.ndarray) -> np.ndarray:
    """A picture with an alpha channel, opaque."""
    alpha = picture[:, :, 3:] / 255.0
    return np.rint(alpha * picture[:, :, :3] + 255.0 * (1.0 - alpha)).astype(np.uint8)


def _advice(env: Any) -> str:
    mujoco = sys.modules.get("gymnasium.envs.mujoco.mujoco_env")
    if mujoco and isinstance(getattr(env, "unwrapped", None), mujoco.MujocoEnv):
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
