"""A population on several devices plays and learns what it does on one: eight virtual ones, in a
process of its own."""

import io
import json
import os
import pathlib
import subprocess
import sys

import jax
import numpy as np
import pytest

import credo
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy
from credo.networks.mlp import MLP
from credo.playing import devices

EIGHT = "--xla_force_host_platform_device_count=8"
HERE = pathlib.Path(__file__).parent


def on_eight(folder, *words):
    """What `on_eight.py` finds."""
    tests = os.pathsep.join([str(HERE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    flags = {"XLA_FLAGS": f"{os.environ['XLA_FLAGS']} {EIGHT}", "PYTHONPATH": tests}
    command = [sys.executable, str(HERE / "on_eight.py"), str(folder), *words]
    done = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return on_eight(tmp_path_factory.mktemp("eight"))


def test_episodes_have_the_bits_of_one_device(found):
    """Returns, steps, and all rows of a buffer that are valid."""
    assert set(found["rollouts"].values()) == {0.0}
    assert len(found["rollouts"]) == 8
    assert found["given"] == 0.0


def test_each_device_has_its_members_and_two_at_least(found):
    """Of two members there is nothing to share out; every device gets the whole result."""
    assert found["shares"] == [[2, 2, 8], [3, 2, 8], [16, 2, 8], [17, 3, 8]]


@pytest.mark.parametrize("name", ["sequences", "team", "learner"])
def test_a_run_has_the_bytes_of_one_device(found, name):
    """Metrics, the champion and the best policy, where a learner joins in too."""
    hashes, programs = found["runs"][f"{name} on many"]
    assert hashes == found["runs"][f"{name} on one"][0]
    # Nothing is compiled after the first generation; its checkpoint is written after it is told.
    assert len(programs) == 6
    assert programs[1] <= programs[0] + 1
    assert set(programs[1:]) == {programs[-1]}


def test_a_run_goes_on_with_other_devices(found):
    assert found["resumed"] == found["runs"]["sequences on one"][0]


def test_seeds_have_a_device_each_and_the_bytes_of_runs_alone(found):
    """Also after a signal; one that fails takes none with it."""
    seeds = found["seeds"]
    stopped, failed = seeds["codes"]
    assert stopped == 143
    assert failed == "1 of 4 runs failed:\n/broken: ValueError: depth is 0: it must be at least 1"
    assert not all(seeds["left"])
    assert seeds["done"] == [True, False, True, True]
    assert seeds["same"] == [True, True]


@pytest.mark.slow
def test_every_algorithm_learns_on_two_devices_what_it_does_on_one(tmp_path):
    """To the bit, but for PPO: of it nothing is divided, and XLA adds up one sum in another order,
    that of its policy's loss, in which summands of about 1 cancel."""
    for name, (one, two) in on_eight(tmp_path, "every").items():
        if name != "ppo":
            assert one == two, name
            continue
        numbers = [np.genfromtxt(io.StringIO(x), delimiter=",", skip_header=1) for x in (one, two)]
        np.testing.assert_allclose(*numbers, rtol=1e-5, atol=1e-6)


def test_more_devices_than_there_are_or_a_task_that_knows_none(tmp_path):
    there = jax.local_device_count()
    options = {"generations": 1, "path": tmp_path / "run", "progress": False}
    evolve = Neuroevolution(Copy(), MLP(hidden=(2,)), population_size=4)
    words = rf"devices is {there + 1}, and JAX has {there} \(cpu\).*device_count={there + 1}"
    with pytest.raises(ValueError, match=words):
        credo.train(evolve, devices=there + 1, **options)
    outside = Neuroevolution(Gymnasium("Pendulum-v1"), MLP(hidden=(2,)), population_size=4)
    with pytest.raises(ValueError, match=r"Gymnasium does not run in JAX.*--processes"):
        credo.train(outside, devices=2, **options)
    with pytest.raises(ValueError, match=r"processes is 2, and Copy runs in JAX.*--devices"):
        credo.train(evolve, processes=2, **options)
    with pytest.raises(ValueError, match="devices is 0: it must be at least 1"):
        credo.train(evolve, devices=0, **options)
    assert not (tmp_path / "run").exists()


def test_one_device_is_no_mesh():
    with devices.using(1):
        assert jax.sharding.get_mesh().empty
