"""Scene files as others wrote them, with `nil` put in; the hash of what they show."""

import os

import drjit as dr
import mitsuba as mi
import pytest

from command_line import LAMP, NIL, SENSOR, read, remarks, scene
from nil_mitsuba import scene_files
from nil_mitsuba.scene_files import SceneFiles
from small_stills import TRIANGLE


@pytest.mark.parametrize("integrator", ["path", "never_written"])
def test_another_integrator_is_replaced_before_it_is_built(command, folder, integrator):
    other = (
        f'<integrator type="{integrator}"><integer name="max_depth" value="3"/>'
        '<string name="of_its_own" value="x"/></integrator>'
    )
    (folder / "scene.xml").write_text(scene(other, SENSOR, LAMP))
    status, _, err = command("render", "scene.xml", "-P", "rr_depth=7")
    assert status == 0
    assert remarks(err) == f'scene.xml: the integrator "{integrator}" is replaced by "nil".\n'
    header = read("scene.exr")[0]
    assert (header["max_depth"], header["rr_depth"]) == (3, 7)


def test_a_scene_without_integrator_is_rendered_with_nil(command, folder):
    (folder / "scene.xml").write_text(scene(SENSOR, LAMP))
    status, _, err = command("render", "scene.xml", "-P", "twist=0")
    assert (status, remarks(err)) == (0, 'scene.xml has no integrator: rendering with "nil".\n')
    assert read("scene.exr")[0]["twist"] == 0


def test_wrappers_of_nil_stay_and_others_go(command, folder):
    moment = '<integrator type="moment"><integrator type="{}"/></integrator>'
    film = SENSOR.replace("$format", "float32")
    (folder / "nil.xml").write_text(scene(moment.format("nil"), film, LAMP))
    (folder / "path.xml").write_text(scene(moment.format("path"), film, LAMP))

    status, _, err = command("render", "nil.xml", "-P", "twist=2", "--png", "nil.png")
    assert (status, remarks(err)) == (0, "")
    assert len(read("nil.exr")[1]) > 3

    status, _, err = command("render", "path.xml")
    assert (status, remarks(err)) == (
        0,
        'path.xml: the integrator "moment" is replaced by "nil".\n',
    )
    assert len(read("path.exr")[1]) == 3


def test_meshes_includes_and_constants_are_found_from_any_folder(command, folder):
    place = folder / "a" / "parts"
    place.mkdir(parents=True)
    (place / "triangle.obj").write_text("v 0 0 .9\nv 1 0 .9\nv 0 1 .9\nf 1 3 2\n")
    (place / "mesh.xml").write_text(
        '<scene version="3.0.0"><shape type="obj"><string name="filename" value="$mesh"/>'
        '<emitter type="area"/></shape></scene>'
    )
    (folder / "a" / "scene.xml").write_text(
        scene(
            '<default name="mesh" value="none.obj"/>',
            '<integrator type="path"/><include filename="parts/mesh.xml"/>',
            SENSOR,
        )
    )
    status, _, err = command(
        "render", "a/scene.xml", "-D", "mesh=parts/triangle.obj", "-D", "spp=16"
    )
    assert status == 0, err
    header, _, pixels = read("a/scene.exr")
    assert header["spp"] == 16
    assert dr.max(pixels.array)[0] > 0.5


@pytest.mark.parametrize(
    "text, value",
    [
        ("3", 3),
        ("-2", -2),
        ("0.5", 0.5),
        ("1e-3", 1e-3),
        ("true", True),
        ("False", False),
        ("abc", "abc"),
        ("1,2", "1,2"),
    ],
)
def test_properties_have_the_type_they_look_like(rgb, text, value):
    parsed = scene_files.parse_value(text)
    assert parsed == value and type(parsed) is type(value)


def test_three_numbers_are_a_vector(rgb):
    assert list(scene_files.parse_value("-1,0.5,2")) == [-1, 0.5, 2]


@pytest.mark.parametrize("shapes", range(6))
def test_a_film_without_a_filter_gets_a_box_filter(folder, rgb, shapes):
    # The scene's list of nodes grows by one, whatever room there was
    (folder / "scene.xml").write_text(scene(NIL, SENSOR, *[LAMP] * shapes))
    files = scene_files.SceneFiles("scene.xml", {}, {})
    assert not files.scene(merge=False).sensors()[0].film().rfilter().is_box_filter()
    files = scene_files.SceneFiles("scene.xml", {}, {})
    files.use_box_filter()
    assert '"gaussian" is replaced by "box"' in files.notes[0]
    assert files.scene().sensors()[0].film().rfilter().is_box_filter()


def test_the_hash_of_a_scene_tells_what_it_shows(still_folder):
    def scene_hash(**parameters):
        return SceneFiles("scene.xml", parameters, {}).hash

    resolver = mi.file_resolver()
    here = os.getcwd()
    os.chdir(still_folder)
    mi.set_file_resolver(mi.FileResolver())
    try:
        plain = scene_hash()
        assert scene_hash(spp="99") == plain and scene_hash(twist="2") == plain
        assert scene_hash(resolution="13") != plain
        (still_folder / "triangle.obj").write_text(TRIANGLE.replace(".9", ".8"))
        assert scene_hash() != plain
    finally:
        os.chdir(here)
        mi.set_file_resolver(resolver)
