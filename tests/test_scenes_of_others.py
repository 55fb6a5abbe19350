"""Scenes that nobody here made, bent by a stranger: one command, and one made of what it said."""

import math
import re
import shlex
import shutil

import drjit as dr
import mitsuba as mi
import pytest

import blender_export
from command_line import planes

PLAIN = ("-P", "quotient=false")


def cornell_box_of_a_benchmark(folder, request):
    shutil.copy(request.getfixturevalue("data") / "scenes/cornell-box/scene.xml", folder)


def cornell_box_of_mitsuba(folder, request):
    state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), mi.cornell_box())
    mi.parser.write_file(state, str(folder / "scene.xml"))


def export_of_blender(folder, request):
    blender_export.export(folder)


# With the size of a small picture and the number of shapes that flat space shows
BOXES = [cornell_box_of_a_benchmark, cornell_box_of_mitsuba]
SCENES = [*BOXES, export_of_blender]


@pytest.fixture
def stranger(request, rgb, folder, command):
    """Runs the command on a scene at a small size: what it says, and its layers by channel."""
    (folder / "scene.xml").unlink()
    request.param(folder, request)
    text = (folder / "scene.xml").read_text()  # whose own integrator Mitsuba may not have
    (folder / "flat.xml").write_text(re.sub("path_guiding_integrator", "path", text))
    size = ("32", "18") if request.param is export_of_blender else ("24", "24")

    def run(*options, what="render", scene="scene.xml"):
        small = ("-D", f"resx={size[0]}", "-D", f"resy={size[1]}")
        more = ("--spp", "16", "-o", "a.exr", "--layers", "shape,distance")
        status, out, err = command(
            what, scene, *small, *(more if what == "render" else ()), *options
        )
        assert status == 0, err
        return (planes(folder / "a.exr") if what == "render" else out), err

    def advice(*options):
        """The options that a first command ends in; to aim takes less time than to render."""
        said = run(*options, "--at", "0,1,0", what="aim")[1]
        return shlex.split(re.search(r": add (.*) to fit it to them\.$", said, re.M)[1])

    run.advice = advice
    run.flat = lambda: mi.render(
        mi.load_file("flat.xml", resx=size[0], resy=size[1]),
        integrator=mi.load_dict({"type": "path", "max_depth": 12}),
        spp=16,
    )
    return run


def assert_shows_the_scene(layers, flat):
    """Several shapes are seen, none fills the picture, and it is about as bright as flat space."""
    shapes = sum(layers["shape.X"], [])
    shares = {shape: shapes.count(shape) / len(shapes) for shape in set(shapes)}
    seen = [shape for shape, share in shares.items() if shape >= 0 and share > 0.01]
    assert len(seen) >= 4
    assert max(shares.values()) < 0.8  # more than the floor fills in the flat export
    pixels = sum((sum(layers[name], []) for name in "RGB"), [])
    assert all(map(math.isfinite, pixels))
    ratio = sum(pixels) / len(pixels) / dr.mean(flat, axis=None).array[0]
    assert 0.3 < ratio < 3


@pytest.mark.parametrize(
    "stranger, space",
    [
        (BOXES[0], ()),
        (BOXES[1], PLAIN),
        pytest.param(BOXES[0], PLAIN, marks=pytest.mark.verify),
        pytest.param(BOXES[1], (), marks=pytest.mark.verify),
    ],
    indirect=["stranger"],
)
def test_a_cornell_box_is_seen_at_the_second_command(stranger, space):
    options = stranger.advice(*space)
    assert options == ["--fit", "camera", "-P", "fibres=y"]
    layers, err = stranger(*space, *options)
    assert "walls" not in err and "upright" not in err
    assert_shows_the_scene(layers, stranger.flat())


@pytest.mark.verify
@pytest.mark.parametrize("stranger", [export_of_blender], indirect=True)
def test_an_export_of_blender_is_seen_in_plain_nil_at_the_second_command(stranger):
    options = stranger.advice(*PLAIN)
    assert options == ["--fit", "-P", "fibres=y"]
    layers, _ = stranger(*PLAIN, *options)
    assert_shows_the_scene(layers, stranger.flat())


@pytest.mark.parametrize("stranger", [export_of_blender], indirect=True)
def test_an_export_of_blender_is_seen_in_the_quotient_once_it_is_aimed(stranger, folder):
    options = stranger.advice()
    assert options == ["--fit", "camera", "-P", "fibres=y"]
    _, err = stranger(*options)
    at = re.search(r"(--at \S+) prints", err)[1].split()
    xml, _ = stranger(*options, *at, what="aim")
    camera = r'<transform name="to_world">\s*<rotate.*?</transform>(?=\s*<sampler)'
    aimed, count = re.subn(
        camera, xml[: xml.index("<float")], (folder / "scene.xml").read_text(), flags=re.S
    )
    assert count == 1
    (folder / "aimed.xml").write_text(aimed)
    layers, _ = stranger(*options, scene="aimed.xml")
    assert_shows_the_scene(layers, stranger.flat())
    # The target is a point of the torus, whose surface bends away by a few pixels
    middle = layers["depth.Z"][9][16]
    assert middle == pytest.approx(
        float(re.search('focus_distance" value="(.*)"', xml)[1]), rel=0.05
    )
