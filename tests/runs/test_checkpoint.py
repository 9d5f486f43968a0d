import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

from credo.runs import checkpoint
from credo.runs.checkpoint import CheckpointError, DamagedCheckpoint, damage, load, save

COUNTERS = {"frames": 2**70 + 1, "best": 0.1 + 0.2, "worst": float("-inf"), "task": "T-Labyrinth ψ"}
FILES = ["state.safetensors", "counters.json", "COMMIT"]


class Policy(eqx.Module):
    weights: jax.Array
    bias: jax.Array
    rate: float = 0.5
    size: int = eqx.field(static=True, default=3)


def odd_bits() -> np.ndarray:
    """Quiet and signalling NaNs with payloads, both zeros, infinities, the smallest subnormal."""
    bits = [0x7FC00001, 0xFFC12345, 0x7F800001, 0x80000000, 0, 0x7F800000, 0xFF800000, 1]
    return np.array(bits, np.uint32).view(np.float32)


def policy(value: float = 1.0) -> Policy:
    return Policy(jnp.full((3, 2), value, jnp.float32), jnp.arange(3, dtype=jnp.float32))


def everything() -> dict:
    return {
        "policy": policy(),
        "odd": jnp.array(odd_bits()),
        "half": (jnp.array(odd_bits().view(np.uint16)[1::2].view(jnp.bfloat16)), jnp.float16(-0.0)),
        "flags": jnp.array([[True, False]]),
        "counts": [jnp.array([2**32 - 1], jnp.uint32), jnp.array(-(2**31), jnp.int32)],
        "small": [jnp.array([-128], jnp.int8), jnp.array([255], jnp.uint8)],
        "nothing": jnp.zeros((0, 4), jnp.float32),
        "host": np.arange(6, dtype=np.int16).reshape(2, 3).T,
        "keys": jax.random.split(jax.random.key(7), 3),
        "rbg": jax.random.key(8, impl="rbg"),
        "name": "kept",
        "none": None,
    }


