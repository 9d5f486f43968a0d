"""Every experiment, on tiny runs: its numbers are plain, its page renders, a rerun repeats it."""

import importlib
import json
import pathlib
from html import escape

import jax
import numpy as np
import pytest

from credo.algorithms.bptt import BPTT
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.executors import local
from credo.experiments import base, chapter3, fig_3_4a
from credo.experiments.catalogue import EXPERIMENTS
from credo.networks.mmu import MMU
from credo.report import page
from credo.runs import config
from credo.runs.loop import train
from credo.runs.record import RunError
from credo.runs.store import Run

BUDGETS = base.BUDGETS
CHAPTER3 = [name for name in base.MODULES if name.partition("-")[2].startswith("3.")]
RESULTS = pathlib.Path(base.__file__).parents[3] / "results"
SIZES = {"population_size": 10, "episodes": 4, "test_episodes": 6}
SEEDS, GENERATIONS = 2, 12
TINY_BPTT = {"batch_size": 10, "updates": 1, "test_episodes": 6}
TINY = {
    "classification 2-deep as written by gradient": BPTT.as_written(
        SequenceClassification(depth=2, min_gap=1, max_gap=2), MMU(hidden=5), **TINY_BPTT
    ),
    "recall 1-deep ours by gradient": BPTT.ours(
        SequenceRecall(depth=1, min_corridor=1, max_corridor=2), MMU(hidden=5), **TINY_BPTT
    ),
    "classification 2-deep as coded": Neuroevolution.as_coded(
        SequenceClassification(depth=2, min_gap=1, max_gap=2), MMU(hidden=5), **SIZES
    ),
    "classification 2-deep ours": Neuroevolution.ours(
        SequenceClassification(depth=2, min_gap=1, max_gap=2), MMU(hidden=5), **SIZES
    ),
    "recall 1-deep ours": Neuroevolution.ours(
        SequenceRecall(depth=1, min_corridor=1, max_corridor=2), MMU(hidden=5), **SIZES
    ),
}


def experiment(name):
    return importlib.import_module(f"credo.experiments.{base.MODULES[name]}")


@pytest.fixture(scope="session")
def runs(tmp_path_factory):
    """Two short runs of each cell."""
    folder = tmp_path_factory.mktemp("cells")
    trained = {
        name: [
            train(
                algorithm,
                generations=GENERATIONS,
                seed=seed,
                path=folder / name / str(seed),
                tensorboard=False,
                progress=False,
            )
            for seed in range(SEEDS)
        ]
        for name, algorithm in TINY.items()
    }
    # A run caches only programs that took a while to compile; tests cache them all.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return trained


def cells_of(name: str, runs: dict[str, list[Run]]) -> dict[str, list[Run]]:
    """As many of the runs as the experiment wants, of its own task."""
    wanted = experiment(name).cells("smoke")
    task = wanted[0].name.split()[0]
    chosen = {cell: group for cell, group in runs.items() if cell.startswith(task)}
    return dict(list(chosen.items())[-len(wanted) :])


def test_the_command_line_lists_what_there_is():
    assert list(EXPERIMENTS) == list(base.MODULES)
    modules = {path.stem for path in pathlib.Path(base.__file__).parent.glob("*.py")}
    shared = {
        "__init__",
        "base",
        "chapter3",
        "chapter3_gradient",
        "chapter4",
        "chapter4_fleet",
        "chapter5",
        "chapter6",
        "chapter7",
    }
    assert modules - shared == set(base.MODULES.values())


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("name", CHAPTER3)
def test_cells_are_named_once_and_have_runs(name, budget):
    cells = experiment(name).cells(budget)
    assert len(cells) >= 1
    assert len({cell.name for cell in cells}) == len(cells)
    assert all(cell.runs >= 2 and cell.generations >= 10 for cell in cells)
    for cell in cells:
        depth, variant = chapter3.split_name(cell.name)
        assert cell.algorithm.env.depth == depth
        assert variant.startswith(tuple(chapter3.VARIANTS))
        assert pathlib.Path(cell.name).name == cell.name  # it is the name of a folder


@pytest.mark.parametrize("budget", [*BUDGETS, "million", "published"])
def test_cells_of_one_name_are_the_same_in_every_experiment(budget):
    """They share their runs."""
    seen = {}
    for name in base.MODULES:
        if budget in base.budgets(name):
            for cell in experiment(name).cells(budget):
                kept = seen.setdefault(cell.name, cell)
                assert kept.algorithm == cell.algorithm
                assert (kept.runs, base.limits(kept)) == (cell.runs, base.limits(cell))
    assert len(seen) > 3


def test_a_budget_that_an_experiment_lacks_is_named(tmp_path):
    with pytest.raises(RunError, match="no budget 'million': it has smoke, quick, full"):
        base.reproduce("fig-3.4a", "million", output=tmp_path, work=tmp_path)


