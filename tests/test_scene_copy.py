"""Copies of scene files with another camera, and all else as it was."""

import codecs
import re
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import pytest

import blender_export
from conftest import DATA, ROOT
from nil_mitsuba.scene_copy import SceneText

CASES = DATA.parent / "cases"
FOREIGN = [*CASES.glob("*.xml"), *DATA.glob("scenes/*/scene.xml")]
SCENES = sorted([*(ROOT / "scenes").glob("*.xml"), *FOREIGN])

FILM = """
        <film type="hdrfilm">
            <integer name="width" value="12"/><integer name="height" value="8"/>
        </film>"""
BALL = '<shape type="sphere"/>'


def scene(*parts, version="3.0.0"):
    return f'<scene version="{version}">{"".join(parts)}</scene>'


def host(to_world):
    matrix = to_world.matrix
    return mi.ScalarTransform4f([[matrix[i, j][0] for j in range(4)] for i in range(4)])


def elsewhere():
    T = mi.ScalarTransform4f
    return T().translate([0.3, -2, 1.1]) @ T().look_at([0, 0, 0], [0.2, 1, 0.4], [0.3, 0.1, 1])


def assert_same(to_world, other, relative=1e-5):
    other = mi.Transform4f(other).matrix
    size = dr.max(dr.abs(other), axis=None)[0]
    assert dr.allclose(to_world.matrix, other, rtol=0, atol=relative * max(size, 1))


def values(sensor):
    """What tells two cameras apart, but for their places."""
    parameters = mi.traverse(sensor)
    names = ("x_fov", "aperture_radius", "focus_distance", "near_clip", "film.size")
    found = {name: parameters[name] for name in names if name in parameters}
    return {"type": sensor.class_name()} | {
        name: [value] if isinstance(value, float) else list(value) for name, value in found.items()
    }


@pytest.fixture
def file(tmp_path, rgb):
    """Writes a scene, as it is."""

    def write(text, name="scene.xml"):
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return tmp_path / name

    return write


@pytest.fixture
def changed(file):
    """The only sensor of a scene, and that of its copy; a pasted element means the same."""

    def change(camera, to_world=None, version="3.0.0", **lens):
        path = file(scene("\n    ", camera, "\n    ", BALL, "\n", version=version))
        before = mi.load_file(str(path)).sensors()[0]
        to_world = host(before.world_transform()) if to_world is None else to_world
        text = SceneText(path)
        after = mi.load_file(str(text.save(0, to_world, **lens))).sensors()[0]
        assert_same(after.world_transform(), to_world)
        pasted = path.read_text().replace(camera, text.camera(0, to_world, **lens))
        assert pasted.split() == text.with_camera(0, to_world, **lens).split()
        return before, after

    return change


# ---------------------------------------------------------------------- whole scenes


@pytest.fixture
def beside(tmp_path):
    """A folder in which a scene lies as in its own, so that a copy finds what it names."""

    def link(path):
        for name in path.parent.iterdir():
            (tmp_path / name.name).symlink_to(name)
        return tmp_path / path.name

    return link


def load(path):
    text = path.read_text()
    small = {name: "8" for name in ("resx", "resy") if f"${name}" in text}
    ours = {"integrator": "path"} if '"$integrator"' in text else {}
    return mi.load_file(str(path), **small, **ours)


def remainder(text):
    return re.sub(r"<sensor.*</sensor>", "", text, flags=re.S)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_copy_with_the_same_camera_is_the_same_scene(rgb, beside, path):
    path = beside(path)
    before, text = load(path), SceneText(path)
    sensor = before.sensors()[0]
    copy = text.save(0, host(sensor.world_transform()))
    after = load(copy)
    assert copy.name == f"{path.stem}-view.xml"
    assert_same(after.sensors()[0].world_transform(), sensor.world_transform())
    assert values(after.sensors()[0]) == values(sensor)
    assert len(after.shapes()) == len(before.shapes())
    # Another camera is not the same
    lens = {"x_fov": 33.25, "focus_distance": 0.7, "aperture_radius": 0.125}
    other = text.with_camera(0, elsewhere(), **lens)
    assert remainder(other) == remainder(path.read_text())
    assert all(f'value="{value}"/>' in other for value in lens.values())


def test_the_scene_of_an_exporter_gets_a_lens(rgb, tmp_path):
    """It writes a principal point of 0, which no thinlens takes."""
    blender_export.export(tmp_path)
    text = SceneText(tmp_path / "scene.xml")
    copy = text.save(0, elsewhere(), x_fov=50, focus_distance=3, aperture_radius=0.1)
    found = values(mi.load_file(str(copy)).sensors()[0])
    assert found["type"] == "ThinLensCamera" and found["x_fov"] == [pytest.approx(50)]
    assert remainder(copy.read_text()) == remainder((tmp_path / "scene.xml").read_text())


