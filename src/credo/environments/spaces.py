"""Spaces of Gymnasium as rows of numbers: observations written into them, actions read from them,
and masks of what is allowed.

No JAX here: a worker process imports this.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from .names import Fault


def told_mask(says: Any, masked: bool) -> Any:
    """The `action_mask` in an observation or an info; None: it has none. Raises `Fault` of one that
    was not there in the first reset."""
    told = says.get("action_mask") if isinstance(says, Mapping) else None
    if told is not None and not masked:
        raise Fault(
            "returned an action_mask in step and none in reset",
            "give it in both, so that learners know that there is one",
        )
    return told


def mask_row(told: Any, choices: Sequence[int]) -> np.ndarray:
    """An `action_mask` as one row of truth values, an option each. Several choices may have theirs
    in a tuple, as Gymnasium samples by them."""
    mask = np.concatenate(told) if isinstance(told, tuple) else np.asarray(told)
    if mask.shape != (sum(choices),) or mask.dtype.kind not in "biu":
        options = f"{choices[0]} actions" if len(choices) == 1 else f"{sum(choices)} options"
        raise Fault(
            f"returned an action_mask of shape {mask.shape} and dtype {mask.dtype}",
            f"give one number, 0 or 1, for each of the {options}",
        )
    mask = mask.astype(bool)
    if not all(part.any() for part in np.split(mask, np.cumsum(choices)[:-1])):
        part = "" if len(choices) == 1 else " for one of its choices"
        raise Fault(f"allows no action: its action_mask is 0 everywhere{part}", "allow one, or end")
    return mask


def shown_mask(space: Any) -> Any:
    """The space of `action_mask` in a Dict of observations; None if there is none."""
    spaces = getattr(space, "spaces", {})
    return spaces.get("action_mask") if isinstance(spaces, dict) else None


def without_mask(space: Any) -> gymnasium.Space:
    """What a Dict of observations has beside `action_mask`: that alone, if it is one thing."""
    rest = {key: part for key, part in space.spaces.items() if key != "action_mask"}
    return next(iter(rest.values())) if len(rest) == 1 else gymnasium.spaces.Dict(rest)


def behind_mask(said: Any) -> Any:
    """Of an observation what `without_mask` has of its space."""
    if not isinstance(said, Mapping):
        raise Fault(f"returned an observation of type {type(said).__name__}", "return a dict")
    rest = {key: part for key, part in said.items() if key != "action_mask"}
    return next(iter(rest.values())) if len(rest) == 1 else rest


class Flat(NamedTuple):
    """An observation space as one row of numbers.

    Box: flattened. Discrete: one-hot. What is made of them: one after the other.
    """

    size: int
    dtype: str  # "uint8" if it is made of Boxes of uint8 alone, else "float32"
    low: np.ndarray  # [size], float64
    high: np.ndarray
    write: Callable[[Any, np.ndarray], None]  # an observation into a row
    image: tuple[int, ...] | None = None  # where the first image begins, and its shape

    @property
    def bounds(self) -> list[Any]:
        """The least and the largest of each number; one number where all are the same."""
        return [x[0] if x.size and (x == x[0]).all() else x.tolist() for x in self[2:4]]

    def behind(self, n: int) -> "Flat":
        """The same row behind n numbers, from 0 to 1, that others write."""
        low, high = np.append(np.zeros(n), self.low), np.append(np.ones(n), self.high)
        image = self.image and (n + self.image[0], *self.image[1:])
        write = lambda obs, row: self.write(obs, row[n:])  # noqa: E731
        return Flat(n + self.size, self.dtype, low, high, write, image)


def as_flat(space: gymnasium.Space, said: str = "an observation", first: str | None = None) -> Flat:
    """How observations of `space` become a row; of a Dict that with the part `first` in front.
    `said` names them in a `Fault`, which is raised of a space that NumPy cannot hold (Graph,
    Sequence)."""
    spaces = gymnasium.spaces
    if not _told_in_numbers(space):
        raise Fault(
            f"has the observation space {space}",
            "use a Box, a Discrete, or a Dict or Tuple of them",
        )
    if isinstance(space, spaces.Box):
        low, high = (np.float64(bound).ravel() for bound in (space.low, space.high))
        small = space.dtype == np.uint8
        write = _box_writer(space, said)
        image = (0, *space.shape) if len(space.shape) == 3 else None
        return Flat(low.size, "uint8" if small else "float32", low, high, write, image)
    if isinstance(space, spaces.Dict):
        parts = {key: part for key, part in space.spaces.items() if _told_in_numbers(part)}
        if first is not None:
            parts = {first: parts[first]} | parts
        return _joined(space, parts, Mapping, said)
    if isinstance(space, spaces.Tuple):
        return _joined(space, dict(enumerate(space.spaces)), (tuple, list), said)

    def write_other(obs: Any, row: np.ndarray) -> None:
        if not space.contains(obs):
            raise Fault(
                f"returned {said} of {obs!r}",
                f"its observation_space is {space}: make the two agree",
            )
        row[:] = spaces.flatten(space, obs)

    size, hot = spaces.flatdim(space), not isinstance(space, spaces.Text)
    low, high = (0.0, 1.0) if hot else (-np.inf, np.inf)
    return Flat(size, "float32", np.full(size, low), np.full(size, high), write_other)


def _told_in_numbers(space: Any) -> bool:
    """Whether a space is one, or is made of such, that an array can hold; of a Dict some part."""
    if isinstance(space, gymnasium.spaces.Dict):
        return any(map(_told_in_numbers, space.spaces.values()))
    try:
        return isinstance(space, gymnasium.Space) and space.is_np_flattenable
    except NotImplementedError:  # of a space of its own that does not say
        return False


def left_out(space: Any) -> list[str]:
    """Warnings of parts of a Dict of observations that are no numbers, such as a text of MiniGrid:
    policies do not see them."""
    parts = getattr(space, "spaces", None)
    if not isinstance(parts, Mapping):
        return []
    left = [key for key, part in parts.items() if not _told_in_numbers(part)]
    if len(left) == len(parts):
        return []
    return [f"its observation {key!r} is no array of numbers, and is left out" for key in left]


def _box_writer(space: Any, said: str) -> Callable[[Any, np.ndarray], None]:
    """The shape decides; every kind of real number is cast. Bounds are not looked at."""
    shape, small = space.shape, space.dtype == np.uint8

    def write(obs: Any, row: np.ndarray) -> None:
        obs = np.asarray(obs)
        if obs.shape != shape:
            raise Fault(
                f"returned {said} of shape {obs.shape}",
                f"its observation_space says {shape}: make the two agree",
            )
        if obs.dtype.kind not in "fuib":
            raise Fault(f"returned {said} of dtype {obs.dtype}", "return real numbers")
        if small and obs.dtype != np.uint8 and row.dtype == np.uint8:
            whole = obs.astype(np.uint8)
            if not np.array_equal(whole, obs):
                raise Fault(
                    f"returned {said} of dtype {obs.dtype} that uint8 cannot hold",
                    "its observation_space says uint8: make the two agree",
                )
            obs = whole
        row[:] = obs.ravel()

    return write


def _joined(space: Any, parts: dict[Any, Any], kind: Any, said: str) -> Flat:
    """The parts of a Dict or Tuple, one after the other, each by its own rule."""
    flats = {key: as_flat(part, f"{said} with {key!r}") for key, part in parts.items()}
    writes, at, image = [], 0, None
    for key, flat in flats.items():
        writes.append((key, slice(at, at + flat.size), flat.write))
        if flat.image and not image:
            image = (at + flat.image[0], *flat.image[1:])
        at += flat.size

    def write(obs: Any, row: np.ndarray) -> None:
        if not isinstance(obs, kind) or len(obs) != len(space.spaces):
            told = f"the keys {list(obs)}" if isinstance(obs, Mapping) else kind_of(obs)
            raise Fault(
                f"returned {said} of {told}",
                f"its observation_space says {list(parts)}: make the two agree",
            )
        for key, place, write_part in writes:
            if kind is Mapping and key not in obs:
                raise Fault(
                    f"returned {said} without {key!r}",
                    f"its observation_space says {list(parts)}: make the two agree",
                )
            write_part(obs[key], row[place])

    small = all(flat.dtype == "uint8" for flat in flats.values())
    low, high = (
        np.concatenate([np.zeros(0), *bounds])
        for bounds in ([x.low for x in flats.values()], [x.high for x in flats.values()])
    )
    return Flat(at, "uint8" if small and flats else "float32", low, high, write, image)


def kind_of(x: Any) -> str:
    """Type and length of what was returned, for a message."""
    length = f" and length {len(x)}" if isinstance(x, (tuple, list)) else ""
    return f"type {type(x).__name__}{length}"


def padded_bounds(flat: Flat, size: int) -> list[Any]:
    """Bounds of an agent's observation that is padded with zeros to `size` numbers."""
    pad = (0, size - flat.size)
    return flat._replace(low=np.pad(flat.low, pad), high=np.pad(flat.high, pad)).bounds


