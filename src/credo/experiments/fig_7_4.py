"""Figure 7.4: the rover domain at couplings 1 to 7."""

from typing import Any

from . import chapter7
from .base import Cell
from .chapter7 import METHODS, Plan

TITLE = "rover domain, coupling 1 to 7"
PUBLISHED = (
    "Figure 7.4 of the dissertation (curves without numbers): MERL is best at every coupling and "
    "still learns beyond 6, the baselines degrade beyond 2. The author's logs: at coupling 4 MERL "
    "0.46 and EA about 0, at coupling 5 MERL 0.43."
)
BUDGETS = chapter7.BUDGETS
PLANS = {
    "smoke": Plan(1_500, 2),
    "quick": Plan(150_000, 2),
    "full": Plan(300_000, 3),
    "published": Plan(2_000_000, 5, 0.1),
}
COUPLINGS = {"smoke": (2,), "quick": (1, 2, 4, 7)}
CODED = "author's dynamics"
LOGGED = {"merl": "0.46 (author's logs)", "ea": "0.00 (author's logs)"}


def cells(budget: str) -> list[Cell]:
    """Every method at every coupling, 2n rovers and 4 POIs; and coupling 4 as the author coded it:
    half the speed, turns of 90 degrees, his starts and local reward; with and without his
    sensors, that have no upper limit."""
    found = [
        chapter7.cell(
            method,
            chapter7.task(method, coupling=coupling),
            f"coupling {coupling}",
            budget,
            PLANS[budget],
        )
        for coupling in COUPLINGS.get(budget, range(1, 8))
        for method in METHODS
        if method not in ("td3 mixed", "td3 global")
    ]
    coded = {"motion": "as-coded", "start": "as-coded", "local": "closeness"}
    sensors = {"observation": "as-coded"}
    return found + [
        chapter7.cell(
            method,
            chapter7.task(method, coupling=4, **coded | extra),
            f"coupling 4, {where}",
            budget,
            PLANS[budget],
        )
        for where, extra in ((CODED, {}), (f"{CODED} and sensors", sensors))
        for method in ("merl", "ea", "td3 local")
    ]


measure = chapter7.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    published = {
        f"{method}, {where}": text
        for method, text in LOGGED.items()
        for where in ("coupling 4", f"coupling 4, {CODED}", f"coupling 4, {CODED} and sensors")
    } | {"merl, coupling 5": "0.43 (author's logs)"}
    return [
        chapter7.scores(measured, published),
        *chapter7.curves(measured),
        chapter7.about(
            "The author's logs are of his dynamics, in which every rover drives at half the speed "
            "whatever it says, with γ 0.5 for MERL and 0.97 for the baselines. His sensors show "
            "1/d², up to 10^6: our critics of rectified units diverge on them, his had tanh. "
            "The dissertation's budget is 2M frames, the budget `published` here. The local reward "
            "is progress towards the closest POI that is left; with the dissertation's, the "
            "distance to the closest POI, see docs/merl.md. Tables show medians and ranges over "
            "runs; the dissertation has means and 95 % intervals of five.",
        ),
    ]
