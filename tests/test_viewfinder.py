"""What the viewfinder does about what it is asked for, without a browser."""

import json
import math
import shlex
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import jobs, keys, viewfinder
from nil_mitsuba.pose import Pose

SCENE = """<scene version="3.0.0">
    <default name="spp" value="64"/><default name="fov" value="50"/>
    <default name="unused" value="1"/>
    <!-- what a copy has to keep -->
    <integrator type="nil"><integer name="max_depth" value="3"/></integrator>
    <sensor type="{sensor}">
        <float name="fov" value="$fov"/>{lens}
        <transform name="to_world">
            <lookat origin="0.1, 0.1, 0.6" target="0.7, 1, 0.4" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/>
            <rfilter type="box"/><string name="component_format" value="float32"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="sphere" id="ball">
        <point name="center" value="0.5, 0.5, 0.5"/><float name="radius" value="0.2"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.2, 0.1"/></bsdf>
    </shape>
    <shape type="sphere" id="bead">
        <point name="center" value="0.2, 0.8, 0.7"/><float name="radius" value="0.1"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.3, 0.7"/></bsdf>
    </shape>
</scene>
"""


class Window:
    """Somebody who looks: asks for one thing after another, and keeps what he is told."""

    def __init__(self, *messages):
        self.viewer = self.ready = True
        self.asks, self.events, self.frames = list(messages), [], []

    def messages(self, _wait):
        taken, self.asks = self.asks, []
        return taken

    def send(self, event):
        json.dumps(event)
        self.events.append(event)

    def show(self, header, jpeg):
        if self.ready:
            self.frames.append((json.loads(json.dumps(header)), jpeg))
        return self.ready

    def told(self, kind):
        return [event for event in self.events if event["is"] == kind]


@pytest.fixture
def look(rgb, tmp_path, monkeypatch):
    """A viewfinder and its window; the scene is in a folder of its own, and nothing denoises."""
    monkeypatch.setattr(viewfinder, "can_denoise", lambda: False)

    def open_(sensor="perspective", lens="", **job):
        path = tmp_path / "scene.xml"
        text = SCENE.format(sensor=sensor, lens=lens)
        if sensor in ("spherical", "orthographic"):  # which have no field of view
            text = text.replace('<float name="fov" value="$fov"/>', "")
        path.write_text(text)
        window = Window()
        opened = jobs.open_scene(jobs.Job(str(path), **job), aiming=True)
        finder = viewfinder.Viewfinder(opened, [], window)
        finder.answer({"do": "hello", "size": [48, 32]})
        return finder, window

    yield open_
    mi.set_variant("llvm_ad_rgb")


def work(finder, frames):
    """Let it work until so many frames more have been shown."""
    count = len(finder.link.frames) + frames
    while len(finder.link.frames) < count:
        finder._work()
        assert not finder.broken, finder.link.events[-1]


def value(finder, name, number):
    finder.answer({"do": "set", "name": name, "value": number})


def test_whoever_comes_is_told_of_the_scene_and_sees_it(look):
    finder, window = look()
    (scene,) = window.told("scene")
    assert (scene["title"], scene["aspect"]) == ("scene.xml", 1.5)
    names = {slider["name"] for slider in scene["sliders"]}
    assert {"twist", "exposure", "fov", "focus", "aperture", "tolerance", "depth", "fog"} <= names
    work(finder, 3)
    header, jpeg = window.frames[-1]
    assert jpeg[:2] == b"\xff\xd8" and header["size"] == [48, 32]
    assert [frame["spp"] for frame, _ in window.frames] == [1, 1, 2]  # a glance, and refined
    assert [slider["first"] for slider in scene["sliders"] if slider["name"] == "fov"] == [50]
    assert [frame["frame"] for frame, _ in window.frames] == [1, 2, 3]


def test_keys_that_are_held_walk_along_the_geodesic_ahead(look, monkeypatch):
    finder, window = look()
    clock = iter(range(1000))
    monkeypatch.setattr(viewfinder.time, "perf_counter", lambda: next(clock) * 0.01)
    start = finder.pose
    finder.answer({"do": "go", "move": [0, 0, 1], "turn": [0, 0]})
    for _ in range(10):
        finder._advance(0.1)
    finder.answer({"do": "go", "move": [0, 0, 0], "turn": [0, 0]})
    there = start.moved((0, 0, 1), finder.speed * 1.0, finder.chart)
    assert list(finder.pose.covering(finder.chart)) == pytest.approx(
        list(there.covering(finder.chart)), abs=1e-9
    )
    assert finder.stale and not finder.moving
    work(finder, 1)
    assert window.frames[-1][0]["place"] == pytest.approx(list(there.place), abs=1e-9)


