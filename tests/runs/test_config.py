"""The object is its config: trees as JSON and back, and what is refused."""

import dataclasses
import json
import textwrap

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.algorithms.neuroevolution import Neuroevolution
from credo.cli.names import CATALOGUE
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.runs import config, files

NETWORKS = [MMU(hidden=3), Recurrent(cell="lstm"), MLP()]


def there_and_back(value):
    return config.from_tree(json.loads(json.dumps(config.to_tree(value))))


@pytest.mark.parametrize("preset", Neuroevolution.presets().values(), ids=lambda p: p.__name__)
@pytest.mark.parametrize("network", NETWORKS, ids=lambda n: type(n).__name__)
def test_an_algorithm_comes_back_as_itself(preset, network):
    algorithm = preset(SequenceRecall(depth=2), network, crossover_probability=0.1)
    assert there_and_back(algorithm) == algorithm


def test_floats_keep_every_bit():
    values = [0.1, 1 / 3, 1e-300, 5e-324, 1e12, -0.0]
    algorithm = Neuroevolution.as_written(Copy(), MMU(hidden=2), crossover_probability=1 / 3)
    assert there_and_back(algorithm).breeder.crossover_probability.hex() == (1 / 3).hex()
    assert [v.hex() for v in there_and_back(values)] == [v.hex() for v in values]


def test_scalars_become_plain_numbers():
    tree = config.to_tree({"b": jnp.float32(0.5), "c": np.int64(3), 4: (True,)})
    assert tree == {"b": 0.5, "c": 3, "4": [True]}
    assert json.loads(json.dumps(tree)) == tree


def test_arrays_are_refused_since_they_would_come_back_as_tuples():
    with pytest.raises(config.ConfigError, match="only numbers, strings"):
        config.to_tree({"a": np.arange(2)})


def test_what_cannot_be_recorded_is_refused():
    with pytest.raises(config.ConfigError, match=r"a field holds .*only numbers, strings"):
        config.to_tree({"a": print})


def tree_of(**changes):
    return config.to_tree(SequenceClassification(depth=2)) | changes


@pytest.mark.parametrize(
    ("tree", "told"),
    [
        (tree_of(dept=3), "has no field 'dept' .did you mean 'depth'"),
        (tree_of(**{"class": "nowhere:Task"}), "cannot find 'nowhere:Task'"),
        (tree_of(**{"class": "credo.cli:Nothing"}), "cannot find 'credo.cli:Nothing'"),
        (tree_of(**{"class": "credo.cli:main"}), "is not an equinox.Module class"),
        (tree_of(**{"class": "os:system"}), "is not an equinox.Module class"),
        (tree_of(**{"class": "subprocess:Popen"}), "is not an equinox.Module class"),
        (tree_of(**{"class": "equinox.nn:Linear"}), "neither Credo's nor"),
    ],
)
def test_a_config_that_names_something_else_is_refused(tree, told):
    with pytest.raises(config.ConfigError, match=told):
        config.from_tree(tree)


def test_values_are_checked_on_the_way_back():
    with pytest.raises(ValueError, match="depth is 0"):
        config.from_tree(tree_of(depth=0))


def test_an_environment_of_ones_own_is_found(tmp_path, monkeypatch):
    source = """
        import equinox as eqx
        from credo.environments.probes import Copy

        class Mine(Copy):
            reach: float = 0.25
        """
    (tmp_path / "module_of_mine.py").write_text(textwrap.dedent(source))
    monkeypatch.syspath_prepend(tmp_path)
    import module_of_mine  # pyright: ignore[reportMissingImports]

    tree = config.to_tree(module_of_mine.Mine(reach=0.5))
    assert tree["class"] == "module_of_mine:Mine"
    assert config.from_tree(tree) == module_of_mine.Mine(reach=0.5)


def test_differences_name_the_place():
    a = config.to_tree(Neuroevolution(Copy(), MMU(hidden=2)))
    b = config.to_tree(Neuroevolution(Copy(), MMU(hidden=3), episodes=4))
    assert config.differences(a, a) == []
    assert config.differences(a, b) == ["episodes: 10 != 4", "network.hidden: 2 != 3"]
    assert config.differences({"x": 1}, {}, "at") == ["at.x: 1 != None"]


def test_a_flat_tree_has_one_row_per_setting():
    flat = config.flatten(config.to_tree(Neuroevolution(Copy(), MMU(hidden=2), episodes=4)))
    assert flat["algorithm"] == "Neuroevolution"
    assert flat["network"] == "MMU"
    assert flat["network.hidden"] == 2
    assert flat["episodes"] == 4
    strength = Neuroevolution(Copy(), MMU()).breeder.mutation.strength
    assert flat["breeder.mutation.strength"] == strength


def test_brief_is_the_task_on_one_line():
    line = config.brief(config.to_tree(SequenceRecall(depth=2, max_corridor=30)))
    assert line == "SequenceRecall(depth=2, min_corridor=10, max_corridor=30, unit=None)"


def test_the_machine_is_recorded_as_json():
    machine = config.machine()
    assert json.loads(json.dumps(machine)) == machine
    assert machine["versions"]["jax"] == jax.__version__
    assert machine["versions"]["equinox"] == eqx.__version__
    assert machine["cores"] >= 1
    assert machine["device"] == jax.devices()[0].device_kind


def test_a_json_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "config.json"
    files.write_json(path, {"a": 1, "σ": "ψ"})
    assert json.loads(path.read_text()) == {"a": 1, "σ": "ψ"}
    with pytest.raises(TypeError):
        files.write_json(path, {"a": print})
    assert json.loads(path.read_text()) == {"a": 1, "σ": "ψ"}


def test_every_field_of_an_algorithm_is_in_its_tree():
    algorithm = Neuroevolution.ours(SequenceClassification(depth=2), MMU(hidden=2))
    names = {field.name for field in dataclasses.fields(algorithm)}
    assert config.to_tree(algorithm).keys() == names | {"class"}


def test_a_record_of_an_older_version_says_so():
    tree = config.to_tree(Neuroevolution(Copy(), MMU(hidden=2)))
    for old in (
        tree | {"elite_fraction": 0.1},
        tree | {"curriculum": {"class": "credo.evolution.curriculum:Curriculum", "start": 3}},
    ):
        with pytest.raises(config.ConfigError, match="was written by an older version of Credo"):
            config.from_tree(old)


def test_every_family_of_the_command_line_may_be_extended_by_a_recorded_class():
    known = {kind.__name__ for kind in config.EXTENSIONS}
    assert set(CATALOGUE["families"]) <= known
