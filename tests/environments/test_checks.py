"""`check_environment` names each fault of a deliberately broken environment, and its fix."""

import re
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.base import AbstractEnvironment
from credo.environments.checks import check_environment
from credo.environments.probes import Copy, Locked, Meet, Remember
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.types import Sequence, TimeStep


@pytest.mark.parametrize(
    "env",
    [
        Copy(size=2, max_steps=3),
        Locked(size=2, hold=1, max_steps=3),
        Remember(delay=2),
        Meet(),
        SequenceClassification(depth=2, min_gap=0, max_gap=2),
        SequenceRecall(depth=1, min_corridor=1, max_corridor=2),
    ],
    ids=lambda env: type(env).__name__,
)
def test_nothing_is_wrong_with_our_own(env):
    assert check_environment(env) == []


class Walk(AbstractEnvironment):
    """A sound little world; each fault below overrides one of its parts."""

    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 1
    max_steps: ClassVar[int] = 4
    signals: ClassVar[tuple[str, ...]] = ("reward",)

    def reset(self, *, key):
        place = self.start(key)
        state = (place, jnp.int32(0))
        return state, self.time_step(state, jnp.float32(0.0))

    def step(self, state, action, *, key):
        place, t = state
        state = (place + self.move(action, key), t + 1)
        return state, self.time_step(state, self.pay(state[0], t))

    def time_step(self, state, reward):
        place, t = state
        return TimeStep(
            self.see(place, t), {"reward": reward}, jnp.bool_(False), t >= self.duration()
        )

    def start(self, key):
        return jax.random.normal(key, (2,))

    def move(self, action, key):
        return 0.1 * action

    def pay(self, place, t):
        return -jnp.sum(place**2)

    def see(self, place, t):
        return place

    def duration(self):
        return self.max_steps


class WrongObsShape(Walk):
    def see(self, place, t):
        return place[:1]


class WrongObsDtype(Walk):
    def see(self, place, t):
        return place.astype(jnp.float16)


class HostObs(Walk):
    def see(self, place, t):
        return [0.0, 1.0]


class NanAtReset(Walk):
    def see(self, place, t):
        return place / jnp.float32(0.0) * 0.0


class NanInTheMiddle(Walk):
    def see(self, place, t):
        return jnp.where(t == 3, jnp.nan, place)


class InfiniteReward(Walk):
    def pay(self, place, t):
        return jnp.where(t == 2, jnp.inf, jnp.float32(0.0))


class OutOfRange(Walk):
    obs_range: ClassVar[tuple[float, float]] = (-1.0, 1.0)

    def see(self, place, t):
        return jnp.clip(place, -1.0, 1.0) + (t >= 2).astype(jnp.float32)


class RangeOfNothing(Walk):
    obs_range: ClassVar[tuple[float, float]] = (1.0, -1.0)


class VectorReward(Walk):
    def pay(self, place, t):
        return place


class IntegerReward(Walk):
    def pay(self, place, t):
        return t


class MissingSignal(Walk):
    signals: ClassVar[tuple[str, ...]] = ("reward", "success")


class ExtraSignal(Walk):
    signals: ClassVar[tuple[str, ...]] = ("score",)


class PaidForNothing(Walk):
    def time_step(self, state, reward):
        return super().time_step(state, reward + 1.0)


class Endless(Walk):
    def duration(self):
        return 10**6


class TooLong(Walk):
    def duration(self):
        return self.max_steps + 2


class OverAtOnce(Walk):
    def duration(self):
        return 0


class UnseededStart(Walk):
    def start(self, key):
        return jnp.asarray(np.random.normal(size=2), jnp.float32)


class UnseededStep(Walk):
    def move(self, action, key):
        return action * np.float32(np.random.uniform())


class KeyIgnored(Walk):
    def start(self, key):
        return jnp.ones(2)


class StateGrows(Walk):
    def step(self, state, action, *, key):
        (place, t), time_step = super().step(state, action, key=key)
        return (place, t, t), time_step


class StateChangesForm(Walk):
    def step(self, state, action, *, key):
        (place, t), time_step = super().step(state, action, key=key)
        return (place, t.astype(jnp.float32)), time_step


