"""A trained policy without JAX: this file, NumPy, and what `credo export` wrote.

    runner = Runner.load("policy.safetensors")
    runner.reset()  # at the start of every episode
    action = runner(observation)

Copy this one file to where the policy is to act: it needs nothing else of Credo. A policy is
numbers and names in a safetensors file; nothing in it is executed.
"""

import dataclasses
import hashlib
import json
import math
import pathlib
import stat
import struct
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

VERSION = 3  # of the description; files of 1, which knew one network each, and 2 are read too
DESCRIPTION, FINGERPRINT = "credo.policy", "credo.sha256"  # their names in the metadata
EPSILON = 1e-6  # of LayerNorm, relative to the variance
LARGEST = 2**30  # bytes of a file
DEEPEST = 8  # networks within networks
MOST_AGENTS = 10_000
MOST_PASSES = 10_000
UNMASKED = (
    "this task says which actions are allowed, and neither a mask was given nor does the "
    "observation begin with it: give mask=, ones where all are allowed"
)

Weights = dict[str, np.ndarray]


class Runner:
    """A policy that acts. Its memory, if it has one, is kept between calls.

    `obs_size` and `action_size` are numbers in an observation and in an action, of a team for each
    of `agents`, which is None for a policy of one. `description` is what the file says of it.
    """

    def __init__(self, description: dict[str, Any], weights: Weights):
        if description["version"] not in range(1, VERSION + 1):
            raise ValueError(
                f"it has format {description['version']}, and this runner reads 1 to {VERSION}: "
                f"use the runner of Credo {description['credo']}, which wrote it"
            )
        if description["version"] == 1:
            network = {"type": description["network"], "config": description["config"]}
            description = description | {"network": network}
        self.description, self._units = description, Units(description)
        sizes = self._units.obs_size, self._units.action_size, self._units.agents
        self.obs_size, self.action_size, self.agents = sizes
        left = set(weights)
        self._network = Node(description["network"], weights, left, *sizes).build()
        for name in sorted(left):
            raise ValueError(_mismatch(name, weights[name].shape, None))
        self._try()

    @classmethod
    def load(cls, path: Any) -> "Runner":
        """The policy in a file that `credo export` wrote.

        **Raises:** `ValueError` if the file is anything else or a bit of it has changed.
        """
        status = pathlib.Path(path).stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > LARGEST:
            raise ValueError(f"{path} is no file of at most {LARGEST} bytes: name a policy's file")
        data = pathlib.Path(path).read_bytes()
        try:
            return cls(*_parse(data))
        except Exception as error:  # whatever the bytes of a damaged file lead to
            raise ValueError(
                f"{path} is damaged, or no policy that `credo export` wrote "
                f"({type(error).__name__}: {error}): export it again"
            ) from error

    def reset(self, seed: int = 0) -> None:
        """Forget: call at the start of every episode. `seed` decides what a policy draws: of those
        there are, only the agents' order of a DMMU with `order="random"`."""
        self._memory = self._network.start(np.random.default_rng(seed))

    def __call__(self, observation: Any, mask: Any = None) -> Any:
        """What to do now.

        **Arguments:**

        - `observation`: `obs_size` numbers in an array of any shape, in a Discrete its integer, in
          a Dict or Tuple what it is made of. Of a team one for each agent, in order, None for one
          that is not there; or a dict by name of those that are. Of a task that says what is
          allowed those numbers may stand in front.
        - `mask`: which options of a Discrete, or of each choice of a larger space, one after the
          other, are allowed. A task that has masks needs one, here or in the observation. Of a team
          one for each agent, None where all are allowed.

        **Returns:** in a Box of Gymnasium an array of its shape, dtype and units; in a Discrete
        an integer; in a space of several what Gymnasium has there, a dict, a tuple or an array; for
        any other task `[action_size]`, float32 in [-1, 1]. Of a team a list of
        these, None for an agent that is not there, or a dict if the observation is one; for a task
        of Credo's `[agents, action_size]`.

        **Raises:** `ValueError` for an observation or a mask that the task cannot have, and if the
        policy's output is not finite.
        """
        return self._units.act(observation, self._step, mask)

    def _step(self, x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):  # what is not finite is refused below
            output, self._memory = self._network(x, self._memory)
        return output

    def _try(self) -> None:
        """One step: what cannot act should fail now."""
        team = () if self.agents is None else (self.agents,)
        self.reset()
        self._units.own(self._step(np.ones((*team, self.obs_size), np.float32)), None)
        self.reset()


# -------------------------------------------------------------------------------------- units


