"""Episodes that several processes play: the same bits, whoever dies."""

import dataclasses
import os
import pathlib
import signal
import sys

import jax
import numpy as np
import pytest

from credo import rollout, tree
from credo.environments import foreign, processes
from credo.environments.gymnasium import Gymnasium
from credo.environments.host import EnvironmentFailure
from credo.environments.pettingzoo import PettingZoo
from credo.evolution.breeder import draw
from credo.networks.mlp import MLP, MLPPolicy
from credo.networks.mmu import MMU
from credo.networks.team import Team
from credo.playing import Outcome, Part, joined, players, split

TASK = Gymnasium("Pendulum-v1", max_episode_steps=15)
ENVIRONMENTS = str(pathlib.Path(__file__).parents[1] / "environments")


@pytest.fixture(scope="module", autouse=True)
def _environments():
    sys.path.insert(0, ENVIRONMENTS)
    yield
    sys.path.remove(ENVIRONMENTS)
    foreign.close_all()


@pytest.fixture(scope="module")
def crew():
    """Three processes, which are asked at once."""
    crew = players.Players(3, patience=0.0)
    yield crew
    crew.close()


def played(env, network, members=7, episodes=2, crew=None, **how):
    """A rollout of fresh policies; by `crew`, or by this process."""
    population = draw(network, env.sizes, members, key=jax.random.key(0))
    before, players._CURRENT.players = players._CURRENT.players, crew
    try:
        return rollout.collect(env, population, episodes, key=jax.random.key(1), **how)
    finally:
        players._CURRENT.players = before


def same(a, b) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)


@pytest.mark.parametrize(
    ("env", "network"),
    [
        (TASK, MLP(hidden=(16, 16))),
        (TASK, MMU()),
        (PettingZoo("mpe2.simple_spread_v3", max_episode_steps=6), Team(trunk=(8,))),
    ],
    ids=["mlp", "mmu", "team"],
)
def test_their_number_changes_no_bit(env, network, crew):
    alone = played(env, network)
    assert same(alone, played(env, network, crew=crew))
    assert sum(one is not None for one in crew._all) == 3
    assert same(played(env, network, limit=4), played(env, network, limit=4, crew=crew))
    assert same(played(env, network, wanted=1), played(env, network, wanted=1, crew=crew))


def test_no_member_is_alone_and_all_are_there():
    worlds = np.arange(14, dtype=np.uint32).reshape(7, 2)
    part = Part(TASK, {"w": np.arange(7)}, worlds, np.zeros((7, 2, 2), np.uint32), 2, False)
    for most in range(1, 9):
        parts = split(part, most)
        assert len(parts) == min(most, 3)
        assert min(len(x.worlds) for x in parts) >= 2
        assert np.concatenate([x.population["w"] for x in parts]).tolist() == list(range(7))
        assert np.concatenate([x.worlds for x in parts]).tolist() == worlds.tolist()
    two = [Outcome({"r": np.full((n, 2), n)}, np.full((n, 2), n), None, [str(n)]) for n in (2, 3)]
    assert joined(two).steps[:, 0].tolist() == [2, 2, 3, 3, 3]
    assert joined(two).endings == ["2", "3"]


def test_one_that_dies_plays_its_part_again(crew, monkeypatch):
    alone, killed = played(TASK, MLP(hidden=(16,))), []
    give = players._Player.give

    def given(self, message):
        give(self, message)
        if not killed:
            killed.append(self.pid)
            os.kill(self.pid, signal.SIGKILL)

    monkeypatch.setattr(players._Player, "give", given)
    assert same(alone, played(TASK, MLP(hidden=(16,)), crew=crew))
    assert killed
    assert killed[0] not in [one.pid for one in crew._all]


def test_one_that_dies_again_and_again_is_named(monkeypatch):
    crew = players.Players(2, patience=0.0)
    monkeypatch.setattr(players._Player, "take", lambda self: None)
    with pytest.raises(RuntimeError, match=r"ended 3 times over the same ones: .*--processes 1"):
        played(TASK, MLP(hidden=(16,)), crew=crew)
    assert crew._all == [None, None]


def test_what_another_process_cannot_have_is_played_here():
    class Policy(MLPPolicy):  # of a function: it cannot be sent
        pass

    alone = played(TASK, MLP(hidden=(4,)))
    own = draw(MLP(hidden=(4,)), TASK.sizes, 7, key=jax.random.key(0))
    fields = {field.name: getattr(own, field.name) for field in dataclasses.fields(own)}
    hasty = players.Players(2, patience=0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(players._CURRENT, "players", hasty, raising=False)
        mine = rollout.collect(TASK, Policy(**fields), 2, key=jax.random.key(1))
    assert same(alone, mine)
    assert hasty.number == 1
    assert hasty._all == [None, None]


def test_an_answer_that_nobody_took_is_not_that_to_the_next_part(crew, monkeypatch):
    alone = played(TASK, MLP(hidden=(8,)))
    with monkeypatch.context() as patch:
        patch.setattr(players, "_heard", lambda answer: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            played(TASK, MLP(hidden=(16, 16)), crew=crew)
    assert same(alone, played(TASK, MLP(hidden=(8,)), crew=crew))


def test_failures_count_together_wherever_they_were(crew):
    # Two of seven members fail in their second episode: each process sees one at most.
    kwargs = {"every": 2, "fault": "nan", "at": 2}
    task = Gymnasium("failing:Rare", kwargs=kwargs, max_episode_steps=6, tolerated=0.9)
    alone = played(task, MLP(hidden=(4,)), common=False)
    assert np.isnan(alone[0].of("reward")).sum() >= 3
    assert same(alone, played(task, MLP(hidden=(4,)), common=False, crew=crew))
    few = Gymnasium("failing:Rare", kwargs=kwargs, max_episode_steps=6, tolerated=0.1)
    with pytest.raises(EnvironmentFailure, match=r"step 2 of the episode .* of 14 episodes failed"):
        played(few, MLP(hidden=(4,)), common=False, crew=crew)


def test_a_short_run_and_a_lone_member_start_nobody():
    patient = players.Players(2, patience=3600.0)
    played(TASK, MLP(hidden=(16,)), crew=patient)
    assert patient._all == [None, None]
    hasty = players.Players(2, patience=0.0)
    played(TASK, MLP(hidden=(16,)), members=1, crew=hasty)
    for fields in ({"in_process": True}, {"at_once": 4}):
        played(Gymnasium("Pendulum-v1", max_episode_steps=15, **fields), MLP(), crew=hasty)
    assert hasty._all == [None, None]


def test_outside_the_block_this_process_plays_alone():
    with players.using(2):
        assert players._CURRENT.players.number == 2
        with players.using(1):
            assert players._CURRENT.players is None
        assert players._CURRENT.players.number == 2
    assert players._CURRENT.players is None
    with players.using(None):
        several = len(processes.cores()) > 1
        assert (players._CURRENT.players is not None) == several
    assert tree.size(draw(MLP(), (3, 1), 2, key=jax.random.key(0))) == 2
