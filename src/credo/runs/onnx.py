"""A champion as an ONNX graph, by jax2onnx: for the runtimes of others, such as ONNX Runtime.

Inputs are `observation` and, of a policy with memory, `memory_0`, `memory_1`, …; outputs `action`,
in [-1, 1], and the memories that the next step is given, `next_memory_0`, …. The file's metadata
have, under `credo.policy`, what the runner's files say of the task and its actions (JSON), and
under `credo.memory` the memories at the start of an episode.
"""

import contextlib
import importlib
import importlib.util
import io
import json
import logging
import pathlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from ..compilation import float32
from ..runner import DESCRIPTION
from . import files
from .export import described
from .policy import champion
from .record import RunError
from .store import Run

MEMORY = "credo.memory"  # its name in the metadata
NEEDS = ("jax2onnx", "onnxruntime")


@float32()
def export(run: Run, path: str | pathlib.Path) -> pathlib.Path:
    """Write a run's champion to an ONNX file, and let ONNX Runtime play a step of it: what differs
    from the policy is not written. What was at `path` is replaced.

    **Raises:** `RunError` if jax2onnx or onnxruntime is not installed, if the folder is not there,
    or if the policy cannot be told as a graph.
    """
    path = pathlib.Path(path)
    if missing := [name for name in NEEDS if importlib.util.find_spec(name) is None]:
        raise RunError(f"ONNX needs {' and '.join(missing)}: `pip install 'credo[onnx]'`")
    if not path.parent.is_dir():
        raise RunError(f"{path.parent} is no folder: make it first, or name another file")
    policy, (description, _) = champion(run), described(run)
    obs = np.ones(_shape(description), np.float32)
    carry = policy.start(key=jax.random.key(0))
    memories, form = jax.tree.flatten(carry)
    if not all(x.dtype == np.float32 for x in memories):
        raise RunError(
            "its memory holds more than numbers, such as the key of an order that is drawn: no "
            "graph has that; export it for credo.Runner"
        )

    def step(obs: Any, *memories: Any) -> tuple[Any, ...]:
        action, carry = policy(obs, jax.tree.unflatten(form, memories))
        return action, *jax.tree.leaves(carry)

    model = _graph(step, obs, memories)
    for name, value in ((DESCRIPTION, description), (MEMORY, [x.tolist() for x in memories])):
        model.metadata_props.add(key=name, value=json.dumps(value))
    data = model.SerializeToString()
    _compare(data, step, obs, memories)
    with files.whole(path) as draft:
        draft.write_bytes(data)
    return path


def _shape(description: dict[str, Any]) -> tuple[int, ...]:
    """Of an observation."""
    agents = description["agents"]
    return (*(() if agents is None else (agents,)), description["obs_size"])


def _graph(step: Any, obs: np.ndarray, memories: list[Any]) -> Any:
    """The function as an ONNX model."""
    n = range(len(memories))
    try:
        with _unheard():
            return importlib.import_module("jax2onnx").to_onnx(
                step,
                [jax.ShapeDtypeStruct(x.shape, np.float32) for x in (obs, *memories)],
                model_name="policy",
                input_names=["observation", *(f"memory_{i}" for i in n)],
                output_names=["action", *(f"next_memory_{i}" for i in n)],
            )
    except Exception as error:  # whatever a converter of others makes of a network
        raise RunError(
            f"jax2onnx cannot tell this policy as a graph ({type(error).__name__}: {error}): "
            "export it for credo.Runner"
        ) from error


@contextlib.contextmanager
def _unheard() -> Iterator[None]:
    """jax2onnx prints and logs, with tracebacks, which of its parts this JAX has no use for."""
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        logging.disable(before)


def _compare(data: bytes, step: Any, obs: np.ndarray, memories: list[PyTree]) -> None:
    """Raise `RunError` if ONNX Runtime says something else than the policy does."""
    runtime = importlib.import_module("onnxruntime")
    try:
        session = runtime.InferenceSession(data, providers=["CPUExecutionProvider"])
        names = [given.name for given in session.get_inputs()]
        given = dict(zip(names, (obs, *map(np.asarray, memories)), strict=True))
        said = session.run(None, given)
    except Exception as error:  # operations that this version of it does not have
        raise RunError(
            f"ONNX Runtime cannot play this policy ({error}): export it for credo.Runner"
        ) from error
    for ours, theirs in zip(step(obs, *memories), said, strict=True):
        if not np.allclose(ours, theirs, rtol=1e-4, atol=1e-5):
            far = float(np.abs(np.asarray(ours) - theirs).max())
            raise RunError(
                f"the graph of jax2onnx differs from the policy by {far:.2g}: export it for "
                "credo.Runner, and report this"
            )
