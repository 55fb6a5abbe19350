"""The viewfinder's server: who gets the page, and what comes from it and goes to it."""

import contextlib
import http.client
import json
import re
import socket
import threading
import time
from urllib.parse import urlsplit

import pytest

websockets = pytest.importorskip("websockets", reason="the extra view is not installed")
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from nil_mitsuba import server  # noqa: E402

HELLO = {"do": "hello", "size": [640, 360]}


@pytest.fixture
def link():
    with server.serve() as link:
        yield link


def port_of(link):
    return urlsplit(link.url).port


def path_of(link):
    return urlsplit(link.url).path


def ask(link, path, method="GET", hosts=None, **headers):
    """Status, headers and text of what is answered to a request."""
    connection = http.client.HTTPConnection("127.0.0.1", port_of(link), timeout=5)
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    for host in hosts if hosts is not None else [f"127.0.0.1:{port_of(link)}"]:
        connection.putheader("Host", host)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    response = connection.getresponse()
    text = response.read().decode()
    connection.close()
    return response.status, response.headers, text


def open_socket(link, **headers):
    """Status of the answer to a browser that asks for the WebSocket with such headers."""
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    hosts = headers.pop("hosts", None)
    connection = socket.create_connection(("127.0.0.1", port_of(link)), timeout=5)
    lines = [f"GET {path_of(link)}socket HTTP/1.1"]
    lines += [f"Host: {host}" for host in hosts or [f"127.0.0.1:{port_of(link)}"]]
    for name, value in (upgrade | headers).items():
        lines.append(f"{name.replace('_', '-')}: {value}")
    with connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(connection.recv(1000).split()[1])


@contextlib.contextmanager
def a_viewer(link, hello=HELLO):
    """A page that has the viewfinder open, and has said hello."""
    where = f"127.0.0.1:{port_of(link)}{path_of(link)}socket"
    origin = f"http://127.0.0.1:{port_of(link)}"
    with connect(f"ws://{where}", origin=origin, proxy=None, close_timeout=0.5) as page:
        if hello:
            page.send(json.dumps(hello))
            assert heard(link) == [hello]
        yield page


def heard(link, seconds=5):
    return link.messages(seconds)


def say(page, *messages):
    with contextlib.suppress(ConnectionClosed):  # after a message that was refused
        for message in messages:
            page.send(message if isinstance(message, (str, bytes)) else json.dumps(message))


