"""A trained policy without JAX: this file, NumPy, and what `credo export` wrote.

    runner = Runner.load("policy.safetensors")
    runner.reset()  # at the start of every episode
    action = runner(observation)

Copy this one file to where the policy is to act: it needs nothing else of Credo. A policy is
numbers and names in a safetensors file; nothing in it is executed.
"""

import hashlib
import json
import math
import pathlib
import struct
from typing import Any

import numpy as np

VERSION = 1  # of the description
DESCRIPTION, FINGERPRINT = "credo.policy", "credo.sha256"  # their names in the metadata
EPSILON = 1e-6  # of LayerNorm, relative to the variance

Weights = dict[str, np.ndarray]
Shapes = dict[str, tuple[int, ...]]


class Runner:
    """A policy that acts. Its memory, if it has one, is kept between calls."""

    def __init__(self, description: dict[str, Any], weights: Weights):
        if description["version"] != VERSION:
            raise ValueError(
                f"it has format {description['version']}, and this runner reads {VERSION}: use "
                f"the runner of Credo {description['credo']}, which wrote it"
            )
        self.description = description
        self.obs_size, self.action_size = description["obs_size"], description["action_size"]
        network = NETWORKS[description["network"]]
        _check(weights, network.shapes(description["config"], self.obs_size, self.action_size))
        self._network = network(description["config"], weights)
        self._units = _units(description["action"])
        self.reset()

    @classmethod
    def load(cls, path: Any) -> "Runner":
        """The policy in a file that `credo export` wrote.

        **Raises:** `ValueError` if the file is anything else or a bit of it has changed.
        """
        data = pathlib.Path(path).read_bytes()
        try:
            return cls(*_parse(data))
        except Exception as error:  # whatever the bytes of a damaged file lead to
            raise ValueError(
                f"{path} is damaged, or no policy that `credo export` wrote "
                f"({type(error).__name__}: {error}): export it again"
            ) from error

    def reset(self) -> None:
        """Forget: call at the start of every episode."""
        self._memory = self._network.start()

    def __call__(self, observation: Any) -> Any:
        """What to do now.

        **Arguments:** `observation`: `obs_size` numbers in an array of any shape.

        **Returns:** in a Box of Gymnasium an array of its shape, dtype and units; in a Discrete
        an integer; for any other task `[action_size]`, float32 in [-1, 1].
        """
        x = np.asarray(observation, np.float32).ravel()
        if x.size != self.obs_size:
            raise ValueError(f"the observation has {x.size} numbers: it must have {self.obs_size}")
        if not np.isfinite(x).all():
            # It would stay in the memory of a recurrent network for ever.
            raise ValueError(f"the observation is {x}: NaN and inf are no observations")
        output, self._memory = self._network(x, self._memory)
        return self._units(output)


def _units(action: Any) -> Any:
    """What turns an action in [-1, 1] into the task's own."""
    if action is None:
        return lambda output: output
    if "n" in action:
        return lambda output: int(np.argmax(output)) + action["start"]
    low, high = np.array(action["low"], np.float64), np.array(action["high"], np.float64)
    center, half = (low + high) / 2, (high - low) / 2
    shape, dtype = action["shape"], np.dtype(action["dtype"])
    whole = not np.issubdtype(dtype, np.floating)

    def scale(output: np.ndarray) -> np.ndarray:
        own = np.minimum(np.maximum(center + half * output, low), high)
        return (np.rint(own) if whole else own).astype(dtype).reshape(shape)

    return scale


# ----------------------------------------------------------------------------------- networks


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(np.minimum(-x, 88.0)))  # beyond 88 float32 overflows


ACTIVATIONS = {
    "sigmoid": _sigmoid,
    "tanh": np.tanh,
    "identity": lambda x: x,
    "relu": lambda x: np.maximum(x, 0.0),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
}


def _act(x: np.ndarray, activation: str) -> tuple[np.ndarray, np.ndarray]:
    """The output, and as an action in [-1, 1]."""
    y = ACTIVATIONS[activation](x)
    return y, 2.0 * y - 1.0 if activation == "sigmoid" else y