def test_some_cells_alone(tmp_path, monkeypatch):
    chosen = []
    monkeypatch.setattr(local, "run", lambda jobs, *_, **__: chosen.extend(jobs))
    monkeypatch.setattr(base, "Run", lambda path: path)
    monkeypatch.setattr(fig_3_4a, "measure", lambda runs, budget: dict.fromkeys(runs, 1))
    monkeypatch.setattr(fig_3_4a, "sections", lambda measured: [])
    folders = {"output": tmp_path / "pages", "work": tmp_path / "work"}
    html = base.reproduce("fig-3.4a", "quick", only="5-deep (ours|as coded)$", **folders)
    assert {job.path.parent.name for job in chosen} == {
        "classification 5-deep ours",
        "classification 5-deep as coded",
    }
    record = json.loads(html.with_name("results.json").read_text())
    assert record["command"].endswith("--budget quick --only '5-deep (ours|as coded)$'")
    assert len(record["cells"]) == 2
    html = base.reproduce("fig-3.4a", "quick", only="2-DEEP ours$", **folders)
    record = json.loads(html.with_name("results.json").read_text())
    assert len(record["cells"]) == 3
    assert "classification 2-deep ours" in record["cells"]
    assert list(record["measured"]) == list(record["cells"])
    assert record["command"].count(" && ") == 1
    with pytest.raises(RunError, match=r"only is '\(', no regular expression"):
        base.reproduce("fig-3.4a", "quick", only="(", **folders)
    with pytest.raises(RunError, match=r"no cell of .* at budget quick has 'hopper' in its"):
        base.reproduce("fig-3.4a", "quick", only="hopper", **folders)


def recorded(cells, command, processor="one", **measured):
    """A `results.json` of these cells."""
    return {
        "experiment": "fig-3.4a",
        "budget": "quick",
        "command": command,
        "cells": {
            cell.name: {
                "runs": cell.runs,
                "first seed": cell.first_seed,
                "generations": cell.generations,
                "algorithm": json.loads(json.dumps(config.to_tree(cell.algorithm))),
            }
            for cell in cells
        },
        "machine": {"processor": processor},
        "measured": measured or {cell.name: f"{processor} {cell.name}" for cell in cells},
    }


def written(tmp_path, record):
    path = tmp_path / "results.json"
    path.write_text(json.dumps(record))
    return path


def test_what_earlier_commands_measured_stays(tmp_path, capsys):
    cells = fig_3_4a.cells("quick")
    first, second, third, *_ = cells
    path = written(tmp_path, recorded([third, first], "a", "old"))
    earlier = base.kept(path, cells, [second, first])
    assert capsys.readouterr().err == f"kept of {path}: {third.name}\n"
    found = base.merged(earlier, recorded([second, first], "b", "new"), cells)
    assert list(found["cells"]) == list(found["measured"]) == [c.name for c in cells[:3]]
    assert found["measured"][first.name] == f"new {first.name}"
    assert found["measured"][third.name] == f"old {third.name}"
    machines = [cell.get("machine") for cell in found["cells"].values()]
    assert machines == [None, None, {"processor": "old"}]
    for command, expected in (("b", "a && b"), ("a", "b && a")):  # the last one is last
        again = base.kept(written(tmp_path, found), cells, [second])
        again = base.merged(again, recorded([second], command, "new"), cells)
        assert again == found | {"command": expected}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda cell: cell["algorithm"].update(population_size=7), "population_size: 7 != 100"),
        (lambda cell: cell["algorithm"].update(no_such_field=1), "cannot be read"),
        (lambda cell: cell.pop("algorithm"), "cannot be read: 'algorithm'"),
        (lambda cell: cell.update({"first seed": 77}), "first seed: 77 != "),
        (lambda cell: cell.update({"generations": 3}), "generations: 3 != "),
        (lambda cell: cell.update({"stop_at": 3.0}), "stop_at: 3.0 != None"),
    ],
)
def test_cells_with_other_settings_do_not_stay(tmp_path, change, why, capsys):
    first, second, *_ = cells = fig_3_4a.cells("quick")
    record = recorded([first], "a")
    change(record["cells"][first.name])
    assert base.kept(written(tmp_path, record), cells, [second]) is None
    said = capsys.readouterr().err
    assert said.startswith("not kept of ")
    assert f"{first.name} (" in said
    assert why in said


def test_what_else_stays_and_does_not(tmp_path, capsys):
    first, second, *others = cells = fig_3_4a.cells("quick")
    fewer = recorded([first], "a")
    fewer["cells"][first.name]["runs"] = 1
    assert list(base.kept(written(tmp_path, fewer), cells, [second])["cells"]) == [first.name]
    together = written(tmp_path, recorded([first], "a", all_cells=1))
    assert base.kept(together, cells, [second]) is None
    assert "of all its cells together" in capsys.readouterr().err
    gone = written(tmp_path, recorded([first], "a"))
    assert base.kept(gone, others, others[:1]) is None
    assert "no such cell today" in capsys.readouterr().err
    assert base.kept(tmp_path / "none.json", cells, [first]) is None
    for damaged in ("{", "{}"):
        (tmp_path / "results.json").write_text(damaged)
        with pytest.raises(RunError, match=r"is no record of results .*move it away"):
            base.kept(tmp_path / "results.json", cells, [first])