def raw(leaf) -> tuple:
    """Everything that must come back, comparable where NaN is not."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return str(leaf.dtype), leaf.shape, np.asarray(jax.random.key_data(leaf)).tobytes()
    return str(leaf.dtype), leaf.shape, np.asarray(leaf).tobytes()


def is_array(leaf) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray)


def assert_same(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (raw(a), isinstance(a, jax.Array)) == (raw(b), True) if is_array(b) else a == b


def names(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def fill(directory: Path, *generations: int, keep: int = 3) -> None:
    for generation in generations:
        save(directory, generation, policy(generation), {"frames": generation}, keep=keep)


def flip(path: Path, position: int, bit: int = 0) -> None:
    data = bytearray(path.read_bytes())
    data[position] ^= 1 << bit
    path.write_bytes(data)


def test_round_trip_is_exact(tmp_path):
    state = everything()
    folder = save(tmp_path / "new" / "checkpoints", 12, state, COUNTERS)
    assert folder == tmp_path / "new" / "checkpoints" / "00000012"
    assert names(folder) == sorted(FILES)
    like = eqx.filter_eval_shape(everything)
    for found in (load(folder.parent, like), load(folder.parent, state, generation=12)):
        assert_same(found.state, state)
        assert (found.generation, found.path) == (12, folder)
        assert repr(found.counters) == repr(COUNTERS)


def test_state_is_a_file_that_the_formats_own_library_reads(tmp_path):
    folder = save(tmp_path, 0, everything(), {})
    arrays = load_file(folder / "state.safetensors")
    assert arrays["['policy'].weights"].tolist() == [[1.0, 1.0]] * 3
    assert arrays["['odd']"].tobytes() == odd_bits().tobytes()
    assert arrays["['keys']"].dtype == np.uint32
    commit = json.loads((folder / "COMMIT").read_text())
    assert commit["files"]["counters.json"]["bytes"] == 2


def test_static_parts_come_from_like(tmp_path):
    save(tmp_path, 0, policy(), {})
    like = Policy(jnp.zeros((3, 2)), jnp.zeros(3), rate=0.25)
    assert load(tmp_path, like).state.rate == 0.25


@pytest.mark.parametrize("tree", [{}, jnp.float32(3.0), {"a": 1.0}])
def test_trees_of_no_array_or_one(tmp_path, tree):
    save(tmp_path, 0, tree, {})
    assert_same(load(tmp_path, tree).state, tree)


@pytest.mark.parametrize("name", FILES)
def test_any_flipped_bit_falls_back_and_is_named(tmp_path, name):
    fill(tmp_path, 1, 2)
    file = tmp_path / "00000002" / name
    whole = file.read_bytes()
    for position in range(len(whole)):
        flip(file, position, bit=position % 8)
        assert damage(file.parent), f"byte {position}"
        file.write_bytes(whole)
    assert damage(file.parent) is None

    flip(file, len(whole) // 2)
    with pytest.warns(DamagedCheckpoint, match=r"00000002 is damaged .* using 00000001 instead"):
        found = load(tmp_path, policy())
    assert found.generation == found.counters["frames"] == 1
    assert_same(found.state, policy(1.0))


def truncate(folder):
    os.truncate(folder / "state.safetensors", 100)


def empty_file(folder):
    os.truncate(folder / "counters.json", 0)


def empty(folder):
    for name in FILES:
        (folder / name).unlink()


def uncommit(folder):
    (folder / "COMMIT").unlink()


def lose(folder):
    (folder / "state.safetensors").unlink()


def rename(folder):
    shutil.rmtree(folder)
    shutil.copytree(folder.with_name("00000001"), folder)


def replace_by_file(folder):
    shutil.rmtree(folder)
    folder.write_text("")


DAMAGES = {
    truncate: "state.safetensors has 100 bytes, COMMIT says",
    empty_file: "counters.json has 0 bytes, COMMIT says 17",
    empty: "the folder is empty",
    uncommit: "has no COMMIT: writing it was never finished",
    lose: "state.safetensors is missing",
    rename: "COMMIT is not as it was written",
    replace_by_file: "cannot be read",
}


@pytest.mark.parametrize("harm", DAMAGES)
def test_damage_is_named_and_the_one_before_used(tmp_path, harm):
    fill(tmp_path, 1, 2)
    harm(tmp_path / "00000002")
    with pytest.warns(DamagedCheckpoint, match=DAMAGES[harm]):
        assert load(tmp_path, policy()).generation == 1
    with pytest.raises(CheckpointError, match=DAMAGES[harm]):
        load(tmp_path, policy(), generation=2)


def test_every_skipped_checkpoint_is_named(tmp_path):
    fill(tmp_path, 1, 2, 3)
    uncommit(tmp_path / "00000003")
    truncate(tmp_path / "00000002")
    with pytest.warns(DamagedCheckpoint) as caught:
        assert load(tmp_path, policy()).generation == 1
    assert ["00000003" in str(w.message) for w in caught] == [True, False]
    assert ["00000002" in str(w.message) for w in caught] == [False, True]


def test_all_damaged_is_an_error_that_lists_each(tmp_path):
    fill(tmp_path, 1, 2, 3)
    for generation, harm in enumerate((truncate, empty, uncommit), 1):
        harm(tmp_path / f"{generation:08d}")
    with pytest.raises(CheckpointError) as error:
        load(tmp_path, policy())
    lines = str(error.value).splitlines()
    assert lines[1:4] == [
        f"  00000003: {damage(tmp_path / '00000003')}",
        f"  00000002: {damage(tmp_path / '00000002')}",
        f"  00000001: {damage(tmp_path / '00000001')}",
    ]


def test_no_checkpoint_is_an_error(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint in"):
        load(tmp_path / "absent", policy())
    fill(tmp_path, 4)
    with pytest.raises(CheckpointError, match=r"no checkpoint of 5 in .* there is 00000004"):
        load(tmp_path, policy(), generation=5)


@pytest.mark.parametrize(
    ("like", "message"),
    [
        (
            Policy(jnp.zeros((2, 3)), jnp.zeros(3)),
            r"1 leaves.*\.weights: found float32\[3, 2\], expected float32\[2, 3\]",
        ),
        (
            Policy(jnp.zeros((3, 2)), jnp.zeros(3, jnp.int32)),
            r"\.bias: found float32\[3\], expected int32\[3\]",
        ),
        (
            Policy(jnp.zeros((3, 2)), jnp.zeros(3), jnp.float32(0)),
            r"\.rate: found no array, expected float32\[\]",
        ),
        (
            Policy(jnp.zeros((3, 2)), None),
            r"\.bias: found float32\[3\], expected no array",
        ),
        ({"other": jnp.zeros(3)}, r"3 leaves differ.*\['other'\]: found no array"),
    ],
)
def test_a_different_structure_is_named_and_never_falls_back(tmp_path, like, message):
    save(tmp_path, 1, like, {})
    save(tmp_path, 2, policy(), {})
    with pytest.raises(CheckpointError, match=f"(?s){message}"):
        load(tmp_path, like)


def test_another_generator_of_keys_is_a_different_dtype(tmp_path):
    save(tmp_path, 0, {"key": jax.random.key(0, impl="rbg")}, {})
    with pytest.raises(CheckpointError, match=r"found key<rbg>\[\], expected key<fry>\[\]"):
        load(tmp_path, {"key": jax.random.key(0)})
    with pytest.raises(CheckpointError, match=r"found key<rbg>\[\], expected uint32\[4\]"):
        load(tmp_path, {"key": jnp.zeros(4, jnp.uint32)})


def test_what_cannot_be_stored_exactly_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"leaf \['clock'\] is float64\[\]"):
        save(tmp_path, 0, {"clock": np.float64(1.0)}, {})
    for counters in ({1: "a"}, {"a": (1, 2)}, {"a": np.float64(0.5)}):
        with pytest.raises(ValueError, match="would come back as"):
            save(tmp_path, 0, {}, counters)
    with pytest.raises(ValueError, match="generation is -1"):
        save(tmp_path, -1, {}, {})
    with pytest.raises(ValueError, match="keep is 0"):
        save(tmp_path, 0, {}, {}, keep=0)
    assert names(tmp_path) == []


def test_64_bits_are_never_narrowed_silently(tmp_path):
    state = {"clock": np.float64(1 / 3)}
    with jax.enable_x64(True):
        save(tmp_path, 0, state, {})
        assert_same(load(tmp_path, state).state, {"clock": jnp.float64(1 / 3)})
    with pytest.raises(CheckpointError, match=r"\['clock'\] is float64\[\]: set jax_enable_x64"):
        load(tmp_path, state)


def test_retention(tmp_path):
    fill(tmp_path, 1, 2, 3, 4, 5, keep=2)
    assert names(tmp_path) == ["00000004", "00000005"]
    fill(tmp_path, 6, keep=1)
    assert names(tmp_path) == ["00000006"]


def test_damaged_ones_do_not_count_as_kept(tmp_path):
    fill(tmp_path, 1, 2, 3, 4, keep=9)
    flip(tmp_path / "00000004" / "state.safetensors", 200)
    uncommit(tmp_path / "00000003")
    fill(tmp_path, 5, keep=2)
    assert names(tmp_path) == ["00000002", "00000003", "00000004", "00000005"]
    fill(tmp_path, 6, keep=2)
    assert names(tmp_path) == ["00000005", "00000006"]


def test_later_ones_stay_when_a_run_goes_back(tmp_path):
    fill(tmp_path, 7, 8, 9)
    fill(tmp_path, 2, 3, keep=1)
    assert names(tmp_path) == ["00000003", "00000007", "00000008", "00000009"]


def test_the_same_generation_again(tmp_path):
    folder = save(tmp_path, 1, policy(1.0), {})
    inode = (folder / "state.safetensors").stat().st_ino
    save(tmp_path, 1, policy(2.0), {})
    assert (folder / "state.safetensors").stat().st_ino == inode
    truncate(folder)
    save(tmp_path, 1, policy(3.0), {})
    assert_same(load(tmp_path, policy()).state, policy(3.0))
    assert names(tmp_path) == ["00000001"]


def test_remains_of_killed_processes_are_ignored_and_then_removed(tmp_path):
    fill(tmp_path, 1)
    for name in (".00000002.partial", ".00000000.removed"):
        shutil.copytree(tmp_path / "00000001", tmp_path / name)
        uncommit(tmp_path / name)
    (tmp_path / ".notes").mkdir()
    assert load(tmp_path, policy()).generation == 1
    fill(tmp_path, 2)
    assert names(tmp_path) == [".notes", "00000001", "00000002"]


class Killed(BaseException):
    """Not an error that anything handles."""


def fail_at(k: int, error: BaseException, patch: pytest.MonkeyPatch) -> list[str]:
    """Make the k-th of the calls that change the disk raise `error`, a write half-way. Killed
    processes change nothing more. Returns a list that names the calls that failed."""
    failed, calls, os_write = [], iter(range(10**9)), os.write

    def failing(name, original):
        def call(*args, **kwargs):
            if name == "open" and not args[1] & os.O_CREAT:
                return original(*args, **kwargs)
            if next(calls) == k or (failed and isinstance(error, Killed)):
                if name == "write" and not failed:
                    os_write(args[0], args[1][: len(args[1]) // 2])
                failed.append(name)
                raise error
            return original(*args, **kwargs)

        return call

    changes = ("mkdir", "open", "write", "fsync", "link", "rename", "replace", "unlink", "rmdir")
    for name in changes:
        patch.setattr(os, name, failing(name, getattr(os, name)))
    return failed


def outcome(action, k: int, error: BaseException) -> tuple[str | None, list[str]]:
    """What `action` raises if its k-th call fails so, and the calls that failed."""
    with pytest.MonkeyPatch.context() as patch:
        failed = fail_at(k, error, patch)
        try:
            action()
        except (CheckpointError, Killed) as raised:
            return str(raised), failed
        return None, failed


def test_killed_at_any_call_leaves_a_good_checkpoint(tmp_path):
    fill(tmp_path / "start", 1, 2)
    uncommit(tmp_path / "start" / "00000002")  # to be replaced: the longest way
    used = []
    for k in range(100):
        directory = tmp_path / str(k)
        shutil.copytree(tmp_path / "start", directory)
        action = lambda to=directory: save(to, 2, policy(2.0), {}, keep=1)  # noqa: E731
        _, failed = outcome(action, k, Killed())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DamagedCheckpoint)
            found = load(directory, policy())
        assert_same(found.state, policy(float(found.generation)))
        used.append(found.generation)
        save(directory, 3, policy(3.0), {}, keep=1)
        assert names(directory) == ["00000003"]
        if not failed:
            break
    assert used == sorted(used)
    assert (used.count(1) > 10, used.count(2) > 3) == (True, True)


def test_killed_while_removing_old_ones_leaves_none_that_looks_damaged(tmp_path):
    removing = 0
    for k in range(100):
        directory = tmp_path / str(k)
        fill(directory, 1, 2)
        action = lambda to=directory: save(to, 3, policy(3.0), {}, keep=1)  # noqa: E731
        _, failed = outcome(action, k, Killed())
        folders = [path for path in directory.iterdir() if not path.name.startswith(".")]
        assert [damage(folder) for folder in folders] == [None] * len(folders)
        if not failed:
            break
        removing += (directory / ".00000001.removed").exists()
    assert names(directory) == ["00000003"]
    assert removing > 2


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_disk_that_fails_at_any_call(tmp_path, number):
    """Full disk, full quota, broken disk: a clear error, no debris, older ones intact."""
    messages = []
    for k in range(100):
        directory = tmp_path / str(k)
        fill(directory, 1, 2)
        action = lambda to=directory: save(to, 3, policy(3.0), {"frames": 3})  # noqa: E731
        message, failed = outcome(action, k, OSError(number, os.strerror(number)))
        there = names(directory)
        if message is None:
            # "mkdir" of a folder that exists may fail as it likes.
            assert (failed in ([], ["mkdir"]), there[-1]) == (True, "00000003")
        else:
            messages.append(message)
            # The last call of all syncs a checkpoint that is complete.
            assert there[:2] == ["00000001", "00000002"]
            assert there[2:] in ([], ["00000003"])
        newest = load(directory, policy())
        assert newest.generation == len(there)
        assert_same(newest.state, policy(float(newest.generation)))
        if not failed:
            break
    assert len(messages) > 10
    for message in messages:
        assert os.strerror(number) in message
        assert ("bytes, and" in message) == (number != errno.EIO)


def test_full_disk_says_how_much_is_needed(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=1234)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    fail_at(4, OSError(errno.ENOSPC, "full"), monkeypatch)
    with pytest.raises(CheckpointError) as error:
        save(tmp_path, 1, jnp.zeros(10_000), {})
    monkeypatch.undo()
    folder = save(tmp_path, 1, jnp.zeros(10_000), {})
    needed = sum((folder / name).stat().st_size for name in FILES[:2])
    assert needed > 40_000
    assert f"{needed:,} bytes, and 1,234 are free in {tmp_path}" in str(error.value)


def test_the_systems_own_limit(tmp_path):
    """A real refusal by the kernel, not a patched one: no file may pass 4 KiB."""
    fill(tmp_path, 1)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
        with pytest.raises(CheckpointError, match="File too large"):
            save(tmp_path, 2, jnp.zeros(10_000), {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert names(tmp_path) == ["00000001"]
    assert load(tmp_path, policy()).generation == 1


FULL = """
import sys
import numpy as np
from pathlib import Path
from credo.runs.checkpoint import CheckpointError, load, save
directory = Path(sys.argv[1])
save(directory, 1, np.arange(5000, dtype=np.int32), {})
try:
    save(directory, 2, np.arange(50000, dtype=np.int32), {})