class Units:
    """Between a task and its policy: observations as float32 rows, actions in the task's units.

    `task` has `obs_size`, `action_size`, `agents` (None: no team); `action` or `actions`: None for
    [-1, 1], or a description of the action space, of a team one for each agent; and where they are
    known `observations` ({"n", "start"} of a Discrete), `names` of the agents, the options of its
    `choices`, whether it is `masked`: whether observations begin with which are allowed, and the
    `lengths` of the agents' observations without that.

    **Raises:** `ValueError`, or what Python raises, if that makes no sense.
    """

    def __init__(self, task: Mapping[str, Any]):
        self.obs_size = _size("obs_size", task["obs_size"])
        self.action_size = _size("action_size", task["action_size"])
        agents, self.agents = task.get("agents"), None
        if agents is not None:
            self.agents = _size("agents", agents, MOST_AGENTS)
        self.names = self._one_each("names", task.get("names"))
        self._mask = sum(task.get("choices") or ()) if task.get("masked") else 0
        if not 0 <= self._mask <= min(self.obs_size, self.action_size):
            raise ValueError(f"choices are {task['choices']}, more than an action or observation")
        self._lengths = self._one_each("lengths", task.get("lengths"))
        self._discrete = task.get("observations") if agents is None else None
        self._shown = self._one_each("shown", task.get("shown") if agents else [task.get("shown")])
        self._heard = False  # whether what is allowed was said of any agent
        self._asks = bool(task.get("asks", self.agents is None and self._mask))
        if self._discrete is not None:
            n, start = self._discrete["n"], self._discrete["start"]
            if n != self.obs_size - self._mask or type(start) is not int:
                n = self.obs_size - self._mask
                raise ValueError(f"observations are {self._discrete}: n must be {n}")
        spaces = task.get("action", task.get("actions"))
        if agents is None and spaces is not None:
            spaces = [spaces]
        elif spaces is not None:
            self._one_each("actions", spaces)
        self._own = None if spaces is None else list(map(self._scale, spaces))

    def act(self, observation: Any, step: Callable[[np.ndarray], Any], mask: Any = None) -> Any:
        """The action in the task's units that follows from `step`, a policy on float32 arrays."""
        rows = self.read(observation, mask)
        output = np.asarray(step(rows))
        if not np.isfinite(output).all():
            raise ValueError(
                f"the policy's output for {observation!r} is {output}: its weights, or numbers as "
                "large as these, overflow"
            )
        if self._mask:  # of a task that takes numbers in [-1, 1] as they are, itself follows it
            mask = None if self._own is None else rows[..., : self._mask] > 0.5
        own = self.own(output, mask)
        if self.agents is not None and isinstance(observation, Mapping):
            return {name: own[k] for k, name in enumerate(self.names) if name in observation}
        if isinstance(own, list):
            rows = zip(observation, own, strict=True)
            return [None if row is None else action for row, action in rows]
        return own

    def read(self, observation: Any, mask: Any = None) -> np.ndarray:
        """`[obs_size]`, of a team `[agents, obs_size]`, float32. Raises `ValueError`."""
        if self.agents is None:
            return self._row(observation, mask, 0)
        if isinstance(observation, Mapping):
            observation = self._by_name(observation)
        given = isinstance(observation, np.ndarray | list | tuple)
        if not given or len(observation) != self.agents:
            raise ValueError(
                f"the observation is {observation!r}: it must be that of each of {self.agents} "
                "agents, in order, None for one that is not there"
            )
        masks = [None] * self.agents if mask is None else self._one_each("mask", mask)
        rows = np.zeros((self.agents, self.obs_size), np.float32)
        rows[:, : self._mask] = 1.0  # who is not there may do anything
        self._heard = not self._asks
        for k, row in enumerate(observation):
            if row is not None:
                row = self._row(row, masks[k], k)
                rows[k, : row.size] = row
        if not self._heard and any(row is not None for row in observation):
            raise ValueError(UNMASKED)
        return rows

    def own(self, output: np.ndarray, mask: Any) -> Any:
        """An action in [-1, 1] in the task's units."""
        if self._own is None:
            _no_mask(mask)
            return output
        rows, masks = ([output], [mask]) if self.agents is None else (output, mask)
        masks = [None] * len(rows) if masks is None else self._one_each("mask", masks)
        each = zip(self._own, rows, masks, strict=True)
        own = [read(_barred(row, mask, options)) for (options, read), row, mask in each]
        return own[0] if self.agents is None else own

    def _row(self, observation: Any, mask: Any, k: int) -> np.ndarray:
        """The observation of agent k. In a team of others it may be shorter than the largest."""
        shown = self._shown[k] if self._shown else None
        if isinstance(observation, Mapping) and self.agents is not None:
            observation = {**observation}  # what is allowed is told apart in a team
            mask = observation.pop("action_mask", None) if mask is None else mask
            if shown is None and len(observation) == 1:
                (observation,) = observation.values()
        if isinstance(observation, Mapping) or (shown and _in_parts(observation)):
            x = _flat(observation, shown)
        elif self._discrete is not None and np.ndim(observation) == 0:
            x = _one_hot(observation, self._discrete["n"], self._discrete["start"])
        else:
            x = np.asarray(observation, np.float32).ravel()
        x = self._told(x, mask, k) if self._mask else x
        padded = self.agents is not None and self._own is not None
        if x.size > self.obs_size or (x.size < self.obs_size and not padded):
            raise ValueError(f"the observation has {x.size} numbers: it must have {self.obs_size}")
        if not np.isfinite(x).all():
            # It would stay in the memory of a recurrent network for ever.
            raise ValueError(f"the observation is {x}: NaN and inf are no observations")
        return x

    def _told(self, x: np.ndarray, mask: Any, k: int) -> np.ndarray:
        """An observation with what is allowed in front, which it may have already."""
        own = self.obs_size - self._mask if self._lengths is None else self._lengths[k]
        if x.size == own:
            if mask is None and self._asks and self.agents is None:
                raise ValueError(UNMASKED)
            self._heard |= mask is not None
            options = self._mask if self._own is None else self._own[k][0]
            x = np.append(np.arange(self._mask) < options, x).astype(np.float32)
        elif x.size in (self.obs_size, own + self._mask):
            self._heard = True
        if mask is None:
            in_front = x.size in (self.obs_size, own + self._mask)
            if in_front and not np.isin(x[: self._mask], (0.0, 1.0)).all():
                raise ValueError(
                    f"the observation begins with {x[: self._mask]}, and should with what is "
                    "allowed: 0 or 1 for each option, in front of all else, or give mask="
                )
            return x
        allowed = _flags(mask)
        if allowed.size > self._mask:
            raise ValueError(f"the mask is {mask}: it must say which of {self._mask} are allowed")
        return np.concatenate(
            [allowed, np.zeros(self._mask - allowed.size), x[self._mask :]]
        ).astype(np.float32)

    def _by_name(self, observation: Mapping[Any, Any]) -> list[Any]:
        """An entry for each agent, None for those that are not named."""
        strangers = [name for name in observation if name not in (self.names or ())]
        if strangers or self.names is None:
            raise ValueError(
                f"the observation names {strangers[:1] or 'no agent'}: this team has "
                f"{self.names or 'no names, so give a row for each agent'}"
            )
        return [observation.get(name) for name in self.names]

    def _one_each(self, what: str, values: Any) -> Any:
        if values is not None and len(values) != (self.agents or 1):
            raise ValueError(f"{what} is {values!r}: it must have one entry for each agent")
        return values

    def _scale(self, space: Any) -> tuple[int, Callable[[np.ndarray], Any]]:
        """How many options a space has, and what turns an action in [-1, 1] into one of its own. In
        a team a space may be smaller than the largest: it takes as much as it holds."""
        options = sum(_choices(space))
        cursor = [0, options]  # where the next choice begins, and the next Box
        read = _reader(space, cursor)
        size = cursor[1]
        if size > self.action_size or (self.agents is None and size < self.action_size):
            has = f"an action has {size} numbers in its space"
            raise ValueError(f"{has}, and {self.action_size} as such")
        return options, read


def _size(what: str, n: Any, most: int | None = None) -> int:
    if type(n) is not int or n < 1 or (most is not None and n > most):
        bounds = "of at least 1" if most is None else f"from 1 to {most}"
        raise ValueError(f"{what} is {n!r}: it must be a whole number {bounds}")
    return n


