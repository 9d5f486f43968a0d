"""The cybersecurity task: a fleet of proxy servers finds out whose requests are genuine.

Source: Khadka (2019), section 4.2.2; numbers that the dissertation leaves out (the length of an
episode, what a server sees while it is busy) are those of the author's published code ("as coded").

Departures from the code:

- A request is served once: simultaneous claims on a device's last requests are granted in random
  order and the others get nothing. There several servers may take the last request, and counts of
  pending requests go on below zero.
- The number of busy steps may be drawn from 0, and an observation ends with the server's status.
"""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import require
from ..types import TimeStep, Trace
from .base import AbstractEnvironment
from .viewer import Mark, Viewer

LEGEND = (
    Mark("box", "good", "genuine device, with the requests that are pending"),
    Mark("rhombus", "bad", "nefarious device; both are faint once nothing is pending"),
    Mark("dot", "c0", "a server that acts in this step, in its own colour"),
    Mark("ring", "c0", "a server that is busy; faint: away"),
    Mark("line", "c0", "the device that it serves in this step"),
    Mark("plus", "good", "+1 above a server: it has served a genuine request"),
    Mark("minus", "bad", "−1: a nefarious one; 0: none was left"),
)

ACTS, BUSY, AWAY = 1.0, 0.0, -1.0  # a server's status, as observed


class FleetState(eqx.Module):
    """A fleet between two steps."""

    genuine: Bool[Array, " devices"]
    pending: Int[Array, " devices"]  # requests not served yet, at least 0
    told: Float[Array, "servers devices"]  # ±1 where a server was last told what it had served
    busy: Int[Array, " servers"]  # steps left in which it cannot act
    step: Int[Array, ""]


