"""Figure 6.2: CERL with two learners that fail alone."""

from .base import Cell, Experiment, Value
from .fig_5_3 import BUDGETS, REFERENCES, curves, notes, table
from .fig_6_5 import ATTRIBUTION, MEASURES, cerl, parts, portfolio, tasks
from .views import published

GAMMAS = (0.0, 1.0)
CERL = "cerl of gamma 0 and 1"
HOPPER = {"task": "Hopper-v5"}


def cells(budget: str) -> list[Cell]:
    """The portfolio and its parts."""
    (task,) = tasks(budget, ("Hopper-v5",))
    made = cerl(task, budget, CERL, learners=portfolio(GAMMAS))
    return [made, *parts(task, budget, GAMMAS)]


EXPERIMENT = Experiment(
    published="Figure 6.2 of the dissertation: on Hopper, in 5 million frames, CERL with TD3 at "
    "γ = 0 and γ = 1 reaches 2136 ± 512; each of the two alone, and evolution, stay at 1,000 or "
    "below.",
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    values=[
        *REFERENCES,
        Value(2136.0, "return", "Figure 6.2", HOPPER | {"method": CERL}, "± 512"),
        Value("≤ 1,000", "return", "Figure 6.2", HOPPER),
    ],
    views=(
        curves(**{"published CERL, 5M": published("return", number=True)}),
        table(),
        *ATTRIBUTION,
        notes(),
    ),
)
