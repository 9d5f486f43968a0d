"""What every experiment shares: cells by their labels, `--only`, what earlier commands measured."""

import importlib
import json
import pathlib
from dataclasses import replace

import pytest

from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.sequence_classification import SequenceClassification
from credo.executors import local
from credo.experiments import base, catalogue
from credo.experiments.base import Cell, Experiment, Trained, Value, grid, named
from credo.experiments.views import Curves, Table, mean, published
from credo.networks.mmu import MMU
from credo.report.rows import Results, Row, read, rows, series, write
from credo.runs.record import RunError

TINY = Neuroevolution.ours(
    SequenceClassification(depth=2, min_gap=1, max_gap=2),
    MMU(hidden=5),
    population_size=10,
    episodes=4,
    test_episodes=6,
)
CELLS = [
    Cell({"method": "evolution", "depth": depth}, TINY, range(2), generations=12)
    for depth in (2, 5, 21)
]
EVERY = [(name, budget) for name in catalogue.EXPERIMENTS for budget in base.find(name).budgets]


def measure(cell):
    """A number of each run, of two episodes, and of the task."""
    yield from rows(
        "return", [[1, 2]] * len(cell.seeds), cell.labels, seed=cell.seeds, episode=None
    )
    yield from rows("random", 0.5, cell.labels)
    yield from series(
        "score", "frames", [1, 2], [[0, 1]] * len(cell.seeds), cell.labels, seed=cell.seeds
    )


TABLE = Table("Return", ["depth"], {"return": mean("return"), "published": published("return")})
EXPERIMENT = Experiment(
    cells=lambda budget: CELLS,
    measures=(measure,),
    views=(TABLE, Curves("score", "frames", ["depth"])),
    published="A text.",
    values=(Value(3.0, "return", "a paper", {"depth": 5}),),
)


@pytest.fixture
def shared(tmp_path, monkeypatch):
    """An experiment whose runs are said to be done."""
    monkeypatch.setattr(base, "find", lambda name: EXPERIMENT)
    done = []

    def trained(cells, budget, *_):
        done.extend(cell.name for cell in cells)
        return [Trained(cell, [], budget) for cell in cells]

    monkeypatch.setattr(base, "trained", trained)
    return {"output": tmp_path / "pages", "work": tmp_path / "work"}, done


# -------------------------------------------------------------------------------------------- cells


def test_labels_are_told_in_words():
    assert named({"method": "merl", "coupling": 4}) == "merl, coupling 4"
    assert named({"method": "td3", "gamma": 1.0, "task": "Hopper-v5"}) == "td3, gamma 1, Hopper-v5"
    assert named({"task": "x", "delayed": True}) == "x, delayed"
    assert named({"task": "x", "delayed": False}) == "x"
    assert Cell({"network": "5/2"}, None, [0]).folder == "5-2"


def test_a_grid_has_every_combination():
    found = grid(depth=(1, 2), method=("a", "b"))
    assert [tuple(x.values()) for x in found] == [(1, "a"), (1, "b"), (2, "a"), (2, "b")]
    assert list(found[0]) == ["depth", "method"]


def test_the_catalogue_has_every_module():
    folder = pathlib.Path(base.__file__).parent
    modules = {path.stem for path in folder.glob("*.py") if "\nEXPERIMENTS = " in path.read_text()}
    assert modules - {"catalogue"} == set(catalogue.MODULES)
    for module, names in catalogue.MODULES.items():
        found = importlib.import_module(f"credo.experiments.{module}").EXPERIMENTS
        assert set(found) == set(names)
    every = [name for names in catalogue.MODULES.values() for name in names]
    assert sorted(every) == sorted(catalogue.EXPERIMENTS)


@pytest.mark.parametrize("budget", ["smoke", "quick", "full", "million", "published"])
def test_cells_of_one_name_are_the_same_in_every_experiment(budget):
    """They share their runs."""
    seen = {}
    for name in [name for name, has in EVERY if has == budget]:
        cells = base.find(name).cells(budget)
        assert len({cell.name for cell in cells}) == len(cells) >= 1
        for cell in cells:
            kept = seen.setdefault(cell.folder, cell)
            assert (kept.algorithm, kept.labels) == (cell.algorithm, cell.labels)
            assert (list(kept.seeds), kept.budget) == (list(cell.seeds), cell.budget)
            assert pathlib.Path(cell.folder).name == cell.folder
    assert len(seen) > 3


def test_only_matches_what_a_reader_sees():
    cells = base.find("fig-7.4").cells("full")
    (found,) = base.matching(cells, "^merl, coupling 4$", "fig-7.4")
    assert found.labels == {"method": "merl", "coupling": 4}
    assert len(base.matching(cells, "MERL, COUPLING 4", "fig-7.4")) == 3
    with pytest.raises(RunError, match=r"--only '\(' is no regular expression"):
        base.matching(cells, "(", "fig-7.4")
    with pytest.raises(RunError, match=r"no cell of fig-7.4 has 'hopper' in its name: there are m"):
        base.matching(cells, "hopper", "fig-7.4")


# ---------------------------------------------------------------------------------------- reproduce


def test_a_budget_that_an_experiment_lacks_is_named(tmp_path):
    with pytest.raises(RunError, match="no budget 'million': it has smoke, quick, full"):
        base.reproduce("fig-3.4a", "million", output=tmp_path, work=tmp_path)


