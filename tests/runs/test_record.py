"""config.json: whatever is wrong with it is one sentence with its path."""

import json
import os

import pytest

from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.probes import Copy
from credo.networks.mmu import MMU
from credo.runs import config, record, trust
from credo.runs.folder import runs_in
from credo.runs.record import RunError
from credo.runs.store import Run

TREE = json.loads(json.dumps(config.to_tree(Neuroevolution(Copy(), MMU(hidden=2)))))
BREEDER = TREE["breeder"]
MACHINE = {"versions": {"jax": "1"}, "processor": "p", "cores": 2, "device": "cpu", "system": "s"}
GOOD = {"algorithm": TREE, "seed": 3, "budget": {"generations": 5}, "machine": MACHINE}


def write(folder, content):
    (folder / "config.json").write_text(json.dumps(content))


def test_a_record_comes_back_as_it_was(tmp_path):
    record.write(tmp_path, GOOD)
    run = Run(tmp_path)
    assert {k: v for k, v in run.config.items() if k not in ("sha256", "signature")} == GOOD
    assert run.trusted
    assert run.algorithm == Neuroevolution(Copy(), MMU(hidden=2))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"seed": "3"}, "'seed' is \"3\": it must be a whole number"),
        ({"seed": 3.0}, "'seed' is 3.0"),
        ({"seed": True}, "'seed' is true"),
        ({"algorithm": 4}, "'algorithm' is 4: it must be an object"),
        ({"algorithm": TREE | {"class": 5}}, "'algorithm' is .*it must be an object"),
        ({"algorithm": TREE | {"class": "os:system()"}}, "'algorithm' is .*it must be an object"),
        ({"algorithm": {"class": "a:B"}}, "'algorithm' is .*it must be an object"),
        ({"budget": {"generations": "5"}}, "'budget' is .*whole numbers of at least 1"),
        ({"budget": {}}, "'budget' is"),
        ({"budget": {"generations": 0}}, "'budget' is"),
        ({"budget": {"generations": 5, "stop_at": "x"}}, "'budget' is"),
        ({"budget": {"generation": 5}}, "'budget' is"),
        ({"budget": [5]}, "'budget' is"),
        ({"machine": "mine"}, "'machine' is"),
        ({"machine": MACHINE | {"versions": ["jax"]}}, "'machine' is"),
        ({"machine": MACHINE | {"cores": "2"}}, "'machine' is"),
        ({"task": {"obs_size": "2"}}, "'task' is"),
        ({"changes": {"a": 1}}, "'changes' is"),
        ({"warm_start": 7}, "'warm_start' is 7"),
    ],
)
def test_a_value_of_a_wrong_type_is_named(tmp_path, changes, told):
    write(tmp_path, GOOD | changes)
    with pytest.raises(RunError, match=rf"{tmp_path}/config\.json is damaged: {told}"):
        Run(tmp_path)


@pytest.mark.parametrize("name", list(GOOD))
def test_what_is_missing_is_named(tmp_path, name):
    write(tmp_path, {k: v for k, v in GOOD.items() if k != name})
    run = Run(tmp_path)
    with pytest.raises(RunError, match=rf"config\.json is damaged: it has no '{name}'"):
        run.config[name]


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"3", b"\xff{}", b"[" * 200_000, b'{"seed": ' + b"9" * 5000 + b"}"],
)
def test_what_is_no_record_is_one_error(tmp_path, content):
    (tmp_path / "config.json").write_bytes(content)
    with pytest.raises(RunError, match=rf"{tmp_path}/config\.json is damaged"):
        Run(tmp_path)


def test_nothing_waits_for_a_pipe_or_reads_a_huge_file(tmp_path):
    os.mkfifo(tmp_path / "config.json")
    with pytest.raises(RunError, match=rf"{tmp_path}/config\.json cannot be read: is no regular"):
        Run(tmp_path)
    (tmp_path / "config.json").unlink()
    with (tmp_path / "config.json").open("wb") as file:
        file.truncate(3 * 2**30)
    with pytest.raises(RunError, match=rf"{tmp_path}/config\.json has 3,221,225,472 bytes"):
        Run(tmp_path)


