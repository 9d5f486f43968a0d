"""Colours and dashes: of the page, by theme, and of methods, the same on every page."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

STATIC = Path(__file__).parent / "static"


@dataclass(frozen=True)
class Theme:
    """Colours. The curves are those of Okabe & Ito (2008) without the yellow, told apart by the
    colour-blind; on a dark page the same hues, lighter."""

    ink: str
    muted: str
    grid: str
    page: str
    box: str  # behind commands and the heads of tables
    cold: str  # lowest value of a heat map with both signs
    warm: str  # highest value
    curves: tuple[str, ...]

    @property
    def rc(self) -> dict[Any, Any]:
        """Settings of matplotlib: those of all figures, in these colours."""
        file = STATIC / "figure.mplstyle"
        colors = {
            "axes.edgecolor": self.muted,
            "axes.labelcolor": self.ink,
            "axes.titlecolor": self.ink,
            "grid.color": self.grid,
            "legend.labelcolor": self.ink,
        }
        colors |= {f"{axis}tick.color": self.muted for axis in "xy"}
        colors |= {f"{axis}tick.labelcolor": self.ink for axis in "xy"}
        return dict(matplotlib.rc_params_from_file(file, use_default_template=False)) | colors


LIGHT = Theme(
    ink="#1c1f23",
    muted="#59616b",
    grid="#e6e9ec",
    page="#ffffff",
    box="#f5f6f8",
    cold="#005b96",
    warm="#c24a00",
    curves=("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#333333"),
)
DARK = Theme(
    ink="#e4e7eb",
    muted="#a0a8b2",
    grid="#2b3037",
    page="#14171b",
    box="#1d2127",
    cold="#58b2f0",
    warm="#f08a4b",
    curves=("#4aa3e6", "#f07f3c", "#22bd8f", "#e097c2", "#f2b441", "#93d3f7", "#e8e8e8"),
)
DASHES = ((1.0, 0.0), (6.0, 1.6), (6.0, 1.5, 1.3, 1.5), (1.3, 1.3))  # in widths of the line


class Look(NamedTuple):
    """How a curve looks in every theme: indices of a colour among a theme's `curves`, and of
    `DASHES`."""

    color: int
    dash: int


# No two methods look the same, and those that are often compared differ in colour.
_GRID = (  # a row for each of the first dashes, a column for each colour
    ("dmmu", "erl", "mmu", "cerl", "lstm", "gru", "merl"),
    ("td3", "cnf", "neuroevolution", "lstmsm", "sac", "ddpg", "ppo"),
    ("bptt", "rnn", "ea", "ccea", "matd3", "maddpg", "mlp"),
)
METHODS = {
    name: Look(color, dash) for dash, row in enumerate(_GRID) for color, name in enumerate(row)
}
ALIASES = {
    "gradient": "bptt",
    "evolution": "neuroevolution",
    "ff": "mlp",
    "feed": "mlp",
    "hybrid": "erl",
    "learner": "sac",
}


def method(label: str) -> str | None:
    """The first known method that a label names, in any spelling of case: "erl" of "ERL: 10
    policies". None if there is none."""
    words = (ALIASES.get(word, word) for word in re.findall(r"\w+", label.lower()))
    return next((word for word in words if word in METHODS), None)


def assign(labels: Iterable[str]) -> Mapping[str, Look]:
    """How the curves of a page look, by label.

    A label that names a method looks as that method does on every page; any other, and a second of
    the same method, as nothing else on this page, in the colour that is used least. The same labels
    look the same. There are 28 looks; of more curves than that, some look alike.
    """
    names = list(dict.fromkeys(labels))
    looks: dict[str, Look] = {}
    for name in sorted(names, key=lambda name: name.lower() not in METHODS):  # exact ones first
        known = METHODS.get(method(name) or "")
        if known is not None and known not in looks.values():
            looks[name] = known
    colors, dashes = len(LIGHT.curves), len(DASHES)
    every = [Look(i % colors, i % dashes) for i in range(colors * dashes)]
    for name in names:
        if name not in looks:  # of the rarest colour; more than there are begin again
            used = Counter(look.color for look in looks.values())
            free = [look for look in every if look not in looks.values()] or every
            looks[name] = min(free, key=lambda look: used[look.color])
    return {name: looks[name] for name in names}
