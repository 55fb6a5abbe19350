"""A cell that is fitted to a scene, to its camera, and what is said of it."""

import re

import mitsuba as mi
import pytest

from command_line import LAMP, NIL, SENSOR, complaint, read, scene
from nil_mitsuba import fitting

FAR_LAMP = LAMP.replace('x="0.5"', 'x="-7"')  # from the camera at (0.5, 0.5, 0.1)
UPRIGHT = SENSOR.replace('target="0.5, 0.5, 1" up="0, 1, 0"', 'target="0.5, 1, 0.1" up="0, 0, 1"')


@pytest.fixture
def said(command, folder):
    """What is said of a scene and its cell, by a command that does not render."""

    def run(*parts, fit=("--fit",), more=()):
        (folder / "scene.xml").write_text(scene(*parts))
        at = ("--at", "0.52,0.53,0.2", "-P", "max_distance=99")  # within reach in any cell
        status, _, err = command("aim", *fit, "scene.xml", *at, *more)
        assert status == 0, err
        return err

    return run


def printed(err):
    """The cell that was printed: its corner, or identity, and its edge."""
    size, corner = re.search("-P cell_size=(.*) -P cell_origin=(.*)$", err, re.M).groups()
    return [float(c) for c in corner.split(",")], float(size)


@pytest.fixture
def fitted(command, folder):
    """Renders a scene with a fitted cell: the cell's corner and edge, and what was said."""

    def run(*parts, fit=("--fit",), more=()):
        (folder / "scene.xml").write_text(scene(*parts))
        status, _, err = command("render", *fit, "scene.xml", "-o", "a.exr", *more)
        assert status == 0, err
        header = read("a.exr")[0]
        return [float(c) for c in header["cell_origin"].split(",")], header["cell_size"], err

    return run


def test_fit_puts_the_shapes_into_the_smallest_cell(fitted):
    corner, size, _ = fitted(NIL, SENSOR, FAR_LAMP)
    assert size == pytest.approx(0.3 * (1 + 1e-3), rel=1e-6)
    assert [c + size / 2 for c in corner] == pytest.approx((-7, 0.5, 0.7), rel=1e-6)


@pytest.mark.parametrize("fit", ["--fit", "--fit=camera"])
def test_what_fit_prints_keeps_its_cell(fitted, fit):
    corner, size, err = fitted(NIL, SENSOR, FAR_LAMP, fit=[fit])
    lines = re.findall("^ +(.*cell_size.*|.*cell_origin.*)$", err, re.M)
    options = lines.pop().split()
    assert fitted(NIL, SENSOR, FAR_LAMP, fit=[], more=options)[:2] == (corner, size)
    nil = f'<integrator type="nil">{"".join(lines)}</integrator>'
    assert fitted(nil, SENSOR, FAR_LAMP, fit=[])[:2] == (corner, size)


def test_a_camera_outside_of_the_fitted_cell_is_told_what_becomes_of_it(said):
    err = said(NIL, SENSOR, FAR_LAMP)
    (warning,) = (line for line in err.splitlines() if "outside" in line)
    assert "the camera at (0.5, 0.5, 0.1) lies outside" in warning
    assert "--fit camera takes" in warning
    behind = LAMP.replace('z="0.7"', 'z="-0.7"')
    assert "lies outside" in said(NIL, SENSOR, behind)
    # In plain Nil nothing is carried, nor with a camera that the shapes surround
    assert "outside" not in said(NIL, SENSOR, FAR_LAMP, more=["-P", "quotient=false"])
    assert "outside" not in said(NIL, SENSOR, LAMP.replace("0.15", "3"))