# ---------------------------------------------------------------------- one camera


def camera(*inside, kind="perspective", film=FILM):
    return f'<sensor type="{kind}">{"".join(inside)}{film}\n    </sensor>'


def to_world(*steps):
    return f'\n        <transform name="to_world">{"".join(steps)}</transform>'


LOOK = '<lookat origin="0.2, 0.1, 0.7" target="0.3, 0.9, 0.6" up="0, 0, 1"/>'
LENS = """
        <float name="aperture_radius" value="0.05"/>
        <float name="focus_distance" value="2.5"/>"""


@pytest.mark.parametrize(
    "text",
    [
        camera(to_world('<scale x="-1"/>', LOOK)),
        camera(to_world('<scale x="0.3" y="0.3"/>', LOOK), kind="orthographic"),
        camera(to_world('<scale x="-30" y="20" z="3"/>', LOOK), kind="orthographic"),
        # Sheared, which no look from a place along a view can say
        camera(to_world(LOOK, '<scale x="2" z="0.5"/>'), kind="orthographic"),
        # Sizes that differ by less than a picture shows
        camera(to_world('<scale value="1.0005"/>', LOOK), kind="orthographic"),
        # Four digits: neither quite straight nor quite level
        camera(
            to_world(
                '<matrix value="-0.9923 0.0154 0.1231 0.2 0.1240 0.1231 0.9846 0.1 0 0.9923 '
                '-0.1241 0.7 0 0 0 1"/>'
            )
        ),
        camera(
            to_world('<matrix value="-1 0 0 0 0 1 0 1 0"/>', '<translate value="1e6, 0.1, 0"/>')
        ),
        # Straight up and straight down
        camera(to_world('<rotate x="1" angle="-90"/>', '<translate z="0.1"/>')),
        camera(to_world('<rotate x="1" angle="90"/>', '<rotate y="1" angle="1e-3"/>')),
        camera(to_world(LOOK, '<rotate x="1" angle="77.3"/>', '<rotate z="1" angle="3"/>')),
        camera(),
        camera(kind="spherical", film='<film type="hdrfilm"><rfilter type="box"/></film>'),
        camera(to_world(LOOK), kind="fisheye"),
        '<sensor type="perspective"/>',
        "<sensor\ttype = 'perspective' id=\"a > b type='c'\" />",
        '<sensor type="perspective"></sensor>',
    ],
)
def test_a_camera_of_any_make_comes_back(changed, text):
    before, after = changed(text)
    assert values(after) == values(before)
    changed(text, elsewhere())


@pytest.mark.parametrize(
    "view",
    [
        "",
        '<float name="fov" value="40"/>',
        '<float name="fov" value="40"/> <string name="fov_axis" value="y"/>',
        '\n<string name="fov_axis" value="diagonal"/>\n  <float name="fov" value="40"/>  ',
        '<string name="fov_axis" value="smaller"/><float name="fov" value="40"/>',
        '\n        <string name="focal_length" value="35mm"/>\n',
        '<integer value="40" name="fov"/>',
        '<default name="wide" value="40"/><float name="fov" value="$wide"/>',
    ],
)
@pytest.mark.parametrize("kind", ["perspective", "thinlens", "stereo_perspective"])
def test_a_field_of_view_is_across_however_it_was_written(changed, view, kind):
    eye = '<string name="eye" value="left"/><float name="interocular_distance" value="1"/>'
    more = {"thinlens": LENS, "stereo_perspective": eye}
    text = camera(view, to_world(LOOK), more.get(kind, ""), kind=kind)
    before, after = changed(text, x_fov=61.5)
    expected = {"x_fov": [61.5]}
    assert values(after) == values(before) | expected
    # Left as it is, too
    before, after = changed(text)
    assert values(after) == values(before)


def test_a_lens_opens_and_closes(changed):
    plain = camera(to_world(LOOK), '\n        <float name="fov" value="40"/>')
    _, after = changed(plain, aperture_radius=0.125, focus_distance=3)
    expected = {"type": "ThinLensCamera", "aperture_radius": [0.125], "focus_distance": [3.0]}
    assert values(after).items() >= expected.items()
    wide = camera(to_world(LOOK), LENS, '<float name="fov" value="40"/>', kind="thinlens")
    before, after = changed(wide, aperture_radius=0)
    assert after.class_name() == "PerspectiveCamera"
    assert values(after)["x_fov"] == values(before)["x_fov"]
    before, after = changed(wide, aperture_radius=0.5)
    assert values(after) == values(before) | {"aperture_radius": [0.5]}
    before, after = changed(wide, focus_distance=7)
    assert values(after) == values(before) | {"focus_distance": [7.0]}
    for closed in (None, 0):  # of what has no lens
        before, after = changed(plain, aperture_radius=closed)
        assert values(after) == values(before)


