"""The viewfinder's page and the one viewer who has it open. Knows nothing of Mitsuba or Dr.Jit.

The page is served to this computer only, at an address that nobody guesses, and it speaks with the
command by a WebSocket. Threads of the server carry messages; what they mean is the engine's matter,
which calls a `Link` in the main thread.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import logging
import math
import os
import queue
import re
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from http import HTTPStatus
from importlib import resources
from typing import Any

try:
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response
    from websockets.sync.server import ServerConnection
    from websockets.sync.server import serve as serve_websockets
except ModuleNotFoundError:
    raise ModuleNotFoundError(
        "the viewfinder needs the package websockets: pip install 'nil-mitsuba[view]'"
    ) from None

PAGE = "viewfinder.html"

# One frame is drawn while the next one is on its way: more would only make the picture late.
FRAMES_AHEAD = 2

# Bytes of a message from the page; the longest that means something has about a hundred.
MESSAGE_SIZE = 2**16

# Seconds for a browser on this computer to say hello, and to answer when it is told goodbye.
HELLO_SECONDS = 10.0
GOODBYE_SECONDS = 1.0

SIGNAL_SECONDS = 0.1  # between two looks at whether a signal has come

# Why a connection ends, as RFC 6455 numbers it; from 4000 on numbers are the application's.
GOING_AWAY, REFUSED, TAKEN = 1001, 1008, 4001

TAKEN_SENTENCE = "Another window has this viewfinder: close that one, and this one takes over."


# --------------------------------------------------------------------- messages


def _number(least: float, most: float) -> Callable[[Any], bool]:
    # True is an int in Python, and no comparison holds for not-a-number
    return lambda value: type(value) in (int, float) and least <= value <= most


def _whole(least: int, most: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and least <= value <= most


def _list(count: int, each: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: type(value) is list and len(value) == count and all(map(each, value))


def _or_null(check: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or check(value)


def _name(value: Any) -> bool:
    return type(value) is str and re.fullmatch(r"[a-z][a-z_]{0,31}", value) is not None


# A picture of 16384 pixels a side is more than screens have; drags and wheels come once a frame
# of the screen, in which nobody drags a hundred heights.
_SIZE = _list(2, _whole(1, 2**14))
_AT = _list(2, _number(0, 1))
_PART = _number(-1, 1)

# What the page may ask for, and what comes with it.
HOLDS: dict[str, dict[str, Callable[[Any], bool]]] = {
    "hello": {"size": _SIZE},
    "size": {"size": _SIZE},
    "look": {"by": _list(2, _number(-100, 100))},
    "go": {"move": _list(3, _PART), "turn": _list(2, _PART)},
    "speed": {"by": _number(-100, 100)},
    "point": {"at": _or_null(_AT)},
    "aim": {"at": _AT},
    "set": {"name": _name, "value": _number(-1e30, 1e30)},  # what float32 holds
    "copy": {},
    "save": {},
    "render": {},
    "key": {},
    "home": {},
    "drawn": {"frame": _whole(0, 2**53)},  # what a browser counts exactly
}


def understood(text: str | bytes) -> dict[str, Any]:
    """A message of the page; raises ValueError, with a sentence, if it is none of `HOLDS`."""
    if not isinstance(text, str):
        raise ValueError("A message is not text.")
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("A message is not JSON.") from None
    do = message.get("do") if type(message) is dict else None
    if type(do) is not str or do not in HOLDS:
        raise ValueError('A message has no "do" that the viewfinder knows.')
    checks = HOLDS[do]
    if message.keys() != {"do", *checks}:
        raise ValueError(f'A message "{do}" does not hold what it has to.')
    for name, check in checks.items():
        if not check(message[name]):
            raise ValueError(f'In a message "{do}", "{name}" is not what it has to be.')
    return message


def _plain(value: Any) -> Any:
    """A value with null for each number that JSON does not have."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    return value


def _json(event: dict[str, Any]) -> str:
    return json.dumps(_plain(event), separators=(",", ":"))


# ------------------------------------------------------------------- the viewer