def as_shown(space: Any, first: str | None = None) -> dict[str, Any] | None:
    """Of a Dict or a Tuple how `as_flat` makes numbers of it, as JSON, for `credo.runner`; None for
    any other."""
    spaces = gymnasium.spaces
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        return None
    parts = [(key, part) for key, part in _parts(space) if _told_in_numbers(part)]
    parts.sort(key=lambda part: first is not None and part[0] != first)
    return {"parts": [[key, as_shown(part) or _entries(part)] for key, part in parts]}


def _entries(space: Any) -> dict[str, Any]:
    """What is no Dict and no Tuple: options of which one is told, or so many numbers."""
    spaces = gymnasium.spaces
    if isinstance(space, spaces.MultiDiscrete):
        nvec, start = (x.ravel().tolist() for x in _vector(space))
        return {"nvec": nvec, "start": start}
    return as_choice(space) or {"size": spaces.flatdim(space)}


def as_choice(space: gymnasium.Space) -> dict[str, int] | None:
    """A Discrete as JSON; None for what is none."""
    if not isinstance(space, gymnasium.spaces.Discrete):
        return None
    return {"n": int(space.n), "start": int(space.start)}


def described(space: Any) -> dict[str, Any]:
    """An action space as JSON, for `credo.runner`."""
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = [[key, described(part)] for key, part in _parts(space)]
        return {"parts": parts, "dict": isinstance(space, spaces.Dict)}
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        form = {"shape": list(space.shape), "dtype": str(space.dtype)}
        nvec, start = (x.ravel().tolist() for x in _vector(space))
        return {"nvec": nvec, "start": start, **form}
    if not isinstance(space, spaces.Box):
        return as_choice(space) or {}
    low, high = (np.float64(bound).ravel().tolist() for bound in (space.low, space.high))
    return {"low": low, "high": high, "shape": list(space.shape), "dtype": str(space.dtype)}


