import os
import signal
import subprocess
import tempfile

# Tests run one worker per core: one thread each, and programs compiled for speed of compiling.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false --xla_backend_optimization_level=0"
)

import jax
import pytest

from credo import compilation

# Where tests are started by `nohup` or in the background, what they start would ignore these.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)

compilation.enable_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Runs are signed with a key in the user's own folder: here one for all tests of a process.
settings = tempfile.TemporaryDirectory(prefix="credo-tests-")
os.environ["XDG_CONFIG_HOME"] = settings.name


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Compiled programs of all modules would fill gigabytes."""
    yield
    jax.clear_caches()


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Three nodes on this machine: a head that does nothing, and two with a core each."""
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # or it writes a token into the home
    monkeypatch.chdir(tmp_path)
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(2):
            made.add_node(num_cpus=1)
        yield made
    finally:
        made.shutdown()
        assert parent_of_all("raylet") == []


def parent_of_all(name):
    """Processes below this one whose program has a name."""
    found = subprocess.run(["ps", "-eo", "pid,ppid,comm"], capture_output=True, text=True).stdout
    lines = [line.split(maxsplit=2) for line in found.splitlines()[1:]]
    return [int(pid) for pid, parent, comm in lines if comm == name and int(parent) == os.getpid()]
