"""Experiments of section 3.4 and of networks beside the MMU: their cells, how instances are
counted, and pages from numbers made up."""

import importlib
import json

import numpy as np
import pytest

from credo.algorithms.bptt import BPTT
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.sequence_classification import SequenceClassification
from credo.experiments import base, beyond_3, chapter3, chapter3_gradient, fig_3_11, fig_3_12
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.report.pages import render
from credo.report.sections import Page
from credo.runs.loop import train

NAMES = ("fig-3.4b", "fig-3.9b", "fig-3.11", "fig-3.12", "fig-3.13", "beyond-3")


def cells(name, budget):
    return importlib.import_module(f"credo.experiments.{base.MODULES[name]}").cells(budget)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("budget", base.BUDGETS)
def test_every_budget_has_cells_with_names_of_their_own(name, budget):
    found = cells(name, budget)
    assert len({cell.name for cell in found}) == len(found) >= 2
    assert all(cell.runs >= 2 and cell.generations >= 10 for cell in found)


def test_what_is_known_from_other_figures_is_shared():
    known = {cell.name: cell for cell in chapter3.classification_cells("full")}
    known |= {cell.name: cell for cell in chapter3.recall_cells("full")}
    found = [cell for name in NAMES for cell in cells(name, "full")]
    shared = [cell for cell in found if cell.name in known]
    assert len(shared) >= 20
    assert all(base.limits(cell) == base.limits(known[cell.name]) for cell in shared)
    assert all(cell.algorithm == known[cell.name].algorithm for cell in shared)


def test_both_trainers_have_as_many_instances_in_beyond_3():
    for cell in cells("beyond-3", "full"):
        algorithm = cell.algorithm
        if isinstance(algorithm, BPTT):
            assert algorithm.updates * algorithm.batch_size == 1000
        else:
            assert algorithm.population_size * algorithm.episodes == 1000
        task = cell.name.split()[0]
        assert cell.generations == chapter3_gradient.GENERATIONS[task]["full"]
        assert cell.first_seed == 200  # our settings are reported on seeds not looked at


def test_cells_are_the_trainer_the_network_and_the_size_of_their_name():
    cell = chapter3_gradient.cell("recall", 4, "as written by gradient", "quick", "gru")
    assert cell.name == "recall 4-deep as written by gradient, gru"
    assert cell.algorithm.network == Recurrent("gru", 20, initializer="kaiming")
    assert (cell.algorithm.env.depth, cell.algorithm.l2, cell.first_seed) == (4, 0.1, 0)
    other = chapter3_gradient.cell("classification", 5, "ours", "full", "mmu 5×2").algorithm
    assert isinstance(other, Neuroevolution)
    assert (other.network.hidden, other.network.cells, other.network.encoder) == (5, 2, "learned")
    assert chapter3.split_name("recall 4-deep ours, lstm") == (4, "ours, lstm")


def made_up(success, **more):
    return {
        "floor": ["remember the first signal", 0.25],
        "success": success,
        "curve": {
            "generation": [10, 20],
            "raw": [[0.1, s] for s in success],
            "smoothed": [[0.1, s] for s in success],
            "last raw": success,
            "last smoothed": success,
        },
        "by instances": {"instances": [10_000, 20_000], "success": [[0.1, s] for s in success]},
        **more,
    }


def rendered(module, measured):
    sections = module.sections(json.loads(json.dumps(measured)))
    html = render(Page(module.TITLE, module.PUBLISHED, "credo reproduce x", sections))
    assert ">nan" not in html
    return sections


def test_figure_3_11_has_its_four_parts_and_the_published_number():
    tested = {
        "distractors": {"gaps": [0, 15, 101], "success": [[1.0, 1.0, 0.5], [1.0, 0.9, 0.3]]},
        "depths": {
            "depths": [16, 21, 66, 101],
            "success": [[1.0, 1.0, 0.5, 0.2], [1.0, 0.9, 0.5, 0.1]],
        },
    }
    measured = {
        "classification 21-deep ours by gradient": made_up([0.9, 1.0], **tested),
        "classification 21-deep as coded": made_up([0.5, 0.7]),
    }
    sections = rendered(fig_3_11, measured)
    titles = [section.title for section in sections]
    for part in ("(a) ours by gradient", "(b) Gradient and evolution, 21-deep", "(d) Champions"):
        assert any(title.startswith(part) for title in titles)
    both = next(s for s in sections if s.title.startswith("(b)"))
    assert [curve.label for curve in both.curves] == ["ours by gradient", "as coded"]
    away = next(s for s in sections if s.title.startswith("Away"))
    assert away.rows == [
        ["21", "ours by gradient", "40.0 ± 10.0", "14.5 ± 2.3", "15.0 ± 5.0"],
    ]


def test_figure_3_12_compares_at_one_depth():
    measured = {
        f"recall {depth}-deep {variant}": made_up([0.9, 1.0])
        for depth in (2, 4)
        for variant in ("ours by gradient", "ours at equal instances")
    }
    sections = rendered(fig_3_12, measured)
    both = next(s for s in sections if s.title == "(b) Gradient and evolution, 4-deep")
    assert len(both.curves) == 2


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two short runs by each trainer."""
    task = SequenceClassification(depth=2, min_gap=1, max_gap=2)
    sizes = {"population_size": 8, "episodes": 4, "test_episodes": 6}
    trainers = {
        "classification 2-deep ours at equal instances": Neuroevolution.ours(
            task, MMU(hidden=3), **sizes
        ),
        "classification 2-deep ours by gradient, gru": BPTT.ours(
            task, Recurrent("gru", 3), batch_size=16, updates=2, test_episodes=6
        ),
    }
    folder = tmp_path_factory.mktemp("gradient")
    return {
        name: [
            train(
                algorithm,
                generations=10,
                seed=seed,
                path=folder / name / str(seed),
                tensorboard=False,
                progress=False,
            )
            for seed in range(2)
        ]
        for name, algorithm in trainers.items()
    }


def test_success_is_laid_over_the_instances_of_each_trainer(runs):
    measured = beyond_3.measure(runs, "smoke")
    assert json.loads(json.dumps(measured, allow_nan=False)) == measured
    rendered(beyond_3, measured)
    evolved, trained = measured.values()
    assert evolved["by instances"]["instances"] == [32 * g for g in range(1, 11)]
    assert trained["by instances"]["instances"] == [32 * g for g in range(1, 11)]
    scores = [run.metrics["champion_score"] for run in list(runs.values())[1]]
    np.testing.assert_allclose(trained["by instances"]["success"], scores, atol=1e-4)
    assert trained["weights"] == 3 * (3 * 1 + 3 * 3 + 3) + 3 + 1
    assert np.shape(trained["right"]) == (2, 10)
    assert all(0 <= x <= beyond_3.SIGNALS["smoke"] for run in trained["right"] for x in run)