def test_a_lens_that_closed_keeps_its_focus(file):
    wide = camera(to_world(LOOK), LENS, kind="thinlens")
    closed = SceneText(file(scene(wide))).save(0, elsewhere(), aperture_radius=0)
    opened = SceneText(closed).save(0, elsewhere(), aperture_radius=0.25)
    found = values(mi.load_file(str(opened)).sensors()[0])
    assert found["focus_distance"] == [2.5] and found["aperture_radius"] == [0.25]


def test_what_older_versions_called_otherwise_is_replaced(changed):
    old = camera(
        f'<transform name="toWorld">{LOOK}</transform><float name="fov" value="40"/>'
        '<string name="fovAxis" value="y"/><float name="apertureRadius" value="0.05"/>'
        '<float name="focusDistance" value="2.5"/>',
        kind="thinlens",
    )
    lens = {"x_fov": 50, "focus_distance": 2, "aperture_radius": 0.25}
    _, after = changed(old, elsewhere(), version="0.6.0", **lens)
    assert values(after).items() >= {k: [pytest.approx(v)] for k, v in lens.items()}.items()


def test_a_meters_direction_makes_way(changed):
    one = '<film type="hdrfilm"><integer name="width" value="1"/><integer name="height" value="1"/>'
    ray = '<point name="origin" value="1, 2, 3"/><vector name="direction" x="0" y="1" z="0"/>'
    changed(camera(ray, kind="radiancemeter", film=one + "</film>"), elsewhere())
    ray = '<vector name="direction" x="0" y="1" z="0"/>'
    changed(camera(ray, kind="distant", film=one + '<rfilter type="box"/></film>'), elsewhere())


def test_what_else_a_camera_has_stays_where_it_was(file):
    text = camera(
        "\n        <!-- wide -->\n",
        '\t<float name="fov" value="$fov"/> <!-- degrees -->',
        to_world("\n", LOOK, "<!-- an old one -->"),
        '\n        <float name="near_clip" value="$near"/>',
        '\n        <sampler type="multijitter"/>',
        '\n        <ref id="air"/> <string name="fov_axis" value="y"/>\n',
    )
    air = '<medium type="homogeneous" id="air"/>'
    path = file(scene('<default name="near" value="0.125"/>', air, "\n    ", text))
    copied = SceneText(path, {"fov": "70"}).camera(0, mi.ScalarTransform4f(), x_fov=65)
    assert (
        copied
        == """<sensor type="perspective">
    <!-- wide -->
\t<float name="fov" value="65"/>
\t<string name="fov_axis" value="x"/> <!-- degrees -->
    <transform name="to_world">
        <lookat origin="0, 0, 0" target="0, 0, 1" up="0, 1, 0"/>
        <translate value="0, 0, 0"/>
    </transform>
    <float name="near_clip" value="$near"/>
    <sampler type="multijitter"/>
    <ref id="air"/>

    <film type="hdrfilm">
        <integer name="width" value="12"/><integer name="height" value="8"/>
    </film>
</sensor>"""
    )


def test_constants_go_that_a_copy_has_no_use_for(file):
    """Mitsuba refuses those that nothing refers to."""
    fov = '<float name="fov" value="$fov"/><!-- $fov -->'
    near = '<float name="near_clip" value="$fov_near"/>'
    ball = '<shape type="sphere"><float name="radius" value="$size"/></shape>'
    file(scene(ball), "ball.xml")
    path = file(scene(camera(fov, near), '<include filename="ball.xml"/>'))
    given = {"size": "2", "fov": "70", "fov_near": "0.125"}
    text = SceneText(path, given)
    assert text.defines(0, elsewhere()) == given
    rest = text.defines(0, elsewhere(), x_fov=50)
    assert rest == {"size": "2", "fov_near": "0.125"}
    copy = str(text.save(0, elsewhere(), x_fov=50))
    assert values(mi.load_file(copy, **rest).sensors()[0])["near_clip"] == [0.125]
    with pytest.raises(RuntimeError, match=r"unused parameters:\s+- \$fov=70$"):
        mi.load_file(copy, **given)


