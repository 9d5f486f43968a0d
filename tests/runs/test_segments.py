import errno
import itertools
import json
import os
import shutil
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from test_checkpoint import Killed, assert_same, flip, names, outcome

from credo import replay
from credo.replay import Replay
from credo.runs import checkpoint, segments
from credo.runs.checkpoint import CheckpointError, DamagedCheckpoint, damage, load, save
from credo.types import Transition

CAPACITY = 40
ROWS = 2000  # that a test ever writes


@pytest.fixture(autouse=True)
def _ten_rows_a_part(monkeypatch):
    monkeypatch.setattr(segments, "BYTES", 210)
    monkeypatch.setattr(checkpoint, "_seen", {})


def written_rows(seed: int) -> dict[str, np.ndarray]:
    """Any bits, NaNs with payloads too; 21 bytes a row."""
    bits = np.random.default_rng(seed).integers(0, 256, (ROWS, 20), np.uint8)
    bits[:, 11] |= bits[:, 0] & 0x7F  # some exponents full
    return {
        "obs": bits[:, :12].copy().view(np.float32),
        "half": bits[:, 12:14].copy().view(jnp.bfloat16)[:, 0],
        "count": bits[:, 14:18].copy().view(np.int32)[:, 0],
        "small": bits[:, 18:20].copy().view(np.int8)[:, :, None],
        "done": bits[:, 0] > 127,
        "nothing": np.zeros((ROWS, 0), np.float32),
    }


def filled(written: int, capacity: int = CAPACITY, seed: int = 0) -> dict:
    """A state whose buffer had its first `written` rows written one after the other."""

    def ring(rows: np.ndarray) -> jax.Array:
        data = np.zeros((capacity, *rows.shape[1:]), rows.dtype)
        for row in range(max(0, written - capacity), written):
            data[row % capacity] = rows[row]
        return jnp.array(data)

    data = jax.tree.map(ring, written_rows(seed))
    return {"buffer": Replay(data, jnp.int32(written)), "weights": jnp.full(3, written, jnp.int32)}


def like(state: dict) -> dict:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)


def parts(folder: Path) -> list[Path]:
    return sorted(folder.glob("replay*"))


def ranges(folder: Path) -> list[tuple[int, int]]:
    return [(int(path.name[8:20]), int(path.name[21:33])) for path in parts(folder)]


def assert_loads(directory: Path, state: dict, **options) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", DamagedCheckpoint)
        assert_same(load(directory, like(state), **options).state, state)


@pytest.mark.parametrize("capacity", [1, 7, 25, 40])
@pytest.mark.parametrize("written", [0, 1, 9, 10, 11, 25, 39, 40, 41, 1234])
def test_round_trip_is_exact(tmp_path, capacity, written):
    state = filled(written, capacity)
    folder = save(tmp_path, 1, state, {})
    found = ranges(folder)
    assert [row for start, stop in found for row in range(start, stop)] == list(
        range(max(0, written - capacity), written)
    )
    assert all(start // 10 == (stop - 1) // 10 for start, stop in found)
    assert_loads(tmp_path, state)
    stored = load_file(folder / "state.safetensors")
    assert sorted(stored) == ["['buffer'].written", "['weights']"]


def test_a_part_is_a_file_that_the_formats_own_library_reads(tmp_path):
    folder = save(tmp_path, 1, filled(45), {})  # rows 40 to 44 lie in the slots 0 to 4
    rows = load_file(parts(folder)[-1])
    expected = written_rows(0)
    assert ranges(folder) == [(5, 10), (10, 20), (20, 30), (30, 40), (40, 45)]
    for name in expected:
        found = rows[f"['buffer'].data['{name}']"]
        assert (found.dtype, found.shape) == (expected[name].dtype, expected[name][40:45].shape)
        assert found.tobytes() == expected[name][40:45].tobytes()


def inodes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_ino for path in parts(folder)}


def test_a_part_is_written_twice_and_shared_with_the_checkpoint_before_the_last(tmp_path):
    written = (38, 47, 47, 48, 58)
    folders = [save(tmp_path, g, filled(n), {}, keep=9) for g, n in enumerate(written)]
    assert ranges(folders[0]) == [(0, 10), (10, 20), (20, 30), (30, 38)]
    assert ranges(folders[1]) == [(7, 10), (10, 20), (20, 30), (30, 40), (40, 47)]
    found = [inodes(folder) for folder in folders]
    for before, after in itertools.pairwise(found):
        assert not set(before.values()) & set(after.values())
    for name in set(found[0]) & set(found[1]):
        assert len({there[name] for there in found if name in there}) == 2
        assert found[2][name] == found[0][name]
    assert found[2].keys() == found[1].keys()
    for generation, n in enumerate(written):
        assert_loads(tmp_path, filled(n), generation=generation)


