"""What is done in processes of Ray, on the nodes of a cluster. JAX is not imported there, but in
their children, which train."""

import json
import os
import pathlib
import socket
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

from ..environments import cluster
from ..environments.processes import Child
from ..runs.lock import RunLocked, lock
from . import worker
from .worker import SAVE


def train(message: str, mark: str, setup: Mapping[str, Any]) -> dict[str, Any]:
    """Train the job of a message in a worker; its answer. After `ray.cancel` it is saved first.

    `mark`: as of `blind`. `setup`: what `cluster.home` says, and a worker's `arguments`.
    """
    if why := blind(mark, setup["home"]):
        return {"error": f"node {socket.gethostname()} {why}"}
    cluster.move_in(setup)
    options = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    options |= {"env": os.environ | setup["env"]}
    process = Child(worker.__name__, *setup["arguments"], grace=SAVE, opening=True, **options)
    try:
        answer, _ = process.communicate(message + "\n")
    except KeyboardInterrupt:
        process.terminate()
        answer, _ = process.communicate()
    finally:
        process.end(0.0)
    ended = f"its process ended with exit code {process.returncode}"
    return json.loads(answer) if answer else {"error": ended}


def look(marks: Sequence[str], home: str, wanted: Mapping[str, str]) -> str:
    """Why runs cannot be trained on this node as where the command was given, whose versions are
    `wanted`, in words; "" if they can."""
    if other := cluster.other(wanted):
        return other
    return next(filter(None, (blind(mark, home) for mark in marks)), "")


def blind(mark: str, home: str) -> str:
    """Why this node cannot train runs that lie beside `mark`, a folder that the command made and
    holds the lock of, in words; "" if it can."""
    folder = os.path.dirname(mark)
    if why := cluster.homeless(home):
        return why
    if not os.path.isdir(mark):
        return (
            f"does not see what the command writes into {folder}: runs must be on storage that all "
            "nodes have under the same name, such as NFS; choose a folder there"
        )
    try:
        with lock(pathlib.Path(mark)):
            return (
                f"does not see that the command locked a file in {folder}: two nodes could train "
                "one run at once: mount the storage so that locks hold between nodes (Lustre with "
                "flock, NFS without nolock and local_lock)"
            )
    except RunLocked:
        return ""