def _in_parts(observation: Any) -> bool:
    """Whether a sequence is the parts of a Tuple, and not their numbers one after the other."""
    if isinstance(observation, list):
        return any(isinstance(x, Mapping | tuple) or np.ndim(x) for x in observation)
    return isinstance(observation, tuple)


def _flags(mask: Any) -> np.ndarray:
    """A mask as one row, also of several choices in a tuple, as Gymnasium samples by them."""
    parts = mask if isinstance(mask, tuple) and any(np.ndim(x) for x in mask) else (mask,)
    return np.concatenate([np.asarray(part, np.bool_).ravel() for part in parts])


def _flat(observation: Any, shown: Any) -> np.ndarray:
    """The numbers of a dict or tuple, in the order in which the policy was trained on them."""
    if shown is None:
        raise ValueError(
            f"the observation is a {type(observation).__name__}, of which the policy's record does "
            "not tell the order of parts: give its numbers, what is allowed first"
        )
    if "parts" in shown:
        rows = []
        if not isinstance(observation, Mapping) and len(observation) != len(shown["parts"]):
            raise ValueError(
                f"the observation has {len(observation)} parts: it must have {len(shown['parts'])}"
            )
        for key, part in shown["parts"]:
            try:
                rows.append(_flat(observation[key], part))
            except (KeyError, IndexError, TypeError) as error:
                raise ValueError(f"the observation has no part {key!r}: {observation!r}") from error
        return np.concatenate(rows)
    if "nvec" in shown:
        entries, options = np.asarray(observation).ravel(), (shown["nvec"], shown["start"])
        every = zip(entries, *options, strict=True)
        return np.concatenate([_one_hot(entry, n, start) for entry, n, start in every])
    if "n" in shown:
        return _one_hot(observation, shown["n"], shown["start"])
    x = np.asarray(observation, np.float32).ravel()
    if x.size != shown["size"]:
        raise ValueError(f"a part of the observation has {x.size} numbers: not {shown['size']}")
    return x


def _one_hot(observation: Any, n: int, start: int) -> np.ndarray:
    """`[n]` of an integer from `start` on."""
    entry = np.asarray(observation)
    if entry.dtype.kind not in "iu" or not start <= entry < start + n:
        last = start + n - 1
        raise ValueError(
            f"the observation is {observation!r}: it must be an integer from {start} to {last}"
        )
    return (np.arange(start, start + n) == entry).astype(np.float32)


def _no_mask(mask: Any) -> None:
    if mask is not None:
        raise ValueError("a mask was given: only a Discrete has entries to allow")


def _choices(space: Any) -> list[int]:
    """Options of each choice in a space."""
    if "parts" in space:
        return [n for _, part in space["parts"] for n in _choices(part)]
    if "nvec" in space:
        return [_size("nvec", n) for n in space["nvec"]]
    return [_size("n", space["n"])] if "n" in space else []


def _barred(output: np.ndarray, mask: Any, options: int) -> np.ndarray:
    """An action with -inf for options that a mask does not allow."""
    if mask is None:
        return output
    if not options:
        _no_mask(mask)
    mask = _flags(mask)
    if mask.size < options or not mask[:options].any():
        raise ValueError(f"the mask is {mask}: it must allow at least one of {options} entries")
    allowed = np.append(mask[:options], np.ones(output.size - options, np.bool_))
    return np.where(allowed, output, -np.inf)


def _reader(space: Any, cursor: list[int]) -> Callable[[np.ndarray], Any]:
    """What turns an action into one of a space's own: of the options of a choice it takes the
    largest. `cursor`: where its choices and its Boxes begin, which is moved on."""
    if "parts" in space:
        keys, parts = zip(*space["parts"], strict=True)
        readers = [_reader(part, cursor) for part in parts]
        made = (lambda own: dict(zip(keys, own, strict=True))) if space["dict"] else tuple
        return lambda output: made([read(output) for read in readers])
    if "nvec" in space:
        return _several(space, cursor)
    return _one(space, cursor) if "n" in space else _box(space, cursor)


def _one(space: Any, cursor: list[int]) -> Callable[[np.ndarray], int]:
    """A Discrete."""
    n, start, at = _size("n", space["n"]), space["start"], cursor[0]
    if type(start) is not int:
        raise ValueError(f"start is {start!r}: it must be an integer")
    cursor[0] += n
    return lambda output: int(np.argmax(output[at : at + n])) + start


def _several(space: Any, cursor: list[int]) -> Callable[[np.ndarray], np.ndarray]:
    """A MultiDiscrete or a MultiBinary."""
    sizes, at = _choices(space), cursor[0]
    shape, dtype = tuple(space["shape"]), np.dtype(space["dtype"])
    start = np.asarray(space["start"], dtype)
    if math.prod(shape) != len(sizes) or start.size != len(sizes) or dtype.kind not in "iu":
        raise ValueError(f"its action space has {len(sizes)} choices and shape {shape}")
    ends = np.cumsum(sizes) + at
    cursor[0] = int(ends[-1])

    def choose(output: np.ndarray) -> np.ndarray:
        parts = [output[end - n : end] for end, n in zip(ends, sizes, strict=True)]
        return (np.array([np.argmax(x) for x in parts], dtype) + start).reshape(shape)

    return choose


def _box(space: Any, cursor: list[int]) -> Callable[[np.ndarray], np.ndarray]:
    """A Box: an action is scaled to its bounds; one of integers gets the nearest."""
    low, high = np.array(space["low"], np.float64), np.array(space["high"], np.float64)
    shape, dtype = tuple(space["shape"]), np.dtype(space["dtype"])
    bounded = np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()
    if low.ndim != 1 or low.shape != high.shape or math.prod(shape) != low.size or not bounded:
        raise ValueError(f"its action space has low {low}, high {high} and shape {shape}")
    if dtype.kind not in "fiu":
        raise ValueError(f"its action space has dtype {dtype}: it must be one of numbers")
    center, half, at, end = (low + high) / 2, (high - low) / 2, cursor[1], cursor[1] + low.size
    cursor[1] = end

    def scale(output: np.ndarray) -> np.ndarray:
        own = np.minimum(np.maximum(center + half * output[at:end], low), high)
        return (own if dtype.kind == "f" else np.rint(own)).astype(dtype).reshape(shape)

    return scale


