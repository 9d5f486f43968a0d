"""Flags for the fields of objects, also of those inside tuples and wrappers."""

import dataclasses
from typing import Any

import equinox as eqx
import pytest

from credo.algorithms.erl import ERL
from credo.algorithms.off_policy import OffPolicy
from credo.cli import names, values
from credo.cli.line import Line
from credo.environments import wrappers
from credo.environments.probes import Choose, Copy
from credo.environments.sequence_recall import SequenceRecall
from credo.evolution.breeder import Breeder
from credo.evolution.cem import CEM
from credo.learners.base import AbstractLearner
from credo.learners.coach import Coached
from credo.learners.horizon import Truncated
from credo.learners.manager import UCB, AbstractManager, Progress, Thompson, Uniform
from credo.learners.sac import SAC
from credo.learners.surrogate import Preselection
from credo.learners.td3 import TD3, ddpg
from credo.networks.choosing import Choosing
from credo.networks.exploration import GaussianNoise
from credo.networks.mlp import MLP, ResidualCritic
from credo.runs import config


class Portfolio(eqx.Module):
    env: eqx.Module
    learners: tuple[AbstractLearner, ...] = (TD3(gamma=0.9), SAC(gamma=0.997))
    manager: AbstractManager | None = None
    size: int = 3
    episodes: int = 1


class Odd(Copy):
    """A task with a field that is called as one of the algorithm."""

    episodes: int = 7


@dataclasses.dataclass
class Options:
    """Options."""

    word: str = ""
    _: dataclasses.KW_ONLY
    seed: int = 0
    yes: bool = False
    rate: float | None = None
    layers: tuple[int, ...] = (64, 64)
    kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)


def taken(value, *argv):
    return Line("train", argv).take(value)


def test_each_member_of_a_tuple_has_the_flags_of_its_own_class():
    argv = ["--learners.0.gamma", "0.5", "--learners.0.policy-delay", "3"]
    argv += ["--learners.1.batch_size=7", "--depth", "2", "--size", "4"]
    portfolio = Portfolio(SequenceRecall())
    first = taken(portfolio, *argv)
    expected = (TD3(gamma=0.5, policy_delay=3), SAC(gamma=0.997, batch_size=7))
    assert first == Portfolio(SequenceRecall(depth=2), learners=expected, size=4)
    assert taken(portfolio) is portfolio


def test_a_short_name_stands_for_all_fields_and_a_full_one_comes_before_it():
    first = taken(Portfolio(SequenceRecall()), "--learners.1.gamma", "0.4", "--gamma", "0.5")
    assert [learner.gamma for learner in first.learners] == [0.5, 0.4]
    first = taken(OffPolicy(Copy()), "--learning-rate", "0.25", "--hidden", "3,4", "--tau=1")
    assert (first.learner.actor_lr, first.learner.critic_lr, first.learner.tau) == (0.25, 0.25, 1.0)
    assert first.network.hidden == (3, 4)
    assert taken(OffPolicy(Copy()), "--hidden", "5", "6").network.hidden == (5, 6)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--manager thompson --manager.memory 0.5", Thompson(memory=0.5)),
        ("--manager uniform", Uniform()),
        ("--manager none", None),
        ("--manager credo.learners.manager:UCB --manager.exploration 0", UCB(exploration=0.0)),
    ],
)
def test_a_member_of_a_family_is_chosen_by_its_word(words, expected):
    assert taken(Portfolio(Copy()), *words.split()).manager == expected


def test_what_a_population_may_have_is_chosen_by_words():
    words = "--breeder cem --parents 0.4 --coach coached --coach.share 0.3 --surrogate preselection"
    words += " --surrogate.states 64 --manager progress --manager.kind change --horizon truncated"
    made = taken(ERL.erl(Copy()), *words.split())
    assert made.breeder == CEM(parents=0.4)
    assert made.coach == Coached(share=0.3)
    assert made.surrogate == Preselection(states=64)
    assert made.manager == Progress(kind="change")
    assert made.horizon == Truncated()
    assert config.from_tree(config.to_tree(made), trust=False) == made
    assert taken(made, "--breeder", "genetic", "--coach", "none").breeder == Breeder()


def test_what_is_chosen_already_stays_as_it_is():
    kept = taken(Portfolio(Copy(), manager=UCB(exploration=3.0)), "--manager", "ucb")
    assert kept.manager == UCB(exploration=3.0)