def test_of_one_checkpoint_alone_a_part_is_written_once(tmp_path):
    first = inodes(save(tmp_path, 1, filled(38), {}, keep=1))
    second = inodes(save(tmp_path, 2, filled(39), {}, keep=1))
    assert {name[8:20] for name in first.keys() & second.keys()} == {
        f"{n:012d}" for n in (0, 10, 20)
    }
    assert all(first[name] == second[name] for name in first.keys() & second.keys())


def test_a_part_goes_with_the_last_checkpoint_that_has_it(tmp_path):
    for generation, written in enumerate((20, 35, 52, 69, 69, 69)):
        folder = save(tmp_path, generation, filled(written), {}, keep=3)
    assert names(tmp_path) == ["00000003", "00000004", "00000005"]
    assert ranges(folder) == [(29, 30), (30, 40), (40, 50), (50, 60), (60, 69)]
    assert {path.stat().st_nlink for path in parts(folder)} == {2}
    last = save(tmp_path, 6, filled(110), {}, keep=1)
    assert names(tmp_path) == ["00000006"]
    assert {path.stat().st_nlink for path in parts(last)} == {1}
    assert_loads(tmp_path, filled(110))


@pytest.mark.parametrize("keep", [2, 3])
def test_no_damaged_part_spoils_all_checkpoints(tmp_path, keep):
    for generation, written in enumerate((35, 38, 52, 52, 69, 72)):
        save(tmp_path, generation, filled(written), {}, keep=keep)
        for path in tmp_path.glob("*/replay*"):
            whole, at = path.read_bytes(), os.stat(path).st_mtime_ns
            flip_part(path)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DamagedCheckpoint)
                if generation:
                    load(tmp_path, like(filled(written)))
            path.write_bytes(whole)
            os.utime(path, ns=(at, at))
    assert len(names(tmp_path)) == keep


def test_without_room_for_a_second_copy_parts_are_shared(tmp_path, monkeypatch):
    first = save(tmp_path, 1, filled(38), {})
    usage = shutil.disk_usage(tmp_path)._replace(free=500)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.warns(UserWarning, match="too little room in .* for a second copy of the replay"):
        second = save(tmp_path, 2, filled(39), {})
    shared = inodes(first).items() & inodes(second).items()
    assert len(shared) == 3
    assert_loads(tmp_path, filled(39))


def test_several_buffers(tmp_path):
    state = {"a": filled(12), "b": [filled(33, 25, seed=1)["buffer"]]}
    folder = save(tmp_path, 1, state, {})
    assert [path.name[6] for path in parts(folder)] == list("001111")
    assert_loads(tmp_path, state)


def test_old_parts_are_not_read_again_by_a_process_that_knows_them(tmp_path, monkeypatch):
    for generation in (0, 1):
        save(tmp_path, generation, filled(35), {})
    read, fingerprint = [], checkpoint._fingerprint
    monkeypatch.setattr(
        checkpoint, "_fingerprint", lambda path: read.append(path.name) or fingerprint(path)
    )
    save(tmp_path, 2, filled(38), {}, keep=2)
    assert sorted(read) == ["counters.json", "state.safetensors"]  # of the older one that stays
    assert_loads(tmp_path, filled(38))
    assert len([name for name in read if name.startswith("replay")]) == 4
    checkpoint._seen.clear()  # as in another process
    read.clear()
    save(tmp_path, 3, filled(39), {}, keep=1)
    assert sorted(name[8:20] for name in read) == [f"{row:012d}" for row in (0, 10, 20)]
    assert_loads(tmp_path, filled(39))


def test_rows_that_changed_are_written_again(tmp_path):
    """Another run's rows, as after going back to an older checkpoint: same range, other bits."""
    save(tmp_path, 1, filled(35), {})
    for generation, state in {2: filled(35, seed=1), 3: filled(38, seed=2)}.items():
        save(tmp_path, generation, state, {})
        assert_loads(tmp_path, state)
    one_row = filled(38, seed=2)
    done = one_row["buffer"].data["done"]
    one_row["buffer"].data["done"] = done.at[13].set(~done[13])
    save(tmp_path, 4, one_row, {})
    assert_loads(tmp_path, one_row)
    assert_loads(tmp_path, filled(35, seed=1), generation=2)


