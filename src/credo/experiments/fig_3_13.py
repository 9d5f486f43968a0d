"""Figure 3.13: recall by gradient, trained in corridors of 10..20 steps, tested in 1..101."""

from .base import Experiment
from .fig_3_10 import VIEWS, sweep
from .fig_3_12 import by_gradient

EXPERIMENT = Experiment(
    published="Figure 3.13 of the dissertation (a curve without numbers): generalization to other "
    "corridors is comparable to that by evolution (Figure 3.10).",
    cells=by_gradient,
    measures=(sweep,),
    views=VIEWS,
)
