"""The runner alone: numbers by hand, files that are damaged, and what it imports."""

import json
import math
import os
import pathlib
import shutil
import struct
import subprocess
import sys

import numpy as np
import pytest

from credo import runner
from credo.runner import DESCRIPTION, FINGERPRINT, Runner, fingerprint

MLP = {
    "hidden": [2],
    "activation": "relu",
    "normalization": "none",
    "output_activation": "tanh",
}
WEIGHTS = {
    "W_0": np.float32([[1.0, 2.0], [-1.0, 0.5]]),
    "b_0": np.float32([0.5, -1.0]),
    "W_1": np.float32([[0.25, 3.0]]),
    "b_1": np.float32([-0.5]),
}


def described(action=None, **changes):
    """As version 1 had it, whose files are still read."""
    return {
        "version": 1,
        "credo": "0.1.0",
        "network": "MLP",
        "config": MLP,
        "obs_size": 2,
        "action_size": 1,
        "action": action,
    } | changes


TEAM = {
    "type": "Team",
    "config": {"trunk": [2], "sharing": "trunk", "activation": "relu"},
    "parts": [{"type": "MLP", "config": MLP | {"hidden": []}, "parts": []}] * 2,
}
TEAM_WEIGHTS = {
    "trunks.0.W_0": WEIGHTS["W_0"],
    "trunks.0.b_0": WEIGHTS["b_0"],
    "heads.0.W_0": WEIGHTS["W_1"],
    "heads.0.b_0": WEIGHTS["b_1"],
    "heads.1.W_0": np.float32([[1.0, 1.0]]),
    "heads.1.b_0": np.float32([0.0]),
}
BOXES = [
    {"low": [-2.0], "high": [6.0], "shape": [1], "dtype": "float32"},
    {"low": [0.0], "high": [10.0], "shape": [], "dtype": "int64"},
]


def team(**changes):
    changes = {"agents": 2, "network": TEAM, "version": 2} | changes
    return described(changes.pop("action", None), **changes)


def write(path, description, weights=WEIGHTS, edit=lambda header: None):
    """A policy's file from scratch."""
    text = json.dumps(description)
    header = {"__metadata__": {DESCRIPTION: text, FINGERPRINT: fingerprint(text, weights)}}
    offset = 0
    for name, array in weights.items():
        ends = [offset, offset + array.nbytes]
        header[name] = {"dtype": "F32", "shape": list(array.shape), "data_offsets": ends}
        offset += array.nbytes
    edit(header)
    head = json.dumps(header).encode()
    body = b"".join(array.tobytes() for array in weights.values())
    path.write_bytes(struct.pack("<Q", len(head)) + head + body)
    return path


@pytest.fixture
def file(tmp_path):
    return tmp_path / "policy.safetensors"


def test_actions_are_what_a_hand_computes(file):
    act = Runner.load(write(file, described()))
    # Hidden: relu(1 + 2 + .5, -1 + .5 - 1) = (3.5, 0); output: tanh(.25 * 3.5 - .5).
    np.testing.assert_allclose(act([1.0, 1.0]), [math.tanh(0.375)], rtol=1e-6)
    # Hidden: relu(-1 + 2 + .5, 1 + .5 - 1) = (1.5, .5).
    expected = math.tanh(0.25 * 1.5 + 3.0 * 0.5 - 0.5)
    np.testing.assert_allclose(act([[-1.0], [1.0]]), [expected], rtol=1e-6)
    assert act([1.0, 1.0]).dtype == np.float32


def test_a_box_gets_its_own_units_shape_and_dtype(file):
    space = {"low": [-2.0], "high": [6.0], "shape": [1, 1], "dtype": "float64"}
    action = Runner.load(write(file, described(space)))([1.0, 1.0])
    assert action.shape == (1, 1)
    assert action.dtype == np.float64
    np.testing.assert_allclose(action, 2.0 + 4.0 * math.tanh(0.375), rtol=1e-6)


def test_a_box_of_integers_gets_the_nearest(file):
    space = {"low": [0.0], "high": [10.0], "shape": [1], "dtype": "int64"}
    action = Runner.load(write(file, described(space)))([1.0, 1.0])
    assert action.dtype == np.int64
    assert action.tolist() == [7]  # 5 + 5 tanh(0.375) = 6.79