def test_a_key_that_is_let_go_at_once_makes_a_step(look):
    finder, _ = look()
    for _ in range(10):
        before = finder.pose.covering(finder.chart)
        finder.answer({"do": "go", "move": [0, 0, 1], "turn": [0, 0]})
        finder.answer({"do": "go", "move": [0, 0, 0], "turn": [0, 0]})
        step = finder.pose.covering(finder.chart) - before
        assert 0.01 < math.hypot(*step) < 0.2


def test_what_is_dragged_follows_the_hand(look):
    finder, _ = look()
    at = finder.sight((0.4, 0.45)).direction
    finder.answer({"do": "look", "by": [0.1 * 24 / 16, 0.05]})
    moved = finder.sight((0.5, 0.5)).direction
    assert moved == pytest.approx(at, abs=0.02)
    assert finder.pose.left.z == pytest.approx(0, abs=1e-6)


def test_what_is_aimed_at_is_in_the_middle_then_and_sharp(look):
    finder, window = look()
    sight = finder.sight((0.3, 0.4))
    finder.answer({"do": "aim", "at": [0.3, 0.4]})
    middle = finder.sight((0.5, 0.5))
    assert (middle.shape, middle.cell) == (sight.shape, sight.cell)
    assert middle.position == pytest.approx(sight.position, abs=1e-4)
    assert finder.lens["focus_distance"] == pytest.approx(sight.distance)
    assert window.told("value")[-1]["name"] == "focus"


def test_what_is_pointed_at_is_told(look):
    finder, window = look()
    work(finder, 1)
    finder.answer({"do": "point", "at": [0.5, 0.5]})
    while not window.told("under"):
        finder._work()
    under = window.told("under")[-1]
    assert under["shape"] == "ball" and under["cell"] == (0, 0, 0)
    assert math.dist(under["position"], (0.5, 0.5, 0.5)) == pytest.approx(0.2, abs=1e-3)
    finder.answer({"do": "point", "at": None})
    assert window.told("under")[-1]["shape"] is None


def test_a_slider_goes_no_farther_than_its_ends_and_says_so(look):
    finder, window = look()
    value(finder, "twist", 1.6)  # whole in the quotient
    assert finder.nil.twist == 2 and window.told("value")[-1] == {
        "is": "value",
        "name": "twist",
        "value": 2.0,
    }
    value(finder, "fov", 1e9)
    assert finder.lens["x_fov"] == 150
    value(finder, "nothing", 1)
    assert "nothing" in window.told("says")[-1]["text"]


def test_in_plain_nil_the_twist_may_be_any_number(look):
    finder, _ = look(properties={"quotient": "false"})
    value(finder, "twist", 0.37)
    assert finder.nil.twist == 0.37 and finder.chart.twist == 0.37
    work(finder, 1)


def test_what_is_dragged_costs_no_more_than_its_pictures(look, monkeypatch):
    """A hand sends sixty values a second, and a twist takes as long as a picture."""
    finder, window = look()
    work(finder, 2)
    calls = []
    for name in ("look", "change"):
        method = getattr(finder.preview, name)
        monkeypatch.setattr(
            finder.preview, name, lambda *a, f=method, n=name, **k: calls.append(n) or f(*a, **k)
        )
    for step in range(60):
        value(finder, "twist", step % 3)
        finder.answer({"do": "look", "by": [0.01, 0]})
    assert calls == []
    work(finder, 2)
    assert sorted(calls) == ["change", "look"]


def test_what_is_pointed_at_is_seen_from_where_the_camera_is_now(look):
    finder, window = look()
    work(finder, 2)
    window.ready = False  # no picture is shown meanwhile
    before = finder.sight((0.5, 0.5)).direction
    finder.answer({"do": "look", "by": [0.5, 0]})
    assert math.dist(finder.sight((0.5, 0.5)).direction, before) > 0.1


