"""Figure 3.7: where a champion writes over 21 signals that flip their sign."""

from .base import Experiment
from .dissertation import told
from .fig_3_4a import deepest
from .fig_3_6 import SHARES, heat_map, writes_on

EXPERIMENT = Experiment(
    **told("fig-3.7"),
    cells=deepest,
    measures=(writes_on([-1.0, 1.0] * 10 + [-1.0]),),
    views=(heat_map(signals_only=True), SHARES),
)
