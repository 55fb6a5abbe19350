"""What ends the command when Python's own handlers cannot: a second Ctrl-C or SIGTERM."""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator

from . import files

# So many seconds after its second signal, a main thread that has not ended by itself is ended.
PATIENCE = 2.0

# What goes on for longer than this after a first signal is explained.
EXPLAIN_SECONDS = 1.0


class Watch:
    """Ends this process after a second Ctrl-C or SIGTERM, whatever its main thread is doing.

    Python's handlers run in the main thread, between two of its byte codes, which may be minutes
    apart in a kernel. The numbers of signals are written to a socket at once, and read by a thread.
    To be used in the main thread, as a context: signals count that come in it. ``farewell`` gives
    the sentence that goes with the end.
    """

    def __init__(self, farewell: str):
        self.farewell: Callable[[], str] = lambda: farewell
        self._explanation: Callable[[], str] | None = None
        self._numbers: list[int] = []

    @contextlib.contextmanager
    def explaining(self, sentence: Callable[[], str]) -> Iterator[None]:
        """What goes on after a first signal in this context is explained with a sentence."""
        self._explanation = sentence
        try:
            yield
        finally:
            self._explanation = None

    def __enter__(self) -> Watch:
        self._read, self._write = socket.socketpair()
        self._write.setblocking(False)
        self._before = signal.set_wakeup_fd(self._write.fileno(), warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        signal.set_wakeup_fd(self._before)
        self._write.close()  # the thread reads its end
        self._thread.join()
        self._read.close()
        if len(self._numbers) > 1:  # what else happens at exit, as with workers, has no more time
            left = max(0.0, self._deadline - time.monotonic())
            timer = threading.Timer(left, os._exit, (128 + self._numbers[1],))
            timer.daemon = True
            timer.start()

    def _run(self) -> None:
        with contextlib.suppress(EOFError):
            self._hear(1)
            if not self._hear(2, EXPLAIN_SECONDS):
                if self._explanation:
                    _say(self._explanation())
                self._hear(2)
            self._deadline = time.monotonic() + PATIENCE
            self._hear(math.inf, PATIENCE)
            files.abandon()
            _say(self.farewell())
            os._exit(128 + self._numbers[1])

    def _hear(self, count: float, seconds: float = math.inf) -> bool:
        """Read until so many signals have come, or time is over; raises EOFError at the end."""
        stop = time.monotonic() + seconds
        while len(self._numbers) < count:
            left = None if seconds == math.inf else max(0.0, stop - time.monotonic())
            if not select.select([self._read], [], [], left)[0]:
                return False
            data = self._read.recv(64)
            if not data:
                raise EOFError
            self._numbers += (n for n in data if n in (signal.SIGINT, signal.SIGTERM))
        return True


def _say(sentence: str) -> None:
    """Write a sentence to stderr, in place of a progress bar, without waiting for anyone's lock."""
    start = "\r\033[K" if os.isatty(2) else ""
    with contextlib.suppress(OSError):
        os.write(2, f"{start}nil-mitsuba: {sentence}\n".encode(errors="replace"))
