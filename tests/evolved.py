"""An algorithm with other settings."""

import dataclasses

from credo.evolution.breeder import evolving


def evolved(algorithm, **changes):
    """The algorithm with other fields, those of its breeder included."""
    return dataclasses.replace(algorithm, **evolving(algorithm.breeder, changes))
