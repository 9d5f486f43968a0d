"""A run that is killed at random moments and resumed ends in the bytes of one left alone."""

import importlib.util
import pathlib

import pytest

path = pathlib.Path(__file__).with_name("kill.py")
specification = importlib.util.spec_from_file_location("kill", path)
assert specification is not None
assert specification.loader is not None
kill = importlib.util.module_from_spec(specification)
specification.loader.exec_module(kill)


def test_killed_three_times(tmp_path):
    assert kill.compare(tmp_path, times=3, generations=600, seed=1) == []
    assert kill.rows(tmp_path / "disturbed") > 2  # dispatches, so there was something to kill
    newest = sorted(p.name for p in (tmp_path / "disturbed" / "checkpoints").iterdir())[-1]
    assert newest == "00000600"


@pytest.mark.slow
@pytest.mark.parametrize(("what", "generations"), [("merl", 800), ("matd3", 1200)])
def test_teams_killed_once_while_they_train(tmp_path, what, generations):
    assert kill.compare(tmp_path, 1, generations, seed=10, what=what) == []
    newest = sorted(p.name for p in (tmp_path / "disturbed" / "checkpoints").iterdir())[-1]
    assert newest == f"{generations:08d}"
    columns, *_, last = (tmp_path / "disturbed" / "metrics.csv").read_text().splitlines()
    told = dict(zip(columns.split(","), last.split(","), strict=True))
    assert int(told["updates"]) > 0  # it had learned


def test_a_difference_would_be_seen(tmp_path):
    for name, content in (("a", b"1"), ("b", b"2")):
        (tmp_path / name / "checkpoints" / "00000001").mkdir(parents=True)
        for file in ("metrics.csv", "champion.safetensors", "checkpoints/00000001/COMMIT"):
            (tmp_path / name / file).write_bytes(content)
        (tmp_path / name / "config.json").write_text("{}")
    assert kill.different(tmp_path / "a", tmp_path / "b") == [
        "metrics.csv",
        "champion.safetensors",
        "checkpoints/00000001/COMMIT",
    ]