def test_a_discrete_gets_the_largest_entry(file):
    weights = WEIGHTS | {
        "W_1": np.float32([[0.0, 0.0], [1.0, 0.0], [0.5, 0.0]]),
        "b_1": np.zeros(3, np.float32),
    }
    description = described({"n": 3, "start": 5}, action_size=3)
    assert Runner.load(write(file, description, weights))([1.0, 1.0]) == 6


def test_a_mask_leaves_the_largest_entry_that_is_allowed(file):
    weights = WEIGHTS | {"W_1": np.float32([[0, 0], [1, 0], [0.5, 0]]), "b_1": np.zeros(3, "f4")}
    description = described({"n": 3, "start": 5}, action_size=3)
    act = Runner.load(write(file, description, weights))
    assert act([1.0, 1.0], mask=[1, 0, 1]) == 7
    assert act([1.0, 1.0], np.array([True, False, False])) == 5
    for mask in ([0, 0, 0], [1, 1]):
        with pytest.raises(ValueError, match="must allow at least one of 3 entries"):
            act([1.0, 1.0], mask)
    box = {"low": [-2.0], "high": [6.0], "shape": [1], "dtype": "float64"}
    for action in (None, box):
        with pytest.raises(ValueError, match="only a Discrete has entries to allow"):
            Runner.load(write(file, described(action)))([1.0, 1.0], mask=[1])


def test_a_discrete_observation_is_its_integer_or_one_hot(file):
    act = Runner.load(write(file, described(observations={"n": 2, "start": -1})))
    assert act(-1) == act([1.0, 0.0]) == act(np.int64(-1))
    assert act(0) == act(np.array([0, 1])) != act(-1)
    for wrong in (1, -2, 0.0, True):
        with pytest.raises(ValueError, match="must be an integer from -1 to 0"):
            act(wrong)


def test_a_team_acts_head_by_head(file):
    act = Runner.load(write(file, team(), TEAM_WEIGHTS))
    assert act.agents == 2
    # Hidden as above: (3.5, 0) of (1, 1) and (1.5, .5) of (-1, 1).
    first = [math.tanh(0.375), math.tanh(2.0)]
    np.testing.assert_allclose(act([[1.0, 1.0], [-1.0, 1.0]])[:, 0], first, rtol=1e-6)
    swapped = [math.tanh(0.25 * 1.5 + 3.0 * 0.5 - 0.5), math.tanh(3.5)]
    np.testing.assert_allclose(act(np.array([[-1, 1], [1, 1]]))[:, 0], swapped, rtol=1e-6)
    assert act(np.zeros((2, 2))).shape == (2, 1)
    for wrong in (np.zeros((3, 2)), [[1.0, 1.0]], 5):
        with pytest.raises(ValueError, match="that of each of 2 agents, in order"):
            act(wrong)
    with pytest.raises(ValueError, match="has 1 numbers: it must have 2"):
        act(np.zeros((2, 1)))
    with pytest.raises(ValueError, match=r"names \['a'\]: this team has no names"):
        act({"a": np.zeros(2)})


def test_each_agent_of_a_team_has_its_own_units(file):
    act = Runner.load(write(file, team(action=BOXES, names=["a", "b"]), TEAM_WEIGHTS))
    first, second = act([[1.0, 1.0], [-1.0, 1.0]])
    np.testing.assert_allclose(first, [2.0 + 4.0 * math.tanh(0.375)], rtol=1e-6)
    assert (first.dtype, second.dtype, second.shape) == (np.float32, np.int64, ())
    assert second == 10  # 5 + 5 tanh(2) = 9.82
    assert act([None, [-1.0, 1.0]]) == [None, 10]  # who is absent neither sees nor acts
    assert act({"b": [-1.0, 1.0]}) == {"b": 10}
    # A shorter observation is padded with zeros, as in training.
    assert act([[1.0], [1.0]]) == act([[1.0, 0.0], [1.0, 0.0]])
    with pytest.raises(ValueError, match=r"names \['c'\]: this team has \['a', 'b'\]"):
        act({"c": [0.0, 0.0]})


def test_an_output_that_overflows_is_refused(file):
    weights = WEIGHTS | {"W_0": np.float32([[1, 2], [1, 2]]), "W_1": np.float32([[1, -1]])}
    act = Runner.load(write(file, described(), weights))
    assert np.isfinite(act([1e30, 0.0]))
    with pytest.raises(ValueError, match="overflow"):  # inf - inf
        act([3e38, 3e38])