def test_what_only_leaves_out_stays_as_it_was(shared):
    folders, done = shared
    html = base.reproduce("fig-3.4a", "quick", only="depth (5|21)$", **folders)
    path = html.with_name("results.json")
    assert done == ["evolution, depth 5", "evolution, depth 21"]
    first = read(path)
    assert first.command == "credo reproduce fig-3.4a --budget quick --only 'depth (5|21)$'"
    assert len(first.rows) == 2 * (4 + 1)
    base.reproduce("fig-3.4a", "quick", runs=1, only="DEPTH 2$", **folders)
    both = read(path)
    assert both.levels("depth") == [2, 5, 21]  # in the order of the experiment
    assert both.where(depth=(5, 21)).rows == first.rows
    assert both.where(depth=(5, 21)).curves == first.curves
    assert [cell["seeds"] for cell in both.cells] == [[0], [0, 1], [0, 1]]
    again = "credo reproduce fig-3.4a --budget quick --runs 1 --only 'DEPTH 2$'"
    assert both.command == f"{first.command} && {again}"
    base.reproduce("fig-3.4a", "quick", only="depth (5|21)$", **folders)
    assert read(path) == replace(both, command=f"{again} && {first.command}")  # the last is last
    page = html.read_text()
    assert "evolution, depth 21" in page
    base.reproduce("fig-3.4a", "quick", **folders)
    assert read(path).command == "credo reproduce fig-3.4a --budget quick"


def test_reproduce_trains_once_and_repeats_itself(tmp_path, monkeypatch):
    only = replace(EXPERIMENT, cells=lambda budget: CELLS[:1])
    monkeypatch.setattr(base, "find", lambda name: only)
    folders = {"output": tmp_path / "pages", "work": tmp_path / "work"}
    html = base.reproduce("fig-3.4a", "smoke", runs=1, jobs=1, **folders)
    assert html == tmp_path / "pages" / "fig-3.4a" / "smoke" / "report.html"
    results = html.with_name("results.json")
    before, page = results.read_bytes(), html.read_bytes()
    (cell,) = read(results).cells
    assert cell["seeds"] == [0]
    assert cell["budget"] == {"generations": 12}
    assert 0.0 <= cell["hours"] < 0.1
    assert cell["machine"]["versions"]["credo"]
    folder = tmp_path / "work" / "smoke" / "evolution, depth 2"
    assert [path.name for path in folder.iterdir()] == ["0"]

    def refuse(core):
        raise AssertionError("what is finished was trained again")

    monkeypatch.setattr(local, "_start", refuse)
    base.reproduce("fig-3.4a", "smoke", runs=1, jobs=1, **folders)
    assert results.read_bytes() == before
    assert html.read_bytes() == page


# ------------------------------------------------------------------------- what was measured before


def recorded(cells, command="a", value=1.0):
    """Results of these cells."""
    told = [cell.record() | {"machine": {"processor": command}} for cell in cells]
    found = [Row(cell.labels, seed, "return", value) for cell in cells for seed in cell.seeds]
    return Results("fig-3.4a", "quick", command, told, found, [])


def kept(tmp_path, results, every, chosen):
    write(results, tmp_path / "results.json")
    return base.kept(tmp_path / "results.json", every, chosen)


def test_what_earlier_commands_measured_stays(tmp_path, capsys):
    first, second, third = CELLS
    earlier = kept(tmp_path, recorded([third, first], "old"), CELLS, [second, first])
    assert capsys.readouterr().err == f"kept of {tmp_path / 'results.json'}: {third.name}\n"
    found = base.merged(earlier, recorded([second, first], "new", 2.0), CELLS)
    assert [cell["labels"]["depth"] for cell in found.cells] == [2, 5, 21]
    assert [cell["machine"]["processor"] for cell in found.cells] == ["new", "new", "old"]
    assert [row.value for row in found.rows] == [2.0] * 4 + [1.0] * 2
    assert found.command == "old && new"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda cell: cell["algorithm"].update(population_size=7), "population_size: 7 != 10"),
        (lambda cell: cell["algorithm"].update(no_such_field=1), "cannot be read"),
        (lambda cell: cell.pop("algorithm"), "cannot be read: 'algorithm'"),
        (lambda cell: cell.update({"seeds": [77, 78]}), "first seed: 77 != 0"),
        (lambda cell: cell["budget"].update({"generations": 3}), "generations: 3 != "),
        (lambda cell: cell["budget"].update({"stop_at": 3.0}), "stop_at: 3.0 != None"),
    ],
)
def test_cells_with_other_settings_do_not_stay(tmp_path, change, why, capsys):
    first, second, _ = CELLS
    record = recorded([first])
    change(record.cells[0])
    assert kept(tmp_path, record, CELLS, [second]) is None
    said = capsys.readouterr().err
    assert said.startswith("not kept of ")
    assert f"{first.name} (" in said
    assert why in said


def test_what_else_stays_and_does_not(tmp_path, capsys):
    first, second, third = CELLS
    fewer = replace(first, seeds=[0])
    stays = kept(tmp_path, recorded([fewer]), CELLS, [second])
    assert [cell["seeds"] for cell in stays.cells] == [[0]]
    assert kept(tmp_path, recorded([first]), [second, third], [second]) is None
    assert "no such cell today" in capsys.readouterr().err
    assert base.kept(tmp_path / "none.json", CELLS, [first]) is None
    for damaged in ("{", "{}", json.dumps({"measured": {}, "cells": {}})):
        (tmp_path / "results.json").write_text(damaged)
        with pytest.raises(RunError, match=r"is no record of results .*convert_results.*move it"):
            base.kept(tmp_path / "results.json", CELLS, [first])


def test_extent_says_what_ends_a_run():
    assert (
        base.extent({"seeds": [0] * 10, "budget": {"generations": 1000}})
        == "10 × 1,000 generations"
    )
    both = {"frames": 1_500_000, "generations": 910, "stop_at": 9000.0}
    expected = "1 × 1,500,000 frames or 910 generations or a score of 9,000"
    assert base.extent({"seeds": [3], "budget": both}) == expected