def stacked() -> dict:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), filled(12), filled(25))


def dirty() -> dict:
    """A bit in a row never written, which is no number other than zero: -0.0."""
    state = filled(12)
    data = state["buffer"].data
    data["obs"] = data["obs"].at[39, 2].set(-0.0)
    return state


def unequal() -> dict:
    state = filled(12)
    state["buffer"].data["done"] = jnp.ones(7, jnp.bool_)
    return state


def with_keys() -> dict:
    state = filled(12)
    state["buffer"].data["key"] = jax.random.split(jax.random.key(0), CAPACITY)
    return state


@pytest.mark.parametrize("make", [stacked, dirty, unequal, with_keys])
def test_a_buffer_that_cannot_be_cut_is_stored_whole(tmp_path, make):
    state = make()
    folder = save(tmp_path, 1, state, {})
    assert parts(folder) == []
    assert_loads(tmp_path, state)


@pytest.mark.parametrize("capacity", [7, 25, 40])
def test_buffers_that_a_device_holds_give_the_same_files(tmp_path, monkeypatch, capacity):
    state = filled(57, capacity)
    first = save(tmp_path / "a", 1, state, {})
    monkeypatch.setattr(segments, "_is_on_cpu", lambda leaf: False)
    second = save(tmp_path / "b", 1, state, {})
    assert (first / "COMMIT").read_bytes() == (second / "COMMIT").read_bytes()
    assert_loads(tmp_path / "b", state)


def test_with_the_buffer_itself(tmp_path):
    """Saved, extended with donation, and saved again: nothing that was saved changes."""
    no = jnp.bool_(False)
    row = Transition(jnp.zeros(3), jnp.zeros(1), {"task": jnp.float32(0)}, jnp.zeros(3), no, no)

    def rows(n: int) -> Transition:
        random = np.random.default_rng(n).standard_normal((n, 8), np.float32)
        ended = random[:, 0] > 0
        return Transition(
            random[:, :3], random[:, 3:4], {"task": random[:, 4]}, random[:, 5:], ended, ~ended
        )

    buffer = replay.extend(Replay.empty(row, 50), rows(33))
    expected = []
    for generation, n in enumerate((5, 14, 27)):
        save(tmp_path, generation, {"replay": buffer}, {})
        expected.append(jax.tree.map(lambda x: jnp.array(np.array(x)), {"replay": buffer}))
        buffer = replay.extend(buffer, rows(n))
    for generation, state in enumerate(expected):
        assert_loads(tmp_path, state, generation=generation)
    resumed = replay.extend(load(tmp_path, expected[0]).state["replay"], rows(27))
    assert_same(resumed, buffer)


def flip_part(path: Path) -> None:
    flip(path, path.stat().st_size - 3)
    os.utime(path, ns=(1, 1))  # a write some time later: the clock of a file is coarse


def lose_part(path: Path) -> None:
    path.unlink()


def shorten(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 1)


def rename_part(path: Path) -> None:
    path.rename(path.with_name(path.name.replace("replay0", "replay1")))


DAMAGES = {
    flip_part: "the SHA-256 of replay0-000000000040-.* is not the one in COMMIT",
    lose_part: "replay0-000000000040-.* is missing",
    shorten: "replay0-000000000040-.* has .* bytes, COMMIT says",
    rename_part: "replay0-000000000040-.* is missing",
}


@pytest.mark.parametrize("harm", DAMAGES)
def test_damage_to_a_part_is_named_and_the_one_before_used(tmp_path, harm):
    for generation, written in enumerate((35, 52)):
        folder = save(tmp_path, generation, filled(written), {})
    harm(next(path for path in parts(folder) if "replay0-000000000040-" in path.name))
    state = filled(35)
    with pytest.warns(DamagedCheckpoint, match=DAMAGES[harm]):
        found = load(tmp_path, like(state))
    assert found.generation == 0
    assert_same(found.state, state)