def test_another_exposure_traces_nothing(look, monkeypatch):
    finder, window = look()
    work(finder, 2)
    monkeypatch.setattr(finder.preview, "render", None)
    value(finder, "exposure", 3)
    assert len(window.frames) == 3
    assert window.frames[-1][0]["spp"] == window.frames[-2][0]["spp"]
    assert window.frames[-1][1] != window.frames[-2][1]


def test_a_picture_at_rest_grows_to_the_size_that_there_is_room_for(look):
    finder, window = look()
    finder.width = 160
    finder.answer({"do": "size", "size": [960, 640]})
    work(finder, 4)
    sizes = [frame["size"] for frame, _ in window.frames]
    assert sizes == [[160, 107], [320, 213], [640, 427], [960, 640]]


def test_another_size_of_the_page_keeps_what_is_seen(look):
    finder, window = look()
    work(finder, 3)
    finder.answer({"do": "size", "size": [96, 64]})
    assert not finder.stale
    work(finder, 1)
    assert window.frames[-1][0]["size"] == [96, 64]


def test_a_picture_that_could_not_be_shown_is_shown_later(look):
    finder, window = look()
    work(finder, 2)
    window.ready = False
    value(finder, "exposure", 2)
    window.ready = True
    shown = len(window.frames)
    finder._work()
    assert len(window.frames) == shown + 1
    assert window.frames[-1][0]["spp"] == window.frames[-2][0]["spp"]


def test_moving_pictures_are_as_large_as_there_is_time_for(look):
    finder, _ = look()
    finder.answer({"do": "size", "size": [2000, 2000]})
    for _ in range(20):
        finder._adapt(1.0)
    assert finder.width == viewfinder.SMALLEST
    for _ in range(40):
        finder._adapt(0.01)
    assert finder.width > 1000


def test_the_size_of_moving_pictures_follows_their_time(look, monkeypatch):
    finder, _ = look()
    taken = []
    monkeypatch.setattr(finder, "_adapt", taken.append)
    for _ in range(3):
        finder.answer({"do": "home"})
        work(finder, 1)
    assert len(taken) == 2 and min(taken) > 0  # that which compiles the kernel tells nothing


def test_paths_are_short_only_while_something_moves(look, monkeypatch):
    finder, _ = look()
    value(finder, "depth", 20)
    render, depths = finder.preview.render, []

    def watched(*arguments):
        depths.append(finder.nil.max_depth)
        render(*arguments)

    monkeypatch.setattr(finder.preview, "render", watched)
    work(finder, 2)
    assert depths[0] == viewfinder.MOVING_DEPTH and set(depths[1:]) == {20}


def test_however_long_a_picture_takes_the_next_is_near(look, monkeypatch):
    finder, window = look()
    steps = []
    monkeypatch.setattr(finder, "_advance", steps.append)
    monkeypatch.setattr(finder, "_work", lambda: None)
    ended = iter((False, True))
    finder.run(lambda: next(ended))  # long after it was made
    assert steps == [viewfinder.LONGEST_STEP]


def test_fog_takes_light_away_and_can_be_cleared(look):
    finder, window = look()
    work(finder, 2)
    clear = dr.mean(finder.picture.array)[0]
    assert finder.fog_medium is None
    value(finder, "fog", 1.5)
    assert window.told("says")[-1]["kind"] == "busy"
    work(finder, 4)
    foggy = dr.mean(finder.picture.array)[0]
    value(finder, "fog", 0)
    work(finder, 4)
    assert foggy < 0.8 * clear
    assert dr.mean(finder.picture.array)[0] == pytest.approx(clear, rel=0.1)
    assert "--fog" not in finder.keeper.options(finder.shot, {})


def options_of(finder):
    finder.answer({"do": "copy"})
    return finder.link.told("camera")[-1]


def test_the_camera_that_is_copied_is_that_which_is_shown(look, tmp_path):
    finder, window = look()
    finder.answer({"do": "go", "move": [0.5, 0.2, 1], "turn": [0.3, 0.1]})
    finder._advance(0.8)
    finder.answer({"do": "go", "move": [0, 0, 0], "turn": [0, 0]})
    value(finder, "twist", 2)
    value(finder, "fov", 70)
    camera = options_of(finder)
    assert camera["options"] == "-P twist=2"
    sensor = mi.load_string(
        f'<scene version="3.0.0"><default name="spp" value="1"/>{camera["xml"]}</scene>'
    ).sensors()[0]
    assert sensor.class_name() == "PerspectiveCamera"  # not that which takes its place here
    pose = Pose.of(sensor.world_transform(), finder.chart)
    for name in ("place", "view", "up"):
        assert list(getattr(pose, name)) == pytest.approx(
            list(getattr(finder.pose, name)), abs=1e-6
        )
    assert mi.traverse(sensor)["x_fov"][0] == pytest.approx(70)


