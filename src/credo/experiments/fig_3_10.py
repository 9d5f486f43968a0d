"""Figure 3.10: recall networks trained on corridors of 10..20 steps, tested on 1..101."""

from ..environments.sequence_recall import SequenceRecall
from ..report.rows import Series
from .base import Experiment, Trained
from .fig_3_5a import GAPS, swept, views
from .fig_3_9a import cells

STEPS, SWEEP = "steps per corridor", "success by corridor"


def sweep(trained: Trained) -> list[Series]:
    """Success by the length of corridors. Distances keep the unit of training, or longer corridors
    would look like shorter ones."""
    env = trained.env
    task = SequenceRecall(env.depth, 1, 101, unit=env.unit or env.max_corridor)
    lengths = tuple(dict.fromkeys(max(1, gap) for gap in GAPS[trained.budget]))
    return swept(SWEEP, STEPS, trained, task, lengths)


VIEWS = views(SWEEP, STEPS, "steps", 1)
EXPERIMENT = Experiment(
    published="Figure 3.10 of the dissertation (a curve without numbers): success falls to a "
    "plateau away from the trained 10..20 steps, further the deeper the task. Its corridors of 0 "
    "steps have no junction to turn at: the shortest here has 1 step.",
    cells=cells,
    measures=(sweep,),
    views=VIEWS,
)
