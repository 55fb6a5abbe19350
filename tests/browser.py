"""A real browser, and what a test sees of the viewfinder's page in it."""

import base64
import contextlib
import os
import shutil
import time

import mitsuba as mi
import pytest

SECONDS = 10  # more than anything takes, on a busy machine


def first_of(*names):
    return next(filter(None, map(shutil.which, names)), None)


@contextlib.contextmanager
def chromium(width, height):
    """A Chromium without a window of such an inner size; skips the test where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    binary = first_of("chromium", "chromium-browser", "google-chrome")
    driver = first_of("chromedriver")
    if not (binary and driver):
        pytest.skip("chromium or chromedriver is not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    arguments = [
        "--headless=new",
        f"--window-size={width},{height}",
        "--disable-gpu",
        "--disable-dev-shm-usage",  # it is small in containers
        "--disable-background-networking",
        "--disable-component-update",
        "--no-first-run",
        "--no-proxy-server",
    ]
    if os.geteuid() == 0:  # for whom Chromium has no sandbox
        arguments.append("--no-sandbox")
    for argument in arguments:
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SE_OFFLINE", "true")  # no one is asked for drivers
        patch.setenv("NO_PROXY", "localhost,127.0.0.1")
        service = webdriver.ChromeService(executable_path=driver)
        browser = webdriver.Chrome(options=options, service=service)
    try:
        yield Page(browser, width, height)
    finally:
        browser.quit()


def linear(bitmap):
    """A picture as a linear tensor (height, width, 3)."""
    kind = mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False
    return mi.TensorXf(bitmap.convert(*kind))


class Page:
    """The viewfinder's page, as its viewer has it before him."""

    def __init__(self, browser, width, height):
        self.browser = browser
        self.home = browser.current_window_handle
        self.resize(width, height)
        grant = {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}
        browser.execute_cdp_cmd("Browser.grantPermissions", grant)

    def resize(self, width, height, scale=1):
        """Give the window an inner size, in pixels of which the screen has ``scale``² each."""
        self.browser.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False},
        )

    def open(self, url):
        self.browser.get(url)

    def run(self, script, *arguments):
        return self.browser.execute_script(script, *arguments)

    def find(self, name):
        return self.browser.find_element("id", name)

    def click(self, name):
        self.find(name).click()

    def text(self, name):
        """What is written somewhere, as the viewer sees it."""
        return self.find(name).text

    @property
    def state(self):
        return self.run("return document.body.dataset.state")

    @property
    def frame(self):
        """The number of the frame that is shown, or None."""
        number = self.run("return document.getElementById('picture').dataset.frame")
        return None if number is None else int(number)

    def wait(self, condition, seconds=SECONDS):
        """Wait until something holds; returns what it is."""
        end = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < end, self.about()
            time.sleep(0.02)
        return value

    def about(self):
        """What there is to see and to hear, for whoever wonders why a test failed."""
        data = self.run("return {...document.getElementById('picture').dataset}")
        return self.text("stage"), self.text("line"), data, self.complaints()

    @property
    def actions(self):
        return self.webdriver.ActionChains(self.browser, duration=20)

    @property
    def webdriver(self):
        import selenium.webdriver

        return selenium.webdriver

    def press(self, *keys):
        """Press keys one after the other."""
        self.actions.send_keys(*keys).perform()

    def to(self, x, y):
        """Actions that begin by moving the pointer to a part of the picture's width and height."""
        picture = self.find("picture")
        width, height = picture.size["width"], picture.size["height"]
        # From the middle, in whole pixels
        offset = round((x - 0.5) * width), round((y - 0.5) * height)
        return self.actions.move_to_element_with_offset(picture, *offset)

    def picture(self):
        """What the picture shows now: a linear tensor (height, width, 3)."""
        url = self.run("return document.getElementById('picture').toDataURL('image/png')")
        stream = mi.MemoryStream()
        stream.write(base64.b64decode(url.partition(",")[2]))
        stream.seek(0)
        return linear(mi.Bitmap(stream))

    def complaints(self):
        """What the browser has complained of, such as of what the page may not do."""
        return [line["message"] for line in self.browser.get_log("browser")]
