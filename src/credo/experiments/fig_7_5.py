"""Figure 7.5: paths of teams at coupling 3."""

from typing import Any

import jax
import numpy as np

from ..report import trajectories
from ..report.page import Drawing, Table
from ..rollout import record
from ..runs.loop import Run
from . import chapter7
from .base import Cell
from .chapter7 import Plan

TITLE = "paths at coupling 3"
PUBLISHED = (
    "Figure 7.5 of the dissertation: MERL partly trained drives each rover to a POI and observes "
    "none; fully trained it observes 3 of 4 in two teams of three; MATD3-mixed observes none."
)
BUDGETS = chapter7.BUDGETS
PLANS = {
    "smoke": Plan(1_500, 1),
    "quick": Plan(150_000, 1),
    "full": Plan(300_000, 1),
    "published": Plan(2_000_000, 1, 0.1),
}
PARTLY = {"smoke": 1_000, "quick": 25_000, "full": 25_000, "published": 100_000}  # frames
SEED = 7  # of the one world that all are shown in
EPISODES = 100


def cells(budget: str) -> list[Cell]:
    plan, env = PLANS[budget], chapter7.task("matd3 mixed", coupling=3)
    full = [
        chapter7.cell(m, env, "coupling 3, paths", budget, plan) for m in ("merl", "matd3 mixed")
    ]
    partly = plan._replace(frames=PARTLY[budget])
    return [chapter7.cell("merl", env, "coupling 3, paths, partly trained", budget, partly), *full]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return {name: _shown(name, cell[0]) for name, cell in runs.items()}


def _shown(name: str, run: Run) -> dict[str, Any]:
    """One world in full, and the mean of many."""
    env = run.algorithm.env
    shown = env.shown(record(env, run.champion, key=jax.random.key(SEED)))
    return {
        **chapter7.outcome(name, [run]),
        "position": np.round(np.asarray(shown["position"], np.float64), 2).tolist(),
        "poi": np.round(np.asarray(shown["poi"], np.float64), 2).tolist(),
        "observed": np.asarray(shown["observed"][-1]).astype(int).tolist(),
        "activation distance": float(env.activation_distance),
        "size": float(env.size),
    }


def _drawn(name: str, cell: dict[str, Any], dark: bool, prefix: str) -> str:
    return trajectories.trajectories(
        cell["position"],
        cell["poi"],
        np.array(cell["observed"], bool),
        activation_distance=cell["activation distance"],
        size=cell["size"],
        title=name,
        dark=dark,
        prefix=prefix,
    )


def sections(measured: dict[str, Any]) -> list[Any]:
    drawings = [
        Drawing(name, *(_drawn(name, cell, dark, f"t{i}{dark:d}-") for dark in (False, True)))
        for i, (name, cell) in enumerate(measured.items())
    ]
    seen = Table(
        "POIs observed in the world that is drawn",
        ["team", "observed, of 4"],
        [[name, int(sum(cell["observed"]))] for name, cell in measured.items()],
    )
    return [
        *drawings,
        seen,
        chapter7.scores(measured),
        chapter7.about("One run of each, one world for all: a picture, no evidence."),
    ]