class ActiveWithoutTeam(Walk):
    def time_step(self, state, reward):
        return eqx.tree_at(
            lambda t: t.active,
            super().time_step(state, reward),
            jnp.ones(1, bool),
            is_leaf=lambda x: x is None,
        )


class IntegerFlag(Walk):
    def time_step(self, state, reward):
        return eqx.tree_at(lambda t: t.terminated, super().time_step(state, reward), jnp.int32(0))


class NotATimeStep(Walk):
    def time_step(self, state, reward):
        return {"obs": state[0], "reward": reward}


class NoSize(Walk):
    obs_size: ClassVar[int] = 0


class NamelessSignals(Walk):
    signals: ClassVar[tuple[str, ...]] = ()


class TwinSignals(Walk):
    signals: ClassVar[tuple[str, ...]] = ("reward", "reward")


class LonelyTeam(Meet):
    """Private rewards and activity of three in a team of two."""

    def step(self, state, action, *, key):
        state, time_step = super().step(state, action, key=key)
        rewards = {**time_step.rewards, "local": jnp.zeros(3)}
        return state, eqx.tree_at(
            lambda t: (t.rewards, t.active), time_step, (rewards, jnp.ones(3, bool))
        )


WORLDS = {
    WrongObsShape: r"reset: obs has shape \(1,\): it must be \(2,\)",
    WrongObsDtype: r"reset: obs is float16: .*astype\(jnp.float32\)",
    HostObs: "reset: obs is a list: return a JAX array, float32",
    NanAtReset: "reset: obs has NaN or inf",
    NanInTheMiddle: "step: obs has NaN or inf at step 3: keep it finite",
    InfiniteReward: "step: a reward has NaN or inf at step 3",
    OutOfRange: r"step: obs leaves obs_range \(-1.0, 1.0\) at step 2: widen obs_range, or clip",
    RangeOfNothing: r"obs_range is \(1.0, -1.0\): it must be \(least, largest\)",
    VectorReward: r"step: reward 'reward' has shape \(2,\): it must be \(\)",
    IntegerReward: "step: reward 'reward' is int32: it must be float32",
    MissingSignal: r"rewards are \['reward'\] but signals names \['reward', 'success'\]: return",
    ExtraSignal: r"rewards are \['reward'\] but signals names \['score'\]",
    PaidForNothing: "reset: reward 'reward' is 1.0, but nothing was done yet: return zeros",
    Endless: "had not ended after 8 steps, and max_steps is 4: set truncated",
    TooLong: "took 6 steps and max_steps is 4: set truncated there, or raise max_steps",
    OverAtOnce: "reset: the episode has already ended",
    UnseededStart: "the same key gave two different episodes: draw everything from `key`",
    UnseededStep: "the same key gave two different episodes",
    KeyIgnored: "16 different keys gave the same episode: draw the start",
    StateGrows: "reset and step return different structures",
    StateChangesForm: r"state\[1\] is int32\[\] after reset and float32\[\] after step",
    ActiveWithoutTeam: "reset: active is for teams: leave it None, or set agents",
    IntegerFlag: "reset: terminated is int32: it must be bool",
    NotATimeStep: "reset: the second result is dict: return a TimeStep",
    NoSize: "obs_size is 0: it must be a Python int of at least 1",
    NamelessSignals: r"signals is \(\): it must be a tuple of one or more names",
    TwinSignals: "a name occurs twice",
    LonelyTeam: r"step: reward 'local' has shape \(3,\): it must be \(2,\)",
}


def test_the_world_under_the_faults_is_sound():
    assert check_environment(Walk()) == []


@pytest.mark.parametrize("broken", WORLDS, ids=lambda broken: broken.__name__)
def test_a_broken_world_is_named_with_its_fix(broken):
    assert_told(check_environment(broken()), WORLDS[broken])


def assert_told(problems, pattern):
    assert any(re.search(pattern, problem) for problem in problems), problems