class Link:
    """What the engine sees of the page: messages that have come, and whether somebody is there.

    A viewer's first message is {"do": "hello", "size": [width, height]} (pixels of the screen in
    which the picture has room), and when the viewer has left there is {"do": "bye"}. All of them
    hold what `HOLDS` says. ``url`` is the page's address.
    """

    def __init__(self, url: str):
        self.url = url
        self._changed = threading.Condition()
        self._inbox: list[dict[str, Any]] = []
        self._drawn = False  # a frame, since the last look
        self._viewer: _Viewer | None = None

    @property
    def viewer(self) -> bool:
        """Whether somebody is there."""
        return self._viewer is not None

    @property
    def ready(self) -> bool:
        """Whether a frame would be shown now."""
        viewer = self._viewer
        return viewer is not None and viewer.ready

    def messages(self, wait: float) -> list[dict[str, Any]]:
        """All that has come from the page since the last call.

        Waits for up to ``wait`` seconds if nothing has come. That a frame has been drawn is not
        among the messages, but ends the wait: another one can be shown.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._inbox or self._drawn, wait)
            taken, self._inbox, self._drawn = self._inbox, [], False
        return taken

    def await_viewer(self, seconds: float, ended: Callable[[], bool]) -> None:
        """Wait until somebody is there, for so long, or until ``ended``."""
        stop = time.monotonic() + seconds
        with self._changed:
            while not (self._viewer or ended() or time.monotonic() > stop):
                # A signal wakes nobody here: it is looked at between
                self._changed.wait(SIGNAL_SECONDS)

    def send(self, event: dict[str, Any]) -> None:
        """Tell the page something; nothing happens if nobody is there.

        Numbers that are infinite or not a number become null.
        """
        viewer = self._viewer
        if viewer:
            viewer.outbox.put(_json(event))

    def show(self, header: dict[str, Any], jpeg: bytes) -> bool:
        """Show a frame, unless nobody is there or the page has yet to draw two others.

        ``header`` has the key "frame", a number that grows. Returns whether it is shown.
        """
        with self._changed:
            viewer = self._viewer
            if viewer is None or not viewer.ready:
                return False
            viewer.undrawn.append(header["frame"])
        head = _json({"is": "frame", **header}).encode()
        viewer.outbox.put(len(head).to_bytes(4, "big") + head + jpeg)
        return True

    def _attend(self, connection: ServerConnection) -> None:
        """Take what a viewer says until the connection ends; in its thread."""
        viewer = _Viewer(connection)
        with self._changed:
            taken = self._viewer is not None
            if not taken:
                self._viewer = viewer
                self._changed.notify_all()
        if taken:
            connection.close(TAKEN, TAKEN_SENTENCE)
            return
        threading.Thread(target=viewer.write, daemon=True).start()
        greeted = False
        try:
            greeted = self._greet(connection)
            for text in connection:
                self._take(viewer, understood(text))
        except ValueError as error:
            connection.close(REFUSED, str(error))
        except (ConnectionClosed, TimeoutError):
            pass  # who leaves need not say so
        finally:
            with self._changed:
                self._viewer = None
                if greeted:
                    self._inbox.append({"do": "bye"})
                    self._changed.notify_all()
            viewer.outbox.put(None)

    def _greet(self, connection: ServerConnection) -> bool:
        message = understood(connection.recv(timeout=HELLO_SECONDS))
        if message["do"] != "hello":
            raise ValueError('The first message is not "hello".')
        with self._changed:
            self._inbox.append(message)
            self._changed.notify_all()
        return True

    def _take(self, viewer: _Viewer, message: dict[str, Any]) -> None:
        if message["do"] == "hello":
            raise ValueError('"hello" has been said before.')
        with self._changed:
            if message["do"] == "drawn":
                viewer.drawn(message["frame"])
                self._drawn = True
            else:
                self._inbox.append(message)
            self._changed.notify_all()

    def _close(self) -> None:
        """Say goodbye to the viewer, after all that has been sent."""
        viewer = self._viewer
        if viewer:
            viewer.outbox.put(None)
            viewer.gone.wait(2 * GOODBYE_SECONDS)


class _Viewer:
    """A connection: what is to be sent by it, and the frames that the page has not drawn yet."""

    def __init__(self, connection: ServerConnection):
        self.connection = connection
        self.outbox: queue.SimpleQueue[str | bytes | None] = queue.SimpleQueue()
        self.undrawn: deque[int] = deque()
        self.gone = threading.Event()

    @property
    def ready(self) -> bool:
        return len(self.undrawn) < FRAMES_AHEAD

    def drawn(self, frame: int) -> None:
        """The page has drawn a frame, and those before it will not be drawn any more."""
        while self.undrawn and self.undrawn[0] <= frame:
            self.undrawn.popleft()

    def write(self) -> None:
        """Send what is to be sent; in a thread of its own, since a slow browser lets it wait."""
        with contextlib.suppress(ConnectionClosed):
            while (message := self.outbox.get()) is not None:
                self.connection.send(message)
            self.connection.close(GOING_AWAY, "nil-mitsuba view has ended.")
        self.gone.set()


# ------------------------------------------------------------------- the server


@contextlib.contextmanager
def serve(port: int = 0) -> Iterator[Link]:
    """Serve the page at 127.0.0.1 and a port (a free one if 0) while the context lasts.

    Yields the link to whoever opens its ``url``. Raises OSError, with a sentence, if the port
    cannot be had.
    """
    try:
        # To this computer only, whatever "localhost" may mean on it
        listener = socket.create_server(("127.0.0.1", port))
    except OSError as error:
        reason = os.strerror(error.errno or 0)  # Python adds the address to its own
        raise OSError(f"cannot serve the page at 127.0.0.1:{port}: {reason}.") from error
    door = _Door(listener.getsockname()[1])
    link = Link(door.url)
    # Browsers open connections ahead and drop them, which the library would complain about
    logger = logging.getLogger(f"{__name__}.websockets")
    logger.disabled = True
    server = serve_websockets(
        link._attend,
        sock=listener,
        process_request=door.answer,
        compression=None,  # JPEG has been compressed, and messages are short
        server_header=None,
        open_timeout=HELLO_SECONDS,
        # A browser on this computer is there as long as its connection is; and an answer that has
        # come while a kernel was being compiled would be taken for a late one
        ping_interval=None,
        close_timeout=GOODBYE_SECONDS,
        max_size=MESSAGE_SIZE,
        logger=logger,
    )
    # Threads of connections are daemons as well, being started by one
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield link
    finally:
        link._close()
        # It may wait for connections that say nothing, and nobody has to wait for it; the port is
        # free at once
        closing = threading.Thread(target=server.shutdown, daemon=True)
        closing.start()
        closing.join(GOODBYE_SECONDS / 4)


class _Door:
    """Who gets the page, and who may speak with the command."""

    def __init__(self, port: int):
        self.token = secrets.token_urlsafe()
        self.hosts = [f"127.0.0.1:{port}", f"localhost:{port}"]
        self.url = f"http://{self.hosts[0]}/{self.token}/"
        self.page = resources.files(__package__).joinpath(PAGE).read_text(encoding="utf-8")
        self.headers = {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Security-Policy": _policy(self.page, self.hosts),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page or a refusal; None lets a WebSocket open."""
        # A name of somebody else's that leads here would make its pages ours, or ours its
        if not _one_of(request.headers.get_all("Host"), self.hosts):
            return connection.respond(HTTPStatus.FORBIDDEN, "This is not the host's name.\n")
        # Older versions of the library know no other method, and no attribute that says so
        if getattr(request, "method", "GET") != "GET":
            return connection.respond(
                HTTPStatus.METHOD_NOT_ALLOWED, "There is only a page to get.\n"
            )
        token, _, rest = request.path.removeprefix("/").partition("/")
        if not secrets.compare_digest(token.encode(), self.token.encode()):
            return connection.respond(
                HTTPStatus.FORBIDDEN, "Take the address that nil-mitsuba view has printed.\n"
            )
        if rest == "" and request.path.endswith("/"):
            response = connection.respond(HTTPStatus.OK, self.page)
            del response.headers["Content-Type"]
            response.headers.update(self.headers)
            return response
        if rest == "socket":
            origins = [f"http://{host}" for host in self.hosts]
            if _one_of(request.headers.get_all("Origin"), origins):
                return None
            return connection.respond(HTTPStatus.FORBIDDEN, "Another page may not ask for this.\n")
        return connection.respond(HTTPStatus.NOT_FOUND, "There is only one page here.\n")


def _one_of(values: list[str], allowed: list[str]) -> bool:
    return len(values) == 1 and values[0].lower() in allowed


def _policy(page: str, hosts: list[str]) -> str:
    """The Content-Security-Policy by which the page runs its own script and style alone."""

    def hashes(element: str) -> str:
        (text,) = re.findall(rf"<{element}>(.*?)</{element}>", page, re.DOTALL)
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    return "; ".join(
        (
            "default-src 'none'",
            f"script-src {hashes('script')}",
            f"style-src {hashes('style')}",
            "img-src data:",  # its icon
            f"connect-src {' '.join(f'ws://{host}' for host in hosts)}",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    )