def test_an_open_aperture_makes_the_camera_a_thin_lens(look):
    finder, _ = look()
    value(finder, "aperture", 0.02)
    value(finder, "focus", 0.5)
    xml = options_of(finder)["xml"]
    assert 'type="thinlens"' in xml and '"aperture_radius" value="0.02"' in xml
    assert '"focus_distance" value="0.5"' in xml
    value(finder, "aperture", 0)
    assert 'type="perspective"' in options_of(finder)["xml"]


def test_a_copy_is_saved_beside_the_scene_and_over_nothing(look, tmp_path):
    finder, window = look()
    (tmp_path / "scene-view.xml").write_text("mine")
    before = (tmp_path / "scene.xml").read_text()
    finder.answer({"do": "save"})
    finder.answer({"do": "save"})  # nothing has changed since
    value(finder, "fov", 60)
    finder.answer({"do": "save"})
    paths = [event["path"] for event in window.told("saved")]
    assert paths == [str(tmp_path / f"scene-view-{n}.xml") for n in (2, 2, 3)]
    assert (tmp_path / "scene-view.xml").read_text() == "mine"
    assert (tmp_path / "scene.xml").read_text() == before
    assert "what a copy has to keep" in (tmp_path / "scene-view-3.xml").read_text()


def test_the_command_that_is_shown_renders_what_was_shown(look, command, tmp_path, monkeypatch):
    """The mean of 384 pixels of 64 samples each; both are without noise to a percent."""
    finder, window = look(defines={"fov": "45", "spp": "256"}, properties={"cell_size": "1.1"})
    finder.answer({"do": "go", "move": [0, 0, 1], "turn": [0.5, 0]})
    finder._advance(0.5)
    finder.answer({"do": "go", "move": [0, 0, 0], "turn": [0, 0]})
    value(finder, "twist", 2)
    value(finder, "fov", 75)
    value(finder, "exposure", 1)
    work(finder, 8)
    finder.answer({"do": "render"})
    words = shlex.split(window.told("command")[-1]["command"])
    assert words[:2] == ["nil-mitsuba", "render"]
    status, out, err = command(*words[1:])
    assert status == 0, err
    still = mi.TensorXf(mi.Bitmap(str(tmp_path / "scene-view.exr")))[:, :, :3]
    assert (tmp_path / "scene-view.png").exists()
    for c in range(3):
        shown = dr.mean(finder.picture[:, :, c].array)[0]
        assert dr.mean(still[:, :, c].array)[0] == pytest.approx(shown, rel=0.03)


@pytest.mark.parametrize(
    ("old", "new", "looks"),
    [
        ("<film", "<film", ["--png", "--denoise"]),
        ("<rfilter", '<string name="pixel_format" value="luminance"/><rfilter', ["--png"]),
        ("<integrator ", '<integrator type="moment"><integrator ', ["--png"]),
        ('type="hdrfilm"', 'type="specfilm"', []),
    ],
)
def test_the_command_asks_for_what_the_still_can_be(look, command, monkeypatch, old, new, looks):
    special = "specfilm" in new
    text = SCENE.replace(old, new)
    if "moment" in new:
        text = text.replace("</integrator>", "</integrator></integrator>")
    if special:
        text = text.replace("<rfilter", '<spectrum name="band" value="400:0,550:1,700:0"/><rfilter')
    monkeypatch.setattr(sys.modules[__name__], "SCENE", text)
    job = {"variant": "llvm_ad_spectral"} if special else {}
    finder, window = look(defines={"spp": "2"}, **job)
    finder.denoises = True
    finder.answer({"do": "render"})
    words = shlex.split(window.told("command")[-1]["command"])
    assert [word for word in words if word in ("--png", "--denoise")] == looks
    status, _, err = command(*(word for word in words[1:] if word != "--denoise"))
    assert status == 0, err