@pytest.mark.parametrize("fit", [("--fit", "camera"), ("--fit=camera",)])
def test_fit_camera_holds_shapes_and_camera_clear_of_the_faces(fitted, fit):
    corner, size, err = fitted(NIL, SENSOR, FAR_LAMP, fit=fit)
    assert size == pytest.approx((0.5 + 7.15) * (1 + 1e-3), rel=1e-6)
    for point in ((0.5, 0.5, 0.1), (-7.15, 0.35, 0.55), (-6.85, 0.65, 0.85)):
        assert all(c + 4e-4 * size < x < c + (1 - 4e-4) * size for c, x in zip(corner, point))
    assert "outside" not in err


def test_fit_camera_holds_every_sensor_of_a_batch(rgb):
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 2, "height": 2}
    batch = {"type": "batch", "film": film | {"width": 4}}
    for i, x in enumerate((-3, 5)):
        batch[f"eye{i}"] = {
            "type": "perspective",
            "to_world": T().look_at([x, 0, 0], [x, 1, 0], [0, 0, 1]),
            "film": film,
        }
    loaded = mi.load_dict({"type": "scene", "batch": batch, "ball": {"type": "sphere"}})
    nil = mi.load_dict({"type": "nil"})
    found = fitting.fit(loaded, loaded.sensors()[0], nil, "camera")
    assert float(found.properties["cell_size"]) == pytest.approx(8 * (1 + 1e-3), rel=1e-6)
    assert not [note for note in found.notes if "fibres" in note or "outside" in note]
    found = fitting.fit(loaded, loaded.sensors()[0], nil, "shapes")
    assert [note for note in found.notes if "the camera at (-3, 0, 0) lies outside" in note]


def test_what_makes_the_cell_too_large_to_bend_is_named(fitted, said):
    ground = """
        <shape type="rectangle" id="ground"><bsdf type="diffuse"/><transform name="to_world">
            <scale value="{}"/><translate value="0, 0, -1"/></transform></shape>
    """
    sky = '<shape type="sphere" id="dome"><float name="radius" value="900"/></shape>'
    err = said(NIL, SENSOR, LAMP, ground.format(100))
    assert '--fit: all but "ground" would fit into a cell of 0.75075, and' in err
    assert 'cuts off what of "ground" reaches out' in err
    (options,) = re.findall("this lets it bend.*:\n(?: +<.*\n)* +(-P .*)\n", err)
    corner, size, _ = fitted(NIL, SENSOR, LAMP, fit=[], more=options.split())
    assert size == pytest.approx(0.75075)
    assert all(c < x < c + size for c, x in zip(corner, (0.5, 0.5, 0.1)))  # the camera, too
    plain = ["-P", "quotient=false"]
    err = said(NIL, SENSOR, LAMP, ground.format(100), sky, more=plain)
    assert 'all but "dome" and "ground" would fit into a cell of 0.3003' in err
    assert "cuts off" not in err
    err = said(NIL, SENSOR, LAMP, ground.format(100), fit=["--fit=camera"], more=plain)
    assert "would fit into a cell of 0.75075" in err
    # No ground is too large of which the rest takes a third
    assert "would fit" not in said(NIL, SENSOR, LAMP, ground.format(1))


def test_fit_prints_no_more_digits_than_it_needs(fitted):
    corner, size, err = fitted(NIL, SENSOR, LAMP)
    assert "-P cell_size=0.3003 -P cell_origin=0.34985,0.34985,0.54985\n" in err
    assert (size, corner) == (pytest.approx(0.3003), pytest.approx([0.34985, 0.34985, 0.54985]))


def test_fibres_are_suggested_along_the_cameras_up(said):
    err = said(NIL, SENSOR, LAMP)  # y is up
    assert '<string name="fibres" value="y"/>\n    -P fibres=y\n' in err
    assert "fibres" not in said(NIL, SENSOR, LAMP, more=["-P", "fibres=y"])
    upright = '<integrator type="nil"><string name="fibres" value="y"/></integrator>'
    assert "fibres" not in said(upright, SENSOR, LAMP)
    assert "fibres" not in said(NIL, UPRIGHT, LAMP)


