"""Figure 3.10: recall networks trained on corridors of 10..20 steps, tested on 1..101."""

from ..environments.sequence_recall import SequenceRecall
from ..report.rows import Series
from .base import Experiment, Trained
from .dissertation import told
from .fig_3_5a import GAPS, swept, views
from .fig_3_9a import cells

SWEEP = "success by corridor", "steps per corridor"


def sweep(trained: Trained) -> list[Series]:
    """Success by the length of corridors. Distances keep the unit of training, or longer corridors
    would look like shorter ones."""
    env = trained.env
    task = SequenceRecall(env.depth, 1, 101, unit=env.unit or env.max_corridor)
    lengths = tuple(dict.fromkeys(max(1, gap) for gap in GAPS[trained.budget]))
    return swept(SWEEP, trained, task, lengths)


VIEWS = views(SWEEP, "steps", 1)
EXPERIMENT = Experiment(**told("fig-3.10"), cells=cells, measures=(sweep,), views=VIEWS)
