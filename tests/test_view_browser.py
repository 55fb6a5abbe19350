"""The viewfinder's page in a real browser, with an engine that has no scene."""

import contextlib
import threading
import time

import drjit as dr
import mitsuba as mi
import pytest

pytest.importorskip("websockets", reason="the extra view is not installed")
from browser import chromium
from nil_mitsuba import server
from stub_viewfinder import XML, Engine

SHIFT, TAB, ESCAPE, ENTER, HOME = "\ue008", "\ue004", "\ue00c", "\ue007", "\ue011"
LEFT, UP, RIGHT = "\ue012", "\ue013", "\ue014"


@pytest.fixture(scope="module")
def window():
    """A browser for all of these tests: it takes a second to start."""
    with chromium(800, 600) as window:
        yield window


@pytest.fixture(scope="module")
def link():
    with server.serve() as link:
        yield link


@contextlib.contextmanager
def engine_of(link):
    engine = Engine(link)
    thread = threading.Thread(target=engine.run)
    thread.start()
    try:
        yield engine
    finally:
        engine.done.set()
        thread.join()
        assert engine.error is None, engine.error


@pytest.fixture
def page(window, link, rgb):
    """The page of an engine that shows its first frame; it complains of nothing in a test."""
    window.complaints()  # of an earlier test
    link.messages(0)
    with engine_of(link) as engine:
        window.engine = engine
        window.resize(800, 600)
        window.open(link.url)
        window.wait(lambda: window.frame)
        while engine.heard[0]["do"] != "hello":  # the page of the test before
            del engine.heard[0]
        yield window
    assert window.complaints() == []


