"""Films: pictures as a gif or an mp4, from traces or, outside JAX, while an episode is played.

A task of Gymnasium or PettingZoo draws itself ("rgb_array"): a copy of it is opened in this
process for that.
"""

import contextlib
import importlib.util
import inspect
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
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

    **Raises:** `ValueError` for another suffix than .gif and .mp4; `RunError` without ffmpeg.
    """
    kind = _kind(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        draft = pathlib.Path(folder) / path.name
        with kind(draft, rate) as add:
            yield add
        os.replace(draft, path)


def _kind(path: pathlib.Path) -> Callable[..., Any]:
    """What writes such a video."""
    suffix = path.suffix.lower()
    if suffix == ".gif":
        return _gif
    if suffix != ".mp4":
        raise ValueError(f"the output is to be {str(path)!r}: its name must end in .mp4 or .gif")
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise RunError(
            f"cannot write {path}: imageio-ffmpeg is not installed; "
            '`pip install "credo[video]"`, or ask for a .gif'
        )
    return _mp4


@contextlib.contextmanager
def _gif(path: pathlib.Path, rate: float) -> Iterator[Add]:
    from PIL import Image

    images = []
    yield lambda picture: images.append(Image.fromarray(picture))
    hundredths = max(2, round(100 / rate))  # the format counts time in these
    images[0].save(
        path, "GIF", save_all=True, append_images=images[1:], duration=10 * hundredths, loop=0
    )


@contextlib.contextmanager
def _mp4(path: pathlib.Path, rate: float) -> Iterator[Add]:
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    process: subprocess.Popen[bytes] | None = None
    with tempfile.TemporaryFile() as told, contextlib.ExitStack() as stack:

        def add(picture: np.ndarray) -> None:
            nonlocal process
            height, width = (n - n % 2 for n in picture.shape[:2])  # colours are for 2 x 2 pixels
            if process is None:  # started here: that package would fork, which JAX must not
                source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate} -i -".split()
                target = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-y"]
                command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *source, *target]
                process = stack.enter_context(
                    subprocess.Popen(
                        [*command, str(path.absolute())],
                        stdin=subprocess.PIPE,
                        stdout=told,
                        stderr=told,
                    )
                )
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # if it ends early it says why
                process.stdin.write(np.ascontiguousarray(picture[:height, :width]).data)

        yield add
        assert process is not None
        with contextlib.suppress(BrokenPipeError):
            process.communicate()
        if process.returncode != 0:
            told.seek(0)
            words = told.read().decode(errors="replace").strip()
            raise RunError(f"cannot write {path}: ffmpeg says {words!r}; or ask for a .gif")


@contextlib.contextmanager
def drawing(
    task: AbstractForeignEnvironment, size: tuple[int, int]
) -> Iterator[tuple[AbstractForeignEnvironment, Any]]:
    """A task that draws, at this size (width, height) if it lets us choose, and its one copy, in
    this process. Raises `RunError` if it cannot."""
    with _opened(task) as (_, env):
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
                opened = stack.enter_context(_opened(task, **arguments))
                break
            except RunError as error:  # **kwargs may lead to what does not take them
                if not isinstance(_first(error), TypeError):
                    raise
        else:
            raise RunError(told)
        yield opened


@contextlib.contextmanager
def _opened(
    task: AbstractForeignEnvironment, **arguments: Any
) -> Iterator[tuple[AbstractForeignEnvironment, Any]]:
    """A task with further arguments, and its one copy, opened in this process."""
    kwargs = tuple((dict(task.kwargs) | arguments).items())
    task = replace(task, kwargs=kwargs, in_process=True, tolerated=0.0, at_once=None)
    copies: Any = None
    try:
        copies = task.copies(1)
        yield task, copies.here
    except EnvironmentFailure as failure:
        chosen = os.environ.get("MUJOCO_GL", "")  # its library is loaded with MuJoCo
        hint = f"; MUJOCO_GL is {chosen!r}" if "OpenGL" in str(failure) else ""
        raise RunError(f"{failure}{hint}") from failure
    finally:
        if copies is not None:
            copies.close()


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


def draw(render: Callable[[], Any], name: str, env: Any = None) -> np.ndarray:
    """A picture as videos take it. Raises `RunError` if `render()` does, or returns none."""
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
