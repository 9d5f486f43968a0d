"""The screen may go away, the work goes on.

A terminal is closed, `| head -1` has read enough, `| tee` is gone with the same Ctrl-C: then every
word that is written raises. What a run says is worth less than what it learned, so nothing of it
may reach training.
"""

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from typing import Any

GONE = (errno.EPIPE, errno.EIO, errno.EBADF, errno.ENXIO)  # it will never be read again


class Stream:
    """A text stream that is written to as long as it is read, and never raises."""

    def __init__(self, inner: Any):
        self._inner = inner  # None where the process was started without one

    def write(self, text: str) -> int:
        """Never raises for want of a reader; characters that the stream has not are escaped."""
        with _unread(self._inner):
            try:
                self._inner.write(text)
            except UnicodeEncodeError:  # a stream that knows ASCII alone
                code = self.encoding
                self._inner.write(text.encode(code, "backslashreplace").decode(code))
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        with _unread(self._inner):
            self._inner.flush()

    def isatty(self) -> bool:
        with _unread(self._inner):
            return self._inner.isatty()
        return False

    @property
    def encoding(self) -> str:
        return getattr(self._inner, "encoding", None) or "utf-8"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


@contextlib.contextmanager
def calm() -> Iterator[None]:
    """Inside the block nothing that is written to stdout or stderr can raise, whoever writes it."""
    occupy()
    before = sys.stdout, sys.stderr
    now = tuple(x if isinstance(x, Stream) else Stream(x) for x in before)
    sys.stdout, sys.stderr = now  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        if sys.stdout is now[0]:  # or that of others, who will put back what was there
            sys.stdout = before[0]
        if sys.stderr is now[1]:
            sys.stderr = before[1]


def say(text: str) -> None:
    """A line on stderr, if anybody is there to read it."""
    stream = Stream(sys.stderr)
    stream.write(text + "\n")
    stream.flush()


def occupy() -> None:
    """Open the standard streams that this process was started without, on nothing: else the next
    file has their number, and what a library says on it goes into that file."""
    with contextlib.suppress(OSError):
        while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
            os.set_inheritable(descriptor, True)
        os.close(descriptor)


@contextlib.contextmanager
def _unread(stream: Any) -> Iterator[None]:
    """What is not read goes nowhere from now on, also what is left in a buffer."""
    try:
        yield
    except AttributeError:
        if stream is not None:
            raise
    except (OSError, ValueError) as error:  # ValueError: it was closed
        if getattr(error, "errno", None) in GONE:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                nothing = os.open(os.devnull, os.O_WRONLY)
                try:
                    os.dup2(nothing, stream.fileno())
                finally:
                    os.close(nothing)