def test_observations_are_normalised_as_they_were_in_training(file):
    weights = {f"policy.{name}": w for name, w in WEIGHTS.items()}
    weights |= {"mean": np.float32([3.0, 0.0]), "std": np.float32([2.0, 0.1])}
    inner = {"type": "MLP", "config": MLP, "parts": []}
    node = {"type": "Normalized", "config": {}, "parts": [inner]}
    act = Runner.load(write(file, described(version=2, network=node), weights))
    np.testing.assert_allclose(act([5.0, 0.1]), [math.tanh(0.375)], rtol=1e-6)
    # Clipped to (10, -10): hidden relu(10 - 20 + .5, -10 - 5 - 1) = (0, 0).
    np.testing.assert_allclose(act([99.0, -99.0]), [math.tanh(-0.5)], rtol=1e-6)
    weights["std"] = np.float32([2.0, 0.0])
    with pytest.raises(ValueError, match="it must be more than 0"):
        Runner.load(write(file, described(version=2, network=node), weights))


def test_observations_that_are_none_are_refused(file):
    act = Runner.load(write(file, described()))
    with pytest.raises(ValueError, match="has 3 numbers: it must have 2"):
        act(np.zeros(3))
    with pytest.raises(ValueError, match="NaN and inf are no observations"):
        act([0.0, math.nan])


@pytest.mark.parametrize(
    ("description", "weights"),
    [(described(), WEIGHTS), (team(action=BOXES), TEAM_WEIGHTS)],
    ids=["version 1", "team"],
)
def test_any_changed_byte_is_noticed(file, description, weights):
    good = write(file, description, weights).read_bytes()
    assert Runner.load(file).obs_size == 2
    for i in range(len(good)):
        file.write_bytes(good[:i] + bytes([good[i] ^ 1]) + good[i + 1 :])
        with pytest.raises(ValueError, match="is damaged"):
            Runner.load(file)


def test_a_shorter_or_longer_file_is_noticed(file):
    good = write(file, described()).read_bytes()
    for data in (b"", good[:5], good[:100], good[:-1], good + b"\0"):
        file.write_bytes(data)
        with pytest.raises(ValueError, match="is damaged"):
            Runner.load(file)


def entry(name, **changes):
    """A header in which a tensor is told otherwise."""
    return lambda header: header[name].update(changes)


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (entry("b_1", dtype="F64"), "b_1 has dtype F64: it must be F32"),
        (entry("b_1", shape=[2]), r"b_1 of shape \[2\] cannot have bytes 32 to 36"),
        (entry("b_1", shape=[-1]), "b_1 has shape"),
        (entry("b_1", shape=[2**62]), "b_1 of shape"),
        (entry("b_1", data_offsets=[0, 4]), "cannot have bytes"),
        (entry("b_1", shape=[2], data_offsets=[32, 40]), "cannot have bytes"),
        (lambda header: header.pop("b_1"), "4 bytes at its end belong to no array"),
        (lambda header: header.pop("__metadata__"), "nothing in it describes a policy"),
    ],
)
def test_a_header_that_does_not_fit_is_refused(file, edit, told):
    with pytest.raises(ValueError, match=told):
        Runner.load(write(file, described(), edit=edit))


def test_a_name_that_stands_twice_is_refused(file):
    data = write(file, described()).read_bytes().replace(b'"b_1"', b'"b_0"')
    file.write_bytes(data)
    with pytest.raises(ValueError, match="a name stands twice"):
        Runner.load(file)


def test_weights_that_the_network_does_not_have_are_refused(file):
    with pytest.raises(ValueError, match=r"W_0 has shape \(2, 2\), expected \(2, 3\)"):
        Runner.load(write(file, described(obs_size=3)))
    with pytest.raises(ValueError, match=r"g_0 has shape \(2,\), expected None"):
        Runner.load(write(file, described(), WEIGHTS | {"g_0": np.ones(2, np.float32)}))
    with pytest.raises(ValueError, match="b_1 holds NaN or inf"):
        Runner.load(write(file, described(), WEIGHTS | {"b_1": np.float32([math.nan])}))


def nested(depth):
    node = {"type": "MLP", "config": MLP, "parts": []}
    for _ in range(depth):
        node = {"type": "Normalized", "config": {}, "parts": [node]}
    return node


