"""A Ray cluster as this process sees it: `pip install credo[ray]`. Nothing here imports JAX."""

import contextlib
import importlib
import importlib.metadata
import math
import os
import signal
import socket
import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

from . import processes

HEAD = 40.0  # seconds without its head after which a cluster is given up; after 60 Ray ends us
STORE = 10**8  # bytes of memory for Ray's objects where this machine is the cluster
TAKEN = ("CREDO_", "JAX_", "XLA_")  # variables of the environment that are so on all nodes
PACKAGES = ("credo", "jax", "jaxlib", "numpy")


class ClusterLost(RuntimeError):
    """There is no Ray, no cluster at an address, or not any more."""


def library(flag: str) -> Any:
    """The package `ray`. Raises `ClusterLost` if it is not installed."""
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise ClusterLost(f"{flag} needs Ray: pip install 'credo[ray]'") from error


@contextlib.contextmanager
def connected(ray: Any, address: str, flag: str, room: float = 0, store: int = STORE) -> Iterator:
    """Use the cluster at an address, or that of $RAY_ADDRESS; without either one of this machine's
    cores, or of `room` if that is more, which ends with the block. One that the caller is connected
    to already is kept. Yields whether no other machine can join.

    **Raises:** `ClusterLost` if nobody answers; `flag` is what led here."""
    if ray.is_initialized():
        yield False
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    how: dict[str, Any] = {"address": address, "logging_level": "WARNING"}
    if address == "local":
        cores = max(processes.others() or len(processes.cores()), math.ceil(room))
        how |= {"num_cpus": cores, "include_dashboard": False, "object_store_memory": store}
        how |= {"logging_level": "ERROR"}  # nobody can reach it whom it might warn of
    before = signal.getsignal(signal.SIGTERM)
    try:
        try:
            if address not in ("local", "auto"):
                _reach(address, 5.0)  # Ray itself would try for minutes
            with processes.roaming(), warnings.catch_warnings():
                warnings.filterwarnings("ignore", "os.fork")  # Ray's fork becomes another program
                ray.init(**how)
        except (OSError, ValueError) as error:
            raise ClusterLost(
                f"no Ray cluster answers at {address}: {error}. Start one (ray start --head), or "
                f"give {flag} ray, and no RAY_ADDRESS, for this machine alone"
            ) from error
        yield address == "local"
    finally:
        ray.shutdown()
        with contextlib.suppress(ValueError):  # in another thread nothing was changed
            signal.signal(signal.SIGTERM, before)


class Head:
    """Whether the head of the cluster is there, and Ray's own process on this machine. Ray itself
    says nothing until it ends the process that asks."""

    def __init__(self, ray: Any):
        self.address = ray.get_runtime_context().gcs_address
        self.asked = time.monotonic()
        self.failing: float | None = None  # since when
        node = getattr(ray._private.worker, "_global_node", None)
        self._store = getattr(node, "plasma_store_socket_name", None)

    def gone(self) -> str:
        """Why Ray would end this process if it was asked for an object, in words; "" if not."""
        if self._store is None:
            return ""
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as store:
                store.connect(self._store)
        except OSError as error:
            return f"Ray has ended on this machine ({error})"
        return ""

    def missing(self) -> str:
        """Why the cluster is given up, in words; "" as long as there is hope."""
        now = time.monotonic()
        if now - self.asked < 1.0:
            return ""
        self.asked = now
        try:
            _reach(self.address, 1.0)
            self.failing = None
        except OSError as error:
            self.failing = self.failing or now
            if now - self.failing > HEAD:
                return (
                    f"the head of the Ray cluster at {self.address} has not answered for "
                    f"{HEAD:.0f} s ({error})"
                )
        return ""


def brief(error: Exception) -> str:
    """An error of Ray's in a line: what was raised on a node comes last, behind its traceback."""
    lines = str(error).strip().splitlines() or [""]
    raised = type(error).__name__.startswith("RayTaskError")
    return lines[-1] if raised else f"{type(error).__name__}: {lines[0]}"


def _reach(address: str, patience: float) -> None:
    """Raise `OSError` if nothing answers at HOST:PORT within so many seconds, and `ValueError` if
    the address is none."""
    host, _, port = address.rpartition(":")
    socket.create_connection((host.strip("[]"), int(port)), timeout=patience).close()


# What processes on the nodes must have as it is here.


def home() -> dict[str, Any]:
    """The folder in which a command was given (`home`), where it finds modules (`path`), variables
    of its environment (`env`), and `versions`."""
    return {
        "home": os.getcwd(),
        "path": [os.path.abspath(entry) for entry in sys.path],
        "env": {name: x for name, x in os.environ.items() if name.startswith(TAKEN)},
        "versions": versions(),
    }


def homeless(there: str) -> str:
    """Why nothing can be done here for a command that was given in a folder, in words; "" if it
    can."""
    if os.path.isdir(there):
        return ""
    return f"has no folder {there}, in which the command was given: all nodes need it"


def other(wanted: Mapping[str, str]) -> str:
    """Which versions are not those that are wanted, in words; "" if all are."""
    pairs = [(name, found, wanted[name]) for name, found in versions().items()]
    differ = [f"{name} {here}, not {there}" for name, here, there in pairs if here != there]
    return f"has {', '.join(differ)}: install the same versions on all nodes" if differ else ""


def versions() -> dict[str, str]:
    """Those that must be the same on all nodes."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def move_in(told: Mapping[str, Any]) -> None:
    """Find modules and files as where the command was given."""
    sys.path[:] = [*told["path"], *(x for x in sys.path if x not in told["path"])]
    os.chdir(told["home"])
