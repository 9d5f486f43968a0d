"""Whose a run is, and that nothing which a stranger's record names is ever executed."""

import functools
import json
import operator
import os
import subprocess
import sys

import pytest

from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy
from credo.networks.mmu import MMU
from credo.runs import config, record, trust
from credo.runs.store import Run

TREE = json.loads(json.dumps(config.to_tree(Neuroevolution(Copy(), MMU(hidden=2)))))
SAID = {"algorithm": TREE, "seed": 3, "budget": {"generations": 5}}


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))


def test_a_record_is_signed_with_a_key_of_the_user(tmp_path):
    assert not trust.signed_here(SAID)
    assert not (tmp_path / "settings").exists()  # to look makes nothing
    signed = SAID | {"signature": trust.sign(SAID)}
    key = tmp_path / "settings" / "credo" / "key"
    assert key.stat().st_mode & 0o777 == 0o600
    assert len(key.read_bytes()) == 32
    assert trust.signed_here(signed)
    assert not trust.signed_here(signed | {"seed": 4})
    assert not trust.signed_here(SAID | {"signature": None})
    key.write_bytes(bytes(32))  # somebody else's
    assert not trust.signed_here(signed)


def test_a_key_that_others_can_read_is_none(tmp_path):
    trust.sign(SAID)
    (tmp_path / "settings" / "credo" / "key").chmod(0o644)
    with pytest.warns(UserWarning, match="not signed.*can be read or written by others"):
        assert trust.sign(SAID) is None


def test_without_a_folder_nothing_is_signed_and_it_is_said(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="not signed"):
        record.write(tmp_path, SAID)
    assert "signature" not in Run(tmp_path).config
    assert not Run(tmp_path).trusted
    assert Run(tmp_path).algorithm.episodes == 10  # Credo's own classes need no trust


def test_processes_that_make_the_key_at_once_agree(tmp_path):
    script = "from credo.runs import trust; print(trust.sign({'a': 1}))"
    many = [
        subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    told = {process.communicate(timeout=60)[0] for process in many}
    assert len(told) == 1
    assert os.listdir(tmp_path / "settings" / "credo") == ["key"]


EVIL = """
import pathlib
import equinox as eqx
from credo.environments.base import AbstractEnvironment
pathlib.Path({mark!r}).touch()
def anything(*_, **__):
    pathlib.Path({mark!r}).touch()
class Task(AbstractEnvironment):
    pass
"""


@pytest.mark.parametrize(
    "tree",
    [
        TREE | {"class": "evil_module:Task"},
        TREE | {"env": {"class": "evil_module:Task"}},
        TREE | {"network": {"class": "evil_module:anything"}},
        TREE | {"env": {"class": "credo.environments.gymnasium:Gymnasium", "id": "evil_module:T"}},
        TREE | {"env": {"class": "credo.environments.pettingzoo:PettingZoo", "id": "evil_module"}},
        TREE
        | {
            "env": {
                "class": "credo.environments.wrappers:DelayedHostReward",
                "env": {"class": "credo.environments.gymnasium:Gymnasium", "id": "evil_module:T"},
            }
        },
    ],
)
def test_a_strangers_record_imports_nothing(tmp_path, monkeypatch, tree):
    mark = tmp_path / "pwned"
    (tmp_path / "evil_module.py").write_text(EVIL.format(mark=str(mark)))
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps(SAID | {"algorithm": tree}))
    run = Run(tmp_path)
    with pytest.raises(config.ConfigError, match=rf"{tmp_path} was not made here and names evil"):
        _ = run.algorithm
    assert run.part("env") is None or tree["env"] == TREE["env"]
    with pytest.raises(config.ConfigError, match="give --trust"):
        _ = run.champion
    assert not mark.exists()


@pytest.mark.parametrize("name", ["os:system", "subprocess:Popen", "builtins:eval"])
@pytest.mark.parametrize("place", ["class", "env.class", "env.id", "breeder.mutation.class"])
def test_a_function_of_the_machine_is_never_called(tmp_path, monkeypatch, name, place):
    tree = json.loads(json.dumps(TREE))
    outer = place.rpartition(".")[0]
    if place == "env.id":
        tree["env"] = {"class": "credo.environments.gymnasium:Gymnasium", "id": name}
    else:
        part = functools.reduce(operator.getitem, outer.split(".") if outer else (), tree)
        part["class"] = name
    (tmp_path / "config.json").write_text(json.dumps(SAID | {"algorithm": tree}))
    with pytest.raises(config.ConfigError, match=f"names {name}, which is code of others"):
        _ = Run(tmp_path).algorithm


def test_no_module_of_credo_is_a_way_in():
    for name in ("credo.cli:main", "credo.__main__:x", "credo.runs.loop:Run", "credo:train"):
        with pytest.raises(config.ConfigError, match="code of others"):
            config.from_tree(TREE | {"class": name}, trust=False)


def test_gymnasiums_own_tasks_need_no_trust():
    tree = config.to_tree(Gymnasium("Pendulum-v1"))
    assert config.from_tree(tree, trust=False) == Gymnasium("Pendulum-v1")


def test_ones_own_classes_are_ones_own(tmp_path, monkeypatch):
    (tmp_path / "my_module.py").write_text(
        "from credo.environments.probes import Copy\nclass Mine(Copy):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    tree = TREE | {"env": TREE["env"] | {"class": "my_module:Mine"}}
    record.write(tmp_path, SAID | {"algorithm": tree})
    assert type(Run(tmp_path).algorithm.env).__name__ == "Mine"
    assert Run(tmp_path).part("env") is None  # what needs nobody's code asks for none
    (tmp_path / "settings" / "credo" / "key").unlink()  # another user's now
    with pytest.raises(config.ConfigError, match="not made here"):
        _ = Run(tmp_path).algorithm
    assert type(Run(tmp_path, trust=True).algorithm.env).__name__ == "Mine"


def test_a_comparison_with_what_is_recorded_imports_nothing(tmp_path, monkeypatch):
    (tmp_path / "evil_module.py").write_text(EVIL.format(mark=str(tmp_path / "pwned")))
    monkeypatch.syspath_prepend(tmp_path)
    evil = {"class": "evil_module:Task", "depth": 2}
    lines = config.changed(TREE | {"env": evil}, TREE)
    assert "env.class: 'evil_module:Task' != 'credo.environments.probes:Copy'" in lines
    assert not (tmp_path / "pwned").exists()
    newer = {k: v for k, v in TREE.items() if k != "episodes"}
    assert config.changed(newer, TREE) == []
    with pytest.raises(config.ConfigError, match="no field 'episode'"):
        config.changed(TREE | {"episode": 3}, TREE)
