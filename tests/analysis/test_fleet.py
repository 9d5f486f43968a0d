"""Baselines and upper bound of the server fleet, against the enumeration of tiny fleets."""

import dataclasses
import itertools
import math

import jax
import numpy as np
import pytest

from credo.analysis import bounds
from credo.analysis.fleet import (
    _chance,
    best_discovery,
    discovering_fleet,
    fixed_fleet,
    play_fleet,
    play_oracle,
    played,
    trace_fleet,
)
from credo.analysis.scripts import starts
from credo.analysis.statistics import mean_and_standard_error
from credo.environments.server_fleet import ServerFleet
from credo.networks.dmmu import DMMU

KEY = jax.random.key(0)
CASE = ServerFleet.case_study()
TINY = ServerFleet(servers=2, devices=3, requests=1, nefarious=1, busy=0, max_steps=2)
UNEVEN = dataclasses.replace(TINY, busy=(0, 1), max_steps=3, requests=2, nefarious=2)


def classes_of(env):
    """All equally likely classes: +1 genuine, -1 nefarious."""
    for bad in itertools.combinations(range(env.devices), env.nefarious):
        yield tuple(-1 if d in bad else 1 for d in range(env.devices))


def average(env, choices):
    """Mean net of a synchronous fleet over all classes and all these sequences of joint choices,
    `[sequences][rounds][servers]`."""
    nets = []
    for classes, sequence in itertools.product(classes_of(env), choices):
        left, net = [env.requests] * env.devices, 0
        for joint in sequence:
            for device in joint:
                if left[device] > 0:
                    left[device] -= 1
                    net += classes[device]
        nets.append(net)
    return np.mean(nets)


def near(row, exact, errors=4.0):
    mean, error = row
    return abs(mean - exact) <= errors * error + 1e-6


def references(env):
    """Mean net requests and standard error of every script, and of the oracle."""
    nets = played(env, 2000) | played(env, 2000, oracle=True)
    return {name: mean_and_standard_error(net) for name, net in nets.items()}


@pytest.fixture(scope="module")
def tiny():
    return references(TINY)


@pytest.fixture(scope="module")
def case():
    return references(CASE)


def test_baselines_are_the_enumerated_ones(tiny):
    joint = [*itertools.product(range(3), repeat=2)]
    assert list(tiny) == ["random", "fixed", "discovering", "oracle"]
    assert 0 < tiny["random"][1] < 0.05
    assert near(tiny["random"], average(TINY, itertools.product(joint, repeat=2)))
    assert near(tiny["fixed"], average(TINY, [[(0, 1), (0, 1)]]))


def test_the_oracle_of_a_tiny_fleet(tiny):
    best = max(
        average(TINY, [sequence])
        for sequence in itertools.product(itertools.product(range(3), repeat=2), repeat=2)
    )
    assert tiny["oracle"] == (2.0, 0.0)  # both genuine requests, whatever the classes
    assert best < 2.0  # who does not know them


def test_the_oracle_where_the_number_of_actions_is_random():
    """It earns the smaller of actions and genuine requests, here two."""

    def acts(draws):
        at, count = 0, 0
        for busy in draws:
            if at >= UNEVEN.max_steps:
                break
            at, count = at + 1 + busy, count + 1
        return count

    draws = [*itertools.product((0, 1), repeat=UNEVEN.max_steps)]
    exact = np.mean([min(acts(a) + acts(b), 2) for a in draws for b in draws])
    env = dataclasses.replace(UNEVEN, servers=2)
    net = np.asarray(play_oracle(env, starts(env, 2000, key=KEY), key=KEY))
    assert near((net.mean(), net.std() / 2000**0.5), exact)
    alone = dataclasses.replace(UNEVEN, servers=1, requests=3)
    exact = np.mean([min(acts(a), 3) for a in draws])
    net = np.asarray(play_oracle(alone, starts(alone, 2000, key=KEY), key=KEY))
    assert 1.5 < exact < 3
    assert near((net.mean(), net.std() / 2000**0.5), exact)


def test_where_all_are_nefarious_the_oracle_loses_one_device():
    env = dataclasses.replace(TINY, servers=3, nefarious=3, requests=2, max_steps=4)
    net = np.asarray(play_oracle(env, starts(env, 5, key=KEY), key=KEY))
    assert (net == -2).all()


