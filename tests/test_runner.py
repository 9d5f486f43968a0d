"""The runner alone: numbers by hand, files that are damaged, and what it imports."""

import json
import math
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
    return {
        "version": 1,
        "credo": "0.1.0",
        "network": "MLP",
        "config": MLP,
        "obs_size": 2,
        "action_size": 1,
        "action": action,
    } | changes


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


def test_observations_that_are_none_are_refused(file):
    act = Runner.load(write(file, described()))
    with pytest.raises(ValueError, match="has 3 numbers: it must have 2"):
        act(np.zeros(3))
    with pytest.raises(ValueError, match="NaN and inf are no observations"):
        act([0.0, math.nan])


def test_any_changed_byte_is_noticed(file):
    good = write(file, described()).read_bytes()
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


def test_another_format_names_the_version_to_use(file):
    description = described(version=2, credo="9.9.9")
    with pytest.raises(ValueError, match=r"has format 2.*reads 1: use the runner of Credo 9\.9\.9"):
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
