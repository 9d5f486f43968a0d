"""Files: written whole or not at all, through no link, and read without waiting.

A folder of a run may come from another user, or be looked at by others while it is written. So
what stands under a name that is to be written is never followed or trusted: a draft is a new file,
and what is appended to is a regular file. What is read is a regular file of a bounded size: a
pipe would make its reader wait for ever, and a sparse file may be larger than the memory.
"""

import contextlib
import errno
import io
import json
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

MOST = 64 * 2**20  # bytes that are read at once, unless more is asked for
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

Chunk = bytes | memoryview


@contextlib.contextmanager
def whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """The draft of `path`, to be written by its name (see `_drafted`)."""
    with _drafted(path) as (draft, _):
        yield draft


@contextlib.contextmanager
def _drafted(path: str | os.PathLike[str]) -> Iterator[tuple[Path, int]]:
    """Inside the `with` block write the file that is yielded, with its descriptor: afterwards it is
    `path`, whole and on the disk. Until then, and for good if the block raises, `path` is what it
    was.

    The folder is made if there is none. The draft lies beside `path`, exists already, is empty and
    has the same suffix; what had its name is removed first. Raises `OSError`.
    """
    path = Path(path)
    draft = path.with_name(f".{path.name}.draft{path.suffix}")
    path.parent.mkdir(parents=True, exist_ok=True)
    remove(draft)
    descriptor = opened(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    try:
        yield draft, descriptor
        if os.fstat(descriptor).st_nlink == 0:
            raise OSError(errno.EBUSY, "another process writes it at the same time", str(path))
        os.fsync(descriptor)
        os.replace(draft, path)
    except BaseException as error:
        with contextlib.suppress(OSError):  # the first error counts
            if os.fstat(descriptor).st_nlink:  # or it would be another user's
                remove(draft)
        if isinstance(error, OSError):
            raise named(error, path) from error
        raise
    finally:
        os.close(descriptor)
    sync(path.parent)


def write_whole(path: str | os.PathLike[str], chunks: Iterable[Chunk]) -> None:
    """Write `chunks` one after the other as the file `path`, whole or not at all (see `whole`)."""
    with _drafted(path) as (_, descriptor):  # not by name: the draft may be another writer's by now
        _write(descriptor, path, chunks)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8, whole or not at all; lines end as in `text`."""
    # A path that is no text holds lone surrogates, which are spelled as JSON does.
    write_whole(path, [text.encode(errors="backslashreplace")])


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` as JSON, whole or not at all."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def write_new(path: str | os.PathLike[str], chunks: Iterable[Chunk]) -> None:
    """Write a file that did not exist before; it is on the disk afterwards.

    Raises `FileExistsError` if anything, be it a link to nowhere, has that name.
    """
    descriptor = opened(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    try:
        _write(descriptor, path, chunks)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def append(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` behind the file `path`, or as a new one: all of it, or nothing if the disk
    fails. Raises `OSError` if `path` is a link or no regular file."""
    descriptor = opened(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        before = os.fstat(descriptor).st_size
        try:
            _write(descriptor, path, [data])
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, before)
            raise
    finally:
        os.close(descriptor)


def remove(path: str | os.PathLike[str]) -> None:
    """Remove a file, a folder with all that is in it, or a link but not what it leads to; it is
    fine if there is none. Raises `OSError` if it cannot be removed."""
    with contextlib.suppress(FileNotFoundError):
        if stat.S_ISDIR(os.lstat(path).st_mode):
            shutil.rmtree(path)
        else:
            os.unlink(path)


def read_bytes(path: str | os.PathLike[str], most: int = MOST) -> bytes:
    """A regular file. Raises `OSError` if it is none or cannot be read, and `ValueError` if it has
    more than `most` bytes; both name it."""
    with reading(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise ValueError(f"{path} has {size:,} bytes: at most {most:,} are read")
        return file.read()


def read_text(path: str | os.PathLike[str], most: int = MOST) -> str:
    """The same as text; `ValueError` names a file that is not UTF-8."""
    try:
        return read_bytes(path, most).decode()
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is damaged: its byte {error.start} is {error.object[error.start]:#x}, "
            "which is no UTF-8 text"
        ) from None


def reading(path: str | os.PathLike[str]) -> io.BufferedReader:
    """A regular file, open for reading: never waits, and a link is followed. Raises `OSError`."""
    return open(opened(path, os.O_RDONLY, follow=True), "rb")


def opened(path: str | os.PathLike[str], flags: int, *, follow: bool = False) -> int:
    """A descriptor of a regular file: never waits, and goes through a link only to `follow` it.
    Raises `OSError`."""
    flags |= os.O_NONBLOCK | os.O_NOCTTY | (0 if follow else os.O_NOFOLLOW)
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP and not follow:
            raise OSError(errno.ELOOP, "is a link and not followed: remove it", str(path)) from None
        raise
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, "is no regular file", str(path))


def sync(path: str | os.PathLike[str]) -> None:
    """Put a file, or the names in a folder, on the disk. Raises `OSError`."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(descriptor)
    except OSError as error:
        raise named(error, path) from error
    finally:
        os.close(descriptor)


def named(error: OSError, path: str | os.PathLike[str]) -> OSError:
    """The same error with its file: what is written to a descriptor fails without a name."""
    if error.filename is not None or error.errno is None:
        return error
    return OSError(error.errno, error.strerror, str(path))


def advice(error: OSError) -> str:
    """What to do about an error in writing, as the beginning of a sentence."""
    if error.errno == errno.EFBIG:
        return "raise the limit of a file's size (`ulimit -f`) or free some space"
    return "free some space" if error.errno in FULL else "see to that"


def _write(descriptor: int, path: str | os.PathLike[str], chunks: Iterable[Chunk]) -> None:
    for chunk in chunks:
        rest = memoryview(chunk)
        while rest:
            try:
                rest = rest[os.write(descriptor, rest) :]
            except OSError as error:
                raise named(error, path) from error