def part(**changes):
    return {"type": "MLP", "config": MLP | changes, "parts": []}


BOX = {"low": [-2.0], "high": [6.0], "shape": [1], "dtype": "float64"}
DMMU = {"order": "sequential", "access": "everyone"}


@pytest.mark.parametrize(
    "changes",
    [
        {"obs_size": 0},
        {"obs_size": 2.0},
        {"action_size": True},
        {"obs_size": 10**30},
        {"network": part(hidden=[-1])},
        {"network": part(hidden=[2] * 10**6)},
        {"network": part(hidden=[10**30])},
        {"network": part(hidden="2")},
        {"network": part(activation="__import__")},
        {"network": part(output_activation="softmax")},
        {"network": part() | {"type": "__class__"}},
        {"network": {"type": "Claim", "config": MLP}},
        {"network": "MLP"},
        {"network": nested(9)},
        {"network": {"type": "Normalized", "config": {}, "parts": []}},
        {"network": TEAM},
        {"network": part(), "agents": 1},
        {"network": TEAM, "agents": 10**9},
        {"network": TEAM | {"config": TEAM["config"] | {"sharing": "all"}}, "agents": 2},
        {"network": {"type": "DMMU", "config": DMMU, "parts": [part()]}, "agents": 1},
        {"network": {"type": "DMMU", "config": DMMU, "parts": []}, "agents": 1},
        {"network": {"type": "Centralized", "config": {}, "parts": [TEAM]}, "agents": 2},
        {"action": {"n": 1}},
        {"action": {"n": 1, "start": "x"}},
        {"action": {"n": 2, "start": 0}},
        {"action": BOX | {"dtype": "O"}},
        {"action": BOX | {"dtype": "S1000000000"}},
        {"action": BOX | {"low": [math.nan]}},
        {"action": BOX | {"low": [7.0]}},
        {"action": BOX | {"low": [-2.0] * 3, "high": [6.0] * 3, "shape": [3]}},
        {"action": BOX | {"shape": [2]}},
        {"action": [BOX]},
        {"agents": 2, "network": TEAM, "action": [BOX]},
        {"agents": 2, "network": TEAM, "names": ["a"]},
        {"observations": {"n": 3, "start": 0}},
    ],
    ids=str,
)
def test_a_description_that_makes_no_sense_is_refused_at_once(file, changes):
    weights = TEAM_WEIGHTS if changes.get("network") is TEAM else WEIGHTS
    write(file, described(**{"version": 2, "network": part()} | changes), weights)
    with pytest.raises(ValueError, match="is damaged, or no policy"):
        Runner.load(file)


def test_what_is_no_plain_file_is_refused_without_waiting(tmp_path, file):
    os.mkfifo(tmp_path / "pipe")
    with file.open("wb") as sparse:
        sparse.truncate(2**31)
    for path in (tmp_path / "pipe", tmp_path, file):
        with pytest.raises(ValueError, match="is no file of at most"):
            Runner.load(path)


def test_another_format_names_the_version_to_use(file):
    description = described(version=4, credo="9.9.9")
    told = r"has format 4.*reads 1 to 3: use the runner of Credo 9\.9\.9"
    with pytest.raises(ValueError, match=told):
        Runner.load(write(file, description))


def test_a_file_that_is_not_there_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        Runner.load(tmp_path / "nowhere")


def in_another_process(code, **options) -> str:
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, **options
    )
    return result.stdout.strip()


def test_importing_it_imports_neither_jax_nor_the_rest_of_credo():
    code = (
        "import sys, numpy; before = set(sys.modules); import credo.runner;"
        "new = {name for name in set(sys.modules) - before"
        " if name.partition('.')[0] not in sys.stdlib_module_names};"
        "print(sorted(new), 'jax' in sys.modules)"
    )
    assert in_another_process(code) == "['credo', 'credo.runner'] False"


def test_the_file_acts_alone(tmp_path, file):
    shutil.copy(pathlib.Path(runner.__file__), tmp_path / "runner.py")
    write(file, described())
    code = (
        "import sys; from runner import Runner;"
        f"print(Runner.load('{file.name}')([1.0, 1.0])[0], 'credo' in sys.modules)"
    )
    action, imported = in_another_process(code, cwd=tmp_path).split()
    assert float(action) == pytest.approx(math.tanh(0.375), abs=1e-6)
    assert imported == "False"