class MLP:
    """`credo.networks.mlp`: `W_l`, `b_l` of each layer l, `g_l`, `s_l` of its LayerNorm."""

    def __init__(self, config: dict[str, Any], weights: Weights):
        self.config, self.weights = config, weights

    @staticmethod
    def shapes(config: dict[str, Any], x: int, y: int) -> Shapes:
        sizes, shapes = [x, *config["hidden"], y], {}
        for i, units in enumerate(sizes[1:]):
            shapes.update({f"W_{i}": (units, sizes[i]), f"b_{i}": (units,)})
        if config["normalization"] != "none":
            for i, units in enumerate(config["hidden"]):
                shapes.update({f"g_{i}": (units,), f"s_{i}": (units,)})
        return shapes

    def start(self) -> None:
        return None

    def __call__(self, x: np.ndarray, memory: None) -> tuple[np.ndarray, None]:
        w, c = self.weights, self.config
        depth = len(c["hidden"])
        for i in range(depth):
            x = w[f"W_{i}"] @ x + w[f"b_{i}"]
            if c["normalization"] == "before":
                x = self._normalize(i, x)
            x = ACTIVATIONS[c["activation"]](x)
            if c["normalization"] == "after":
                x = self._normalize(i, x)
        return _act(w[f"W_{depth}"] @ x + w[f"b_{depth}"], c["output_activation"])[1], None

    def _normalize(self, i: int, x: np.ndarray) -> np.ndarray:
        x = x - np.mean(x)
        x = x / np.sqrt(np.mean(np.square(x)) + np.float32(EPSILON))
        return self.weights[f"g_{i}"] * x + self.weights[f"s_{i}"]


class MMU:
    """`credo.networks.mmu`: Khadka (2019), equations 3.1-3.5. The memory is (y, m)."""

    def __init__(self, config: dict[str, Any], weights: Weights):
        self.config, self.weights = config, weights

    @staticmethod
    def shapes(config: dict[str, Any], x: int, y: int) -> Shapes:
        h = config["hidden"]
        m = h if config["memory"] is None else config["memory"]
        shapes = {"K_p": (h, x), "N_p": (h, m), "b_p": (h,), "Z_y": (y, h), "b_y": (y,)}
        for gate, size in (("i", h), ("r", h), ("w", m)):
            shapes.update({f"K_{gate}": (size, x), f"R_{gate}": (size, y)})
            shapes.update({f"N_{gate}": (size, m), f"b_{gate}": (size,)})
        if config["decoder"] == "learned":
            shapes.update({"N_d": (h, m), "b_d": (h,)})
        if config["encoder"] == "learned":
            shapes.update({"Z_f": (m, h), "b_f": (m,)})
        if config["start_memory"] == "learned":
            shapes["m_0"] = (m,)
        return shapes

    def start(self) -> tuple[np.ndarray, np.ndarray]:
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
        y, action = _act(weights["Z_y"] @ h + weights["b_y"], c["output_activation"])
        return action, (y, m)

    def _gate(self, name: str, x: np.ndarray, y: np.ndarray, m: np.ndarray) -> np.ndarray:
        w = self.weights
        return _sigmoid(
            w[f"K_{name}"] @ x + w[f"R_{name}"] @ y + w[f"N_{name}"] @ m + w[f"b_{name}"]
        )


class Recurrent:
    """`credo.networks.recurrent`: Elman RNN, GRU and LSTM. The memory is (h, c)."""

    GATES = {"rnn": "h", "gru": "zrh", "lstm": "ifoc"}

    def __init__(self, config: dict[str, Any], weights: Weights):
        self.config, self.weights = config, weights

    @staticmethod
    def shapes(config: dict[str, Any], x: int, y: int) -> Shapes:
        h = config["hidden"]
        shapes = {"Z_y": (y, h), "b_y": (y,)}
        for gate in Recurrent.GATES[config["cell"]]:
            shapes.update({f"W_{gate}": (h, x), f"U_{gate}": (h, h), f"b_{gate}": (h,)})
        return shapes

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        zeros = np.zeros(self.config["hidden"], np.float32)
        return zeros, zeros

    def __call__(self, x: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        (h, c), cell = memory, self.config["cell"]
        if cell == "rnn":
            h = np.tanh(self._gate("h", x, h))
        elif cell == "gru":
            z, r = (_sigmoid(self._gate(name, x, h)) for name in "zr")
            h = z * h + (1.0 - z) * np.tanh(self._gate("h", x, r * h))
        else:
            i, f, o = (_sigmoid(self._gate(name, x, h)) for name in "ifo")
            c = f * c + i * np.tanh(self._gate("c", x, h))
            h = o * np.tanh(c)
        output = self.weights["Z_y"] @ h + self.weights["b_y"]
        return _act(output, self.config["output_activation"])[1], (h, c)

    def _gate(self, name: str, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        w = self.weights
        return w[f"W_{name}"] @ x + w[f"U_{name}"] @ h + w[f"b_{name}"]


NETWORKS: dict[str, Any] = {"MLP": MLP, "MMU": MMU, "Recurrent": Recurrent}


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


def _check(weights: Weights, shapes: Shapes) -> None:
    found = {name: array.shape for name, array in weights.items()}
    wrong = sorted(n for n in found.keys() | shapes.keys() if found.get(n) != shapes.get(n))
    if wrong:
        raise ValueError(
            f"its network does not have such weights: {wrong[0]} has shape "
            f"{found.get(wrong[0])}, expected {shapes.get(wrong[0])}"
        )
