"""Films: pictures as a gif or an mp4, from traces or, outside JAX, while an episode is played.

A task of Gymnasium or PettingZoo draws itself ("rgb_array"): a copy of it is opened in this
process for that.
"""

import contextlib
import importlib.util
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ..environments.foreign import AbstractForeignEnvironment
from ..environments.host import EnvironmentFailure
from ..runs.record import RunError

Add = Callable[[np.ndarray], None]


@contextlib.contextmanager
def film(path: pathlib.Path, rate: float) -> Iterator[Add]:
    """Inside the `with` block add pictures `[height, width, 3]`, uint8: afterwards they are the
    video `path`, shown `rate` a second. Until then, and if the block raises, what had that name
    stays. Two that write one video do not mix.

    **Raises:** `RunError` for an mp4 without ffmpeg, or if that fails. Any other suffix is a gif.
    """
    mp4 = path.suffix.lower() == ".mp4"
    if mp4 and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise RunError(
            f"cannot write {path}: imageio-ffmpeg is not installed; "
            "`pip install imageio-ffmpeg`, or ask for a .gif"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        draft = pathlib.Path(folder) / path.name
        with (_mp4 if mp4 else _gif)(draft, rate) as add:
            yield add
        os.replace(draft, path)


@contextlib.contextmanager
def _gif(path: pathlib.Path, rate: float) -> Iterator[Add]:
    """A gif that repeats for ever; all pictures are in memory until it is written."""
    from PIL import Image

    images = []
    yield lambda picture: images.append(Image.fromarray(picture))
    duration = 10 * max(2, round(100 / rate))  # ms; the format counts time in hundredths
    images[0].save(path, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0)


@contextlib.contextmanager
def _mp4(path: pathlib.Path, rate: float) -> Iterator[Add]:
    """An H.264 video; ffmpeg takes each picture as it comes. The first one tells the size."""
    with tempfile.TemporaryFile() as said:  # a pipe that is not read could fill and stop it
        process: subprocess.Popen[bytes] | None = None

        def add(picture: np.ndarray) -> None:
            nonlocal process
            height, width = (n - n % 2 for n in picture.shape[:2])  # colours are for 2 x 2 pixels
            process = process or _ffmpeg(path, rate, f"{width}x{height}", said)
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # if it ends early it says why
                process.stdin.write(np.ascontiguousarray(picture[:height, :width]).data)

        try:
            yield add
        finally:
            if process is not None:
                process.communicate()
        if process is not None and process.returncode != 0:
            said.seek(0)
            words = said.read().decode(errors="replace").strip()
            raise RunError(f"cannot write {path}: ffmpeg says {words!r}; or ask for a .gif")


def _ffmpeg(path: pathlib.Path, rate: float, size: str, said: Any) -> subprocess.Popen[bytes]:
    """A process that makes `path` of what it is given. Not started by imageio_ffmpeg, which would
    fork: JAX must not be forked."""
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    source = f"-v error -f rawvideo -pix_fmt rgb24 -s {size} -r {rate} -i -".split()
    target = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-y"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *source, *target, str(path.absolute())]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=said)


@contextlib.contextmanager
def drawing(
    task: AbstractForeignEnvironment, size: tuple[int, int]
) -> Iterator[tuple[AbstractForeignEnvironment, Any]]:
    """A task that draws, at this size (width, height) if it lets us choose, and its one copy, in
    this process. Whether it takes these arguments is tried: wrappers and `**kwargs` do not tell.

    **Raises:** `RunError` if it cannot be drawn, or fails for another reason.
    """
    with _opened(task) as (_, env):
        modes = list(getattr(env, "metadata", {}).get("render_modes", []))
    mode = {"render_mode": "rgb_array"}
    sized = mode | {"width": size[0], "height": size[1]}
    refused: RunError | None = None
    for arguments in (sized, mode) if "rgb_array" in modes else ():
        with contextlib.ExitStack() as stack:
            try:
                opened = stack.enter_context(_opened(task, **arguments))
            except RunError as error:
                if not isinstance(_first(error), TypeError):
                    raise
                refused = error
                continue
            yield opened
            return
    raise RunError(
        f"{task.id} cannot be drawn: for that it must take render_mode, name 'rgb_array' among the "
        "render_modes of its metadata, and return an array [height, width, 3] from render(); it "
        f"names {modes}"
    ) from refused


@contextlib.contextmanager
def _opened(
    task: AbstractForeignEnvironment, **arguments: Any
) -> Iterator[tuple[AbstractForeignEnvironment, Any]]:
    """A task with further arguments, and its one copy, opened in this process and closed behind the
    block. Raises `RunError` if it cannot be opened, or fails inside the block."""
    kwargs = tuple((dict(task.kwargs) | arguments).items())
    task = replace(task, kwargs=kwargs, in_process=True, tolerated=0.0, at_once=None)
    try:
        copies: Any = task.copies(1)
        with contextlib.closing(copies):
            yield task, copies.here
    except EnvironmentFailure as failure:
        chosen = os.environ.get("MUJOCO_GL", "")  # its library is loaded with MuJoCo
        hint = f"; MUJOCO_GL is {chosen!r}" if "OpenGL" in str(failure) else ""
        raise RunError(f"{failure}{hint}") from failure


def _first(error: BaseException) -> BaseException:
    """What an error goes back to, by its chain of causes."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def draw(render: Callable[[], Any], name: str, env: Any = None) -> np.ndarray:
    """A picture as videos take it: `[height, width, 3]`, uint8, without an alpha channel.

    **Raises:** `RunError` if `render()` raises or returns something else. `name` and `env`: of the
    task, for its message.
    """
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
    if picture.shape[2] == 3:
        return picture
    alpha = picture[:, :, 3:] / 255.0  # on white
    return np.rint(alpha * picture[:, :, :3] + 255.0 * (1.0 - alpha)).astype(np.uint8)


def _advice(env: Any) -> str:
    """What to do where drawing fails: MuJoCo wants OpenGL, which a machine without a display has
    under two other names."""
    mujoco = sys.modules.get("gymnasium.envs.mujoco.mujoco_env")
    if mujoco and isinstance(getattr(env, "unwrapped", None), mujoco.MujocoEnv):
        return (
            "without a display set the environment variable MUJOCO_GL=egl (it needs libEGL, from "
            "the graphics driver or Mesa) or MUJOCO_GL=osmesa (it needs libOSMesa) beforehand"
        )
    return "install what it names, or mend its render()"
