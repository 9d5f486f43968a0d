"""Flags for the fields of objects, also of those inside tuples and wrappers."""

import dataclasses

import equinox as eqx
import pytest

from credo.environments import wrappers
from credo.environments.sequence_recall import SequenceRecall
from credo.learners.base import AbstractLearner
from credo.learners.sac import SAC
from credo.learners.td3 import TD3
from credo.runs import arguments


@dataclasses.dataclass
class Options:
    """Options."""

    seed: int = 0


class Portfolio(eqx.Module):
    env: eqx.Module
    learners: tuple[AbstractLearner, ...] = (TD3(gamma=0.9), SAC(gamma=0.997))
    size: int = 3


def parsed(value, *argv, **options):
    return arguments.parse("prog", value, Options, list(argv), **options)


def test_each_member_of_a_tuple_has_the_flags_of_its_own_class():
    first, options = parsed(
        Portfolio(SequenceRecall()),
        *("--learners.0.gamma", "0.5", "--learners.0.policy-delay", "3"),
        *("--learners.1.batch-size", "7", "--depth", "2", "--seed", "4"),
    )
    expected = (TD3(gamma=0.5, policy_delay=3), SAC(gamma=0.997, batch_size=7))
    assert first == Portfolio(SequenceRecall(depth=2), learners=expected)
    assert type(first) is Portfolio
    assert options.seed == 4


def test_a_wrapped_task_keeps_its_flags():
    task = wrappers.delayed(SequenceRecall())
    for value, flat in ((task, True), (Portfolio(task), False)):
        (changed, _) = parsed(value, "--depth", "2")
        found = changed if flat else changed.env
        assert found == wrappers.delayed(SequenceRecall(depth=2))
        assert type(found) is type(task)


def test_a_misspelled_flag_that_was_popped_is_suggested(capsys):
    with pytest.raises(SystemExit) as end:
        parsed(SequenceRecall(), "--netwrk", "lstm", popped=("--network", "--preset"))
    assert end.value.code == 2
    assert "credo: --netwrk: did you mean '--network'?" in capsys.readouterr().err


def test_a_switch_is_taken_out():
    assert arguments.pop_switch(["a", "--delayed", "b"], "--delayed") == (True, ["a", "b"])
    assert arguments.pop_switch(["a"], "--delayed") == (False, ["a"])


def test_too_many_names_are_searched_but_not_listed(capsys):
    for given, told in (("Hoper", "did you mean 'Hopper'?"), ("zzz", "choose one of: a, b\n")):
        with pytest.raises(SystemExit):
            arguments.fail("no", given, ("a", "b"), ("Hopper", "c"))
        err = capsys.readouterr().err
        assert told in err
        assert "Hopper, " not in err


@pytest.mark.parametrize(
    ("words", "pairs", "rest"),
    [
        ("--kwargs a=1 b=x", {"a": 1, "b": "x"}, ""),
        ("--depth 3 --kwargs a 1 b False --seed 4", {"a": 1, "b": False}, "--depth 3 --seed 4"),
        ("--kwargs.a 0.5 --kwargs.b=None --seed 4", {"a": 0.5, "b": None}, "--seed 4"),
        ("--kwargs=a=(1,2) --kwargs b=-1", {"a": (1, 2), "b": -1}, ""),
        ("--kwargs a=m:f b='8' c=8x8", {"a": "m:f", "b": "8", "c": "8x8"}, ""),
        ("--kwargs a=1 a=1e3", {"a": 1000}, ""),
        ("--kwargsx=1", {}, "--kwargsx=1"),
    ],
)
def test_settings_by_name_are_taken_out_of_the_words(words, pairs, rest):
    found, left = arguments.pop_pairs(words.split(), "--kwargs")
    assert (found, left) == (pairs, rest.split())
    assert [type(value) for value in found.values()] == [type(value) for value in pairs.values()]


def test_every_change_is_taken_out_of_the_words():
    words = "--set learner.actor-lr=1e-4 --keep 2 --set=signal=local --set a.0.b=True"
    changes, rest = arguments.pop_changes(words.split(), "--set")
    assert changes == {"learner.actor_lr": 1e-4, "signal": "local", "a.0.b": True}
    assert rest == ["--keep", "2"]
