"""Any flipped bit of a file that a result depends on is named when the run is read."""

import importlib.util
import pathlib

path = pathlib.Path(__file__).with_name("flips.py")
specification = importlib.util.spec_from_file_location("flips", path)
assert specification is not None
assert specification.loader is not None
flips = importlib.util.module_from_spec(specification)
specification.loader.exec_module(flips)


def test_every_file_of_a_run_names_its_damage(tmp_path):
    counts = flips.count(tmp_path, times=3, seed=2)
    kinds = {name.partition("/")[2].partition("/")[0] for name in counts}
    assert {"config.json", "metrics.csv", "champion.safetensors", "checkpoints"} <= kinds
    assert any("replay0" in name for name in counts)
    assert {kind for count in counts.values() for kind in count} <= {"named", "harmless"}
