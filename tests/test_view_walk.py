"""The viewfinder as a whole, in a real browser: walk, aim, twist, copy the camera, render it."""

import json
import math
import re
import shlex
import signal
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import pytest

pytest.importorskip("websockets", reason="the extra view is not installed")
from browser import chromium, linear

SHIFT, ENTER = "\ue008", "\ue007"

# A lamp and a grey ball in plain Nil, where twist is a slider without steps
SCENE = """<scene version="3.0.0">
    <integrator type="nil">
        <boolean name="quotient" value="false"/>
        <float name="max_distance" value="8"/>
    </integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0, 0, 0" target="0, 0, 1" up="0, 1, 0"/>
        </transform>
        <float name="fov" value="70"/>
        <film type="hdrfilm">
            <integer name="width" value="64"/>
            <integer name="height" value="36"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant"><rgb name="radiance" value="0.1, 0.2, 0.4"/></emitter>
    <shape type="sphere" id="lamp">
        <point name="center" x="0.4" y="0.2" z="2"/>
        <float name="radius" value="0.2"/>
        <emitter type="area"><rgb name="radiance" value="0.8, 0.05, 0.05"/></emitter>
    </shape>
    <shape type="sphere" id="ball">
        <point name="center" x="-0.5" y="-0.1" z="2"/>
        <float name="radius" value="0.3"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.7, 0.7"/></bsdf>
    </shape>
</scene>
"""


@pytest.fixture
def walked(folder):
    """Starts ``nil-mitsuba view`` for that scene; gives the address that it prints."""
    (folder / "scene.xml").write_text(SCENE)
    code = "from nil_mitsuba import cli; cli.main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "view", "scene.xml", "--no-browser"],
        cwd=folder,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        line = process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:\d+/\S+", line)
        assert found, line + process.stderr.read()
        yield found[0]
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
        assert "Traceback" not in err, err
    finally:
        process.kill()
        process.communicate()


def lamp_in(image):
    """Where the lamp is in a picture, in parts of its sides."""
    height, width, _ = image.shape
    red, green = image[:, :, 0].array, image[:, :, 1].array
    index = dr.arange(mi.UInt32, width * height)
    found = mi.Float((red > 0.4) & (green < 0.15))
    x, y = (dr.sum(found * (i + 0.5)) / dr.sum(found) for i in (index % width, index // width))
    return x[0] / width, y[0] / height


def difference(first, second):
    """The greatest between two pictures, whatever their sizes, as 16 × 9 pixels."""
    small = [mi.Bitmap(image).resample(mi.ScalarVector2u(16, 9)) for image in (first, second)]
    return dr.max(abs(mi.TensorXf(small[0]) - mi.TensorXf(small[1])).array)[0]


def test_a_view_that_was_walked_to_is_the_still_that_is_rendered(walked, folder, command, rgb):
    with chromium(384, 320) as page:
        page.open(walked)

        def shows():
            """What the picture has beside it."""
            data = page.run("return {...document.getElementById('picture').dataset}")
            return {name: json.loads(value) for name, value in data.items()}

        def refined(spp):
            page.wait(lambda: not shows()["moving"] and shows()["spp"] >= spp, 20)

        page.wait(lambda: page.frame, 60)  # a kernel is compiled
        start = shows()["place"]
        assert math.dist(start, (0, 0, 0)) < 1e-6

        for _ in range(10):
            page.press("w")
        page.wait(lambda: 0.2 < math.dist(shows()["place"], start) < 1.5)
        refined(4)

        page.to(*lamp_in(page.picture())).key_down(SHIFT).click().key_up(SHIFT).perform()
        page.wait(lambda: math.dist(lamp_in(page.picture()), (0.5, 0.5)) < 0.02)
        page.to(0.5, 0.5).perform()
        page.wait(lambda: "lamp" in page.text("under"))

        refined(4)
        before = page.picture()
        page.click("value-twist")
        page.press("0.4", ENTER)
        page.wait(lambda: difference(page.picture(), before) > 0.05)

        refined(16)
        page.click("copy")
        page.wait(lambda: page.browser.find_elements("id", "camera-xml"))
        xml, options = (
            page.find(name).get_attribute("value") for name in ("camera-xml", "camera-options")
        )
        seen = page.picture()
        assert page.complaints() == []

    text, count = re.subn("<sensor.*</sensor>", lambda _: xml, SCENE, flags=re.DOTALL)
    assert count == 1 and text != SCENE
    (folder / "walked.xml").write_text(text)
    status, _, err = command("render", "walked.xml", *shlex.split(options), "--spp", "256", "-q")
    assert (status, err) == (0, "")
    still = linear(mi.Bitmap(str(folder / "walked.exr")))
    # A level of the page's picture is up to 0.009, and a camera that is off by one of its pixels, a
    # tenth of these, makes 0.07 at the edge of the lamp
    assert difference(still, seen) < 0.04