def test_a_level_camera_is_written_as_one_would(file):
    text = SceneText(file(scene(camera(to_world(LOOK)))))
    level = mi.ScalarTransform4f().look_at([1, 2, 3], [4, 6, 3], [0, 0, 1])
    written = text.camera(0, level, x_fov=50)
    assert '<lookat origin="0, 0, 0" target="0.6, 0.8, 0" up="0, 0, 1"/>' in written
    assert '<translate value="1, 2, 3"/>' in written and "<scale" not in written


# ---------------------------------------------------------------------- the rest of the file


@pytest.mark.parametrize(
    "start, codec",
    [
        (b"", "utf-8"),
        (codecs.BOM_UTF8, "utf-8"),
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
        (b"<?xml version='1.0' encoding='ISO-8859-1'?>", "latin-1"),
        (b'<?xml version="1.0" encoding="utf-8"?>', "utf-8"),
    ],
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_every_byte_around_the_camera_stays(file, start, codec, newline):
    before = (
        '<!DOCTYPE scene [<!ENTITY dash "-">]>\n<!-- <sensor type="é"/> -- ü -->\n<?x <sensor?>'
        '<scene  version = "3.0.0" >\n\t<!-- é -->  \n \t'
    )
    after = (
        '\n<bsdf type="diffuse" id="&lt;é &amp; ü&#62;"/><![CDATA[ <sensor> ]]>'
        '<!-- <sensor type="perspective"/> -->\n</scene>\n \n'
    )
    text = camera("<!-- é > -->", to_world(LOOK), '<float name="fov" value="40"/>')
    whole, before, after, text = (
        start + part.replace("\n", newline).encode(codec)
        for start, part in (
            (start, before + text + after),
            (start, before),
            (b"", after),
            (b"", text),
        )
    )
    copied = SceneText(file(whole)).save(0, elsewhere(), x_fov=50, aperture_radius=1)
    found = copied.read_bytes()
    assert found.startswith(before) and found.endswith(after)
    middle = found[len(before) : -len(after)].decode(codec)
    assert "<!-- é > -->" in middle and middle != text.decode(codec)
    assert middle.count("\n") > 9 and middle.count("\n") == middle.count(newline)
    assert_same(mi.load_file(str(copied)).sensors()[0].world_transform(), elsewhere())
    assert SceneText(copied).with_camera(0, elsewhere()).encode(codec).endswith(after)


def test_bytes_that_are_no_letters_stay(file):
    before, after = b'<scene version="3.0.0"><!-- \xe9\xff -->', b"\n<!-- \xfc --></scene>"
    text = camera(to_world(LOOK)).encode()
    copied = SceneText(file(before + text + after)).save(0, elsewhere()).read_bytes()
    assert copied.startswith(before) and copied.endswith(after)


# ---------------------------------------------------------------------- which camera


def looking(x, more="", kind="perspective"):
    return camera(to_world(f'<translate x="{x}"/>'), kind=kind).replace(">", f" {more}>", 1)


def test_sensors_have_the_numbers_of_the_scene(file):
    file('<scene version="3.0.0">' + looking(20, 'id="far"') + "</scene>", "cameras.xml")
    file(looking(30, 'version="3.0.0"'), "alone.xml")
    last = looking(60, 'id="last"')
    batch = f'<sensor type="batch">{looking(50)}{last}</sensor>'
    path = file(
        scene(
            "<!-- ", looking(1), " -->", looking(10), BALL, '<include filename="cameras.xml"/>',
            looking(40, 'name="a"'), '<include filename="alone.xml"/>', looking(40), batch,
            '<ref id="last"/>', "\n", looking(70),
        )
    )  # fmt: skip
    text = SceneText(path)
    sensors = mi.load_file(str(path)).sensors()
    assert len(sensors) == 8

    def place(sensor):
        return sensor.world_transform().matrix[0, 3][0]

    for i, where in enumerate((10, 20, 40, 30, 40, None, 60, 70)):
        if where in (20, 30, None):
            with pytest.raises(ValueError, match=f'^the sensor {i} of ".*scene.xml" is '):
                text.with_camera(i, elsewhere())
            continue
        assert place(sensors[i]) == where
        copy = mi.load_file(str(text.save(i, mi.ScalarTransform4f().translate([-3, 0, 0]))))
        found = [place(s) for j, s in enumerate(copy.sensors()) if j != 5]
        expected = [place(s) for j, s in enumerate(sensors) if j not in (5, i)]
        expected.insert(i - (i > 5), -3)
        assert found == expected


METER = f'<shape type="rectangle"><sensor type="irradiancemeter">{FILM}</sensor></shape>'


@pytest.mark.parametrize(
    "text, sensor, sentence",
    [
        (scene(BALL), 0, '^the scene ".*scene.xml" has no sensor.$'),
        (scene(camera()), 1, "has no sensor 1: its sensors are numbered from 0 to 0.$"),
        (scene(camera()), -1, "has no sensor -1: "),
        (
            scene('<include filename="part.xml"/>'),
            0,
            'is written in ".*part.xml", which it includes: move the <sensor> into "scene.xml".$',
        ),
        (scene(camera(camera(), kind="batch")), 0, "is a batch of several: "),
        (scene(METER), 0, "^the sensor 0 .* on a shape .*: write the cameras before the shapes.$"),
        (scene(METER, camera()), 1, "^the sensor 1 .* meshes are merged: "),
        (scene(camera("<!-- a -- b -->")), 0, "is not well-formed XML: .* in line 1.$"),
        (
            scene("\n\n", camera('\n<string name="a" value="&b;"/>')),
            0,
            "undefined entity in line 4.",
        ),
    ],
)
def test_a_camera_that_the_text_does_not_hold_is_told(file, text, sensor, sentence):
    file(scene(camera()), "part.xml")
    text = SceneText(file(text))
    for use in (text.camera, text.with_camera, text.save):
        with pytest.raises(ValueError, match=sentence):
            use(sensor, elsewhere())
    assert not list(text.path.parent.glob("*-view*"))


def test_cameras_before_a_meter_have_their_numbers(file):
    path = file(scene(looking(10), METER, BALL))
    copy = mi.load_file(str(SceneText(path).save(0, elsewhere())))
    assert_same(copy.sensors()[0].world_transform(), elsewhere())


@pytest.mark.parametrize(
    "text, lens, sentence",
    [
        (camera(kind="orthographic"), {"x_fov": 50}, '"orthographic", which has no fov.$'),
        (camera(kind="spherical"), {"focus_distance": 5}, '"spherical", which has no focus_dist'),
        (camera(kind="fisheye"), {"aperture_radius": 0.1}, "which has no aperture_radius.$"),
        (
            camera('<float name="principal_point_offset_y" value="0.1"/>'),
            {"aperture_radius": 0.1},
            "has a principal_point_offset, which no thinlens has: remove it, or close the aperture",
        ),
    ],
)
def test_a_lens_that_a_camera_cannot_have_is_told(file, text, lens, sentence):
    with pytest.raises(ValueError, match=sentence):
        SceneText(file(scene(text))).camera(0, elsewhere(), **lens)


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("hello", "No document element found"),
        (b"\x00\xff", "Parsing of XML file"),
        ("<scene", "Error parsing"),
        (scene(camera('<float name="fov" value="$wide"/>')), r"undefined parameter: \$wide"),
        ('<shape version="3.0.0" type="sphere"/>', "must be a <scene> tag.$"),
    ],
)
def test_what_is_no_scene_is_told(file, text, sentence):
    with pytest.raises((ValueError, RuntimeError), match=sentence):
        SceneText(file(text))


