"""Episodes that several processes play: the same bits, whoever dies."""

import dataclasses
import os
import pathlib
import signal
import sys

import jax
import numpy as np
import pytest

from credo import playing, rollout
from credo.environments import foreign, processes, worker
from credo.environments.gymnasium import Gymnasium
from credo.environments.host import EnvironmentFailure
from credo.environments.pettingzoo import PettingZoo
from credo.evolution.breeder import draw
from credo.networks.mlp import MLP, MLPPolicy
from credo.networks.mmu import MMU
from credo.networks.team import Team
from credo.playing import Outcome, Part, cut, joined, local, play, players, shared

TASK = Gymnasium("Pendulum-v1", max_episode_steps=15)
ENVIRONMENTS = str(pathlib.Path(__file__).parents[1] / "environments")


@pytest.fixture(scope="module", autouse=True)
def _environments():
    sys.path.insert(0, ENVIRONMENTS)
    yield
    sys.path.remove(ENVIRONMENTS)
    foreign.close_all()


def hasty(number):
    """Players that are asked at once."""
    return players.Players(local.Processes(number), patience=0.0)


@pytest.fixture(scope="module")
def crew():
    """Three processes, which are asked at once."""
    crew = hasty(3)
    yield crew
    crew.close()


def played(env, network, members=7, episodes=2, crew=None, **how):
    """A rollout of fresh policies; by `crew`, or by this process."""
    population = draw(network, env.sizes, members, key=jax.random.key(0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(players._CURRENT, "players", crew or players.Players())
        return rollout.collect(env, population, episodes, key=jax.random.key(1), **how)


def part(env, network, members, episodes=1, record=True, limit=None, seed=0, wanted=None) -> Part:
    """Fresh policies with worlds of their own, as they are asked for."""
    key = jax.random.key(seed)
    population = draw(network, env.sizes, members, key=key)
    worlds, keys = map(np.asarray, playing.draw((members, episodes), False, key))
    return Part(env, population, worlds, keys, wanted or episodes, record, limit)


def arrays(found):
    return vars(found) if isinstance(found, Outcome) else found


def same(a, b) -> bool:
    pairs = zip(*(jax.tree.leaves(jax.tree.map(arrays, x)) for x in (a, b)), strict=True)
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
    assert sum(one is not None for one in crew.crew.all) == 3
    assert same(played(env, network, limit=4), played(env, network, limit=4, crew=crew))
    assert same(played(env, network, wanted=1), played(env, network, wanted=1, crew=crew))


def test_no_member_is_alone_and_all_are_there():
    one = {"w": np.arange(7)}
    worlds = np.arange(14, dtype=np.uint32).reshape(7, 2)
    population = Part(TASK, one, worlds, np.zeros((7, 2, 2), np.uint32), 2, False)
    champion = dataclasses.replace(population, worlds=np.zeros((1, 5), np.uint32))
    for most in range(1, 9):
        shares = shared([population], most)
        assert len(shares) == min(most, 3)
        slices = [part for share in shares for part in cut([population], share)]
        assert min(len(x.worlds) for x in slices) >= 2
        assert np.concatenate([x.population["w"] for x in slices]).tolist() == list(range(7))
        assert np.concatenate([x.worlds for x in slices]).tolist() == worlds.tolist()
        assert len(shared([champion], most)) == 1
        both = shared([population, champion], most)
        lanes = [sum(x.worlds.size for x in cut([population, champion], y)) for y in both]
        assert sum(lanes) == 19
        assert most > 3 or max(lanes) - min(lanes) <= 4  # of two members at most
        assert sorted({i for share in both for i, *_ in share}) == [0, 1]
    ten = dataclasses.replace(population, worlds=np.zeros((10, 1), np.uint32))
    assert shared([ten], 2) == [[(0, 0, 5)], [(0, 5, 10)]]
    two = [Outcome({"r": np.full((n, 2), n)}, np.full((n, 2), n), None) for n in (2, 3)]
    assert joined(two).steps[:, 0].tolist() == [2, 2, 3, 3, 3]


def asked(crew, *parts):
    """What comes of parts that are asked for together."""
    waiting = [crew.ask(part) for part in parts]
    return [one.result() for one in waiting]


@pytest.mark.parametrize("task", [TASK, dataclasses.replace(TASK, at_once=3)], ids=["all", "turns"])
def test_what_is_played_together_has_the_bits_of_what_is_played_alone(task, crew):
    network = MLP(hidden=(16,))
    parts = [
        part(task, network, 4, 2, wanted=1),
        part(task, network, 1, 5, record=False, seed=1),
        part(task, network, 1, 2, limit=3, seed=2),
        part(task, MMU(), 3, seed=3),
    ]
    alone = [play([one])[0] for one in parts]
    assert same(alone, play(parts))
    assert same(alone, asked(crew, *parts))
    assert [x.rows is None for x in alone] == [False, True, False, False]
    assert alone[2].steps.tolist() == [[3, 3]]
    assert [x.rows is not None and x.rows[-1] is not None for x in alone] == [0, 0, 0, 1]


def test_what_was_started_is_played_while_this_process_does_something_else(crew):
    network = MLP(hidden=(16,))
    first, second, late = (part(TASK, network, 4, seed=seed) for seed in range(3))
    one, two = crew.ask(first), crew.ask(second)
    crew.start()
    assert crew._away is not None
    three = crew.ask(late)  # it waits until those are back
    assert same([three.result()], [play([late])[0]])
    assert crew._away is None
    assert same([one.result(), two.result()], [play([x])[0] for x in (first, second)])


def test_what_nobody_wants_any_more_is_not_played():
    class Counting(players.Players):
        together: tuple[int, ...] = ()

        def _play(self, together):
            self.together = (*self.together, len(together))
            super()._play(together)

    crew, one = Counting(), part(TASK, MLP(hidden=(4,)), 2)
    forgotten, wanted = crew.ask(one), crew.ask(one)
    del forgotten
    wanted.result()
    other = part(dataclasses.replace(TASK, max_episode_steps=3), MLP(hidden=(4,)), 2)
    short, long = crew.ask(other), crew.ask(one)
    assert short.result().steps.max() == 3
    assert long.outcome is not None
    assert crew.together == (1, 1, 1)  # another task is played by itself


def test_who_asks_again_after_a_failure_is_answered():
    kwargs = {"every": 1, "fault": "nan", "at": 2}
    task = Gymnasium("failing:Rare", kwargs=kwargs, max_episode_steps=6, tolerated=0.0)
    crew, network = players.Players(), MLP(hidden=(4,))
    one, other = crew.ask(part(task, network, 2)), crew.ask(part(task, network, 2))
    with pytest.raises(EnvironmentFailure):
        one.result()
    with pytest.raises(RuntimeError, match="were given up when others failed"):
        other.result()


def test_one_that_dies_plays_its_part_again(crew, monkeypatch):
    alone, killed = played(TASK, MLP(hidden=(16,))), []
    give = local._Player.give

    def given(self, message, spared):
        give(self, message, spared)
        if not killed:
            killed.append(self.pid)
            os.kill(self.pid, signal.SIGKILL)

    monkeypatch.setattr(local._Player, "give", given)
    assert same(alone, played(TASK, MLP(hidden=(16,)), crew=crew))
    assert killed
    assert killed[0] not in [one.pid for one in crew.crew.all if one is not None]


@pytest.mark.parametrize("fault", ["dies", "holds", "leaves_a_child"])
def test_a_task_that_ends_its_process_costs_the_episode_alone(fault):
    # One episode in nine ends the process that plays them, and with it all others there.
    kwargs = {"every": 9, "fault": fault, "at": 2}
    task = Gymnasium("failing:Rare", kwargs=kwargs, max_episode_steps=6, tolerated=1.0, timeout=1.0)
    seeds = np.asarray(playing.draw((7, 4), False, jax.random.key(1))[0])
    alone = played(task, MLP(hidden=(4,)), 7, 4, common=False)
    assert np.isnan(alone[0].of("reward")).tolist() == (seeds % 9 == 0).tolist()
    assert (seeds % 9 == 0).any()
    crew = hasty(2)
    try:
        for _ in range(2):  # at first without a worker, then with one
            assert same(alone, played(task, MLP(hidden=(4,)), 7, 4, common=False, crew=crew))
            assert crew._suspects == {task}
    finally:
        crew.close()


def test_copies_without_a_worker_are_closed_where_they_may_end_nobody():
    foreign.spare(True)
    try:
        TASK.copies(2).reset(np.zeros(2, np.uint32), np.ones(2, bool))
        assert isinstance(TASK.copies(2)._backend, worker.Fatal)
        foreign.spare(False)
        TASK.copies(2).reset(np.zeros(2, np.uint32), np.ones(2, bool))
        assert isinstance(TASK.copies(2)._backend, worker.Process)
    finally:
        foreign.spare(False)
        foreign.close(TASK)


@pytest.mark.parametrize("timeout", [1e-9, 1e12, float("inf")])
def test_any_time_can_be_waited(timeout, monkeypatch):
    monkeypatch.setattr(worker, "SHORTEST", 60.0)  # a slow machine would end the tests
    some = worker.Fatal(TASK.spec(), 1, timeout)
    try:
        assert some.reset(np.zeros(1, np.uint32), np.ones(1, bool)).obs.shape == (1, 3)
    finally:
        some.close()


def test_a_task_with_an_alarm_of_its_own_gets_a_worker():
    task = Gymnasium("failing:Alarming", max_episode_steps=4, timeout=30.0)
    crew = hasty(2)
    try:
        assert np.isfinite(played(task, MLP(hidden=(4,)), crew=crew)[0].of("reward")).all()
        assert crew._suspects == {task}
    finally:
        crew.close()


def test_one_that_dies_again_and_again_is_named(monkeypatch):
    crew = hasty(2)
    monkeypatch.setattr(local._Player, "take", lambda self: None)
    with pytest.raises(RuntimeError, match=r"ended 3 times over the same ones: .*--processes 1"):
        played(TASK, MLP(hidden=(16,)), crew=crew)
    assert crew.crew.all == [None, None]


def test_what_another_process_cannot_have_is_played_here():
    class Policy(MLPPolicy):  # of a function: it cannot be sent
        pass

    alone = played(TASK, MLP(hidden=(4,)))
    own = draw(MLP(hidden=(4,)), TASK.sizes, 7, key=jax.random.key(0))
    fields = {field.name: getattr(own, field.name) for field in dataclasses.fields(own)}
    soon = hasty(2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(players._CURRENT, "players", soon)
        mine = rollout.collect(TASK, Policy(**fields), 2, key=jax.random.key(1))
    assert same(alone, mine)
    assert soon.crew is None


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
    patient = players.Players(local.Processes(2), patience=3600.0)
    played(TASK, MLP(hidden=(16,)), crew=patient)
    assert patient.crew.all == [None, None]
    soon = hasty(2)
    played(TASK, MLP(hidden=(16,)), members=1, crew=soon)
    for fields in ({"in_process": True}, {"at_once": 4}):
        played(Gymnasium("Pendulum-v1", max_episode_steps=15, **fields), MLP(), crew=soon)
    assert soon.crew.all == [None, None]


def test_outside_the_block_this_process_plays_alone():
    def number():
        crew = players._CURRENT.players.crew
        return 1 if crew is None else crew.number

    with players.using(2):
        assert number() == 2
        with players.using(1):
            assert number() == 1
        assert number() == 2
    assert number() == 1
    with players.using(None):
        assert number() == len(processes.cores())
