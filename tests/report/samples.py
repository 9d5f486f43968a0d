"""Sections to draw, and a string that tries to be markup."""

import numpy as np

from credo.report.sections import Curve, Figure, HeatMap, Reference, Track, Tracks

HOSTILE = '<script>alert(\'x\')</script> & "$a_$" id="f" </svg> [a](b) ` | {{ 1 }}'


def figure(**changes) -> Figure:
    rng = np.random.default_rng(0)
    curves = [Curve(f"depth {d}", np.arange(30), rng.random((4, 30))) for d in (2, 3)]
    arguments = {
        "title": "Success",
        "x_label": "generation",
        "y_label": "share",
        "curves": curves,
        "references": (Reference("baseline", 0.25), Reference("upper bound", 1.0)),
    }
    return Figure(**(arguments | changes))


def heat_map(**changes) -> HeatMap:
    arguments = {
        "title": "Writes",
        "values": np.linspace(-1.0, 2.0, 15).reshape(3, 5),
        "row_labels": ["a", "b", "c"],
        "column_labels": list("12345"),
        "x_label": "step",
        "y_label": "cell",
    }
    return HeatMap(**(arguments | changes))


def tracks(**changes) -> Tracks:
    arguments = {
        "title": "Walk",
        "tracks": [
            Track("robot", [0, 1, 1, 2], ["", "told", "", ""]),
            Track("static", [0] * 4, (), True),
        ],
        "goals": [0, 2, 1, 1],
        "reached": [True, False, True, False],
        "row_labels": ["a", "b", "c"],
        "column_labels": list("1234"),
        "x_label": "trial",
        "y_label": "endpoint",
        "breaks": (2,),
    }
    return Tracks(**(arguments | changes))