def test_damage_to_a_part_damages_all_that_share_it(tmp_path):
    folders = [save(tmp_path, i, filled(n), {}, keep=9) for i, n in enumerate((35, 36, 37))]
    flip_part(parts(folders[0])[1])
    assert [damage(folder) is None for folder in folders] == [False, True, False]
    flip_part(parts(folders[1])[1])
    with pytest.raises(CheckpointError, match="no intact checkpoint"):
        load(tmp_path, like(filled(38)))
    # A process that still has the rows writes them again, and this one is whole.
    fourth = save(tmp_path, 3, filled(39), {}, keep=9)
    assert damage(fourth) is None
    assert [path.stat().st_nlink for path in parts(fourth)] == [2, 1, 2, 1]
    assert_loads(tmp_path, filled(39))


def test_without_its_buffer_a_state_is_loaded_however_damaged_the_buffer_is(tmp_path):
    state = {"a": filled(35), "b": stacked()}
    folder = save(tmp_path, 7, state, {"frames": 35})
    flip_part(parts(folder)[1])
    parts(folder)[2].unlink()
    with pytest.raises(CheckpointError, match="no intact"):
        load(tmp_path, like(state))
    smaller = {"a": like(filled(35, 12)), "b": like(state["b"])}
    for wanted in (like(state), smaller):
        with pytest.warns(UserWarning, match="replay buffer of checkpoint .*00000007 is left out"):
            found = load(tmp_path, wanted, without_replay=True)
        empty = {
            part: {
                "buffer": jax.tree.map(
                    lambda x: jnp.zeros(x.shape, x.dtype), wanted[part]["buffer"]
                ),
                "weights": state[part]["weights"],
            }
            for part in state
        }
        assert_same(found.state, empty)
        assert (found.generation, found.counters) == (7, {"frames": 35})
    flip(folder / "state.safetensors", -1)
    with pytest.raises(CheckpointError, match=r"SHA-256 of state\.safetensors"):
        load(tmp_path, like(state), without_replay=True)


def test_any_flipped_bit_is_noticed(tmp_path):
    folder = save(tmp_path, 1, filled(12), {})
    for path in (*parts(folder), folder / "COMMIT"):
        whole = path.read_bytes()
        for position in range(0, len(whole), 5):
            flip(path, position, bit=position % 8)
            assert damage(folder), f"byte {position} of {path.name}"
            path.write_bytes(whole)
    assert damage(folder) is None


@pytest.mark.parametrize(
    ("written", "old", "new"), [(15, 40, 41), (15, 40, 15), (0, 9, 1), (9, 9, 40)]
)
def test_a_buffer_never_full_fits_another_capacity(tmp_path, written, old, new):
    save(tmp_path, 1, filled(written, old), {})
    found = load(tmp_path, like(filled(written, new)))
    assert_same(found.state, filled(written, new))
    # And what is saved then shares the files.
    folders = [save(tmp_path, g, filled(written, new), {}, keep=9) for g in (2, 3)]
    assert inodes(folders[1]) == inodes(tmp_path / "00000001")


@pytest.mark.parametrize(("written", "old", "new"), [(41, 40, 41), (15, 40, 14), (50, 40, 60)])
def test_another_capacity_that_would_lose_rows_is_a_different_shape(tmp_path, written, old, new):
    save(tmp_path, 1, filled(written, old), {})
    message = rf"\['obs'\]: found float32\[{old}, 3\], expected float32\[{new}, 3\]"
    with pytest.raises(CheckpointError, match=message):
        load(tmp_path, like(filled(written, new)))


def test_a_part_that_is_not_what_its_name_says(tmp_path):
    """Made by hand, with hashes that fit."""
    folder = save(tmp_path, 1, filled(15), {})
    path = parts(folder)[0]
    commit = json.loads((folder / "COMMIT").read_text())
    for change in ({"['buffer'].data['obs']": np.zeros((9, 3), np.float32)}, {}):
        save_file(load_file(path) | change if change else {}, path)
        commit["files"][path.name] = checkpoint._fingerprint(path)
        (folder / "COMMIT").write_bytes(checkpoint._commit_text(1, commit["files"]))
        assert damage(folder) is None
        with pytest.raises(CheckpointError, match=r"replay buffer's .*\] is damaged"):
            load(tmp_path, like(filled(15)))


@pytest.mark.parametrize("number", [errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP])
def test_where_there_are_no_links_parts_are_written_again(tmp_path, monkeypatch, number):
    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", refuse)
    for generation, written in enumerate((35, 52)):
        folder = save(tmp_path, generation, filled(written), {})
    assert {path.stat().st_nlink for path in parts(folder)} == {1}
    assert_loads(tmp_path, filled(35), generation=0)
    assert_loads(tmp_path, filled(52))


