"""Figure 3.7: where a champion writes over 21 signals that flip their sign."""

from .base import Experiment
from .fig_3_4a import deepest
from .fig_3_6 import SHARES, heat_map, writes_on

EXPERIMENT = Experiment(
    published="Figure 3.7 of the dissertation: over -1, +1, -1, … one cell is written at each -1 "
    "and another at each +1; distractors, which write nothing, are left out.",
    cells=deepest,
    measures=(writes_on([-1.0, 1.0] * 10 + [-1.0]),),
    views=(heat_map(signals_only=True), SHARES),
)