def test_committed_results_still_make_their_pages(tmp_path):
    """Their record of a cell is older than budgets in frames."""
    for folder in sorted(RESULTS.glob("*/*/results.json")):
        record = json.loads(folder.read_text())
        assert all(base.extent(cell) for cell in record["cells"].values())
    old = tmp_path / "results.json"
    old.write_text((RESULTS / "table-3.2" / "full" / "results.json").read_text())
    assert "10 × 1000 generations" in base.page(old).read_text()


def test_extent_says_what_ends_a_run():
    assert base.extent({"generations": 1000}) == "1000 generations"
    both = {"generations": 910, "frames": 1_500_000, "stop_at": 9000.0}
    assert base.extent(both) == "1,500,000 frames or 910 generations or a score of 9,000"


def numbers(value):
    """Every number in a tree of JSON."""
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from numbers(inner)
    elif isinstance(value, int | float):
        yield value


@pytest.mark.parametrize("name", CHAPTER3)
def test_its_numbers_are_plain_and_its_page_renders(name, runs):
    module = experiment(name)
    chosen = cells_of(name, runs)
    measured = module.measure(chosen, "smoke")
    text = json.dumps(measured, allow_nan=False)
    assert json.loads(text) == measured
    assert np.isfinite(list(numbers(measured))).all()
    assert json.loads(base._compact(measured)) == measured
    sections = module.sections(json.loads(text))
    assert len(sections) >= 1
    html = page.render(
        page.Page(module.TITLE, module.PUBLISHED, f"credo reproduce {name}", sections)
    )
    for section in sections:
        assert escape(section.title) in html
    assert ">nan" not in html


def test_success_is_that_of_the_champions_on_sequences_of_their_own(runs):
    group = runs["classification 2-deep ours"]
    measured = fig_3_4a.measure({"classification 2-deep ours": group}, "smoke")
    (cell,) = measured.values()
    assert len(cell["success"]) == SEEDS
    assert all(0 <= s <= 1 and round(1000 * s) == pytest.approx(1000 * s) for s in cell["success"])
    assert cell["floor"][1] == pytest.approx(0.75)
    last = [run.metrics["champion_score"][-1] for run in group]
    assert cell["curve"]["last raw"] == pytest.approx(last, abs=1e-4)
    assert cell["curve"]["generation"] == [10]
    smooth = [run.metrics["champion_score"].mean() for run in group]  # fewer than 100 generations
    assert cell["curve"]["last smoothed"] == pytest.approx(smooth, abs=1e-4)


def test_a_sweep_over_gaps_agrees_with_the_task_itself(runs):
    """A gap of fixed length, as data and as a task."""
    policies = chapter3.champions(runs["classification 2-deep as coded"])
    wide, key = SequenceClassification(depth=2, min_gap=0, max_gap=3), jax.random.key(0)
    for gap in (0, 3):
        exact = chapter3.success(SequenceClassification(2, gap, gap), policies, episodes=400)
        swept = chapter3.success_with_gap(wide, policies, np.int32(gap), key=key, episodes=400)
        np.testing.assert_allclose(swept, exact, atol=0.14)  # other sequences: 4 σ


def test_numbers_are_written_with_their_spread():
    assert chapter3.percent([0.5, 0.7]) == "60.0 ± 10.0"
    assert chapter3.spread([0.5, 0.6, 1.0]) == "60.0 (50.0…100.0)"
    assert chapter3.split_name("recall 6-deep as coded") == (6, "as coded")


def test_reproduce_trains_once_and_repeats_itself(tmp_path, monkeypatch):
    name = "classification 2-deep ours"
    cells = [base.Cell(name, TINY[name], GENERATIONS, 2)]
    monkeypatch.setattr(fig_3_4a, "cells", lambda budget: cells)
    folders = {"output": tmp_path / "pages", "work": tmp_path / "work"}
    html = base.reproduce("fig-3.4a", "smoke", runs=1, jobs=1, **folders)
    assert html == tmp_path / "pages" / "fig-3.4a" / "smoke" / "report.html"
    results = html.with_name("results.json")
    before, page_before = results.read_bytes(), html.read_bytes()
    record = json.loads(before)
    assert record["command"] == "credo reproduce fig-3.4a --budget smoke --runs 1"
    assert record["cells"][name]["runs"] == 1
    assert len(record["measured"][name]["success"]) == 1
    trained = sorted(path.name for path in (tmp_path / "work" / "smoke" / name).iterdir())
    assert trained == ["0"]

    def refuse(core):
        raise AssertionError("what is finished was trained again")

    monkeypatch.setattr(local, "_start", refuse)
    base.reproduce("fig-3.4a", "smoke", runs=1, jobs=1, **folders)
    assert results.read_bytes() == before
    assert html.read_bytes() == page_before
