"""Files: whole or not at all, through no link, and never waited for."""

import errno
import json
import os
import re
import resource
import signal
from pathlib import Path

import pytest

from credo.runs import files

DRAFT = ".page.html.draft.html"


@pytest.fixture
def precious(tmp_path):
    """Somebody's file outside the folder that is written to."""
    (tmp_path / "folder").mkdir()
    path = tmp_path / "precious"
    path.write_text("precious")
    return path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_the_old_one_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "new" / "page.html"
    with files.whole(path) as draft:
        assert (draft, draft.read_bytes()) == (path.with_name(DRAFT), b"")
        draft.write_text("one")
        assert not path.exists()
    with pytest.raises(ZeroDivisionError):
        _write_half_and_fail(path)
    assert (path.read_text(), names(path.parent)) == ("one", ["page.html"])
    files.write_whole(path, [b"tw", memoryview(b"o")])
    assert (path.read_text(), names(path.parent)) == ("two", ["page.html"])


def _write_half_and_fail(path: Path) -> None:
    with files.whole(path) as draft:
        draft.write_text("half")
        raise ZeroDivisionError


@pytest.mark.parametrize("kind", ["link", "dangling", "hard link", "file", "folder", "pipe"])
def test_whatever_has_the_drafts_name_is_removed_and_not_followed(precious, kind):
    folder = precious.parent / "folder"
    draft = folder / DRAFT
    {
        "link": lambda: draft.symlink_to(precious),
        "dangling": lambda: draft.symlink_to(precious.with_name("made")),
        "hard link": lambda: draft.hardlink_to(precious),
        "file": lambda: draft.write_text("left by a killed process, and longer"),
        "folder": lambda: (draft / "in it").mkdir(parents=True),
        "pipe": lambda: os.mkfifo(draft),
    }[kind]()
    files.write_text(folder / "page.html", "new")
    assert (folder / "page.html").read_text() == "new"
    assert (names(folder), precious.read_text()) == (["page.html"], "precious")
    assert names(precious.parent) == ["folder", "precious"]


def _write_while_another_writes(path: Path) -> None:
    with files.whole(path) as draft:
        draft.write_text("hal")
        files.write_text(path, "whole")
        draft.write_text("half")


def test_two_writers_at_once_give_no_half_file(tmp_path):
    path = tmp_path / "page.html"
    with pytest.raises(OSError, match="at the same time"):
        _write_while_another_writes(path)
    assert path.read_text() == "whole"


def test_a_new_file_takes_nobodys_place(precious):
    link = precious.parent / "folder" / "link"
    link.symlink_to(precious.with_name("made"))
    for path in (precious, link):
        with pytest.raises(FileExistsError, match=re.escape(str(path))):
            files.write_new(path, [b"x"])
    assert names(precious.parent) == ["folder", "precious"]
    files.write_new(precious.with_name("made"), [b"x", b"y"])
    assert precious.with_name("made").read_bytes() == b"xy"


def test_append_goes_through_no_link_and_waits_for_no_reader(precious):
    folder = precious.parent / "folder"
    (folder / "link").symlink_to(precious)
    with pytest.raises(OSError, match=r"is a link and not followed: remove it: .*link'"):
        files.append(folder / "link", b"x")
    os.mkfifo(folder / "pipe")
    with pytest.raises(OSError, match="pipe'"):
        files.append(folder / "pipe", b"x")
    files.append(folder / "new", b"x")
    files.append(folder / "new", b"y")
    assert ((folder / "new").read_text(), precious.read_text()) == ("xy", "precious")


@pytest.fixture
def _at_most_1000_bytes():
    """A real refusal by the kernel: no file may be larger."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.usefixtures("_at_most_1000_bytes")
def test_where_a_file_may_not_grow_the_old_one_stays(tmp_path):
    path = tmp_path / "rows"
    files.append(path, b"a" * 900)
    for write in (files.append, lambda path, data: files.write_whole(path, [data])):
        with pytest.raises(OSError, match=r"File too large: .*rows"):
            write(path, b"b" * 1200)
        assert (path.read_bytes(), names(tmp_path)) == (b"a" * 900, ["rows"])


def test_remove(precious):
    folder = precious.parent / "folder"
    (folder / "link").symlink_to(precious)
    (folder / "to a folder").symlink_to(precious.parent)
    (folder / "deep" / "er").mkdir(parents=True)
    (folder / "deep" / "link").symlink_to(precious)
    os.mkfifo(folder / "pipe")
    (folder / "file").write_text("")
    for name in [*names(folder), "none"]:
        files.remove(folder / name)
    assert (names(folder), precious.read_text()) == ([], "precious")


def test_only_regular_files_of_a_bounded_size_are_read(precious):
    folder = precious.parent / "folder"
    os.mkfifo(folder / "pipe")
    (folder / "link").symlink_to(precious)
    with (folder / "sparse").open("wb") as file:
        file.truncate(3 * 2**30)
    for path in (folder, folder / "pipe", Path("/dev/zero")):
        with pytest.raises(OSError, match=f"is no regular file: '{path}'"):
            files.read_bytes(path)
    with pytest.raises(ValueError, match=r"sparse has 3,221,225,472 bytes: at most 67,108,864"):
        files.read_text(folder / "sparse")
    with pytest.raises(FileNotFoundError, match="none'"):
        files.read_bytes(folder / "none")
    assert files.read_bytes(folder / "link", 8) == b"precious"
    with pytest.raises(ValueError, match="has 8 bytes: at most 7"):
        files.read_bytes(precious, 7)


def test_text_that_is_none_names_its_file(tmp_path):
    (tmp_path / "text").write_bytes("ψ".encode() + b"\xb1")
    with pytest.raises(ValueError, match=r"text is damaged: its byte 2 is 0xb1"):
        files.read_text(tmp_path / "text")


def test_json_comes_back_even_if_a_path_is_no_text(tmp_path):
    value = {"ψ": [1, 0.1 + 0.2, None], "path": os.fsdecode(b"/runs/\xff")}
    files.write_json(tmp_path / "config.json", value)
    assert json.loads(files.read_text(tmp_path / "config.json")) == value
    assert '\n "ψ": [' in files.read_text(tmp_path / "config.json")


def test_only_a_full_disk_is_told_to_be_freed():
    told = {number: files.advice(OSError(number, "")) for number in (*files.FULL, errno.EIO)}
    assert [number for number, text in told.items() if "free some space" not in text] == [errno.EIO]
    assert "ulimit -f" in told[errno.EFBIG]