def test_every_flipped_bit_is_found(tmp_path):
    record.write(tmp_path, GOOD)
    path, silent = tmp_path / "config.json", 0
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), 7):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        try:
            found = record.read(tmp_path)
        except RunError as error:
            told = str(error)
        else:  # one white space became another
            told, silent = str(path), silent + 1
            assert {k: v for k, v in found.items() if k in GOOD} == GOOD
        assert str(path) in told
    assert silent == 0


def test_a_setting_changed_by_hand_is_refused(tmp_path):
    record.write(tmp_path, GOOD)
    text = (tmp_path / "config.json").read_text()
    (tmp_path / "config.json").write_text(text.replace('"episodes": 10', '"episodes": 11'))
    with pytest.raises(RunError, match=r"was changed after Credo wrote it.*--set NAME=VALUE"):
        Run(tmp_path)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("episodes", "10", "episodes of .*Neuroevolution is '10': it must be int"),
        ("breeder", BREEDER | {"elite_fraction": "0.1"}, "elite_fraction of .* is '0.1': it must"),
        (
            "breeder",
            BREEDER | {"elite_fraction": {"real": 0.1}},
            "elite_fraction of .* must be float",
        ),
        ("network", 3, "network of .* is 3: it must be"),
        ("env", None, "env of .* is None"),
    ],
)
def test_a_setting_of_a_wrong_type_is_named(name, value, told):
    with pytest.raises(config.ConfigError, match=told):
        config.from_tree(TREE | {name: value})


def test_a_word_is_no_truth_value():
    tree = config.to_tree(Neuroevolution(Copy(), MMU(hidden=2)))
    name = next(k for k, v in tree.items() if isinstance(v, bool))
    with pytest.raises(config.ConfigError, match=f"{name} of .* is 'False': it must be bool"):
        config.from_tree(tree | {name: "False"})


def test_a_complex_number_cannot_be_recorded():
    import numpy as np

    with pytest.raises(config.ConfigError, match="only numbers, strings"):
        config.to_tree({"a": np.complex64(1j)})


def test_a_field_that_is_missing_is_one_error():
    with pytest.raises(config.ConfigError, match="cannot be made of what is recorded"):
        config.from_tree({k: v for k, v in TREE.items() if k != "network"})


def test_a_seal_says_what_differs():
    seal = trust.seal(GOOD)
    assert record.stranger(GOOD, seal) is None
    assert record.stranger(GOOD, None) is None  # of an older version
    assert record.stranger(GOOD | {"seed": 4}, seal) == (
        "it was written for a run with seed 3, this one has 4"
    )
    other = GOOD | {"algorithm": TREE | {"episodes": 11}}
    assert "another algorithm, task or settings" in (record.stranger(other, seal) or "")
    changes = [{"generation": 2, "before": trust.short(TREE)}]
    assert record.stranger(other | {"changes": changes}, seal) is None
    longer = GOOD | {"budget": {"generations": 9}}
    assert record.stranger(longer, seal) is None
    assert record.stranger(GOOD, seal | {"algorithm": [1]}) is not None  # and no error


def test_a_task_with_other_sizes_is_told_in_words():
    task = record.task_of(Copy())
    record.check_task({"task": task}, Copy())
    record.check_task({}, Copy())
    n = Copy().obs_size
    with pytest.raises(
        RunError,
        match=rf"Copy has {n} numbers in an observation today and {n + 1} when this run began",
    ):
        record.check_task({"task": task | {"obs_size": n + 1}}, Copy())
    with pytest.raises(RunError, match="Copy has no agents of a team today and 3 when"):
        record.check_task({"task": task | {"agents": 3}}, Copy())


def test_where_a_run_began_is_said_elsewhere(tmp_path, monkeypatch):
    said = {"task": record.task_of(Copy())}
    assert record.home(said) == ""
    here = os.getcwd()
    monkeypatch.chdir(tmp_path)
    assert record.home(said) == f". It began in {here}: start credo there"


def test_runs_in_a_folder_of_seeds(tmp_path):
    for seed in (0, 2, 10):
        (tmp_path / f"seed-{seed}").mkdir()
        record.write(tmp_path / f"seed-{seed}", GOOD)
    assert [run.name for run in runs_in(tmp_path)] == ["seed-0", "seed-2", "seed-10"]
    assert runs_in(tmp_path / "seed-2") == [tmp_path / "seed-2"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="empty is no run and has none in it"):
        runs_in(tmp_path / "empty")
