"""Runs are called as they are on the command line, whoever started them."""

import pytest

from credo.algorithms.erl import ERL
from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.algorithms.ppo import PPO
from credo.cli.names import ALGORITHMS, load
from credo.environments import wrappers
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Choose, Copy, Meet, Remember
from credo.networks.mmu import MMU
from credo.runs.config import to_tree
from credo.runs.folder import free_name
from credo.runs.names import algorithm_word, run_name, task_word


@pytest.mark.parametrize("word", list(ALGORITHMS))
def test_every_algorithm_has_the_word_that_made_it(word):
    entry = ALGORITHMS[word]
    env = {"a team": Meet(), "labelled sequences": Remember()}.get(entry.get("learns", ""), Copy())
    network = (MMU(),) if entry.get("network") else ()
    assert algorithm_word(to_tree(load(entry["path"])(env, *network))) == word


def test_a_preset_does_not_change_the_word():
    assert algorithm_word(to_tree(ERL.ours(Copy()))) == "erl"
    assert algorithm_word(to_tree(ERL.hybrid(Copy(), learners=()))) == "ea"
    assert algorithm_word(to_tree(Neuroevolution.ours(Remember(), MMU()))) == "neuroevolution"


def test_sac_is_one_word_whatever_the_actions():
    assert algorithm_word(to_tree(OffPolicy.sac(Choose()))) == "sac"


def test_tasks_are_called_by_their_id_or_class():
    hopper = Gymnasium("Hopper-v5")
    assert task_word(to_tree(hopper)) == "Hopper-v5"
    assert task_word(to_tree(Copy())) == "Copy"
    assert task_word(to_tree(wrappers.delayed(hopper))) == "Hopper-v5-delayed"
    assert run_name(to_tree(PPO(Copy()))) == "ppo-Copy"


def test_a_folder_from_python_has_the_name_of_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(free_name(ERL.erl(Gymnasium("Hopper-v5")), 0)) == "runs/erl-hopper-v5-0"
    assert str(free_name(OffPolicy.ddpg(Copy()), 3)) == "runs/ddpg-copy-3"
