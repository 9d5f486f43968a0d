"""Figure 3.13: recall by gradient, trained in corridors of 10..20 steps, tested in 1..101."""

from .base import Experiment
from .dissertation import told
from .fig_3_10 import VIEWS, sweep
from .fig_3_12 import by_gradient

EXPERIMENT = Experiment(**told("fig-3.13"), cells=by_gradient, measures=(sweep,), views=VIEWS)