def test_learners_are_chosen_with_their_critics_and_noise():
    words = "--learners td3,ddpg sac --learners.0.critic residual --learners.1.noise gaussian"
    made = taken(Portfolio(Copy()), *words.split(), "--learners.1.noise.std", "0.5").learners
    assert made == (
        TD3(gamma=0.9, critic=ResidualCritic()),
        ddpg(noise=GaussianNoise(0.5)),
        SAC(),
    )
    assert taken(Portfolio(Copy()), "--learners", "none").learners == ()


def test_a_wrapped_task_keeps_its_flags():
    changed = taken(Portfolio(wrappers.delayed(SequenceRecall())), "--depth", "2")
    assert changed.env == wrappers.delayed(SequenceRecall(depth=2))


def test_a_field_of_the_task_that_the_algorithm_has_too_needs_its_full_name():
    both = taken(Portfolio(Odd()), "--episodes", "3", "--env.episodes", "4")
    assert (both.episodes, both.env.episodes) == (3, 4)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--manager tompson", "did you mean 'thompson'?"),
        ("--manager os:system", "os:system is no AbstractManager"),
        ("--manager credo.learners.td3:TD3", "credo.learners.td3:TD3 is no AbstractManager"),
        ("--size three", "--size is 'three': it must be a whole number"),
        ("--size", "--size needs a value"),
        ("--learners.0.gamma x", "--learners.0.gamma is 'x': it must be a number"),
    ],
)
def test_wrong_values_are_named_with_what_is_right(words, told, capsys):
    with pytest.raises(SystemExit) as end:
        taken(Portfolio(Copy()), *words.split())
    assert end.value.code == 2
    assert told in capsys.readouterr().err


def test_words_and_flags_of_a_command():
    line = Line("x", ["a", "--seed=1e1", "--yes", "--rate", "-2.5", "--layers", "3,4"])
    made = line.command(Options)
    assert made == Options("a", seed=10, yes=True, rate=-2.5, layers=(3, 4))
    line = Line("x", ["--yes", "a", "--rate", "None", "--layers", "3"])
    assert line.command(Options) == Options("a", yes=True, layers=(3,))


def test_a_misspelled_flag_is_suggested(capsys):
    for flag, told in (("--sed", "'--seed'"), ("--lr", "'--learning-rate'"), ("--id", "a word")):
        line = Line("x", [flag, "1"])
        line.command(Options)
        line.take(OffPolicy(Copy()))
        with pytest.raises(SystemExit):
            line.done()
        assert told.strip("'") in capsys.readouterr().err


def test_too_many_names_are_searched_but_not_listed(capsys):
    for given, told in (("Hoper", "did you mean 'Hopper'?"), ("zzz", "choose one of: a, b\n")):
        with pytest.raises(SystemExit):
            names.fail("no", given, ("a", "b"), ("Hopper", "c"))
        err = capsys.readouterr().err
        assert told in err
        assert "Hopper, " not in err


@pytest.mark.parametrize(
    ("words", "pairs", "seed"),
    [
        ("--kwargs a=1 b=x", {"a": 1, "b": "x"}, 0),
        ("--kwargs a 1 b False --seed 4", {"a": 1, "b": False}, 4),
        ("--kwargs.a 0.5 --kwargs.b=None --seed 4", {"a": 0.5, "b": None}, 4),
        ("--kwargs=a=(1,2) --kwargs b=-1", {"a": (1, 2), "b": -1}, 0),
        ("--kwargs a=m:f b='8' c=8x8", {"a": "m:f", "b": "8", "c": "8x8"}, 0),
        ("--kwargs a=1 a=1e3", {"a": 1000}, 0),
        (
            "--kwargs learner.actor-lr=1e-4 --kwargs=a.0.b=True",
            {"learner.actor_lr": 1e-4, "a.0.b": True},
            0,
        ),
    ],
)
def test_settings_by_name(words, pairs, seed):
    made = Line("x", words.split()).command(Options)
    assert (made.kwargs, made.seed) == (pairs, seed)
    assert [type(value) for value in made.kwargs.values()] == [type(v) for v in pairs.values()]


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", "90.0"), ("30m", "1800.0"), ("2h", "7200.0"), ("1.5", "1.5")]
)
def test_times(text, seconds):
    assert values.seconds("wall-clock", text) == seconds


def test_the_flags_of_a_network_that_chooses_are_those_within():
    """Each once: named twice, one of two values would win in silence."""
    line = Line("train", ["--network.hidden", "7"])
    made: Any = line.take(ERL.erl(Choose(), Choosing(MLP(), (3,))))
    assert made.network == Choosing(MLP(hidden=(7,)), (3,))
    assert "network.hidden" in line.known()
    assert not [name for name in line.known() if name.startswith("network.network")]
    assert line.inside(made.network, "network") is not made.network  # given again
    assert Line("train", []).inside(made.network, "network") is made.network
