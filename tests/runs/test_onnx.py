"""ONNX files: ONNX Runtime acts as the policy does over an episode, and they say what they are."""

import importlib.util
import json
import sys

import jax
import numpy as np
import pytest

if any(importlib.util.find_spec(name) is None for name in ("jax2onnx", "onnxruntime")):
    pytest.skip("an extra: pip install credo[onnx]", allow_module_level=True)

import onnx
import onnxruntime

from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.probes import Choose, Meet
from credo.environments.sequence_recall import SequenceRecall
from credo.networks.choosing import choosing
from credo.networks.dmmu import DMMU
from credo.networks.dnc import DNC
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.ntm import NTM
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team
from credo.runs import checkpoint, config, files
from credo.runs.onnx import export
from credo.runs.record import RunError, task_of
from credo.runs.store import Run

NETWORKS = {
    "mlp": (SequenceRecall(2), MLP((4,))),
    "mmu": (SequenceRecall(2), MMU(4)),
    "lstm": (SequenceRecall(2), Recurrent("lstm", 3)),
    "ntm": (SequenceRecall(2), NTM(hidden=4, rows=5, width=3)),
    "choosing": (Choose(), choosing(Choose(), Recurrent("gru", 3))),
    "team": (Meet(), Team((4,), MMU(3))),
    "dmmu": (Meet(), DMMU("mmu", 3)),
}


def run_of(path, env, network):
    """A run on disk with fresh weights."""
    path.mkdir()
    algorithm = Neuroevolution(env, network, population_size=10)
    champion = network.init(*env.sizes, key=jax.random.key(3))
    checkpoint.export_policy(path / "champion.safetensors", champion)
    record = {"algorithm": config.to_tree(algorithm), "seed": 0, "task": task_of(env)}
    files.write_json(path / "config.json", json.loads(json.dumps(record)))
    return Run(path, trust=True)


@pytest.mark.parametrize("name", NETWORKS)
def test_it_acts_as_the_policy_over_an_episode(tmp_path, name):
    run = run_of(tmp_path / "run", *NETWORKS[name])
    path = export(run, tmp_path / "policy.onnx")
    policy = run.policy(raw=True)
    session = onnxruntime.InferenceSession(str(path))
    told = session.get_modelmeta().custom_metadata_map
    memories = [np.float32(x) for x in json.loads(told["credo.memory"])]
    assert bool(memories) == (name != "mlp")
    *_, shape = (given.shape for given in session.get_inputs()[:1])
    draw = np.random.default_rng(0)
    for _ in range(6):
        obs = draw.normal(size=shape).astype(np.float32)
        names = [given.name for given in session.get_inputs()]
        assert names == ["observation", *(f"memory_{i}" for i in range(len(memories)))]
        action, *memories = session.run(None, dict(zip(names, [obs, *memories], strict=True)))
        np.testing.assert_allclose(action, policy(obs), rtol=0, atol=1e-5)


def test_the_file_says_what_it_is(tmp_path):
    run = run_of(tmp_path / "run", *NETWORKS["choosing"])
    model = onnx.load(export(run, tmp_path / "policy.onnx"))
    onnx.checker.check_model(model)
    told = {x.key: x.value for x in model.metadata_props}
    described = json.loads(told["credo.policy"])
    assert (described["task"], described["choices"]) == ("Choose", [3])


def test_what_no_graph_holds_is_named(tmp_path):
    run = run_of(tmp_path / "run", Meet(), DMMU("mmu", 3, order="random"))
    with pytest.raises(RunError, match="its memory holds more than numbers"):
        export(run, tmp_path / "policy.onnx")
    dnc = run_of(tmp_path / "dnc", SequenceRecall(2), DNC(hidden=4, rows=4, width=3))
    with pytest.raises(RunError, match=r"ONNX Runtime cannot play this policy .*CumProd"):
        export(dnc, tmp_path / "policy.onnx")
    with pytest.raises(RunError, match="is no folder: make it first"):
        export(run, tmp_path / "nowhere/policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()
    assert "jax2onnx" in sys.modules
