"""Ctrl-C, SIGTERM and a terminal that is closed."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE = 2.0  # seconds from a second signal until the process is ended, whatever it waits for

_heard: list[int] = []  # a Ctrl-C that `hear` remembers


def hear() -> None:
    """From now on remember a Ctrl-C: while a library is imported or C code calls back, the
    `KeyboardInterrupt` that it raises may be swallowed, and a run would begin as if nothing was."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _remember)


def _remember(number, frame):
    _heard.append(number)
    raise KeyboardInterrupt


class Signals:
    """Ctrl-C, SIGTERM and SIGHUP ask for an end after the generation; a second one stops at once.

    Python handles a signal between two steps of its own, which may never come: a program that
    runs, a pipe that is not written to. So a thread hears of it too, and if the second one does not
    stop the process in `GRACE` seconds, it ends it. A hang-up that is ignored (`nohup`) stays so.

    `end`: called before that, to end child processes.
    """

    def __init__(self, quiet: bool = True, end: Callable[[], Any] | None = None):
        self.received = 0
        self.quiet, self.end = quiet, end
        self._before: dict[int, Any] = {}
        self._left = threading.Event()

    def __enter__(self):
        """Hear signals, in the main thread alone; another one gets none."""
        if threading.current_thread() is threading.main_thread():
            for number in NUMBERS:
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._receive)
            self._listen()
            self.received = _heard.pop() if _heard else 0
        return self

    def _receive(self, number, frame):
        """Python's handler: note the first signal, end at the second one."""
        if self.received:
            raise SystemExit(128 + number)
        self.received = number
        if not self.quiet and sys.stderr is not None:
            # Not `print`: the signal may have come while the progress bar was being written. The
            # terminal may be gone with it.
            with contextlib.suppress(OSError):
                os.write(2, b"\ncredo: stopping after this generation; once more to stop at once\n")

    def _listen(self) -> None:
        """Have the system write the number of every signal into a pipe, for `_watch`."""
        read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        self._old = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(read,), daemon=True).start()

    def _watch(self, read: int) -> None:
        """In a thread: end the process if `GRACE` seconds after a second signal it is still
        there."""
        seen = 0
        while data := os.read(read, 64):  # empty once no process can write any more
            for number in data:
                seen += number in self._before
                if number in self._before and seen == 2 and not self._left.wait(GRACE):
                    with contextlib.suppress(Exception):  # the end comes in any case
                        (self.end or (lambda: None))()
                    os._exit(128 + number)
        os.close(read)

    def __exit__(self, *_):
        """What was in place before hears them again."""
        self._left.set()
        if self._before:
            for number, handler in self._before.items():
                signal.signal(number, signal.SIG_DFL if handler is None else handler)
            signal.set_wakeup_fd(self._old)
            os.close(self._write)
