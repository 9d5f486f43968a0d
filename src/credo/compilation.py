"""Compiling: one `jit` for the whole library, and a cache that outlives the process."""

import contextlib
import functools
import os
import pathlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.core
import numpy as np


def cache_directory() -> pathlib.Path | None:
    """Where compiled programs are kept: `$CREDO_CACHE`, or `credo` in `$XDG_CACHE_HOME` or
    `~/.cache`. None if nothing can be written there, or it is not known where home is."""
    try:
        named = os.environ.get("CREDO_CACHE")
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        path = pathlib.Path(named) if named else pathlib.Path(home) / "credo"
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # without HOME, and with a user whom the system does not know
        return None
    return path if os.access(path, os.W_OK | os.X_OK) else None


def jit(function: Any = None, *, donate: Any = "none") -> Any:
    """`equinox.filter_jit` that treats Python floats as data.

    Under plain `filter_jit` a float is part of the program, so a new mutation strength or γ
    compiles again. Sizes (`int`, `str`, `bool`) stay part of the program. `donate` as there:
    `"all-except-first"` lets the result take the place of every argument but the first.
    """
    if function is None:
        return functools.partial(jit, donate=donate)
    inner = eqx.filter_jit(function, donate=donate)
    # XLA fills half of a 512-bit register unless told otherwise. With all of it a population of
    # 100 packed on the last axis plays twice as fast, to the same bits; processors without such
    # registers ignore it. JAX takes the option at the outermost `jit` only.
    options: dict[str, Any] = {"compiler_options": {"xla_cpu_prefer_vector_width": 512}}
    outer = eqx.filter_jit(function, donate=donate, **options)

    @functools.wraps(function)
    def call(*args, **kwargs):
        args, kwargs = jax.tree.map(
            lambda x: np.asarray(x, np.float32) if isinstance(x, float) else x, (args, kwargs)
        )
        traced = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((args, kwargs)))
        return (inner if traced else outer)(*args, **kwargs)

    return call


@contextlib.contextmanager
def float32() -> Iterator[None]:
    """Numbers have 32 bits here, also where JAX was told to give them 64 (`JAX_ENABLE_X64`), which
    is the caller's affair: a run is the same with and without. Wider ones that are passed to a
    program are rounded. Also a decorator, `@float32()`; other threads see nothing of it.

    What a task in JAX computes between `reset` and the end of an episode has 32 bits too.
    """
    wide = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    with jax.enable_x64(False) if wide else contextlib.nullcontext():
        yield


def when(due: Any, play: Callable[[], Any], skip: Callable[[], Any]) -> Any:
    """`play()` if the scalar `due`, else `skip()`; as part of a program only where `due` is traced,
    so that what reaches outside JAX can be called where it is not."""
    if isinstance(due, jax.core.Tracer):
        return jax.lax.cond(due, play, skip)
    return play() if due else skip()


def repeat(due: Callable[[Any], Any], step: Callable[[Any], Any], state: Any) -> Any:
    """`step` as long as `due(state)`; as part of a program only where that is traced (`when`)."""
    if not isinstance(due(state), jax.core.Tracer):
        while due(state):
            state = step(state)
        return state
    dynamic, static = eqx.partition(state, eqx.is_array)

    def again(dynamic):
        return eqx.filter(step(eqx.combine(dynamic, static)), eqx.is_array)

    dynamic = jax.lax.while_loop(lambda x: due(eqx.combine(x, static)), again, dynamic)
    return eqx.combine(dynamic, static)


@functools.cache  # said once
def enable_cache() -> None:
    """Keep compiled programs in `cache_directory()` between processes."""
    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:
        return  # the user's own choice, with thresholds of their own
    directory = cache_directory()
    if directory is None:
        # Not in a folder for temporary files: whoever can write there could give us programs.
        warnings.warn(
            "compiled programs are not kept, so every command compiles anew: HOME has no .cache "
            "that can be written; set CREDO_CACHE to a folder that can",
            stacklevel=2,
        )
        return
    jax.config.update("jax_compilation_cache_dir", str(directory / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