# ---------------------------------------------------------------------- saving


def test_no_file_is_ever_written_over(file):
    path = file(scene(camera()))
    path.with_name("scene-view-2.xml").symlink_to("nowhere")
    path.with_name("scene-view-4.xml").mkdir()
    text = SceneText(path)
    x = [mi.ScalarTransform4f().translate([i, 0, 0]) for i in range(12)]
    with ThreadPoolExecutor(6) as threads:
        saved = list(threads.map(lambda to_world: text.save(0, to_world), x))
    names = {"scene-view.xml", *(f"scene-view-{i}.xml" for i in (3, *range(5, 15)))}
    assert {copy.name for copy in saved} == names
    for i, copy in enumerate(saved):
        assert f'<translate value="{i}, 0, 0"/>' in copy.read_text()
    assert path.read_text() == scene(camera())


def test_what_cannot_be_saved_leaves_nothing(file, monkeypatch):
    text = SceneText(file(scene(camera())))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(
        OSError, match='^cannot write ".*scene-view.xml": No space left on device.$'
    ):
        text.save(0, elsewhere())
    assert [path.name for path in text.path.parent.iterdir()] == ["scene.xml"]
    text.path = text.path.with_name("a" * 250 + ".xml")
    with pytest.raises(OSError, match='^cannot write ".*-view.xml": File name too long.$'):
        text.save(0, elsewhere())


def test_a_file_that_changes_later_is_copied_as_it_was(file):
    path = file(scene(looking(10)))
    text = SceneText(path)
    copied = text.with_camera(0, elsewhere())
    path.write_text("gone")
    assert text.save(0, elsewhere()).read_text() == copied