def square_in(page):
    """Where the bright square is in the picture that is shown, in parts of its sides."""
    image = page.picture()
    height, width, _ = image.shape
    red = image[:, :, 0].array
    index = dr.arange(mi.UInt32, width * height)
    found = mi.Float(red > 0.5)
    x, y = (dr.sum(found * (i + 0.5)) / dr.sum(found) for i in (index % width, index // width))
    return x[0] / width, y[0] / height


def near(place, *expected):
    return all(abs(a - b) < 0.01 for a, b in zip(place, expected))


# ------------------------------------------------------------------------- the picture


def test_it_shows_the_frame_as_large_as_the_window_allows(page):
    hello = page.engine.heard_of("hello")
    width, height = page.run("return [innerWidth, innerHeight]")
    panel, line = page.find("panel").size["width"], page.find("line").size["height"]
    assert [message["size"] for message in hello] == [[width - panel, height - line]]
    size = page.find("picture").size
    assert size["width"] == width - panel and abs(size["height"] - size["width"] * 9 / 16) <= 1
    image = page.picture()
    assert image.shape[1] == size["width"]  # a pixel for each of the screen
    assert near(square_in(page), 0.7, 0.3)
    wall = [image[5, 5, c].array[0] for c in range(3)]
    assert wall[2] > 10 * wall[0] > 0  # blue
    assert page.text("title") == "room" and page.browser.title.startswith("room")
    assert not page.find("waiting").is_displayed()


def test_it_asks_for_as_many_pixels_as_the_screen_has(page):
    page.resize(640, 480, scale=2)
    asked = page.wait(lambda: page.engine.heard_of("size"))[-1]["size"]
    width, height = page.run("return [stage.clientWidth, stage.clientHeight]")
    assert asked == [2 * width, 2 * height]
    page.wait(lambda: page.picture().shape[1] == asked[0])


def test_a_small_frame_fills_the_same_place(page):
    before = page.find("picture").rect
    page.engine.scale = 8
    page.press(HOME)
    page.wait(lambda: page.run("return picture.dataset.width") == str(before["width"] // 8))
    assert page.find("picture").rect == before
    assert near(square_in(page), 0.7, 0.3)


def test_frames_that_come_fast_are_all_answered(page):
    page.engine.many = 40
    page.wait(lambda: page.frame == 41)
    page.wait(lambda: page.engine.link.ready)


# ------------------------------------------------------------------------ keys and mouse


def goes(page):
    return [(*m["move"], *m["turn"]) for m in page.engine.heard_of("go")]


def test_keys_walk_as_long_as_they_are_held(page):
    page.actions.key_down("w").key_down("w").key_down("a").key_up("w").key_up("a").perform()
    page.wait(lambda: len(goes(page)) == 4)
    assert goes(page) == [(0, 0, 1, 0, 0), (1, 0, 1, 0, 0), (1, 0, 0, 0, 0), (0, 0, 0, 0, 0)]


def test_each_key_goes_its_way(page):
    page.press(*"wsadeq", LEFT, RIGHT, UP)
    page.wait(lambda: len(goes(page)) == 18)
    assert goes(page)[::2] == [
        *((0, 0, 1, 0, 0), (0, 0, -1, 0, 0), (1, 0, 0, 0, 0), (-1, 0, 0, 0, 0)),
        *((0, 1, 0, 0, 0), (0, -1, 0, 0, 0)),
        *((0, 0, 0, 1, 0), (0, 0, 0, -1, 0), (0, 0, 0, 0, 1)),
    ]
    assert set(goes(page)[1::2]) == {(0, 0, 0, 0, 0)}


def test_who_leaves_the_window_stands_still(page):
    page.actions.key_down("w").perform()
    page.run("window.dispatchEvent(new Event('blur'))")
    page.wait(lambda: len(goes(page)) == 2)
    assert goes(page)[-1] == (0, 0, 0, 0, 0)
    page.actions.key_up("w").perform()


def test_the_picture_follows_the_hand(page):
    height = page.find("picture").size["height"]
    page.to(0.5, 0.5).click_and_hold().move_by_offset(90, -45).release().perform()
    page.wait(lambda: near(square_in(page), 0.7 + 90 / height * 9 / 16, 0.3 - 45 / height))
    sums = [sum(m["by"][i] for m in page.engine.heard_of("look")) for i in (0, 1)]
    assert abs(sums[0] - 90 / height) < 1e-6 and abs(sums[1] + 45 / height) < 1e-6
    page.to(0.2, 0.2).perform()  # no button is down any more
    page.wait(lambda: page.engine.heard_of("point"))
    assert sums[0] == sum(m["by"][0] for m in page.engine.heard_of("look"))


def test_a_click_with_shift_brings_what_is_there_to_the_middle(page):
    page.to(0.7, 0.3).key_down(SHIFT).click().key_up(SHIFT).perform()
    page.wait(lambda: near(square_in(page), 0.5, 0.5))
    assert len(page.engine.heard_of("aim")) == 1 and page.engine.heard_of("look") == []


def test_a_click_alone_changes_nothing(page):
    page.to(0.7, 0.3).click().perform()
    page.press(HOME)
    page.wait(lambda: page.engine.heard_of("home"))
    assert {message["do"] for message in page.engine.heard} <= {"hello", "point", "home"}


def test_the_wheel_changes_speed(page):
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    origin = ScrollOrigin.from_element(page.find("picture"))
    page.actions.scroll_from_origin(origin, 0, -300).perform()
    page.wait(lambda: sum(m["by"] for m in page.engine.heard_of("speed")) == 3)
    assert page.wait(lambda: page.text("says")) == "Speed +3."


def test_what_is_under_the_pointer_is_told(page):
    page.to(0.7, 0.3).perform()
    page.wait(lambda: "square" in page.text("under"))
    assert page.text("under").split("\n") == [
        *("square", "2.410 away", "at 0.500, −1.250, 0.333", "cell 0, 0, 1")
    ]
    page.to(0.2, 0.8).perform()
    page.wait(lambda: page.text("under") == "sky")
    page.actions.move_to_element(page.find("title")).perform()
    page.wait(lambda: page.text("under") == "")
    page.wait(lambda: page.engine.heard_of("point")[-1]["at"] is None)


def test_what_comes_under_a_pointer_at_rest_is_told(page):
    page.to(0.5, 0.5).perform()
    page.wait(lambda: page.text("under") == "sky")
    page.engine.place = [0.5, 0.5]
    page.press(HOME)  # shows that
    page.wait(lambda: "square" in page.text("under"))


def test_a_pointer_that_runs_about_asks_eight_times_a_second(page):
    for i in range(12):
        page.to(0.1 + 0.05 * i, 0.5).perform()
    seconds = page.run("return performance.now()") / 1000
    asked = page.engine.heard_of("point")
    assert 2 <= len(asked) <= 8 * seconds + 1


# ----------------------------------------------------------------------------- sliders


def sets(page, name):
    return [m["value"] for m in page.engine.heard_of("set") if m["name"] == name]


def blue_in(page):
    return page.picture()[5, 5, 2].array[0]


def test_a_slider_is_dragged_and_a_double_click_takes_it_back(page):
    slider = page.find("slider-twist")
    before, width = blue_in(page), slider.size["width"]
    page.actions.drag_and_drop_by_offset(slider, -width // 2, 0).perform()  # from its middle
    page.wait(lambda: sets(page, "twist")[-1:] == [0])
    page.wait(lambda: blue_in(page) < 0.1 * before)
    assert page.find("value-twist").get_attribute("value") == "0.00"
    page.actions.double_click(slider).perform()
    page.wait(lambda: sets(page, "twist")[-1:] == [1])
    page.wait(lambda: abs(blue_in(page) - before) < 0.05 * before)
    page.press(LEFT)  # the arrows are the picture's again
    page.wait(lambda: len(goes(page)) == 2)
    assert sets(page, "twist")[-1] == 1


def test_the_keyboard_moves_a_slider(page):
    page.find("slider-exposure").send_keys(RIGHT, RIGHT)
    page.wait(lambda: sets(page, "exposure")[-1:] == [0.2])
    assert goes(page) == []


def test_a_number_can_be_typed_and_keys_do_not_walk_meanwhile(page):
    page.click("value-twist")
    page.press("0.25wasd")
    page.press(*"\ue003" * 4, ENTER)  # backspaces
    page.wait(lambda: sets(page, "twist") == [0.25])
    page.click("value-twist")
    page.press("7", ENTER)  # beyond its end
    page.wait(lambda: sets(page, "twist") == [0.25, 1])
    page.click("value-twist")
    page.press("0.5", ESCAPE)
    page.click("value-fov")
    page.press("nonsense", ENTER)
    assert page.find("value-fov").get_attribute("value") == "60"
    page.press("w")
    page.wait(lambda: len(goes(page)) == 2)
    assert sets(page, "twist") == [0.25, 1] and sets(page, "fov") == []


def test_a_logarithmic_slider_has_the_geometric_mean_in_its_middle(page):
    page.click("slider-focus_distance")
    page.wait(lambda: sets(page, "focus_distance"))
    assert abs(sets(page, "focus_distance")[-1] - 10**0.5) < 0.1  # pixels


def test_what_the_command_makes_of_a_slider_is_shown(page):
    page.click("value-max_depth")
    page.press("30", ENTER)
    page.wait(lambda: page.find("value-max_depth").get_attribute("value") == "16")
    assert page.find("slider-max_depth").get_attribute("value") == "16"
    assert sets(page, "max_depth") == [30]


def test_what_is_off_or_on_is_a_switch(page):
    page.click("slider-filmic")
    page.wait(lambda: sets(page, "filmic") == [1])
    page.click("slider-filmic")
    page.wait(lambda: sets(page, "filmic") == [1, 0])


def test_sliders_that_come_and_go_keep_the_others(page):
    page.run("sliders.get('twist').row.dataset.mark = 'same'")
    gone = page.engine.sliders.pop("aperture_radius")
    page.engine.sliders["twist"]["value"] = 0.5
    page.engine.send_scene()
    page.wait(lambda: page.find("value-twist").get_attribute("value") == "0.50")
    assert page.run("return sliders.get('twist').row.dataset.mark") == "same"
    assert page.run("return document.getElementById('slider-aperture_radius')") is None
    page.engine.sliders["aperture_radius"] = gone
    page.engine.send_scene()
    page.wait(lambda: page.run("return sliders.size") == len(page.engine.sliders))
    names = page.run("return [...document.querySelectorAll('.slider')].map(r => r.dataset.name)")
    assert names == list(page.engine.sliders)


# ------------------------------------------------------------------------ what is kept


def test_the_camera_is_copied(page):
    page.click("copy")
    area = page.wait(lambda: page.browser.find_elements("id", "camera-xml"))[0]
    assert area.get_attribute("value") == XML
    assert page.find("camera-options").get_attribute("value") == "-P twist=1"
    page.wait(lambda: page.text("card-note") == "Copied.")
    assert page.run("return navigator.clipboard.readText()") == XML
    page.press(ESCAPE)
    assert not page.find("card").is_displayed()


def test_without_a_clipboard_the_camera_is_selected_for_copying(page):
    page.run(
        "navigator.clipboard.writeText = () => Promise.reject(); document.execCommand = () => false"
    )
    page.press("c")
    page.wait(lambda: page.text("card-note") == "Press Ctrl-C to copy it.")
    assert page.run("return getSelection().toString()") == XML
    page.press("w", ESCAPE, "w")
    page.wait(lambda: len(goes(page)) == 2)


def test_a_copy_of_the_scene_is_saved(page):
    page.click("save")
    page.wait(lambda: page.text("says") == "Saved as scenes/room.view-1.xml")


def test_the_command_of_the_still_is_shown(page):
    page.click("render")
    area = page.wait(lambda: page.browser.find_elements("id", "command"))[0]
    assert area.get_attribute("value").startswith("nil-mitsuba render scenes/room.view-1.xml ")


def test_keys_of_a_flight_are_counted(page):
    page.click("key")
    page.wait(lambda: page.text("keys-text") == "1 key in cameras.json.")
    page.press("k")
    page.wait(lambda: page.text("keys-text") == "2 keys in cameras.json.")
    page.click("fly")
    area = page.wait(lambda: page.browser.find_elements("id", "fly-command"))[0]
    assert area.get_attribute("value").startswith("nil-mitsuba fly scenes/room.xml ")


# ------------------------------------------------------------------------- what is said


def test_an_error_stays_until_it_is_closed(page):
    page.engine.link.send({"is": "says", "kind": "busy", "text": "Compiling …"})
    page.wait(lambda: page.text("busy") == "Compiling …")
    sentence = 'The shape "<b>ball</b>" crosses the face x = 1.'
    page.engine.link.send({"is": "says", "kind": "error", "text": sentence})
    page.wait(lambda: page.text("error-text") == sentence)
    assert not page.find("busy").is_displayed()
    page.click("error-close")
    assert not page.find("error").is_displayed()


def test_a_frame_ends_what_it_was_waited_for(page):
    page.engine.link.send({"is": "says", "kind": "busy", "text": "Compiling …"})
    page.wait(lambda: page.find("busy").is_displayed())
    page.press(HOME)
    page.wait(lambda: not page.find("busy").is_displayed())


def test_the_controls_hide_and_the_picture_grows(page):
    before = page.find("picture").size["width"]
    page.press(TAB)
    page.wait(lambda: page.engine.heard_of("size"))
    assert page.find("picture").size["width"] == 800 > before
    assert not page.find("panel").is_displayed()
    page.click("show")
    assert page.find("picture").size["width"] == before


def test_a_keyboard_alone_reaches_the_controls(page):
    page.actions.key_down(SHIFT).send_keys(TAB, TAB).key_up(SHIFT).perform()
    assert page.run("return document.activeElement.id") == "help-button"
    page.press(ENTER)
    assert page.find("help").is_displayed()
    page.press("h")
    assert not page.find("help").is_displayed() and goes(page) == []


def test_everything_that_is_clicked_has_a_name(page):
    nameless = """return [...document.querySelectorAll('button, input')].filter(e =>
        !(e.getAttribute('aria-label') || e.textContent.trim() || e.labels?.length)).length"""
    assert page.run(nameless) == 0


# ------------------------------------------------------------------------ coming and going


def test_a_second_window_is_told_and_takes_over_when_the_first_has_gone(page):
    page.browser.switch_to.new_window("tab")
    try:
        page.open(page.engine.link.url)
        page.wait(lambda: page.state == "taken")
        assert page.text("veil-text") == server.TAKEN_SENTENCE
        page.browser.switch_to.window(page.home)
        assert page.state == "open"
        page.open("about:blank")
        page.browser.switch_to.window(page.browser.window_handles[-1])
        page.wait(lambda: page.frame and page.state == "open")
        assert not page.find("veil").is_displayed()
    finally:
        page.browser.close()
        page.browser.switch_to.window(page.home)


def test_a_page_that_is_loaded_again_goes_on(page):
    page.press("w")
    page.browser.refresh()
    page.wait(lambda: page.frame and page.state == "open")
    assert [m["do"] for m in page.engine.heard if m["do"] in ("hello", "bye")] == [
        *("hello", "bye", "hello")
    ]


def test_the_end_is_said(page):
    page.engine.link.send({"is": "end", "text": "The command has ended."})
    page.engine.link.send({"is": "says", "kind": "note", "text": "A word too late."})
    page.wait(lambda: page.state == "ended")
    time.sleep(0.1)
    assert page.state == "ended" and page.text("veil-text") == "The command has ended."


def test_a_command_that_ends_without_a_word_is_noticed(window, rgb):
    with server.serve() as link, engine_of(link):
        window.open(link.url)
        window.wait(lambda: window.frame)
    window.wait(lambda: window.state == "ended")
    assert window.text("veil-text") == "nil-mitsuba view has ended."
