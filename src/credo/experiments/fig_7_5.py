"""Figure 7.5: paths of teams at coupling 3."""

from collections.abc import Iterable, Sequence

import jax
import numpy as np

from ..report import trajectories
from ..report.rows import Results, Row, Series, rows, series
from ..report.sections import Drawing
from ..rollout import record
from .base import Cell, Experiment, Trained, Value, named
from .dissertation import notes, told
from .fig_7_4 import MEASURES, Plan, cell, rovers, table
from .views import Table, plain, present

PLANS = {
    "smoke": Plan(1_500, 1),
    "quick": Plan(150_000, 1),
    "full": Plan(300_000, 1),
    "published": Plan(2_000_000, 1, 0.1),
}
PARTLY = {"smoke": 1_000, "quick": 25_000, "full": 25_000, "published": 100_000}  # frames
SEED = 7  # of the one world that all are shown in
TEAMS = ("method", "coupling", "training")


def cells(budget: str) -> list[Cell]:
    """MERL partly and fully trained, and MATD3."""
    plan, env = PLANS[budget], rovers("matd3 mixed", coupling=3)
    partly, place = plan._replace(frames=PARTLY[budget]), {"coupling": 3, "paths": True}
    return [
        cell("merl", env, place | {"training": "partly trained"}, budget, partly),
        cell("merl", env, place, budget, plan),
        cell("matd3 mixed", env, place, budget, plan),
    ]


def paths(cell: Trained) -> list[Row | Series]:
    """Where rovers of each run drove in one world (m), and which POIs they observed."""
    key = jax.random.key(SEED)
    worlds = [cell.env.shown(record(cell.env, run.champion, key=key)) for run in cell.runs]
    place = np.round([np.asarray(world["position"], np.float64) for world in worlds], 2)
    poi, steps = np.round(np.asarray(worlds[0]["poi"], np.float64), 2), np.arange(place.shape[1])
    seeds, found = cell.seeds, []
    for axis, name in enumerate(("x", "y")):
        along = np.moveaxis(place[..., axis], 1, 2)  # [runs, rovers, steps]
        found += series(name, "step", steps, along, cell.labels, seed=seeds, rover=None)
        found += rows(f"POI {name}", poi[:, axis], cell.labels, poi=None)
    observed = [np.asarray(world["observed"][-1]).astype(int) for world in worlds]
    found += rows("observed", observed, cell.labels, seed=seeds, poi=None)
    found += rows("activation distance", float(cell.env.activation_distance), cell.labels)
    return found + rows("size", float(cell.env.size), cell.labels)


def drawings(results: Results, values: Sequence[Value]) -> Iterable[Drawing]:
    """The paths of every team, of its first run."""
    for i, team in enumerate(results.cells):
        told = {name: team["labels"].get(name) for name in TEAMS}
        here, title = results.where(**told), named(present(told))
        (xs, ys), (poi_x, poi_y) = (
            (here.array(f"{kind}x", *dims), here.array(f"{kind}y", *dims))
            for kind, dims in (("", ("seed", "rover")), ("POI ", ("poi",)))
        )
        colours = (
            trajectories.trajectories(
                np.stack([xs[0].T, ys[0].T], axis=-1).astype(np.float64),
                np.stack([poi_x, poi_y], axis=-1).astype(np.float64),
                here.array("observed", "seed", "poi")[0].astype(bool),
                activation_distance=here.value("activation distance"),
                size=here.value("size"),
                title=title,
                dark=dark,
                prefix=f"t{i}{dark:d}-",
            )
            for dark in (False, True)
        )
        yield Drawing(title, *colours)


OBSERVED = Table(
    "POIs observed in the world that is drawn", TEAMS, {"observed, of 4": plain("observed", 4)}
)
EXPERIMENT = Experiment(
    **told("fig-7.5"),
    budgets=tuple(PLANS),
    cells=cells,
    measures=(*MEASURES, paths),
    views=(drawings, OBSERVED, table(*TEAMS), notes("rovers", "fig-7.5")),
)