def test_a_team_may_not_resize_its_activity():
    assert_told(
        check_environment(LonelyTeam()), r"step: active has shape \(3,\): it must be \(2,\)"
    )


def test_what_is_no_environment_is_told_so():
    assert_told(check_environment(object()), "object is not an environment of ours: derive it from")


class Echo(Remember):
    """A sound sequence task whose parts the faults below replace."""

    def sample(self, *, key):
        sequence = super().sample(key=key)
        fields = {name: getattr(sequence, name) for name in sequence.__dataclass_fields__}
        return Sequence(**(fields | self.fault(sequence, key)))

    def fault(self, sequence, key):
        return {}


class FlatInputs(Echo):
    def fault(self, sequence, key):
        return {"inputs": sequence.inputs[:, 0]}


class ShortTargets(Echo):
    def fault(self, sequence, key):
        return {"targets": sequence.targets[1:]}


class WeightsForScored(Echo):
    def fault(self, sequence, key):
        return {"scored": sequence.scored.astype(jnp.float32)}


class LengthBeyond(Echo):
    def fault(self, sequence, key):
        return {"length": jnp.int32(self.max_steps + 1)}


class LengthZero(Echo):
    def fault(self, sequence, key):
        return {"length": jnp.int32(0), "scored": jnp.zeros_like(sequence.scored)}


class PaddingScored(Echo):
    def fault(self, sequence, key):
        return {"length": sequence.length - 1, "scored": jnp.ones_like(sequence.scored)}


class NothingScored(Echo):
    def fault(self, sequence, key):
        return {"scored": jnp.zeros_like(sequence.scored)}


class InfiniteInputs(Echo):
    def fault(self, sequence, key):
        positive = sequence.inputs[0, 0] > 0
        return {"inputs": jnp.where(positive, jnp.inf, sequence.inputs)}


class UnseededSequence(Echo):
    def fault(self, sequence, key):
        return {"inputs": sequence.inputs + np.float32(np.random.uniform())}


class SameSequence(Echo):
    def sample(self, *, key):
        return super().sample(key=jax.random.key(0))


class NotASequence(Echo):
    def sample(self, *, key):
        return super().sample(key=key).inputs


class SummedReward(Echo):
    def reward(self, answer, target, scored, perfect):
        return jnp.sum(answer * target)


class RelativeReward(Echo):
    def reward(self, answer, target, scored, perfect):
        return answer * target - jnp.mean(answer * target) + jnp.mean(answer)


SEQUENCES = {
    FlatInputs: r"inputs has shape \(3,\): it must be \(3, 1\)",
    ShortTargets: r"targets has shape \(2,\): it must be \(3,\)",
    WeightsForScored: "scored is float32: it must be bool",
    LengthBeyond: r"lengths are 4..4 and max_steps is 3: every length must lie in 1..max_steps",
    LengthZero: "lengths are 0..0 and max_steps is 3",
    PaddingScored: "a step at or beyond `length` is scored: padding must not count",
    NothingScored: "no scored step before its `length`",
    InfiniteInputs: "inputs has NaN or inf for some key",
    UnseededSequence: "the same key gave two different sequences",
    SameSequence: "16 different keys gave the same sequence: draw it from `key`",
    NotASequence: "the result is .*: return a Sequence",
    SummedReward: r"reward: its value .* has shape \(\): it must be \(3, 4\)",
    RelativeReward: "reward: one answer alone earns .* work elementwise",
}


@pytest.mark.parametrize("broken", SEQUENCES, ids=lambda broken: broken.__name__)
def test_a_broken_sequence_task_is_named_with_its_fix(broken):
    assert_told(check_environment(broken(delay=2)), SEQUENCES[broken])


class WrongEnds(Meet):
    """Says of three agents whether they ended; there are two."""

    def _time_step(self, state, local, met):
        told = super()._time_step(state, local, met)
        return eqx.tree_at(lambda t: t.gone, told, jnp.zeros(3, bool), is_leaf=lambda x: x is None)


def test_a_team_says_of_every_agent_whether_it_ended():
    assert_told(check_environment(WrongEnds()), r"reset: gone has shape \(3,\): it must be \(2,\)")