def test_discovering_lies_between_the_baselines_and_the_exact_best(case, tiny):
    for env, rows in ((CASE, case), (TINY, tiny)):
        best = best_discovery(env)
        mean, error = rows["discovering"]
        assert max(rows["random"][0], rows["fixed"][0]) + 0.2 < mean <= best + 4 * error
        assert best <= rows["oracle"][0]
    assert case["oracle"] == (6.0, 0.0)
    assert case["discovering"][0] > 4.0


def test_the_one_way_in_gives_the_same_means():
    nets = played(TINY)
    assert bounds.baselines(TINY) == {name: net.mean() for name, net in nets.items()}
    assert bounds.upper_bound(TINY) == (2.0, "upper bound")


def test_the_exact_best_is_the_mean_of_the_published_case_study():
    published = [6, 4, 5, 4, 5, 4]  # Table 4.1, a configuration each
    assert best_discovery(CASE) == pytest.approx(np.mean(published))


@pytest.mark.parametrize(
    ("devices", "nefarious", "requests", "rounds", "exact"),
    [
        (2, 1, 2, 3, 1.5),  # half the time +1 +1 and then an empty device, else -1 +1 +1
        (2, 1, 2, 1, 0.0),
        (3, 3, 2, 3, -2.0),  # one device is lost, and then it is empty
        (2, 0, 1, 3, 2.0),
        (3, 1, 1, 1, 1 / 3),
    ],
)
def test_the_exact_best_by_hand(devices, nefarious, requests, rounds, exact):
    env = ServerFleet(
        servers=1, devices=devices, requests=requests, nefarious=nefarious, max_steps=2 * rounds
    )
    assert best_discovery(env) == pytest.approx(exact)


def test_one_discovering_server_by_hand():
    env = ServerFleet(servers=1, devices=2, requests=2, nefarious=1, max_steps=6)
    begun = starts(env, 50, key=KEY)
    genuine = np.asarray(begun[0].genuine)
    net = np.asarray(play_fleet(env, begun, discovering_fleet(env), key=KEY))
    np.testing.assert_array_equal(net, np.where(genuine[:, 0], 2.0, 1.0))
    net = np.asarray(play_fleet(env, begun, fixed_fleet(env), key=KEY))
    np.testing.assert_array_equal(net, np.where(genuine[:, 0], 2.0, -2.0))


def test_what_is_known_of_an_unknown_device():
    devices, least, most = 5, 1, 3
    table = _chance(devices, least, most)
    for genuine, nefarious in ((0, 0), (1, 0), (1, 2), (0, 3), (3, 0), (4, 0)):
        good = total = 0.0
        for count in range(least, most + 1):
            for bad in itertools.combinations(range(devices), count):
                # The first devices are those that were found.
                found = [d in bad for d in range(genuine + nefarious)]
                if found == [False] * genuine + [True] * nefarious:
                    weight = 1 / math.comb(devices, count)
                    total += weight
                    good += weight * (devices - 1 not in bad)
        assert table[genuine, nefarious] == pytest.approx(good / total)
    assert table[0, 3] == 1.0
    assert table[4, 0] == 0.0


def test_what_cannot_be_done_is_told():
    with pytest.raises(ValueError, match="observation is 'scalar'"):
        discovering_fleet(dataclasses.replace(CASE, observation="scalar"))
    with pytest.raises(ValueError, match=r"busy is \(0, 2\)"):
        best_discovery(dataclasses.replace(CASE, busy=(0, 2)))
    with pytest.raises(ValueError, match="histories"):
        best_discovery(ServerFleet())
    with pytest.raises(ValueError, match="the same in every episode"):
        best_discovery(ServerFleet.case_study((True, True, False, False)))


@pytest.mark.parametrize("order", ["sequential", "random"])
def test_a_trace_says_who_served_what_and_who_wrote(order):
    policy = DMMU(hidden=3, order=order).init(*CASE.sizes, key=KEY)
    genuine = np.array([True, False, True, False])
    trace = trace_fleet(CASE, policy, genuine, key=KEY)
    left, net = [CASE.requests] * 4, np.zeros(CASE.max_steps)
    for t in range(CASE.max_steps):
        for server in np.flatnonzero(trace.acting[t]):
            device = int(trace.device[t, server])
            if left[device] > 0:
                left[device] -= 1
                net[t] += 1 if genuine[device] else -1
    np.testing.assert_array_equal(trace.net, net)
    assert trace.acting.any()
    written = np.asarray(trace.writes).sum(axis=1).cumsum(axis=0)
    start = np.asarray(policy.start(key=KEY).memory)
    np.testing.assert_allclose(trace.memory, start[None] + written, rtol=1e-4, atol=1e-4)
    assert sorted(trace.signature.tolist()) == [0, 1, 2]