def how_it_ends(page):
    """Code and reason with which the server closes a connection."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            page.recv(timeout=5)
    return closed.value.rcvd.code, closed.value.rcvd.reason


def eventually(condition, seconds=5):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


# ----------------------------------------------------------------- who gets the page


def test_its_address_serves_the_page_and_lets_it_run_nothing_of_others(link):
    status, headers, text = ask(link, path_of(link))
    assert status == 200
    assert text.startswith("<!doctype html>") and text.rstrip().endswith("</html>")
    assert headers.get_all("Content-Type") == ["text/html; charset=utf-8"]
    assert headers["Cache-Control"] == "no-store"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["X-Content-Type-Options"] == "nosniff"
    policy = dict(part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == "'none'" and policy["frame-ancestors"] == "'none'"
    assert re.fullmatch("'sha256-[^']*'", policy["script-src"])
    port = port_of(link)
    assert policy["connect-src"] == f"ws://127.0.0.1:{port} ws://localhost:{port}"


def test_the_page_names_nothing_on_a_network(link):
    _, _, text = ask(link, path_of(link))
    addresses = set(re.findall(r"\b(?:https?|wss?):(?://\S*)?", text))
    assert {address.split("'")[0] for address in addresses} == {
        "http://www.w3.org/2000/svg",  # the name of a language
        "ws://${location.host}${location.pathname}socket`);",
    }


def test_a_token_that_nobody_guesses_is_in_the_address(link):
    with server.serve() as other:
        assert path_of(other) != path_of(link)
        assert ask(link, path_of(other))[0] == 403
    assert len(path_of(link)) > 40


@pytest.mark.parametrize("path", ["/", "/wrong/", "//", "/favicon.ico", "/%2e%2e/", "*"])
def test_nothing_is_served_without_the_token(link, path):
    status, _, text = ask(link, path)
    assert status == 403 and "<" not in text


@pytest.mark.parametrize(
    "rest",
    ["viewfinder.html", "../server.py", "%2e%2e/server.py", "//etc/passwd", "?a=b", "socket/", "."],
)
def test_nothing_but_the_page_is_served(link, rest):
    status, _, text = ask(link, path_of(link) + rest)
    assert status == 404 and "<" not in text


def test_the_address_has_to_be_whole(link):
    assert ask(link, path_of(link).rstrip("/"))[0] == 404
    assert ask(link, path_of(link)[:-2] + "/")[0] == 403


@pytest.mark.parametrize("method", ["POST", "PUT", "HEAD", "OPTIONS", "DELETE"])
def test_the_page_can_only_be_got(link, method):
    # Older versions of the library end the connection without a word
    with contextlib.suppress(http.client.HTTPException, OSError):
        assert ask(link, path_of(link), method)[0] == 405


def test_a_name_of_this_computer_is_served(link):
    assert ask(link, path_of(link), hosts=[f"localhost:{port_of(link)}"])[0] == 200
    assert ask(link, path_of(link), hosts=[f"LocalHost:{port_of(link)}"])[0] == 200


@pytest.mark.parametrize(
    "hosts",
    [
        ["evil.example:{port}"],
        ["127.0.0.1"],
        ["127.0.0.1:1"],
        ["localhost.evil.example:{port}"],
        ["127.0.0.1:{port}", "evil.example"],
        ["127.0.0.1:{port}", "127.0.0.1:{port}"],
        [],
    ],
)
def test_a_foreign_host_is_refused(link, hosts):
    hosts = [host.format(port=port_of(link)) for host in hosts]
    assert ask(link, path_of(link), hosts=hosts)[0] == 403
    if hosts:
        origin = f"http://127.0.0.1:{port_of(link)}"
        assert open_socket(link, hosts=hosts, Origin=origin) == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_the_page_may_speak(link, host):
    assert open_socket(link, Origin=f"http://{host}:{port_of(link)}") == 101


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "https://127.0.0.1:{port}",
        "http://127.0.0.1:1",
        "http://127.0.0.1",
        "http://127.0.0.1:{port}.evil.example",
        "null",
        "",
    ],
)
def test_a_foreign_page_may_not_speak(link, origin):
    assert open_socket(link, Origin=origin.format(port=port_of(link))) == 403


def test_what_does_not_say_which_page_it_is_may_not_speak(link):
    assert open_socket(link) == 403


def test_the_socket_is_no_page(link):
    origin = f"http://127.0.0.1:{port_of(link)}"
    assert ask(link, path_of(link) + "socket", Origin=origin)[0] == 426
    assert ask(link, path_of(link) + "socket")[0] == 403


def test_only_this_computer_is_listened_to(link):
    assert urlsplit(link.url).hostname == "127.0.0.1"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documents: nothing is sent
        except OSError:
            pytest.skip("this computer has no other address")
        own = probe.getsockname()[0]
    with pytest.raises(OSError):
        socket.create_connection((own, port_of(link)), timeout=1)


def test_a_port_can_be_chosen_and_is_free_afterwards():
    with server.serve() as link:
        port = port_of(link)
    with server.serve(port) as link:
        assert port_of(link) == port
        with pytest.raises(OSError, match=rf"cannot serve .* at 127\.0\.0\.1:{port}: .*in use\.$"):
            with server.serve(port):
                pass


# ------------------------------------------------------------------- what is said


def test_what_the_page_says_reaches_the_engine_in_order(link):
    said = [
        {"do": "size", "size": [1, 16384]},
        {"do": "look", "by": [0.25, -0.5]},
        {"do": "go", "move": [1, 0, -1], "turn": [0, 0.5]},
        {"do": "speed", "by": -3},
        {"do": "point", "at": [0, 1]},
        {"do": "point", "at": None},
        {"do": "aim", "at": [0.5, 0.25]},
        {"do": "set", "name": "aperture_radius", "value": 1e-3},
        *({"do": word} for word in ("copy", "save", "render", "key", "home")),
    ]
    with a_viewer(link) as page:
        assert link.viewer
        say(page, *said)
        came = []
        while len(came) < len(said):
            came += heard(link)
        assert came == said
    assert heard(link) == [{"do": "bye"}]
    assert not link.viewer


MALFORMED = [
    "",
    "hello",
    "[]",
    "null",
    "{}",
    '{"do": "hello"',
    "[" * 30000,
    b'{"do": "copy"}',
    {"do": "quit"},
    {"do": ["copy"]},
    {"do": "copy", "path": "/etc/passwd"},
    {"do": "look"},
    {"do": "look", "by": [1]},
    {"do": "look", "by": [1, 2, 3]},
    {"do": "look", "by": "12"},
    {"do": "look", "by": [True, 0]},
    {"do": "look", "by": [None, 0]},
    '{"do": "look", "by": [NaN, 0]}',
    '{"do": "look", "by": [1e999, 0]}',
    '{"do": "look", "by": [-Infinity, 0]}',
    {"do": "look", "by": [10**400, 0]},
    {"do": "go", "move": [0, 0, 1.5], "turn": [0, 0]},
    {"do": "go", "move": [0, 0, 1]},
    {"do": "point", "at": [0.5, -0.1]},
    {"do": "aim", "at": None},
    {"do": "set", "name": "twist", "value": "1"},
    {"do": "set", "name": "Twist; rm", "value": 1},
    {"do": "set", "name": "x" * 33, "value": 1},
    {"do": "set", "name": "twist\n", "value": 1},
    {"do": "set", "name": 7, "value": 1},
    {"do": "size", "size": [0, 1]},
    {"do": "size", "size": [640.5, 1]},
    {"do": "size", "size": [10**6, 1]},
    {"do": "drawn", "frame": -1},
    HELLO,
]


@pytest.mark.parametrize("message", MALFORMED, ids=lambda m: str(m)[:40])
def test_what_means_nothing_ends_the_connection_and_never_reaches_the_engine(link, message):
    with a_viewer(link) as page:
        say(page, message, {"do": "save"})
        code, reason = how_it_ends(page)
    assert code == 1008 and re.fullmatch(r"[A-Z\"].*\.", reason)
    assert heard(link) == [{"do": "bye"}]


def test_a_long_message_is_not_even_read(link):
    with a_viewer(link) as page:
        say(page, json.dumps({"do": "set", "name": "twist", "value": 1}) + " " * 2**16)
        assert how_it_ends(page)[0] == 1009
    assert heard(link) == [{"do": "bye"}]


@pytest.mark.parametrize("first", [{"do": "save"}, "", {"do": "hello"}])
def test_who_does_not_say_hello_is_no_viewer(link, first):
    with a_viewer(link, hello=None) as page:
        say(page, first)
        assert how_it_ends(page)[0] == 1008
    assert heard(link, 0.05) == []


def test_one_viewer_steers_and_a_second_one_is_told_so(link):
    with a_viewer(link) as first:
        with a_viewer(link, hello=None) as second:
            say(second, {"do": "hello", "size": [1, 1]})
            code, reason = how_it_ends(second)
            assert code == 4001 and reason == server.TAKEN_SENTENCE
        link.send({"is": "says", "text": "Still here."})
        assert json.loads(first.recv(timeout=5))["text"] == "Still here."
    assert heard(link) == [{"do": "bye"}]


def test_after_the_first_viewer_has_left_the_next_one_may_come(link):
    for _ in range(3):
        with a_viewer(link):
            pass
        assert heard(link) == [{"do": "bye"}]


def test_a_viewer_who_vanishes_has_left(link):
    with a_viewer(link) as page:
        page.socket.shutdown(socket.SHUT_RDWR)
        assert heard(link) == [{"do": "bye"}]


def test_waiting_for_messages_ends_when_one_comes(link):
    with a_viewer(link) as page:
        start = time.monotonic()
        assert link.messages(0.05) == [] and time.monotonic() - start >= 0.05
        threading.Timer(0.05, say, (page, {"do": "copy"})).start()
        assert link.messages(5) == [{"do": "copy"}]
        assert time.monotonic() - start < 4


# -------------------------------------------------------------------- what is shown


def test_the_page_is_told_what_the_engine_says(link):
    with a_viewer(link) as page:
        link.send({"is": "says", "text": "Nil, né 1873 …", "kind": "note"})
        assert json.loads(page.recv(timeout=5))["text"] == "Nil, né 1873 …"
        link.send({"is": "under", "distance": float("inf"), "position": (1.5, float("nan"), 0)})
        event = json.loads(page.recv(timeout=5))
        assert event == {"is": "under", "distance": None, "position": [1.5, None, 0]}


def test_nothing_happens_if_nobody_is_there(link):
    link.send({"is": "says", "text": "Anyone?"})
    assert not link.ready and not link.show({"frame": 1}, b"jpeg")
    with a_viewer(link) as page:
        link.send({"is": "says", "text": "You."})
        assert json.loads(page.recv(timeout=5))["text"] == "You."


def frame_of(page):
    data = page.recv(timeout=5)
    length = int.from_bytes(data[:4], "big")
    return json.loads(data[4 : 4 + length]), data[4 + length :]


def test_no_more_than_two_frames_are_on_their_way(link):
    with a_viewer(link) as page:
        picture = bytes(range(256)) * 2**10  # more than a message from the page may have
        assert link.show({"frame": 1, "spp": 4}, picture) and link.show({"frame": 2}, b"b")
        assert not link.ready and not link.show({"frame": 3}, b"c")
        assert frame_of(page) == ({"is": "frame", "frame": 1, "spp": 4}, picture)
        assert frame_of(page) == ({"is": "frame", "frame": 2}, b"b")
        assert not link.ready
        start = time.monotonic()
        say(page, {"do": "drawn", "frame": 1})
        assert link.messages(5) == [] and link.ready  # it waits no longer than for that
        assert time.monotonic() - start < 4
        assert link.show({"frame": 4}, b"d") and not link.ready
        say(page, {"do": "drawn", "frame": 4})
        eventually(lambda: link.ready)
        assert link.show({"frame": 5}, b"e") and link.show({"frame": 6}, b"f")


def test_frames_that_a_viewer_has_not_drawn_do_not_hinder_the_next_one(link):
    with a_viewer(link):
        assert link.show({"frame": 1}, b"a") and link.show({"frame": 2}, b"b")
    assert heard(link) == [{"do": "bye"}]
    with a_viewer(link):
        assert link.ready


def test_a_page_that_reads_nothing_does_not_keep_the_engine_waiting():
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(server.serve())
        stack.enter_context(a_viewer(link))
        start = time.monotonic()
        for _ in range(300):
            link.send({"is": "says", "text": "x" * 10**5})  # more than sockets hold
        assert time.monotonic() - start < 2


def test_the_end_comes_after_what_has_been_said_before():
    with contextlib.ExitStack() as stack:
        with server.serve() as link:
            page = stack.enter_context(a_viewer(link))
            link.send({"is": "end", "text": "Over."})
        assert json.loads(page.recv(timeout=5)) == {"is": "end", "text": "Over."}
        assert how_it_ends(page)[0] == 1001
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", port_of(link)), timeout=1)


def test_connections_that_say_nothing_do_not_keep_the_command_from_ending():
    with server.serve() as link:
        silent = socket.create_connection(("127.0.0.1", port_of(link)))
        start = time.monotonic()
    assert time.monotonic() - start < 2
    silent.close()


# ------------------------------------------------------------------------ the library


def test_the_server_loads_no_numpy(fresh_python):
    done = fresh_python(
        "import sys; from nil_mitsuba import server\n"
        "with server.serve(): pass\n"
        "print('numpy' in sys.modules)"
    )
    assert done.stdout == "False\n", done.stderr


def test_what_is_missing_is_said(fresh_python):
    done = fresh_python("import sys; sys.modules['websockets'] = None\nimport nil_mitsuba.server")
    assert done.stderr.endswith(
        "the viewfinder needs the package websockets: pip install 'nil-mitsuba[view]'\n"
    )
