"""Metrics on disk: text that comes back as the same floats, and the cut of a resumed run."""

import json
import os

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


@pytest.fixture
def written(tmp_path):
    journal = log.Log(tmp_path, 0, tensorboard=False)
    journal.append(rows(1, 3), 1.0, 1.0)
    journal.append(rows(4, 5), 0.5, 1.5)
    journal.close()
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
    log.Log(written, 5, tensorboard=False).sync()
    names = ("metrics.csv", "timing.csv")
    assert synced == [(written / name).stat().st_ino for name in names]


def test_nan_and_infinity_come_back(tmp_path):
    journal = log.Log(tmp_path, 0, tensorboard=False)
    journal.append([{"generation": 1, "a": float("nan"), "b": float("-inf")}], 1.0, 1.0)
    columns = log.read(tmp_path / "metrics.csv")
    assert np.isnan(columns["a"]).tolist() == [True]
    assert columns["b"].tolist() == [-np.inf]


@pytest.mark.parametrize("tail", [b"", b"6,0.25", b"6", b"6,0.25,0"])
def test_a_resumed_log_is_cut_to_its_checkpoint(written, tail):
    metrics = written / "metrics.csv"
    whole = metrics.read_bytes()
    metrics.write_bytes(whole + tail)
    journal = log.Log(written, 3, tensorboard=False)
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
    journal = log.Log(written, 0, tensorboard=False)
    assert log.read(written / "metrics.csv") == {}
    journal.append(rows(1, 5), 1.0, 1.0)
    assert (written / "metrics.csv").read_bytes() == whole


def test_there_is_nothing_to_read_before_the_first_row(tmp_path):
    assert log.read(tmp_path / "metrics.csv") == {}
    (tmp_path / "metrics.csv").write_text("")
    assert log.read(tmp_path / "metrics.csv") == {}


def test_tensorboard_gets_every_metric_of_every_generation(tmp_path, monkeypatch):
    import tensorboardX

    seen = []
    monkeypatch.setattr(
        tensorboardX.SummaryWriter, "add_scalar", lambda self, *event: seen.append(event)
    )
    journal = log.Log(tmp_path, 0)
    journal.append([{"generation": 1, "a": 0.5, "b": 2}, {"generation": 2, "a": 1.5, "b": 3}], 1, 1)
    journal.close()
    assert seen == [("a", 0.5, 1), ("b", 2, 1), ("a", 1.5, 2), ("b", 3, 2)]
    assert len(list((tmp_path / "tensorboard").iterdir())) == 1
    assert json.dumps(seen)  # plain numbers
