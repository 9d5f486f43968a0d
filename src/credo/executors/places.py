"""The places where runs can be trained. Nothing here imports JAX."""

import dataclasses

from .. import require

KINDS = ("local",)


@dataclasses.dataclass(frozen=True)
class Place:
    """Where runs are trained. Raises `ValueError` for a place that there is not."""

    on: str = "local"
    """Where to train: local, one process for each run on this machine."""

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(
                f"on is {self.on!r}: runs are trained on {', '.join(KINDS)}"
                f"{require.suggestion(self.kind, KINDS)}"
            )

    @property
    def kind(self) -> str:
        """The place without its address."""
        return self.on.partition(":")[0]
