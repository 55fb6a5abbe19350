"""What the command "view" says, in the terminal and on its page."""

import contextlib
import json
import threading

import pytest

pytest.importorskip("websockets", reason="the extra view is not installed")
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from nil_mitsuba import cli


def page(url):
    """The page at an address, when it has connected."""
    where = url.removeprefix("http://")
    return connect(f"ws://{where}socket", origin=f"http://{where.split('/')[0]}", proxy=None)


@pytest.fixture
def slow_browser(monkeypatch):
    """A browser that takes a while until it has the page; gives all that this has been told."""
    told = []

    def show(url):
        with page(url) as socket, contextlib.suppress(ConnectionClosed):
            while True:
                told.append(json.loads(socket.recv(timeout=10)))

    threads = []

    def start(url):
        threads.append(threading.Timer(0.5, show, (url,)))
        threads[-1].start()
        return True

    monkeypatch.setattr(cli.webbrowser, "open", start)

    def told_in_the_end():
        for thread in threads:
            thread.join()
        return told

    yield told_in_the_end


def test_an_error_of_the_scene_waits_for_the_page_and_is_said_once(slow_browser, command, folder):
    (folder / "scene.xml").write_text("<scene version='3.0.0'><shape></scene>")
    status, out, err = command("view", "scene.xml")
    assert status == 1 and out.startswith("http://127.0.0.1:")
    assert err.count("\n") == 1 and err.startswith("nil-mitsuba: ") and "tags mismatch" in err
    assert slow_browser() == [{"is": "end", "text": err.removeprefix("nil-mitsuba: ").rstrip()}]


def test_an_error_does_not_wait_for_a_browser_that_is_not_there(command, folder, monkeypatch):
    (folder / "scene.xml").write_text("<scene version='3.0.0'><shape></scene>")
    monkeypatch.setattr(cli.webbrowser, "open", lambda _: False)
    monkeypatch.setattr(cli, "COMING_SECONDS", 1e9)
    status, _, err = command("view", "scene.xml")
    assert status == 1 and err.count("\n") == 1 and "tags mismatch" in err


def test_an_error_waits_no_longer_than_a_browser_takes(command, folder, monkeypatch):
    (folder / "scene.xml").write_text("<scene version='3.0.0'><shape></scene>")
    monkeypatch.setattr(cli.webbrowser, "open", lambda _: True)
    monkeypatch.setattr(cli, "COMING_SECONDS", 0.1)
    status, _, err = command("view", "scene.xml")
    assert status == 1 and err.count("\n") == 1 and "tags mismatch" in err
