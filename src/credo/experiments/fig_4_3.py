"""Figure 4.3: Spread, a learning robot beside a static one."""

from .base import Cell, Experiment
from .fig_4_2 import (
    BUDGETS,
    CURVES,
    SCORES,
    about,
    beside_a_static_robot,
    given,
    levels,
    pictures,
    shares,
)


def cells(budget: str) -> list[Cell]:
    """Spread."""
    return beside_a_static_robot("spread", budget)


EXPERIMENT = Experiment(
    published="Figure 4.3 of the dissertation, 10 runs, mean ± standard error, %: MMU 77.0 ± 0.7 "
    "(FSP) and 75.1 ± 0.6 (RESP) 2-deep, 67.5 ± 0.4 and 63.7 ± 0.3 3-deep; feed-forward 69.3 ± "
    "2.0, 69.4 ± 1.2, 60.0 ± 1.0, 60.0 ± 0.8.",
    cells=cells,
    measures=(levels, shares),
    views=(
        SCORES,
        CURVES,
        pictures,
        about(
            "The dissertation gives 48 % and 33 % for the static robot alone; by its own rules it "
            "observes the reward in 54.2 % and 52.1 % of the trials.",
        ),
    ),
    values=given(
        "Figure 4.3, 10 runs",
        mmu=("77.0 ± 0.7", "75.1 ± 0.6", "67.5 ± 0.4", "63.7 ± 0.3"),
        ff=("69.3 ± 2.0", "69.4 ± 1.2", "60.0 ± 1.0", "60.0 ± 0.8"),
    ),
    budgets=BUDGETS,
)