def _parts(space: Any) -> list[tuple[Any, gymnasium.Space]]:
    """Those of a Dict or a Tuple."""
    spaces = space.spaces
    return list(spaces.items() if isinstance(spaces, Mapping) else enumerate(spaces))


def _vector(space: Any) -> tuple[np.ndarray, np.ndarray]:
    """Options of each choice of a MultiDiscrete or a MultiBinary, and the first option of each."""
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        return np.asarray(space.nvec), np.asarray(space.start)
    return np.full(space.shape, 2), np.zeros(space.shape, space.dtype)


class Acts(NamedTuple):
    """An action space as numbers in [-1, 1]: those of its choices, one for each option, and behind
    them those of its Boxes."""

    size: int
    choices: tuple[int, ...]  # options of each
    read: Callable[[np.ndarray], Any]  # actions [n, act] as the space's own, one by one


def as_actions(space: gymnasium.Space) -> Acts:
    """How actions are told. Box: -1 is its low, 1 its high. Discrete, MultiDiscrete, MultiBinary:
    of each choice the entry that is largest. Dict, Tuple: those of its parts."""
    choices = tuple(_options(space))
    cursor = [0, sum(choices)]  # where the next choice begins, and the next Box
    read = _reader(space, cursor)
    return Acts(cursor[1], choices, read)


def _options(space: Any) -> list[int]:
    """Options of each choice in a space, in order. Raises `Fault` of a space that has others."""
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Dict | spaces.Tuple):
        return [n for _, part in _parts(space) for n in _options(part)]
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        return [int(n) for n in _vector(space)[0].ravel()]
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    if isinstance(space, spaces.Box):
        return []
    raise Fault(
        f"has the action space {space}",
        "use a Box, a Discrete, a MultiDiscrete, a MultiBinary, or a Dict or Tuple of them",
    )


def _reader(space: Any, cursor: list[int]) -> Callable[[np.ndarray], Any]:
    """What reads actions of a space from numbers at `cursor`, which is moved on."""
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Dict | spaces.Tuple):
        keys, parts = zip(*_parts(space), strict=True)
        readers = [_reader(part, cursor) for part in parts]
        made = dict if isinstance(space, spaces.Dict) else lambda pairs: tuple(x for _, x in pairs)
        return lambda actions: [
            made(zip(keys, own, strict=True))
            for own in zip(*(read(actions) for read in readers), strict=True)
        ]
    if isinstance(space, spaces.Box):
        return _scaled(space, cursor)
    return _chosen(space, cursor)


def _chosen(space: Any, cursor: list[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Of a Discrete, a MultiDiscrete or a MultiBinary."""
    sizes, start = _options(space), cursor[0]
    cursor[0] += sum(sizes)
    if isinstance(space, gymnasium.spaces.Discrete):
        first, end = space.start, cursor[0]
        return lambda actions: np.argmax(actions[:, start:end], axis=1) + first
    ends, firsts = np.cumsum(sizes) + start, _vector(space)[1]

    def read(actions: np.ndarray) -> np.ndarray:
        each = [
            np.argmax(actions[:, end - n : end], axis=1) for end, n in zip(ends, sizes, strict=True)
        ]
        own = np.stack(each, axis=1).reshape(-1, *space.shape) + firsts
        return own.astype(space.dtype)

    return read


def _scaled(space: Any, cursor: list[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Of a Box."""
    low, high = (np.float64(bound).ravel() for bound in (space.low, space.high))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise Fault(
            f"has an action space without bounds: {space}",
            "give its Box a finite low and high: actions in [-1, 1] are scaled to them",
        )
    center, half = (low + high) / 2, (high - low) / 2
    shape, dtype = space.shape, space.dtype
    whole, at, end = not np.issubdtype(dtype, np.floating), cursor[1], cursor[1] + low.size
    cursor[1] = end

    def read(actions: np.ndarray) -> np.ndarray:
        own = np.minimum(np.maximum(center + half * actions[:, at:end], low), high)
        own = np.rint(own) if whole else own
        return own.astype(dtype).reshape(-1, *shape)

    return read