# ----------------------------------------------------------------------------------- networks


@dataclasses.dataclass(frozen=True)
class Node:
    """A network as a file describes it, and the file's arrays, to be claimed by name and shape.

    A network is built of a node, and has `start(random) -> memory` and `(x, memory) -> (action in
    [-1, 1], memory)`, where x is `[obs_size]`, of a team `[agents, obs_size]`, float32.
    """

    described: Any  # {"type", "config", "parts"}: its class, its settings, the networks within
    weights: Weights
    left: set[str]  # names of the arrays that no network has claimed
    x: int  # numbers in an observation
    y: int  # numbers in an action
    agents: Any = None  # how many; None: no team
    prefix: str = ""  # of the names of its arrays
    depth: int = 0  # networks around it

    @property
    def config(self) -> dict[str, Any]:
        """The network's settings."""
        return self.described["config"]

    def build(self) -> Any:
        """The network. Raises `ValueError`, or what Python raises, if the description makes no
        sense."""
        if self.depth >= DEEPEST:
            raise ValueError(f"its networks lie in one another more than {DEEPEST} deep")
        kind, team = NETWORKS[self.described["type"]]
        if team not in (None, self.agents is not None):
            name = self.described["type"]
            raise ValueError(f"{name} cannot act for {self.agents or 1} agents here")
        return kind(self)

    def claim(self, name: str, *shape: int) -> np.ndarray:
        """The array of this name, which must have this shape and be claimed once."""
        name = self.prefix + name
        array = self.weights.get(name)
        sound = all(type(n) is int and n > 0 for n in shape)
        if not sound or array is None or array.shape != shape or name not in self.left:
            raise ValueError(_mismatch(name, None if array is None else array.shape, shape))
        self.left.remove(name)
        return array

    def within(self, prefix: str) -> "Node":
        """The same network, for arrays whose names start so."""
        return dataclasses.replace(self, prefix=f"{self.prefix}{prefix}.")

    def part(self, i: int, prefix: str, x: int, y: int, agents: int | None = None) -> Any:
        """A network within."""
        described, depth = self.described["parts"][i], self.depth + 1
        given = {"described": described, "x": x, "y": y, "agents": agents, "depth": depth}
        return dataclasses.replace(self.within(prefix), **given).build()


def _mismatch(name: str, found: Any, expected: Any) -> str:
    return f"its network does not have such weights: {name} has shape {found}, expected {expected}"


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(np.minimum(-x, 88.0)))  # beyond 88 float32 overflows


ACTIVATIONS = {
    "sigmoid": _sigmoid,
    "tanh": np.tanh,
    "identity": lambda x: x,
    "relu": lambda x: np.maximum(x, 0.0),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
}


class Output:
    """What an output layer says, x, behind its activation, and as an action in [-1, 1]. Within a
    network that chooses an action is what was said."""

    def __init__(self, config: dict[str, Any]):
        self._activation, self._said = config["output_activation"], config.get("said", False)

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self._activation == "relative":  # of formats before 3
            y = np.tanh(x - x.max())
        else:
            y = ACTIVATIONS[self._activation](x)
        return y, x if self._said else 2.0 * y - 1.0 if self._activation == "sigmoid" else y


