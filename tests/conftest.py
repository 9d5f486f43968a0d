import os
import signal
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