except CheckpointError as error:
    print(error)
print([path.name for path in directory.iterdir()])
print(load(directory, np.zeros(5000, np.int32)).state.sum())
"""


def test_a_disk_that_is_really_full(tmp_path):
    """On a file system of 128 KiB, where the system lets a user mount one."""
    mount = f"mount -t tmpfs -o size=128k none {tmp_path}"
    if subprocess.run(["unshare", "-rm", "sh", "-c", mount], capture_output=True).returncode:
        pytest.skip("cannot mount a small file system here")
    command = ["unshare", "-rm", "sh", "-c", f'{mount} && exec "$@"', "sh"]
    command += [sys.executable, "-c", FULL, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    message, left, total = done.stdout.strip().splitlines()
    assert "No space left on device" in message
    assert "it needs 200," in message
    assert (left, total) == ("['00000001']", str(sum(range(5000))))


def test_policy_file_round_trip(tmp_path):
    path = tmp_path / "run" / "champion.safetensors"
    metadata = {"config": json.dumps({"name": "ψ", "γ": 0.99}), "empty": ""}
    checkpoint.export_policy(path, policy(1.0), metadata)
    state = everything()
    checkpoint.export_policy(path, state, metadata)
    assert_same(checkpoint.import_policy(path, eqx.filter_eval_shape(everything)), state)
    assert checkpoint.read_metadata(path) == metadata
    assert names(path.parent) == ["champion.safetensors"]
    assert load_file(path)["['policy'].bias"].tolist() == [0.0, 1.0, 2.0]


def test_policy_file_notices_any_flipped_bit(tmp_path):
    path = tmp_path / "champion.safetensors"
    checkpoint.export_policy(path, {"a": jnp.ones(2), "key": jax.random.key(0)}, {"name": "x"})
    whole = path.read_bytes()
    start = 8 + int.from_bytes(whole[:8], "little")
    # Blanks pad the header: only there does a bit mean nothing.
    text = len(whole[:start].rstrip(b" "))
    for position in [*range(text), *range(start, len(whole))]:
        flip(path, position, bit=position % 8)
        with pytest.raises(CheckpointError, match=r"damaged|cannot read"):
            checkpoint.read_metadata(path)
        path.write_bytes(whole)
    for size in range(0, len(whole), 7):
        path.write_bytes(whole[:size])
        with pytest.raises(CheckpointError, match="damaged"):
            checkpoint.import_policy(path, {})


def test_policy_file_errors(tmp_path):
    path = tmp_path / "champion.safetensors"
    with pytest.raises(CheckpointError, match="cannot read"):
        checkpoint.import_policy(path, policy())
    checkpoint.export_policy(path, policy())
    with pytest.raises(CheckpointError, match=r"\.weights: found float32\[3, 2\], expected float"):
        checkpoint.import_policy(path, Policy(jnp.zeros(1), jnp.zeros(3)))
    for metadata in ({"credo.x": "a"}, {"a": 1}):
        with pytest.raises(ValueError, match="values must be strings"):
            checkpoint.export_policy(path, policy(), metadata)


def test_policy_file_survives_a_full_disk(tmp_path):
    path = tmp_path / "champion.safetensors"
    checkpoint.export_policy(path, policy(1.0))
    action = lambda: checkpoint.export_policy(path, policy(2.0))  # noqa: E731
    failures = 0
    for k in range(100):
        message, failed = outcome(action, k, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        assert names(tmp_path) == ["champion.safetensors"]
        assert checkpoint.import_policy(path, policy()).weights[0, 0] in (1.0, 2.0)
        if not failed:
            break
        assert failed == ["mkdir"] or "No space left on device" in (message or "")
        failures += 1
    assert failures > 5
    assert_same(checkpoint.import_policy(path, policy()), policy(2.0))


SEALS = {
    "record": "ab" * 32,
    "metrics.csv": {"bytes": 2**40, "sha256": "cd" * 32},
    "odd": [0.1, None],
}


def test_seals_come_back_and_are_checked(tmp_path):
    for generation in (1, 2, 3):
        save(tmp_path, generation, policy(generation), {}, seals=SEALS | {"g": generation})
    assert load(tmp_path, policy()).seals == SEALS | {"g": 3}
    asked = []

    def check(generation: int, seals: dict) -> str | None:
        asked.append((generation, seals["g"], seals == SEALS | {"g": generation}))
        return None if generation == 1 else f"it belongs to {seals['g']}"

    with pytest.warns(
        DamagedCheckpoint, match=r"0000000[23] is damaged \(it belongs to [23]\): us"
    ):
        assert load(tmp_path, policy(), check=check).generation == 1
    assert asked == [(3, 3, True), (2, 2, True), (1, 1, True)]
    with pytest.raises(CheckpointError, match=r"(?s)no intact.*00000001: no good.*copy"):
        load(tmp_path, policy(), generation=1, check=lambda *_: "no good")


def test_without_seals_there_are_none(tmp_path):
    """As in checkpoints of older versions, whose COMMIT has the same bytes."""
    folder = save(tmp_path, 1, policy(), {})
    files = {name: checkpoint._fingerprint(folder / name) for name in FILES[:2]}
    expected = json.dumps({"generation": 1, "files": files}, indent=2, sort_keys=True)
    assert (folder / "COMMIT").read_text() == expected
    assert load(tmp_path, policy(), check=lambda g, seals: None if seals == {} else "x").seals == {}


def test_any_flipped_bit_of_the_seals_is_noticed(tmp_path):
    folder = save(tmp_path, 1, policy(), {}, seals=SEALS)
    whole = (folder / "COMMIT").read_bytes()
    for position in range(0, len(whole), 3):
        flip(folder / "COMMIT", position, bit=position % 8)
        assert damage(folder), f"byte {position}"
        (folder / "COMMIT").write_bytes(whole)
    assert damage(folder) is None


def test_the_same_generation_again_gets_its_new_seals(tmp_path):
    folder = save(tmp_path, 1, policy(1.0), {}, seals={"record": "a"})
    inode = (folder / "state.safetensors").stat().st_ino
    save(tmp_path, 1, policy(1.0), {}, seals={"record": "b"})
    assert load(tmp_path, policy()).seals == {"record": "b"}
    assert (folder / "state.safetensors").stat().st_ino == inode
    assert names(folder) == sorted(FILES)


def test_seals_are_plain(tmp_path):
    with pytest.raises(ValueError, match=r"seals \{'a': \(1, 2\)\} would come back as"):
        save(tmp_path, 1, {}, {}, seals={"a": (1, 2)})


def put_link(path: Path) -> None:
    path.symlink_to(path.parent.parent / "elsewhere")


def put_dangling_link(path: Path) -> None:
    path.symlink_to("nowhere")


def put_file(path: Path) -> None:
    path.write_text("")


def put_folder(path: Path) -> None:
    path.mkdir()
    (path / "link").symlink_to("/")


def put_pipe(path: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize("put", [put_link, put_dangling_link, put_file, put_folder, put_pipe])
@pytest.mark.parametrize("name", ["00000002", "00000005", ".00000005.partial", ".00000001.removed"])
def test_nothing_among_checkpoints_jams_a_save(tmp_path, put, name):
    directory, elsewhere = tmp_path / "checkpoints", tmp_path / "elsewhere"
    fill(elsewhere, 2)
    fill(directory, 1, 3, 4, keep=9)
    put(directory / name)
    for generation in (5, 6, 7, 8):
        fill(directory, generation, keep=2)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert load(directory, policy()).generation == generation
    assert names(directory) == ["00000007", "00000008"]
    assert names(elsewhere) == ["00000002"]
    assert damage(elsewhere / "00000002") is None


def test_what_cannot_be_removed_is_a_warning(tmp_path, monkeypatch):
    fill(tmp_path, 1, 2)
    (tmp_path / ".00000000.removed").mkdir()

    def refuse(path, *_, **__):
        raise OSError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(shutil, "rmtree", refuse)
    with pytest.warns(UserWarning, match=r"cannot remove .*: .*Permission denied") as caught:
        fill(tmp_path, 3, keep=1)
    told = [str(warning.message) for warning in caught]
    assert [".00000000.removed" in told[0], ".00000002.removed" in told[1]] == [True, True]
    monkeypatch.undo()
    assert load(tmp_path, policy()).generation == 3
    fill(tmp_path, 4, keep=1)
    assert names(tmp_path) == ["00000004"]


def test_a_pipe_is_damage_and_waited_for_by_nobody(tmp_path):
    fill(tmp_path, 1, 2)
    for name in FILES:
        path = tmp_path / "00000002" / name
        whole = path.read_bytes()
        path.unlink()
        os.mkfifo(path)
        assert "is no regular file" in str(damage(path.parent)) or "0 bytes" in str(
            damage(path.parent)
        )
        path.unlink()
        path.write_bytes(whole)
    os.mkfifo(tmp_path / "champion.safetensors")
    with pytest.raises(CheckpointError, match=r"cannot read .* is no regular file"):
        checkpoint.read_metadata(tmp_path / "champion.safetensors")


def test_a_huge_file_is_damage_that_nobody_reads(tmp_path):
    fill(tmp_path, 1)
    for name in FILES:
        folder = save(tmp_path, 2, policy(), {})
        os.truncate(folder / name, 2**43)
        assert "8,796,093,022,208" in str(damage(folder)).replace(str(2**43), f"{2**43:,}")
        files_left = load(tmp_path, policy(), generation=1)
        assert files_left.generation == 1


@pytest.mark.parametrize(
    "name", [".champion.safetensors.draft.safetensors", "champion.safetensors"]
)
def test_a_policy_is_written_through_no_link(tmp_path, name):
    (tmp_path / "run").mkdir()
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "run" / name).symlink_to(tmp_path / "precious")
    checkpoint.export_policy(tmp_path / "run" / "champion.safetensors", policy())
    assert (tmp_path / "precious").read_text() == "precious"
    assert names(tmp_path / "run") == ["champion.safetensors"]


LIMITED = """
import resource, sys
import numpy as np
from pathlib import Path
from credo.runs import checkpoint
from credo.report.pages import write as write_page
from credo.report.sections import Page
directory = Path(sys.argv[1])
empty = Page("title", "lead", "command", [])