class MLP:
    """`credo.networks.mlp`: `W_l`, `b_l` of each layer l, `g_l`, `s_l` of its LayerNorm. It has no
    memory."""

    def __init__(self, node: Node):
        self._hidden, depth = Layers(node, node.config), len(node.config["hidden"])
        self._w = node.claim(f"W_{depth}", node.y, self._hidden.size)
        self._b = node.claim(f"b_{depth}", node.y)
        self._act = Output(node.config)

    def start(self, random: "np.random.Generator") -> None:
        return None

    def __call__(self, x: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
        return self._act(self._w @ self._hidden(x) + self._b)[1], None


class Layers:
    """Hidden layers: those of an MLP, and a team's trunk."""

    def __init__(self, node: Node, config: dict[str, Any]):
        self._normalization, self._layers = config["normalization"], []
        self._activation, x = ACTIVATIONS[config["activation"]], node.x
        for i, units in enumerate(config["hidden"]):
            layer = [node.claim(f"W_{i}", units, x), node.claim(f"b_{i}", units)]
            if self._normalization != "none":
                layer += [node.claim(f"g_{i}", units), node.claim(f"s_{i}", units)]
            self._layers.append(layer)
            x = units
        self.size = x  # of the last one

    def __call__(self, x: np.ndarray) -> np.ndarray:
        for w, b, *norm in self._layers:
            x = w @ x + b
            if self._normalization == "before":
                x = _normalize(x, *norm)
            x = self._activation(x)
            if self._normalization == "after":
                x = _normalize(x, *norm)
        return x


def _normalize(x: np.ndarray, gain: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """LayerNorm."""
    x = x - np.mean(x)
    x = x / np.sqrt(np.mean(np.square(x)) + np.float32(EPSILON))
    return gain * x + shift


class Convolutional:
    """`credo.networks.convolutional`: `W_l`, `b_l` of each convolution l, and a head. The memory is
    the head's."""

    def __init__(self, node: Node):
        c, shape = node.config, tuple(node.config["shape"])
        self._start, size = c["start"], math.prod(shape)
        self._end, self._scale, self._layers = self._start + size, np.float32(c["scale"]), []
        sound = all(type(n) is int and n > 0 for n in (*shape, self._start + 1))
        if not sound or len(shape) != 3 or self._end > node.x or not self._scale > 0:
            raise ValueError(f"its image of {shape} from {self._start} on is not in an observation")
        layers = zip(c["channels"], c["kernels"], c["strides"], strict=True)
        for i, (n, kernel, stride) in enumerate(layers):
            height, width, channels = shape
            at = np.arange(height * width * channels).reshape(shape)
            at = np.lib.stride_tricks.sliding_window_view(at, (kernel, kernel), axis=(0, 1))
            at = at[::stride, ::stride].transpose(0, 1, 3, 4, 2)
            inputs = kernel * kernel * channels
            w, b = node.claim(f"W_{i}", n, inputs), node.claim(f"b_{i}", n)
            shape = (*at.shape[:2], n)
            self._layers.append((at.reshape(-1, inputs), w, b))
        self._activation = ACTIVATIONS[c["activation"]]
        self._head = node.part(0, "head", node.x - size + math.prod(shape), node.y)
        self.start = self._head.start

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        beside = np.append(x[: self._start], x[self._end :])
        x = x[self._start : self._end] / self._scale
        for at, w, b in self._layers:
            x = self._activation(x[at] @ w.T + b).ravel()
        return self._head(np.append(beside, x), memory)


class MMU:
    """`credo.networks.mmu`: Khadka (2019), equations 3.1-3.5. The memory is (y, m)."""

    def __init__(self, node: Node):
        self.config, shapes = node.config, self._shapes(node.config, node.x, node.y)
        self._act = Output(node.config)
        self.weights = {name: node.claim(name, *shape) for name, shape in shapes}

    @staticmethod
    def _shapes(config: dict[str, Any], x: int, y: int):
        """The names and shapes of its arrays, as the equations have them."""
        h = config["hidden"]
        m = h if config["memory"] is None else config["memory"]
        for gate, size in (("i", h), ("r", h), ("w", m)):
            yield from ((f"K_{gate}", (size, x)), (f"R_{gate}", (size, y)))
            yield from ((f"N_{gate}", (size, m)), (f"b_{gate}", (size,)))
        yield from (("K_p", (h, x)), ("N_p", (h, m)), ("b_p", (h,)), ("Z_y", (y, h)), ("b_y", (y,)))
        if config["decoder"] == "learned":
            yield from (("N_d", (h, m)), ("b_d", (h,)))
        if config["encoder"] == "learned":
            yield from (("Z_f", (m, h)), ("b_f", (m,)))
        if config["start_memory"] == "learned":
            yield "m_0", (m,)

    def start(self, random: "np.random.Generator") -> tuple[np.ndarray, np.ndarray]:
        w = self.weights
        return np.zeros_like(w["b_y"]), w.get("m_0", np.zeros_like(w["b_w"]))

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        (y, m), weights, c = memory, self.weights, self.config
        i, r, w = (self._gate(name, x, y, m) for name in "irw")
        p = weights["K_p"] @ x + weights["N_p"] @ m + weights["b_p"]
        p = ACTIVATIONS[c["block_activation"]](p)
        d = weights["N_d"] @ m + weights["b_d"] if c["decoder"] == "learned" else m
        h = r * ACTIVATIONS[c["decoder_activation"]](d) + p * i
        f = weights["Z_f"] @ h + weights["b_f"] if c["encoder"] == "learned" else h
        written, alpha = w * ACTIVATIONS[c["encoder_activation"]](f), c["alpha"]
        # Both terms of equation 3.4 cost a rounding: the first alone is what training runs.
        cumulative = m + written
        interpolated = written + (1.0 - w) * m
        m = (1.0 - alpha) * cumulative + alpha * interpolated if alpha else cumulative
        y, action = self._act(weights["Z_y"] @ h + weights["b_y"])
        return action, (y, m)

    def _gate(self, name: str, x: np.ndarray, y: np.ndarray, m: np.ndarray) -> np.ndarray:
        w = self.weights
        return _sigmoid(
            w[f"K_{name}"] @ x + w[f"R_{name}"] @ y + w[f"N_{name}"] @ m + w[f"b_{name}"]
        )


class Recurrent:
    """`credo.networks.recurrent`: Elman RNN, GRU and LSTM. The memory is (h, c), of which c is used
    by the LSTM alone."""

    GATES: ClassVar[dict[str, str]] = {"rnn": "h", "gru": "zrh", "lstm": "ifoc"}

    def __init__(self, node: Node):
        self.cell, self._act = node.config["cell"], Output(node.config)
        h = node.config["hidden"]
        self.weights = {"Z_y": node.claim("Z_y", node.y, h), "b_y": node.claim("b_y", node.y)}
        for gate in self.GATES[self.cell]:
            shapes = {f"W_{gate}": (h, node.x), f"U_{gate}": (h, h), f"b_{gate}": (h,)}
            self.weights |= {name: node.claim(name, *shape) for name, shape in shapes.items()}

    def start(self, random: "np.random.Generator") -> tuple[np.ndarray, np.ndarray]:
        zeros = np.zeros(self.weights["Z_y"].shape[1], np.float32)
        return zeros, zeros

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        h, c = memory
        if self.cell == "rnn":
            h = np.tanh(self._gate("h", x, h))
        elif self.cell == "gru":
            z, r = (_sigmoid(self._gate(name, x, h)) for name in "zr")
            h = z * h + (1.0 - z) * np.tanh(self._gate("h", x, r * h))
        else:
            i, f, o = (_sigmoid(self._gate(name, x, h)) for name in "ifo")
            c = f * c + i * np.tanh(self._gate("c", x, h))
            h = o * np.tanh(c)
        return self._act(self.weights["Z_y"] @ h + self.weights["b_y"])[1], (h, c)

    def _gate(self, name: str, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        w = self.weights
        return w[f"W_{name}"] @ x + w[f"U_{name}"] @ h + w[f"b_{name}"]


class Controller:
    """Of `credo.networks.external_memory`, whose input is the observation and what was read."""

    GATES: ClassVar[str] = "ifoc"

    def __init__(self, node: Node, read: int):
        self.lstm, h = node.config["controller"] == "lstm", node.config["hidden"]
        self.weights: Weights = {}
        for gate in self.GATES if self.lstm else "h":
            shapes = {f"W_{gate}": (h, node.x + read), f"b_{gate}": (h,)}
            shapes |= {f"U_{gate}": (h, h)} if self.lstm else {}
            self.weights |= {name: node.claim(name, *shape) for name, shape in shapes.items()}
        outputs = {"Z_y": (node.y, h), "Z_r": (node.y, read), "b_y": (node.y,)}
        self.weights |= {name: node.claim(name, *shape) for name, shape in outputs.items()}
        self._act = Output(node.config)

    def __call__(self, x: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        """The output of its hidden layer, and its state."""
        w = self.weights
        if not self.lstm:
            return np.tanh(w["W_h"] @ x + w["b_h"]), state
        h, c = state
        i, f, o, new = (w[f"W_{g}"] @ x + w[f"U_{g}"] @ h + w[f"b_{g}"] for g in self.GATES)
        c = _sigmoid(f) * c + _sigmoid(i) * np.tanh(new)
        h = _sigmoid(o) * np.tanh(c)
        return h, (h, c)

    def action(self, h: np.ndarray, read: np.ndarray) -> np.ndarray:
        """What the whole network does, given what was just read."""
        w = self.weights
        return self._act(w["Z_y"] @ h + w["Z_r"] @ read + w["b_y"])[1]


def _softmax(x: np.ndarray) -> np.ndarray:
    """Of each row."""
    e = np.exp(x - np.max(x, axis=-1, keepdims=True))
    return e / np.sum(e, axis=-1, keepdims=True)


def _softplus(x: np.ndarray) -> np.ndarray:
    return np.logaddexp(x, np.float32(0.0))


def _by_content(memory: np.ndarray, keys: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """`[heads, rows]`: a softmax of the cosine similarity of rows with each key."""
    of_keys, of_rows = (
        np.sqrt(np.sum(np.square(x), axis=1) + np.float32(1e-6)) for x in (keys, memory)
    )
    return _softmax(strengths[:, None] * ((keys @ memory.T) / (of_keys[:, None] * of_rows[None])))


class NTM:
    """`credo.networks.ntm`: Graves et al. (2014). The memory is (the controller's state, what was
    read, weightings of the reading heads and of the writing heads, rows)."""

    def __init__(self, node: Node):
        c, self._heads = node.config, {"r": node.config["read_heads"]}
        self._heads["w"], self._rows, self._width = c["write_heads"], c["rows"], c["width"]
        self._controller = Controller(node, self._heads["r"] * self._width)
        self._shifts, h = 2 * c["shift"] + 1, c["hidden"]
        sizes = {"k": self._width, "beta": 1, "g": 1, "s": self._shifts, "gamma": 1}
        self.weights: Weights = {}
        for kind, heads in self._heads.items():
            written = {"e": self._width, "a": self._width} if kind == "w" else {}
            for name, size in (sizes | written).items():
                for part, shape in (("W", (heads * size, h)), ("b", (heads * size,))):
                    key = f"{part}_{name}_{kind}"
                    self.weights[key] = node.claim(key, *shape)
        self._start = {
            f"w_{k}_0": node.claim(f"w_{k}_0", n * self._rows) for k, n in self._heads.items()
        }
        self._start["r_0"] = node.claim("r_0", self._heads["r"] * self._width)
        if self._controller.lstm:
            self._start |= {name: node.claim(name, h) for name in ("h_0", "c_0")}
        if c["start_memory"] == "learned":
            self._start["M_0"] = node.claim("M_0", self._rows, self._width)

    def start(self, random: "np.random.Generator") -> Any:
        s = self._start
        state = (s["h_0"], s["c_0"]) if self._controller.lstm else ()
        at = [_softmax(s[f"w_{kind}_0"].reshape(-1, self._rows)) for kind in "rw"]
        constant = np.full((self._rows, self._width), 1e-6, np.float32)
        return state, s["r_0"], *at, s.get("M_0", constant)

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        state, read, at_read, at_write, rows = memory
        h, state = self._controller(np.concatenate([x, read]), state)
        at_write = self._address("w", h, at_write, rows)
        erase, added = _sigmoid(self._emitted("e", "w", h)), self._emitted("a", "w", h)
        kept = np.prod(1.0 - at_write[:, :, None] * erase[:, None], axis=0)
        rows = rows * kept + at_write.T @ added
        at_read = self._address("r", h, at_read, rows)
        read = (at_read @ rows).ravel()
        return self._controller.action(h, read), (state, read, at_read, at_write, rows)

    def _emitted(self, name: str, kind: str, h: np.ndarray) -> np.ndarray:
        w, key = self.weights, f"{name}_{kind}"
        return (w[f"W_{key}"] @ h + w[f"b_{key}"]).reshape(self._heads[kind], -1)

    def _address(self, kind: str, h: np.ndarray, before: np.ndarray, rows: Any) -> np.ndarray:
        names = ("k", "beta", "g", "s", "gamma")
        k, beta, g, s, gamma = (self._emitted(name, kind, h) for name in names)
        g, s = _sigmoid(g), _softmax(s)
        w = g * _by_content(rows, k, _softplus(beta[:, 0])) + (1.0 - g) * before
        n = self._shifts // 2
        w = sum(s[:, i, None] * np.roll(w, i - n, axis=1) for i in range(self._shifts))
        return _softmax((1.0 + _softplus(gamma)) * np.log(w + np.float32(1e-12)))


class DNC:
    """`credo.networks.dnc`: Graves et al. (2016). The memory is (the controller's state, what was
    read, weightings of the reading heads and of the writing head, usage, precedence, links, rows).
    """

    def __init__(self, node: Node):
        c, h = node.config, node.config["hidden"]
        self._rows, self._width, self._heads = c["rows"], c["width"], c["read_heads"]
        r, w, self._hidden = self._heads, self._width, h
        self._controller = Controller(node, r * w)
        parts = {"k_r": r * w, "beta_r": r, "f_r": r, "pi_r": 3 * r}
        parts |= {"k_w": w, "beta_w": 1, "e_w": w, "v_w": w, "ga_w": 1, "gw_w": 1}
        self.weights: Weights = {}
        for name, size in parts.items():
            self.weights[f"W_{name}"] = node.claim(f"W_{name}", size, h)
            self.weights[f"b_{name}"] = node.claim(f"b_{name}", size)

    def start(self, random: "np.random.Generator") -> Any:
        def zeros(*shape: int) -> np.ndarray:
            return np.zeros(shape, np.float32)

        n, heads, h = self._rows, self._heads, self._hidden
        state = (zeros(h), zeros(h)) if self._controller.lstm else ()
        read, at_read, rows = zeros(heads * self._width), zeros(heads, n), zeros(n, self._width)
        return state, read, at_read, zeros(n), zeros(n), zeros(n), zeros(n, n), rows

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        state, read, at_read, at_write, used, last, links, rows = memory
        h, state = self._controller(np.concatenate([x, read]), state)
        retained = np.prod(1.0 - _sigmoid(self._emitted("f_r", h))[:, None] * at_read, axis=0)
        used = (used + at_write - used * at_write) * retained
        at_write = self._where_to_write(h, used, rows)
        erase, added = _sigmoid(self._emitted("e_w", h)), self._emitted("v_w", h)
        rows = rows * (1.0 - np.outer(at_write, erase)) + np.outer(at_write, added)
        kept = 1.0 - at_write[:, None] - at_write[None]
        links = kept * links + np.outer(at_write, last)
        np.fill_diagonal(links, 0.0)
        last = (1.0 - np.sum(at_write)) * last + at_write
        at_read = self._where_to_read(h, at_read, links, rows)
        read = (at_read @ rows).ravel()
        memory = state, read, at_read, at_write, used, last, links, rows
        return self._controller.action(h, read), memory

    def _emitted(self, name: str, h: np.ndarray) -> np.ndarray:
        return self.weights[f"W_{name}"] @ h + self.weights[f"b_{name}"]

    def _where_to_write(self, h: np.ndarray, used: np.ndarray, rows: np.ndarray) -> np.ndarray:
        order = np.argsort(used, kind="stable")
        u, allocated = used[order], np.zeros_like(used)
        allocated[order] = (1.0 - u) * np.concatenate([[np.float32(1.0)], np.cumprod(u)[:-1]])
        strength = 1.0 + _softplus(self._emitted("beta_w", h))
        found = _by_content(rows, self._emitted("k_w", h)[None], strength)[0]
        g_a, g_w = (_sigmoid(self._emitted(name, h)) for name in ("ga_w", "gw_w"))
        return g_w * (g_a * allocated + (1.0 - g_a) * found)

    def _where_to_read(
        self, h: np.ndarray, before: np.ndarray, links: np.ndarray, rows: np.ndarray
    ) -> np.ndarray:
        n = self._heads
        mode = _softmax(self._emitted("pi_r", h).reshape(n, 3))
        keys, strengths = self._emitted("k_r", h).reshape(n, -1), self._emitted("beta_r", h)
        found = _by_content(rows, keys, 1.0 + _softplus(strengths))
        return (
            mode[:, :1] * (before @ links) + mode[:, 1:2] * found + mode[:, 2:] * (before @ links.T)
        )


class Graph:
    """`credo.networks.graph`: any topology. The memory is the units' activations and the contents
    of LSTM cells."""

    def __init__(self, node: Node):
        self._y, self._h, self._passes = node.y, node.config["hidden"], node.config["passes"]
        self._activation, cells = node.config["activation"], node.config["cells"]
        if type(self._passes) is not int or not 1 <= self._passes <= MOST_PASSES:
            raise ValueError(f"its passes are {self._passes!r}")
        self._ports = {"rnn": 1, "lstm": 4}[cells]
        rows, units = node.y + self._ports * self._h, node.y + self._h
        self._w = node.claim("W", rows, node.x + 1 + units)
        self._gated = (self._w[units:] != 0.0).any(axis=1)  # a gate without connections is open

    def start(self, random: "np.random.Generator") -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(self._y + self._h, np.float32), np.zeros(self._h, np.float32)

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        units, cells = memory
        seen = self._w[:, : x.size] @ x + self._w[:, x.size]
        for _ in range(self._passes):
            units, cells = self._updated(seen + self._w[:, x.size + 1 :] @ units, cells)
        y = units[: self._y]
        return 2.0 * y - 1.0 if self._activation == "sigmoid" else y, (units, cells)

    def _updated(self, total: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        φ, slope = ACTIVATIONS[self._activation], 4.9 if self._activation == "sigmoid" else 1.0
        if self._ports == 1:
            return φ(slope * total), cells
        y, h = self._y, self._h
        gates = np.where(self._gated, _sigmoid(total[y + h :]), np.float32(1.0))
        i, f, o = gates[:h], gates[h : 2 * h], gates[2 * h :]
        cells = f * cells + i * np.tanh(total[y : y + h])
        return np.concatenate([φ(slope * total[:y]), o * np.tanh(cells)]), cells


class Team:
    """`credo.networks.team`: a head for each agent on a trunk, of each one or one for all. The
    memory is that of each head."""

    OWN: ClassVar[dict[str, tuple[bool, bool]]] = {  # by what is shared: own trunks, own heads
        "trunk": (False, True),
        "everything": (False, False),
        "nothing": (True, True),
    }

    def __init__(self, node: Node):
        layers = node.config | {"hidden": node.config["trunk"], "normalization": "none"}
        whose = self._whose(node.config, node.agents)

        def each(whose: list[int], made: Callable[[int], Any]) -> list[Any]:
            parts = {k: made(k) for k in dict.fromkeys(whose)}
            return [parts[k] for k in whose]

        self._trunks = each(whose[0], lambda k: Layers(node.within(f"trunks.{k}"), layers))
        size = self._trunks[0].size
        self._heads = each(whose[1], lambda k: node.part(k, f"heads.{k}", size, node.y))

    def _whose(self, config: dict[str, Any], agents: int) -> list[list[int]]:
        """Which trunk and which head each agent has."""
        if config["sharing"] == "groups":
            groups = list(config["groups"])
            if len(groups) != agents:
                raise ValueError(f"its groups are {groups}, of {agents} agents")
            return [groups, groups]
        return [list(range(agents)) if own else [0] * agents for own in self.OWN[config["sharing"]]]

    def start(self, random: "np.random.Generator") -> list[Any]:
        return [head.start(random) for head in self._heads]

    def __call__(self, x: np.ndarray, memory: list[Any]) -> tuple[np.ndarray, list[Any]]:
        agents = zip(self._trunks, self._heads, x, memory, strict=True)
        told = [head(trunk(row), kept) for trunk, head, row, kept in agents]
        return np.stack([action for action, _ in told]), [kept for _, kept in told]


class DMMU:
    """`credo.networks.dmmu`: agents around one memory, each an MMU or a recurrent network. The
    memory is (what is private to each, m, the generator of random orders)."""

    def __init__(self, node: Node):
        # The last number says who takes part: 1 acts, 0 is busy, -1 is away.
        least = {"everyone": None, "present": -0.5, "acting": 0.5}[node.config["access"]]
        self._least, self._order, self._y = least, node.config["order"], node.y
        if self._order not in ("sequential", "simultaneous", "random"):
            raise ValueError(f"its order is {self._order!r}")
        x = node.x if least is None else node.x - 1
        self._agents = [node.part(i, f"agents.{i}", x, node.y) for i in range(node.agents)]
        if not all(isinstance(agent, MMU | Recurrent) for agent in self._agents):
            raise ValueError("its agents must be MMUs or recurrent networks")
        # Of GRUs and Elman networks the state itself is shared, of LSTMs the cell.
        self._swapped = [getattr(agent, "cell", "lstm") != "lstm" for agent in self._agents]

    def start(self, random: "np.random.Generator") -> Any:
        own, m = self._turned(0, self._agents[0].start(random))
        return [np.zeros_like(own)] * len(self._agents), m, random

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        (own, m, random), n = memory, len(self._agents)
        own, after = list(own), m
        there = np.ones(n, np.bool_) if self._least is None else x[:, -1] > self._least
        inputs = x if self._least is None else x[:, :-1]
        actions = np.zeros((n, self._y), np.float32)
        for i in random.permutation(n) if self._order == "random" else range(n):
            if there[i]:
                read = m if self._order == "simultaneous" else after
                actions[i], kept = self._agents[i](inputs[i], self._turned(i, (own[i], read)))
                own[i], left = self._turned(i, kept)
                after = after + (left - read) if self._order == "simultaneous" else left
        return actions, (own, after, random)

    def _turned(self, i: int, pair: Any) -> Any:
        """Between (h, c) of an agent and (private, shared)."""
        return pair[::-1] if self._swapped[i] else pair


class Centralized:
    """`credo.networks.team`: one network for all agents."""

    def __init__(self, node: Node):
        self._agents = n = node.agents
        self._inner = node.part(0, "policy", n * node.x, n * node.y)
        self.start = self._inner.start

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        action, memory = self._inner(x.ravel(), memory)
        return action.reshape(self._agents, -1), memory


class Normalized:
    """`credo.networks.normalized`: observations with mean 0 and standard deviation 1, of each agent
    of a team, clipped to [-10, 10], for the network within."""

    def __init__(self, node: Node):
        shape = (node.x,) if node.agents is None else (node.agents, node.x)
        self._mean, self._std = node.claim("mean", *shape), node.claim("std", *shape)
        if not (self._std > 0).all():
            raise ValueError(f"std is {self._std}: it must be more than 0")
        self._inner = node.part(0, "policy", node.x, node.y, node.agents)
        self.start = self._inner.start

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        return self._inner(np.clip((x - self._mean) / self._std, -10.0, 10.0), memory)


class Choosing:
    """`credo.networks.choosing`: what the network within says of each option, as how far that is
    below the largest of its choice."""

    BARRED: ClassVar[float] = -1e9

    def __init__(self, node: Node):
        parts = [_saying(part) for part in node.described["parts"]]
        node = dataclasses.replace(node, described=node.described | {"parts": parts})
        self._inner = node.part(0, "policy", node.x, node.y, node.agents)
        self._ends, n = np.cumsum(node.config["choices"]), sum(node.config["choices"])
        self._masked, self.start = node.config["masked"], self._inner.start
        if not 0 < n <= (min(node.x, node.y) if self._masked else node.y):
            raise ValueError(f"its choices are {node.config['choices']}: more than an action holds")

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        u, memory = self._inner(x, memory)
        *parts, boxes = np.split(u, self._ends, axis=-1)
        if self._masked:
            masks = np.split(x[..., : self._ends[-1]] > 0.5, self._ends[:-1], axis=-1)
            masks = [mask | ~mask.any(axis=-1, keepdims=True) for mask in masks]
            barred = np.float32(self.BARRED)
            parts = [np.where(*pair, barred) for pair in zip(masks, parts, strict=True)]
        below = [part - part.max(axis=-1, keepdims=True) for part in parts]
        return np.tanh(np.concatenate([*below, boxes], axis=-1)), memory


def _saying(described: dict[str, Any]) -> dict[str, Any]:
    """A network, and those within it, as ones whose action is what their output layer says."""
    parts = [_saying(part) for part in described.get("parts", ())]
    return described | {"config": described["config"] | {"said": True}, "parts": parts}


NETWORKS: dict[str, tuple[Callable[[Node], Any], bool | None]] = {
    "MLP": (MLP, False),
    "MMU": (MMU, False),
    "Convolutional": (Convolutional, False),
    "Recurrent": (Recurrent, False),
    "NTM": (NTM, False),
    "DNC": (DNC, False),
    "Graph": (Graph, False),
    "Team": (Team, True),
    "DMMU": (DMMU, True),
    "Centralized": (Centralized, True),
    "Normalized": (Normalized, None),
    "Choosing": (Choosing, None),
}
"""By name in a file; and whether it acts for a team or, False, for one. None: as that within."""


# ----------------------------------------------------------------------------------- the file


def fingerprint(description: str, weights: Weights) -> str:
    """SHA-256 of everything that decides an action."""
    digest = hashlib.sha256(description.encode())
    for name in sorted(weights):
        digest.update(f"\n{name} {list(weights[name].shape)}\n".encode())
        digest.update(weights[name].astype("<f4").tobytes())
    return digest.hexdigest()


def _parse(data: bytes) -> tuple[dict[str, Any], Weights]:
    """A safetensors file: length of the header (8 bytes), the header (JSON), all numbers."""
    if len(data) < 8:
        raise ValueError(f"it has {len(data)} bytes")
    (length,) = struct.unpack_from("<Q", data)
    if length > len(data) - 8:
        raise ValueError(f"its header should have {length} bytes, more than there are")
    header = json.loads(data[8 : 8 + length].decode(), object_pairs_hook=_once)
    metadata = header.pop("__metadata__", {})
    if DESCRIPTION not in metadata:
        raise ValueError("nothing in it describes a policy")
    weights = _tensors(header, data[8 + length :])
    text = metadata[DESCRIPTION]
    if metadata.get(FINGERPRINT) != fingerprint(text, weights):
        raise ValueError("its SHA-256 is not the one it was written with")
    return json.loads(text), weights


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) != len(pairs):
        raise ValueError("a name stands twice in its header")
    return dict(pairs)


def _tensors(header: dict[str, Any], data: bytes) -> Weights:
    """Arrays by name. They must cover `data` without gaps or overlaps."""
    weights, end = {}, 0
    for name, entry in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
        if entry["dtype"] != "F32":
            raise ValueError(f"{name} has dtype {entry['dtype']}: it must be F32")
        shape, (start, stop) = entry["shape"], entry["data_offsets"]
        if not all(type(n) is int and n >= 0 for n in (start, stop, *shape)):
            raise ValueError(f"{name} has shape {shape} and bytes {start} to {stop}")
        count = math.prod(shape)
        if start != end or stop - start != 4 * count or stop > len(data):
            raise ValueError(f"{name} of shape {shape} cannot have bytes {start} to {stop}")
        array = np.frombuffer(data, "<f4", count, start).reshape(shape).astype(np.float32)
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or inf")
        weights[name], end = array, stop
    if end != len(data):
        raise ValueError(f"{len(data) - end} bytes at its end belong to no array")
    return weights