def test_keys_are_collected_beside_the_scene(look, tmp_path):
    finder, window = look()
    (tmp_path / "scene-keys.json").write_text("mine")
    finder.answer({"do": "key"})
    finder.pose = finder.pose.moved((0, 0, 1), 2.0, finder.chart)
    finder.answer({"do": "key"})
    told = window.told("keys")[-1]
    assert told["count"] == 2 and told["path"] == str(tmp_path / "scene-keys-2.json")
    first, second = keys.load(told["path"])
    assert first.cell == (0, 0, 0) and second.cell == finder.pose.cell != (0, 0, 0)
    assert second.parameters == {"x_fov": pytest.approx(50)}
    words = shlex.split(told["command"])
    assert words[1:3] == ["fly", str(tmp_path / "scene.xml")] and "--keys" in words


def test_keys_keep_the_lens_that_they_were_seen_by(look, tmp_path):
    """The flight is one of a copy with a lens as soon as one of the keys needs it."""
    finder, window = look()
    finder.answer({"do": "key"})
    finder.answer({"do": "set", "name": "aperture", "value": 0.05})
    finder.answer({"do": "key"})
    finder.answer({"do": "set", "name": "aperture", "value": 0})
    finder.answer({"do": "key"})
    told = window.told("keys")[-1]
    assert shlex.split(told["command"])[2] == str(tmp_path / "scene-view.xml")
    apertures = [key.parameters["aperture_radius"] for key in keys.load(told["path"])]
    assert apertures == [0, pytest.approx(0.05), 0]


def test_whoever_loads_the_page_again_has_his_keys(look):
    finder, window = look()
    finder.answer({"do": "key"})
    finder.answer({"do": "bye"})
    finder.answer({"do": "hello", "size": [48, 32]})
    first, again = window.told("keys")
    assert first == again


def test_all_notes_on_a_scene_are_in_one_message(look):
    finder, window = look()
    finder.notes = ["One thing.", "Another."]
    finder.answer({"do": "hello", "size": [48, 32]})
    assert window.told("says")[-2]["text"] == "One thing. Another."


def test_a_copy_that_was_removed_is_written_again(look):
    finder, window = look()
    finder.answer({"do": "save"})
    path = Path(window.told("saved")[-1]["path"])
    path.unlink()
    finder.answer({"do": "render"})
    assert Path(window.told("command")[-1]["path"]).exists()


def test_what_goes_wrong_is_said_once_and_the_walk_goes_on(look, monkeypatch):
    finder, window = look()
    whole = finder.preview.render

    def render(*_):
        raise RuntimeError("out of memory.")

    monkeypatch.setattr(finder.preview, "render", render)
    for _ in range(5):
        finder._work()
    assert [event["text"] for event in window.told("says") if event["kind"] == "error"] == [
        "out of memory."
    ]
    monkeypatch.setattr(finder.preview, "render", whole)
    finder.answer({"do": "home"})
    work(finder, 1)


def test_it_ends_when_nobody_looks_any_more(look, monkeypatch):
    finder, window = look()
    monkeypatch.setattr(viewfinder, "LEAVING_SECONDS", 0.05)
    window.asks = [{"do": "go", "move": [0, 0, 1], "turn": [0, 0]}, {"do": "bye"}]
    ended = iter((False,) * 3)

    def leave():
        window.viewer = next(ended, None) is not None
        return False

    finder.run(leave)
    assert not finder.moving


def test_while_the_page_is_busy_nothing_is_rendered_for_it(look, monkeypatch):
    finder, window = look()
    work(finder, 2)
    window.ready = False
    finder.answer({"do": "home"})
    monkeypatch.setattr(finder.preview, "render", None)
    finder._work()
    assert not finder._works() and len(window.frames) == 2


@pytest.mark.parametrize("kind", ["spherical", "fisheye", "orthographic"])
def test_other_sensors_walk_without_a_lens(look, kind):
    finder, window = look(sensor=kind)
    assert not {"fov", "focus", "aperture"} & set(finder.sliders)
    work(finder, 2)


def test_a_depth_of_64_is_no_limit(look):
    finder, _ = look()
    value(finder, "depth", 64)
    assert finder.nil.max_depth == -1 and "max_depth=-1" in finder.keeper.options(finder.shot, {})