class ServerFleet(AbstractEnvironment):
    """Servers serve requests of devices; the genuine ones pay +1 and the nefarious ones -1.

    Which devices are nefarious is drawn for each episode, and told only by serving them. A server
    that acts serves one request of the device it chose, if one is pending, and is then `busy`,
    whether it got one or not.

    **Actions** `[servers, devices]`: the largest number (the first of equals) is the device.

    **Observation** `[servers, obs]`, in this order: the pending requests of every device (counts,
    zeros while busy, as coded); what the request it just served was worth, a signed one-hot at
    the device or a scalar, 0 if it got none; and its status: 1 acts at this step, 0 is busy, -1
    is away. A server that is away sees zeros and that -1. A network can read from the status who
    takes part; `TimeStep.active` says who acts.

    **Signal** `net`, shared: genuine minus nefarious requests served in this step.

    `truncated` at `max_steps`, never `terminated`.
    """

    signals: ClassVar[tuple[str, ...]] = ("net",)

    servers: int = eqx.field(static=True, default=10)  # agents, at least 1
    devices: int = eqx.field(static=True, default=20)  # devices that have requests, at least 1
    requests: int = eqx.field(static=True, default=5)
    """Pending requests of each device at first, at least 1."""
    nefarious: int | tuple[int, int] = eqx.field(static=True, default=(7, 13))
    """Number of nefarious devices, or (least, most) to draw it from uniformly, 0 to `devices`."""
    busy: int | tuple[int, int] = eqx.field(static=True, default=1)
    """Steps without acting behind each action: a number (1: "synchronous"), or (least, most) to
    draw it from uniformly for each action ((0, 2): "asynchronous")."""
    max_steps: int = eqx.field(static=True, default=15)
    """Length of every episode in steps, at least 1."""
    observation: Literal["signed one-hot", "scalar"] = eqx.field(
        static=True, default="signed one-hot"
    )
    """How the worth of a served request is seen: at its device's place (signed one-hot), or as
    one number."""
    told: Literal["once", "until-action"] = eqx.field(static=True, default="once")
    """How long the worth of a request is observed: one step (as coded; then a server that is busy
    must pay attention to learn it), or until the server acts again."""
    status: bool = eqx.field(static=True, default=True)
    """Whether a server sees if it acts, is busy or away."""
    scale: tuple[float, float] = eqx.field(static=True, default=(1.0, 1.0))
    """What the observed counts, and what a served request was worth, are multiplied by; both more
    than 0. Raw counts drown the worth: 20 devices with 5 requests each against one ±1."""
    schedule: tuple[tuple[int, int], ...] | None = eqx.field(static=True, default=None)
    """One (joins, leaves) per server: it is away before step `joins` and from step `leaves` on,
    counted from 0. None: no server is ever away."""
    classes: tuple[bool, ...] | None = eqx.field(static=True, default=None)
    """Whether each device is genuine, the same in every episode; None: drawn by `nefarious`."""

    @classmethod
    def case_study(cls, classes: tuple[bool, ...] | None = None) -> "ServerFleet":
        """2 servers, 4 devices with 3 requests each, 2 of them nefarious: section 4.2.4."""
        return cls(servers=2, devices=4, requests=3, nefarious=2, max_steps=8, classes=classes)

    def __check_init__(self):
        for name in ("servers", "devices", "requests", "max_steps"):
            require.at_least(name, getattr(self, name), 1)
        require.literals(self)
        low, high = span(self.nefarious)
        if not 0 <= low <= high <= self.devices:
            raise ValueError(
                f"nefarious is {self.nefarious}: it must be a number, or (least, most), "
                f"in 0..{self.devices}, the devices"
            )
        low, high = span(self.busy)
        if not 0 <= low <= high:
            raise ValueError(
                f"busy is {self.busy}: it must be a number of steps of at least 0, or (least, most)"
            )
        if self.classes is not None and len(self.classes) != self.devices:
            raise ValueError(
                f"classes has {len(self.classes)} entries for {self.devices} devices: give True "
                "(genuine) or False for each"
            )
        two = isinstance(self.scale, tuple) and len(self.scale) == 2
        if not (two and all(0 < x < math.inf for x in self.scale)):
            raise ValueError(
                f"scale is {self.scale}: give a tuple (of the counts, of the worth) of finite "
                "numbers of more than 0, as in (1.0, 1.0)"
            )
        self._check_schedule()

    def _check_schedule(self):
        """Raise `ValueError` unless every server has times to join and leave, in this order."""
        if self.schedule is None:
            return
        if not isinstance(self.schedule, Sequence):
            raise ValueError(f"schedule is {self.schedule}: give (joins, leaves) for each server")
        if len(self.schedule) != self.servers:
            raise ValueError(
                f"schedule has {len(self.schedule)} entries for {self.servers} servers: give "
                "(joins, leaves) for each"
            )
        for server, times in enumerate(self.schedule):
            pair = isinstance(times, tuple | list) and len(times) == 2
            if not pair or not 0 <= times[0] < min(times[1], self.max_steps):
                raise ValueError(
                    f"schedule[{server}] is {times}: it must be (joins, leaves) with "
                    f"0 <= joins < leaves and joins < {self.max_steps}, the steps of an episode; "
                    f"(0, {self.max_steps}) is there all the time"
                )

    @property
    def agents(self) -> int:
        return self.servers

    @property
    def action_size(self) -> int:
        return self.devices

    @property
    def obs_size(self) -> int:
        worth = self.devices if self.observation == "signed one-hot" else 1
        return self.devices + worth + int(self.status)

    @property
    def obs_range(self) -> tuple[float, float]:
        counts, worth = self.scale
        return -max(worth, 1.0), max(counts * self.requests, worth, 1.0)

    def reset(self, *, key: PRNGKeyArray) -> tuple[FleetState, TimeStep]:
        if self.classes is not None:
            return self.begin(jnp.asarray(self.classes))
        count_key, order_key = jax.random.split(key)
        low, high = span(self.nefarious)
        count = jax.random.randint(count_key, (), low, high + 1)
        return self.begin(jax.random.permutation(order_key, self.devices) >= count)

    def begin(self, genuine: Bool[Array, " devices"]) -> tuple[FleetState, TimeStep]:
        """An episode with these classes."""
        state = FleetState(
            genuine,
            jnp.full(self.devices, self.requests, jnp.int32),
            jnp.zeros((self.servers, self.devices)),
            jnp.zeros(self.servers, jnp.int32),
            jnp.int32(0),
        )
        return state, self._time_step(state, jnp.float32(0.0))

    def step(
        self, state: FleetState, action: Float[Array, "servers devices"], *, key: PRNGKeyArray
    ) -> tuple[FleetState, TimeStep]:
        claim_key, busy_key = jax.random.split(key)
        acting = self.present(state.step) & (state.busy == 0)
        chosen = jnp.argmax(action, axis=1)[:, None] == jnp.arange(self.devices)[None]
        granted = _grant(acting[:, None] & chosen, state.pending, key=claim_key)
        worth = jnp.where(state.genuine, 1.0, -1.0)[None] * granted.astype(jnp.float32)
        before = state.told if self.told == "until-action" else jnp.zeros_like(state.told)
        state = FleetState(
            state.genuine,
            state.pending - jnp.sum(granted.astype(jnp.int32), axis=0),
            jnp.where(acting[:, None], worth, before),
            jnp.where(acting, self._busy_steps(key=busy_key), jnp.maximum(state.busy - 1, 0)),
            state.step + 1,
        )
        return state, self._time_step(state, jnp.sum(worth))

    def viewer(self) -> Viewer:
        """Servers and devices, and who serves whom."""
        return Viewer(
            "fleet",
            f"{self.servers} servers and {self.devices} devices with {self.requests} requests "
            "each; which devices are nefarious is found out by serving them.",
            self._shown,
            {"servers": self.servers, "devices": self.devices},
            LEGEND,
            agent="server",
            speed=1.0,
        )

    def _shown(self, trace: Trace) -> dict[str, Any]:
        """At every moment what is `pending` and each server's `status`; in every step the device
        of its `choice` and what the request was `worth` to it: -1, and 0, for who does not act."""
        state = trace.states
        present = np.asarray(jax.vmap(self.present)(state.step))
        acting = present & (state.busy == 0)
        status = np.where(present, np.where(acting, ACTS, BUSY), AWAY)
        worth = np.where(acting[:-1], state.told[1:].sum(axis=2), 0.0)
        return {
            "genuine": state.genuine[0],
            "pending": state.pending,
            "status": status.astype(int),
            "choice": np.where(acting[:-1], trace.actions.argmax(axis=2), -1),
            "worth": worth.astype(int),
        }

    def present(self, step: Int[Array, ""]) -> Bool[Array, " servers"]:
        """Who is in the fleet at a step."""
        if self.schedule is None:
            return jnp.ones(self.servers, bool)
        joins, leaves = jnp.asarray(self.schedule, jnp.int32).T
        return (joins <= step) & (step < leaves)

    def _busy_steps(self, *, key: PRNGKeyArray) -> Int[Array, " servers"]:
        """For how many steps each server would be busy after acting now."""
        low, high = span(self.busy)
        if low == high:
            return jnp.full(self.servers, low, jnp.int32)
        return jax.random.randint(key, (self.servers,), low, high + 1)

    def _time_step(self, state: FleetState, net: Float[Array, ""]) -> TimeStep:
        """What servers observe of a state, and `net` for the step that led to it."""
        present = self.present(state.step)
        active = present & (state.busy == 0)
        counts, worth = self.scale
        pending = jnp.where(active[:, None], counts * state.pending.astype(jnp.float32)[None], 0.0)
        told = jnp.where(present[:, None], worth * state.told, 0.0)
        if self.observation == "scalar":
            told = jnp.sum(told, axis=1, keepdims=True)
        parts = [pending, told]
        if self.status:
            parts.append(jnp.where(present, jnp.where(active, ACTS, BUSY), AWAY)[:, None])
        ends = state.step >= self.max_steps
        obs = jnp.concatenate(parts, axis=1)
        return TimeStep(obs, {"net": net}, jnp.bool_(False), ends, active)


def span(value: int | tuple[int, int]) -> tuple[int, int]:
    """(least, most) of a number that may be drawn."""
    return (value, value) if isinstance(value, int) else value


def _grant(
    claims: Bool[Array, "servers devices"], pending: Int[Array, " devices"], *, key: PRNGKeyArray
) -> Bool[Array, "servers devices"]:
    """The claims that are met, as many as are pending, in random order."""
    ticket, index = jax.random.uniform(key, claims.shape[:1]), jnp.arange(claims.shape[0])
    # Two equal tickets would both be the next one.
    earlier = (ticket[None] < ticket[:, None]) | (
        (ticket[None] == ticket[:, None]) & (index[None] < index[:, None])
    )
    ahead = earlier.astype(jnp.float32) @ claims.astype(jnp.float32)
    return claims & (ahead < pending.astype(jnp.float32)[None])
