"""Where many runs are trained: one call, `run(jobs, workers, on=…)`, for each kind of machine."""

import importlib
from typing import TYPE_CHECKING

from .places import Place as Place

if TYPE_CHECKING:
    from .base import run as run
    from .jobs import Job as Job
    from .jobs import RunsFailed as RunsFailed


def __getattr__(name: str):
    # Workers, which choose their core before JAX is imported, are a module of this package.
    module = {"run": "base", "Job": "jobs", "RunsFailed": "jobs"}.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{module}", __name__), name)
