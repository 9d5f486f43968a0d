"""Metrics on disk: text that comes back as the same floats, and the cut of a resumed run."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from credo.runs import log


def rows(first: int, last: int) -> list[dict[str, float | int]]:
    rng = np.random.default_rng(0)
    values = rng.standard_normal(last + 1).astype(np.float32)
    return [
        {"generation": g, "score": float(values[g]), "nan": int(g == 2)}
        for g in range(first, last + 1)
    ]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def written(tmp_path):
    journal = log.Log(tmp_path, 0)
    journal.append(rows(1, 3), 1.0, 1.0)
    journal.append(rows(4, 5), 0.5, 1.5)
    return tmp_path


def test_every_bit_of_a_float32_comes_back(written):
    columns = log.read(written / "metrics.csv")
    expected = np.array([row["score"] for row in rows(1, 5)], np.float32)
    assert list(columns) == ["generation", "score", "nan"]
    assert columns["generation"].tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(columns["score"].astype(np.float32), expected)


def test_the_clock_is_kept_apart_one_row_per_dispatch(written):
    columns = log.read(written / "timing.csv")
    assert columns["generation"].tolist() == [3, 5]
    assert columns["seconds"].tolist() == [1.0, 1.5]
    assert columns["generations_per_second"].tolist() == [3.0, 4.0]


def test_sync_puts_both_files_on_the_disk(written, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_ino))
    log.Log(written, 5).sync()
    paths = (written / "metrics.csv", written, written / "timing.csv")
    assert synced == [path.stat().st_ino for path in paths]


def test_nan_and_infinity_come_back(tmp_path):
    journal = log.Log(tmp_path, 0)
    journal.append([{"generation": 1, "a": float("nan"), "b": float("-inf")}], 1.0, 1.0)
    columns = log.read(tmp_path / "metrics.csv")
    assert np.isnan(columns["a"]).tolist() == [True]
    assert columns["b"].tolist() == [-np.inf]


@pytest.mark.parametrize("tail", [b"", b"6,0.25", b"6", b"6,0.25,0"])
def test_a_resumed_log_is_cut_to_its_checkpoint(written, tail):
    metrics = written / "metrics.csv"
    whole = metrics.read_bytes()
    metrics.write_bytes(whole + tail)
    journal = log.Log(written, 3)
    assert metrics.read_bytes() == b"".join(whole.splitlines(keepends=True)[:4])
    assert log.read(written / "timing.csv")["generation"].tolist() == [3]
    journal.append(rows(4, 5), 0.5, 1.5)
    assert metrics.read_bytes() == whole
    assert sorted(p.name for p in written.iterdir()) == ["metrics.csv", "timing.csv"]


@pytest.mark.parametrize("tail", [b"6,0.25", b"6", b"6,0.25,0"])
def test_a_half_written_line_is_not_read(written, tail):
    metrics = written / "metrics.csv"
    metrics.write_bytes(metrics.read_bytes() + tail)
    assert log.read(metrics)["generation"].tolist() == [1, 2, 3, 4, 5]


def test_a_log_cut_to_nothing_starts_with_its_header_again(written):
    whole = (written / "metrics.csv").read_bytes()
    journal = log.Log(written, 0)
    assert log.read(written / "metrics.csv") == {}
    journal.append(rows(1, 5), 1.0, 1.0)
    assert (written / "metrics.csv").read_bytes() == whole


def test_there_is_nothing_to_read_before_the_first_row(tmp_path):
    assert log.read(tmp_path / "metrics.csv") == {}
    (tmp_path / "metrics.csv").write_text("")
    assert log.read(tmp_path / "metrics.csv") == {}


def refuse(directory: Path, name: str) -> None:
    """Let no file of this name be written, whoever the user is."""
    path = directory / name
    path.unlink(missing_ok=True)
    path.mkdir()


def test_a_clock_that_cannot_be_written_stops_nothing(written):
    journal = log.Log(written, 5)
    refuse(written, "timing.csv")
    more = [{"generation": 6, "score": 0.0, "nan": 0}, {"generation": 7, "score": 0.0, "nan": 0}]
    with pytest.warns(UserWarning, match=r"timing\.csv is no longer written: .*; training goes on"):
        journal.append(more[:1], 1.0, 1.0)
    journal.append(more[1:], 1.0, 1.0)
    journal.sync()
    assert log.read(written / "metrics.csv")["generation"].tolist() == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize(
    "content",
    [
        b"generation,seconds,generations_per_second\n3,1\xb1,3\n",
        b"gener\xb1tion,seconds,generations_per_second\n3,1,3\n",
        b"generation,minutes,generations_per_second\n3,1,3\n",
        b"generation,seconds,generations_per_second\n3,1\n",
        b"generation,seconds,generations_per_second\n3,nan,3\n",
    ],
)
def test_a_damaged_clock_is_begun_anew(written, content):
    (written / "timing.csv").write_bytes(content)
    with pytest.warns(UserWarning, match=r"timing\.csv is .*; timing\.csv is begun anew: "):
        journal = log.Log(written, 5)
    assert journal.elapsed == 0.0
    journal.append([{"generation": 6, "score": 0.0, "nan": 0}], 0.5, 2.0)
    assert log.read(written / "timing.csv")["seconds"].tolist() == [2.0]


def test_the_clock_goes_on(written):
    assert log.Log(written, 5).elapsed == 1.5
    assert log.Log(written, 4).elapsed == 1.0
    assert log.Log(written, 0).elapsed == 0.0


def test_rows_that_are_done_and_gone_are_an_error(written):
    metrics = written / "metrics.csv"
    whole = metrics.read_bytes()
    for left in (None, b"", whole[: len(whole) // 2], whole.replace(b"\n5,", b"\nx,")):
        metrics.write_bytes(left) if left is not None else metrics.unlink()
        with pytest.raises(log.DamagedLog, match=r"metrics\.csv has no row of generation 5"):
            log.Log(written, 5)
    assert names(written) == ["metrics.csv", "timing.csv"]


def test_a_seal_is_of_all_rows(written):
    lines = (written / "metrics.csv").read_bytes().splitlines(keepends=True)
    for generation in (5, 3, 1):
        prefix = b"".join(lines[: generation + 1])
        sha256 = hashlib.sha256(prefix).hexdigest()
        found = log.Log(written, generation).seal()
        assert found == {"bytes": len(prefix), "sha256": sha256}
        log.verify(written, json.loads(json.dumps(found)))
    log.verify(written / "none", log.Log(written, 0).seal())  # no row, so no file


def test_a_seal_is_of_what_was_written(written):
    """Whatever happens to the file since."""
    journal, metrics = log.Log(written, 5), written / "metrics.csv"
    journal.append([{"generation": 6, "score": 0.5, "nan": 0}], 0.5, 2.0)
    whole = metrics.read_bytes()
    metrics.write_bytes(whole.replace(b"\n2,", b"\n7,"))
    sealed = journal.seal()
    assert sealed == {"bytes": len(whole), "sha256": hashlib.sha256(whole).hexdigest()}
    with pytest.raises(log.DamagedLog, match="was changed"):
        log.verify(written, sealed)
    metrics.write_bytes(whole[:-5])
    with pytest.raises(log.DamagedLog, match=r"metrics\.csv was changed while the run went on"):
        journal.sync()


def test_a_table_that_was_cut_is_sealed_anew(written):
    journal = log.Log(written, 3)
    journal.append([row | {"score": 0.5} for row in rows(4, 6)], 1.0, 2.0)
    found = journal.seal()
    assert found["sha256"] == hashlib.sha256((written / "metrics.csv").read_bytes()).hexdigest()


def test_any_flipped_bit_before_the_seal_is_named(written):
    metrics = written / "metrics.csv"
    whole = metrics.read_bytes()
    sealed = log.Log(written, 4).seal()
    for position in range(len(whole)):
        data = bytearray(whole)
        data[position] ^= 1 << position % 8
        metrics.write_bytes(data)
        if position < sealed["bytes"]:
            with pytest.raises(
                log.DamagedLog, match=rf"metrics\.csv was changed: .*{sealed['bytes']} by"
            ):
                log.verify(written, sealed)
        else:
            log.verify(written, sealed)
    metrics.write_bytes(whole[:50])
    with pytest.raises(log.DamagedLog, match=r"metrics\.csv was cut: it has 50 of the \d+ bytes"):
        log.verify(written, sealed)
    metrics.unlink()
    with pytest.raises(log.DamagedLog, match=r"cannot be read.*metrics\.csv.*restore it from"):
        log.verify(written, sealed)


@pytest.mark.parametrize(
    "line", [b"6,0.25", b"6,x,0", b"6,0.25,\xb1", b"", b"6,0.25,0,1", b"\0,0,0"]
)
def test_a_table_that_is_none_names_its_line(written, line):
    metrics = written / "metrics.csv"
    with metrics.open("ab") as file:
        file.write(line + b"\n")
    with pytest.raises(log.DamagedLog, match=r"metrics\.csv is damaged: its line 7 is b'"):
        log.read(metrics)


def test_a_header_that_is_none_names_its_file(written):
    metrics = written / "metrics.csv"
    metrics.write_bytes(metrics.read_bytes().replace(b"score", b"sc\xb1re"))
    for action in (log.read, log.last):
        with pytest.raises(log.DamagedLog, match=r"metrics\.csv is damaged: 'utf-8' codec"):
            action(metrics)


def test_the_last_row_must_fit_the_header(written):
    metrics = written / "metrics.csv"
    metrics.write_bytes(metrics.read_bytes() + b"6,1\n")
    with pytest.raises(log.DamagedLog, match=r"metrics\.csv is damaged: its last line has 2 col"):
        log.last(metrics)


def test_a_pipe_is_no_table_and_waits_for_nobody(tmp_path):
    os.mkfifo(tmp_path / "metrics.csv")
    for action in (log.read, log.last, lambda path: log.Log(path.parent, 0)):
        with pytest.raises(OSError, match=r"no regular file.*metrics\.csv"):
            action(tmp_path / "metrics.csv")


@pytest.mark.parametrize("name", ["metrics.csv", ".metrics.csv.draft.csv", "timing.csv"])
def test_nothing_is_written_through_a_link(written, name):
    victim = written.parent / f"{written.name}-victim"
    path = written / name
    victim.write_bytes(path.read_bytes() if path.exists() else b"precious")
    before = victim.read_bytes()
    path.unlink(missing_ok=True)
    path.symlink_to(victim)
    journal = log.Log(written, 3)
    journal.append(rows(4, 5), 1.0, 1.0)
    assert victim.read_bytes() == before
    assert log.read(written / "metrics.csv")["generation"].tolist() == [1, 2, 3, 4, 5]


def test_a_copy_made_of_links_stays_as_it_was(written):
    copy = written.parent / f"{written.name}-copy"
    shutil.copytree(written, copy, copy_function=os.link)
    before = (copy / "metrics.csv").read_bytes()
    log.Log(written, 5).append([rows(5, 5)[0] | {"generation": 6}], 1.0, 1.0)
    assert (copy / "metrics.csv").read_bytes() == before


LIMITED = """
import resource, sys, warnings
from pathlib import Path
from types import SimpleNamespace
from credo.runs import callbacks, log
directory, size = Path(sys.argv[1]), int(sys.argv[2])
warnings.simplefilter("always")
warnings.showwarning = lambda message, *_: print("warned:", message)
journal = log.Log(directory, 0)
run, board = SimpleNamespace(path=directory), [callbacks.TensorBoard()]
listeners = callbacks.Listeners(run, board, 0.0, True)
resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
g = 0
try:
    while g < 2000:
        rows = [{"generation": g + i, "champion_score": 0.5} for i in (1, 2, 3)]
        journal.append(rows, 1.0, 1.0)
        listeners.hear(rows)
        g += 3
except OSError as error:
    print("error:", error)
print("done:", g)
"""


def test_where_no_file_may_grow_metrics_are_an_error_and_events_are_not(tmp_path):
    """The kernel's own refusal. A thread of TensorBoard's writer would wait here for ever."""
    command = [sys.executable, "-c", LIMITED, str(tmp_path), "4000"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    warned, *clock, error, last = done.stdout.splitlines()
    assert warned.startswith("warned: TensorBoard is no longer told: [Errno 27] File")
    assert clock == []
    assert "metrics.csv" in error
    assert "ulimit -f" in error
    assert "then resume; checkpoints are intact" in error
    g = int(last.removeprefix("done: "))
    assert 300 < g < 1000
    assert log.read(tmp_path / "metrics.csv")["generation"].tolist() == list(range(1, g + 1))