def test_the_identity_of_plain_nil_is_halfway_from_the_camera_to_the_shapes(said):
    plain = ["-P", "quotient=false"]
    err = said(NIL, SENSOR, FAR_LAMP, more=plain)
    corner, size = printed(err)
    assert corner == pytest.approx(((0.5 - 7) / 2, 0.5, (0.1 + 0.7) / 2), rel=1e-5)
    assert size == pytest.approx(0.3 * (1 + 1e-3), rel=1e-6)
    assert "is 25 cells away from the camera" in err and "--fit camera takes a larger" in err
    err = said(NIL, SENSOR, FAR_LAMP, fit=["--fit=camera"], more=plain)
    corner, size = printed(err)
    assert corner == pytest.approx(((0.5 - 7) / 2, 0.5, (0.1 + 0.7) / 2), rel=1e-5)
    assert size == pytest.approx((0.5 + 7.15) * (1 + 1e-3), rel=1e-6)
    assert "cells away" not in err


def test_what_the_flat_camera_looked_at_is_offered_to_aim(command, fitted):
    tilted = SENSOR.replace('origin="0.5, 0.5, 0.1"', 'origin="0.9, 0.9, 0.1"')
    tilted = tilted.replace('target="0.5, 0.5, 1"', 'target="0.5, 0.5, 0.7"')
    err = fitted(NIL, tilted, LAMP, fit=["--fit=camera"])[2]
    (x, y, z) = map(float, re.search("--at (.*),(.*),(.*) prints the to_world", err).groups())
    assert (x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.7) ** 2 == pytest.approx(0.15**2, rel=1e-2)
    assert (
        "to_world" not in fitted(NIL, tilted, LAMP, fit=["--fit=camera"], more=["-P", "twist=0"])[2]
    )
    # Whoever aims already is not told to
    _, _, err = command("aim", "scene.xml", "--fit=camera", "--at", f"{x},{y},{z}")
    assert "--fit: the cell is" in err and "to_world" not in err


def test_a_foreign_scene_out_of_the_cell_is_told_the_options_that_fit(said):
    path = '<integrator type="path"/>'
    err = said(path, SENSOR, FAR_LAMP, fit=[])
    assert ": add --fit camera -P fibres=y to fit it to them.\n" in err
    upright = said(path, UPRIGHT, FAR_LAMP, fit=[], more=["-P", "quotient=false"])
    assert ": add --fit camera to fit it to them.\n" in upright
    # A scene for "nil", one that is fitted, by hand or not, or one that fits
    for parts, fit, more in (
        ((NIL, SENSOR, FAR_LAMP), (), ()),
        ((path, SENSOR, FAR_LAMP), ("--fit",), ()),
        ((path, SENSOR, FAR_LAMP), (), ("-P", "cell_size=2")),
        ((path, SENSOR, LAMP), (), ()),
    ):
        assert "to fit it to them" not in said(*parts, fit=fit, more=more)


def test_a_foreign_scene_out_of_the_cell_is_told_once(command, folder):
    for kind, warned in (("path", False), ("nil", True)):
        foreign = f'<integrator type="{kind}"/>'
        (folder / "scene.xml").write_text(scene(foreign, SENSOR, FAR_LAMP))
        _, out, err = command("render", "scene.xml")
        assert ("reaches 7.15 scene units out of the cube" in out) == warned
        assert ("to fit it to them" in err) != warned


def test_fit_needs_something_to_fit(command, folder):
    (folder / "scene.xml").write_text(scene(NIL, SENSOR))
    status, _, err = command("render", "scene.xml", "--fit")
    assert status == 1 and "--fit needs a scene" in complaint(err)
    for fit in (["--fit=walls"], ["--fit", "cam"], ["--fit", "shape"]):
        status, _, err = command("render", *fit, "scene.xml")
        assert status == 2 and "is not one of 'shapes', 'camera'" in complaint(err)
