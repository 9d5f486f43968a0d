"""What a process may still take is the least of several limits, each of which is looked at."""

import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import memory
from credo.normalization import seen
from credo.replay import Replay, row_bytes, shapes_alone
from credo.types import Transition

GIB = 2**30


def kernel(root, files: dict[str, str]):
    """A /proc and /sys with these files."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_what_the_machine_has_to_give(tmp_path):
    root = kernel(tmp_path, {"proc/meminfo": "MemTotal: 9000 kB\nMemAvailable:   5000 kB\n"})
    assert memory.available(root) == 5000 * 1024


def test_a_container_of_version_2_and_the_group_around_it(tmp_path):
    group = "sys/fs/cgroup/pod/box"
    files = {
        "proc/self/cgroup": "0::/pod/box\n",
        f"{group}/memory.max": "max\n",
        f"{group}/memory.current": "70\n",
        "sys/fs/cgroup/pod/memory.max": "1000\n",
        "sys/fs/cgroup/pod/memory.current": "800\n",
        "sys/fs/cgroup/pod/memory.stat": "anon 500\ninactive_file 300\n",
    }
    assert memory.available(kernel(tmp_path, files)) == 1000 - 800 + 300
    (tmp_path / group / "memory.max").write_text("90\n")
    assert memory.available(tmp_path) == 90 - 70


def test_a_container_of_version_1_that_cannot_see_its_own_name(tmp_path):
    files = {
        "proc/self/cgroup": "4:memory:/docker/abc\n3:cpu:/docker/abc\n",
        "sys/fs/cgroup/memory/memory.limit_in_bytes": "4096\n",
        "sys/fs/cgroup/memory/memory.usage_in_bytes": "96\n",
    }
    assert memory.available(kernel(tmp_path, files)) == 4000


@pytest.fixture
def small_address_space():
    """Room for less than two gigabytes more."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = 1024 * memory._number(memory.pathlib.Path("/proc/self/status"), "VmSize:", 0)
    resource.setrlimit(resource.RLIMIT_AS, (int(used) + 2 * GIB, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def image(dtype: str) -> Transition:
    obs, off = jnp.zeros(84 * 84 * 4, dtype), jnp.bool_(False)
    return Transition(obs, jnp.zeros(1), {"reward": jnp.float32(0)}, obs, off, off)


def test_a_buffer_larger_than_the_process_may_be_is_refused_in_a_sentence(small_address_space):
    row = image("float32")
    with pytest.raises(ValueError, match=r"30,000 transitions needs [\d,]+ bytes") as caught:
        Replay.empty(row, 30_000)
    most = int(str(caught.value).partition("at most ")[2].partition(";")[0].replace(",", ""))
    assert 0 < most * row_bytes(row) <= 2 * GIB
    with shapes_alone():
        assert jax.eval_shape(lambda: Replay.empty(row, 30_000)).capacity == 30_000


def test_bytes_stay_bytes_and_are_numbers_for_a_learner():
    row = image("uint8")
    assert row_bytes(row) < row_bytes(image("float32")) / 3.9
    rows = jax.tree.map(lambda x: jnp.ones((2, *x.shape), x.dtype), row)
    replay = Replay.empty(row, 4).extend(rows, jnp.ones(2, bool))
    assert replay.data.obs.dtype == replay.data.next_obs.dtype == np.uint8
    drawn, _ = replay.sample(3, key=jax.random.key(0))
    assert drawn.obs.dtype == np.uint8
    assert seen(None, drawn.obs).dtype == np.float32
    np.testing.assert_array_equal(seen(None, drawn.obs), 1.0)