def save(): checkpoint.save(directory / "checkpoints", 2, np.arange(50000), {}, seals={"a": 1})
def export(): checkpoint.export_policy(directory / "champion.safetensors", np.arange(50000))
def write(): write_page(Page("title", "lead" * 20000, "command", []), directory / "page.html")

checkpoint.save(directory / "checkpoints", 1, np.arange(5, dtype=np.int32), {})
checkpoint.export_policy(directory / "champion.safetensors", np.arange(5, dtype=np.int32))
write_page(empty, directory / "page.html")
before = {path: path.read_bytes() for path in sorted(directory.rglob("*")) if path.is_file()}
resource.setrlimit(resource.RLIMIT_FSIZE, (60000, 60000))
for action in (save, export, write):
    try:
        action()
    except (checkpoint.CheckpointError, OSError) as error:
        print(error)
after = {path: path.read_bytes() for path in sorted(directory.rglob("*")) if path.is_file()}
print(before == after, len(before))
"""


def test_where_no_file_may_grow_what_was_there_stays(tmp_path):
    """The kernel's own refusal of a checkpoint, a champion and a page."""
    code = LIMITED.replace("np.arange(50000)", "np.arange(50000, dtype=np.int32)")
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    told = done.stdout.splitlines()
    assert [Path(tmp_path, "checkpoints", "00000002").name in told[0], len(told)] == [True, 4]
    for line, file in zip(
        told, ("state.safetensors", "champion.safetensors", "page.html"), strict=False
    ):
        assert "[Errno 27] File too large" in line
        assert file in line
    assert "then resume; older checkpoints are intact." in told[0]
    assert told[3] == "True 5"
