"""Ranges: what a file can say, what is drawn of it, and what is told of a mistake."""

import itertools

import pytest

from credo.sweep import space
from credo.sweep.plan import Plan
from credo.sweep.space import Range

LOG = {"low": 1e-5, "high": 1e-3, "log": True}


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (LOG, Range("x", low=1e-5, high=1e-3, log=True)),
        ({"low": 2, "high": 8, "step": 2}, Range("x", low=2, high=8, step=2)),
        (["cem", "genetic"], Range("x", ("cem", "genetic"))),
        ([True, False], Range("x", ("True", "False"))),
        ([[64, 64], [256]], Range("x", ("64,64", "256"))),
        ([0.1, 1, "None"], Range("x", ("0.1", "1", "None"))),
        (
            {"choices": [1, 2], "when": {"a_b": ["u", "v"], "c": "w"}},
            Range("x", ("1", "2"), when=(("a-b", ("u", "v")), ("c", ("w",)))),
        ),
    ],
)
def test_what_a_file_says_is_a_range(value, expected):
    assert Range.of("x", value) == expected


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ([], "give { low"),
        ({}, "give { low"),
        ({"low": 1}, "give { low"),
        ({"low": 1, "high": 2, "log": 1}, "give { low"),
        ({"low": 1, "high": 2, "choices": [1]}, "give { low"),
        ({"low": 1, "hihg": 2}, r"no 'hihg' \(did you mean 'high'\?\)"),
        ({"low": 2, "high": 1}, "low is 2 and high 1: give low < high"),
        ({"low": 1, "high": 1}, "give low < high"),
        ({"low": "1", "high": 2}, "low is '1': it must be a finite number"),
        ({"low": 0, "high": float("inf")}, "high is inf: it must be a finite number"),
        ({"low": 0, "high": 1, "log": True}, "with log it must be above 0"),
        ({"low": 1, "high": 3, "log": True, "step": 1}, "log and a step: give one"),
        ({"low": 0.0, "high": 1.0, "step": 0.3}, "it must be above 0 and divide the range"),
        ({"low": 0.0, "high": 1.0, "step": -0.5}, "it must be above 0 and divide the range"),
        (["a", "b", "a"], "x has a value twice"),
        ({"choices": ["a"], "when": "b"}, "when is 'b': write when ="),
        ("cem", "x is 'cem': give { low"),
    ],
)
def test_what_cannot_be_a_range_is_told(value, told):
    with pytest.raises(ValueError, match=told) as error:
        Range.of("x", value)
    assert str(error.value).startswith("x")


def test_a_step_divides_what_binary_fractions_do_not():
    assert Range.of("x", {"low": 0.1, "high": 0.7, "step": 0.2}).step == 0.2


def test_numbers_are_whole_where_the_flag_has_whole_ones():
    one = Range.of("x", {"low": 1e3, "high": 1e6, "log": True}).of_whole_numbers(True)
    assert (one.low, one.high, type(one.low)) == (1000, 1_000_000, int)
    other = Range.of("x", {"low": 0, "high": 1}).of_whole_numbers(False)
    assert (other.low, other.high, type(other.low)) == (0.0, 1.0, float)
    with pytest.raises(ValueError, match=r"low is 0\.5: it must be a whole number"):
        Range.of("x", {"low": 0.5, "high": 2}).of_whole_numbers(True)


BREEDER = Range("breeder", ("genetic", "cem", "other"))
DECAY = Range("decay", low=0.1, high=0.9, when=(("breeder", ("cem", "other")),))
NOISE = Range("noise", ("a", "b"), when=(("breeder", ("cem",)),))
DEEP = Range("deep", low=1, high=2, when=(("noise", ("b",)),))


def test_a_corner_has_each_end_and_each_choice():
    ranges = [Range("x", low=1, high=2), Range("y", ("a", "b", "c"))]
    found = list(space.corners(ranges))
    assert found == [
        {"x": 1, "y": "a"},
        {"x": 2, "y": "a"},
        {"x": 1, "y": "a"},
        {"x": 1, "y": "b"},
        {"x": 1, "y": "c"},
    ]


def test_a_range_is_in_corners_under_each_of_its_conditions_and_no_other():
    found = list(space.corners([BREEDER, DECAY, NOISE, DEEP]))
    assert {x["breeder"] for x in found if "decay" in x} == {"cem", "other"}
    assert {x["breeder"] for x in found if "noise" in x} == {"cem"}
    assert {x["noise"] for x in found if "deep" in x} == {"b"}
    decays = {(x["breeder"], x["decay"]) for x in found if "decay" in x}
    assert set(itertools.product(("cem", "other"), (0.1, 0.9))) <= decays
    assert {x["deep"] for x in found if "deep" in x} == {1, 2}
    assert {"breeder": "genetic"} in found


@pytest.mark.parametrize(
    ("ranges", "told"),
    [
        ([DECAY, BREEDER], "decay: when names breeder, which is no list of values above it"),
        ([Range("breeder", low=1, high=2), DECAY], "which is no list of values above it"),
        ([Range("breeder", ("genetic", "cem")), DECAY], "when breeder is 'other': it is one of"),
    ],
)
def test_conditions_are_checked(ranges, told):
    with pytest.raises(ValueError, match=told):
        space.require_known(ranges)
    space.require_known([BREEDER, DECAY, NOISE, DEEP])


class Middle:
    """Suggests the last choice and the highest number."""

    def suggest_categorical(self, name, choices):
        return choices[-1]

    def suggest_float(self, name, low, high, *, step, log):
        return high

    def suggest_int(self, name, low, high, *, step, log):
        return high


def test_what_does_not_count_is_not_drawn():
    assert space.draw([BREEDER, DECAY, NOISE, DEEP], Middle()) == {"breeder": "other", "decay": 0.9}


def test_a_number_on_a_grid_is_as_it_is_written():
    class Third(Middle):
        def suggest_float(self, name, low, high, *, step, log):
            return 0.1 * 3  # 0.30000000000000004

    assert space.draw([Range("x", low=0.1, high=0.5, step=0.1)], Third()) == {"x": 0.3}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"trials": 0}, "trials is 0: it must be at least 1"),
        ({"together": 0}, "together is 0"),
        ({"seeds": 0}, "seeds is 0"),
        ({"startup": 0}, "startup is 0"),
        ({"last": 0.0}, "last is 0.0: it must be above 0 and at most 1"),
        ({"last": 1.5}, "last is 1.5"),
        ({"seed": -1}, "seed is -1"),
        ({"sampler": "cmaes"}, "sampler is 'cmaes': it must be one of random, tpe"),
        ({"metric": ""}, "name a column"),
    ],
)
def test_a_plan_is_checked(changes, told):
    with pytest.raises(ValueError, match=told):
        Plan(**changes)


def test_rounds_do_not_depend_on_the_number_of_trials():
    plan, more = Plan(trials=10, together=4), Plan(trials=12, together=4)
    assert [plan.round_of(n) for n in (0, 3, 4, 9)] == [
        range(4),
        range(4),
        range(4, 8),
        range(8, 10),
    ]
    assert more.round_of(9) == range(8, 12)