def test_a_link_that_was_made_and_called_a_failure_harms_no_older_file(tmp_path, monkeypatch):
    link = os.link

    def lie(old, new):
        link(old, new)
        raise OSError(errno.EEXIST, os.strerror(errno.EEXIST))

    monkeypatch.setattr(os, "link", lie)
    for generation, written in enumerate((35, 52)):
        save(tmp_path, generation, filled(written), {})
    assert_loads(tmp_path, filled(35), generation=0)
    assert_loads(tmp_path, filled(52))
    assert {path.stat().st_nlink for path in tmp_path.glob("*/replay*")} == {1}


def start(directory: Path) -> None:
    """Two checkpoints; generation 2 is to be written over them."""
    save(directory, 0, filled(8, 20), {})
    save(directory, 1, filled(23, 20), {})


def copy(source: Path, target: Path) -> None:
    shutil.copytree(source, target, copy_function=os.link)


def test_killed_at_any_call_leaves_a_good_checkpoint(tmp_path):
    start(tmp_path / "start")
    states = {generation: filled(n, 20) for generation, n in enumerate((8, 23, 28))}
    used, drafts = [], 0
    for k in range(200):
        directory = tmp_path / str(k)
        copy(tmp_path / "start", directory)
        action = lambda to=directory: save(to, 2, states[2], {}, keep=1)  # noqa: E731
        _, failed = outcome(action, k, Killed())
        found = load(directory, like(states[0]))
        assert_same(found.state, states[found.generation])
        used.append(found.generation)
        drafts += (directory / ".00000002.partial").exists()
        folder = save(directory, 3, states[2], {}, keep=1)
        assert (names(directory), damage(folder)) == (["00000003"], None)
        if not failed:
            break
    assert used == sorted(used)
    assert (used.count(1) > 20, used.count(2) > 10, drafts > 20) == (True, True, True)


def test_disk_that_fails_at_any_call(tmp_path):
    start(tmp_path / "start")
    state, failures = filled(28, 20), 0
    for k in range(200):
        directory = tmp_path / str(k)
        copy(tmp_path / "start", directory)
        action = lambda to=directory: save(to, 2, state, {})  # noqa: E731
        message, failed = outcome(action, k, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        assert names(directory)[:2] == ["00000000", "00000001"]
        newest = load(directory, like(state))
        assert_same(newest.state, state if newest.generation == 2 else filled(23, 20))
        if message is None:
            assert failed in ([], ["mkdir"], ["link"])
            assert newest.generation == 2
        else:
            assert ("No space left on device" in message, "it needs" in message) == (True, True)
            failures += 1
        if not failed:
            break
    assert failures > 15


def test_only_what_is_written_is_needed(tmp_path, monkeypatch):
    save(tmp_path, 1, filled(35), {})
    with monkeypatch.context() as patch:
        usage = shutil.disk_usage(tmp_path)._replace(free=7)
        patch.setattr(shutil, "disk_usage", lambda path: usage)
        with pytest.warns(UserWarning, match="too little room"):
            message, _ = outcome(
                lambda: save(tmp_path, 2, filled(39), {}), 3, OSError(errno.ENOSPC, "full")
            )
    folder = save(tmp_path, 2, filled(39), {})
    fixed = sum((folder / name).stat().st_size for name in ("state.safetensors", "counters.json"))
    assert f"it needs {fixed + 9 * 21:,} bytes" in str(message)


def test_eqx_filter_of_a_state_keeps_the_buffer_in_parts(tmp_path):
    folder = save(tmp_path, 1, eqx.filter(filled(15) | {"name": "kept"}, eqx.is_array), {})
    assert ranges(folder) == [(0, 10), (10, 15)]


@pytest.mark.parametrize("written", [15, 55])
def test_a_buffer_of_an_older_form_is_read_in_todays(tmp_path, written):
    """One end for a whole team is every agent's; bytes that were kept as floats are bytes again."""

    def state(done, images):
        rows = {"done": done, "images": images}
        return {"buffer": Replay(rows, jnp.int32(written))}

    old = filled(written)["buffer"].data["done"]
    images = jnp.where(jnp.arange(CAPACITY) < written, jnp.arange(CAPACITY), 0)
    save(tmp_path, 1, state(old, jnp.float32(images)), {})
    new = state(jnp.broadcast_to(old[:, None], (CAPACITY, 3)), images.astype(jnp.uint8))
    assert_same(load(tmp_path, like(new)).state, new)
