"""Aimed cameras: their central geodesic meets the target, and their lens is sharp there."""

import math
import re

import drjit as dr
import mitsuba as mi
import pytest

from benchmarks.studio import film
from command_line import complaint, scene
from nil_mitsuba import aiming, geometry, look_at

EYE, TARGET = (0.2, 0.1, 0.7), (0.6, 0.8, 0.4)


def nil(**parameters):
    return mi.load_dict({"type": "nil", **parameters})


def central(sensor, integrator, lens=None):
    """Start (cells) and direction (cell axes) of the rays through the middle of the picture."""
    from nil_mitsuba.camera import Camera

    lens = mi.Point2f(0.5) if lens is None else lens
    ray, _ = sensor.sample_ray_differential(0, 0.5, mi.Point2f(0.5), lens)
    space = integrator.space()
    p, v, *_ = Camera(sensor, space, integrator.tolerance).start(ray, mi.Float(0.5))
    return p, space.to_cell_axes(v)


def camera_at(to_world, kind="perspective", **more):
    return mi.load_dict(
        {"type": kind, "to_world": to_world, "film": film(8, 8), "near_clip": 1e-3} | more
    )


def arrival(sensor, integrator, distance):
    """Where the central geodesic is after a distance in scene units: cells, and the cell's deck
    element."""
    p, v = central(sensor, integrator)
    way = distance / integrator.cell_size - 1e-3 / integrator.cell_size  # from the near clip plane
    end, _ = geometry.flow(p, v, mi.Float(way), integrator.twist)
    return geometry.wrap(end, integrator.twist) if integrator.quotient else (end, [0, 0, 0])


SPACES = [
    ({"twist": 1.0}, (0, 0, 0)),
    ({"twist": 1.0}, (2, -1, 1)),
    ({"twist": -2.0}, (-1, 3, 0)),
    ({"twist": 0.0}, (1, 1, -2)),
    ({"twist": 2.5, "quotient": False}, (0, 0, 0)),
    ({"twist": 1.0, "cell_size": 40.0, "cell_origin": [-10.0, 5.0, -20.0]}, (1, 2, 1)),
    ({"twist": 1.0, "fibres": "y", "cell_size": 3.0}, (2, -1, 1)),
    ({"twist": 2.0, "fibres": "x", "cell_origin": [1.0, 2.0, 3.0]}, (0, 1, 2)),
]


@pytest.mark.parametrize("parameters, image", SPACES)
def test_an_aimed_cameras_geodesic_arrives_at_the_image(rgb, parameters, image):
    integrator = nil(**parameters)
    place = integrator.space().to_scene
    eye, target = (list(zip(*place(mi.Point3f(p))))[0] for p in (EYE, TARGET))
    to_world, distance = look_at(integrator, eye, target, (0, 1, 0.1), image)
    there, cell = arrival(camera_at(to_world), integrator, distance)
    assert dr.allclose(there, mi.Point3f(TARGET), atol=1e-5)  # some 50 roundings of a cell
    assert [int(c[0]) for c in cell] == list(image) if any(image) else True
    # Mitsuba's own look_at goes elsewhere, or this could not fail
    if integrator.twist:
        straight = mi.ScalarTransform4f().look_at(eye, target, [0, 1, 0.1])
        missed, _ = arrival(camera_at(straight), integrator, distance)
        assert not dr.allclose(missed, mi.Point3f(TARGET), atol=0.02)


def test_what_is_aimed_at_is_in_the_middle_of_the_picture(rgb):
    """The tracer finds the ball in the cell that was asked for, at its distance."""
    integrator = nil(aovs="cell, distance", max_depth=1)
    to_world, distance = look_at(integrator, EYE, TARGET, image=(0, 1, 1))
    small = {"type": "sphere", "center": TARGET, "radius": 1e-3}
    camera = {
        "type": "perspective",
        "fov": 0.01,
        "to_world": to_world,
        "near_clip": 1e-3,
        "film": film(1, 1),
    }
    found = mi.load_dict({"type": "scene", "camera": camera, "ball": small, "nil": integrator})
    names = integrator.aov_names()
    layers = dict(zip(names, list(mi.render(found, spp=1).array)[-len(names) :], strict=True))
    assert [layers[f"cell.{axis}"] for axis in "XYZ"] == [0, 1, 1]
    assert layers["depth.Z"] == pytest.approx(distance - 1e-3, abs=2e-3)  # the clip and the ball


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0.3, -1, 0.2)])
def test_at_twist_zero_it_is_mitsubas_look_at(rgb, up):
    found = look_at(nil(twist=0), EYE, TARGET, up)
    expected = mi.ScalarTransform4f().look_at(EYE, TARGET, up).matrix
    assert dr.allclose(found.to_world.matrix, expected, atol=1e-6)
    assert found.focus_distance == pytest.approx(math.dist(EYE, TARGET), rel=1e-6)


def test_what_is_up_stands_upright_in_the_picture(rgb):
    for up, fibres in ((None, "z"), (None, "x"), ((1, 0, 0), "z"), ((0, -1, 2), "y")):
        integrator = nil(twist=3, quotient=False, fibres=fibres)
        matrix = look_at(integrator, EYE, TARGET, up).to_world.matrix
        left, above = ([matrix[i, j] for i in range(3)] for j in (0, 1))
        up = up or [axis == fibres for axis in "xyz"]
        assert sum(a * b for a, b in zip(left, up)) == pytest.approx(0, abs=1e-6)
        assert sum(a * b for a, b in zip(above, up)) > 0


def test_a_camera_is_aimed_alike_wherever_an_isometry_takes_it(rgb):
    """The rotation is read in the left-invariant frame: coordinates would turn it by k x."""
    integrator = nil(twist=1, quotient=False)
    here = look_at(integrator, EYE, TARGET)
    moved = [
        geometry.multiply(mi.ScalarPoint3f(3, -2, 1), mi.ScalarPoint3f(p)) for p in (EYE, TARGET)
    ]
    there = look_at(integrator, *moved)
    for i in range(3):
        for j in range(3):
            turned = there.to_world.matrix[i, j] - here.to_world.matrix[i, j]
            assert turned == pytest.approx(0, abs=3e-6)
    assert there.focus_distance == pytest.approx(here.focus_distance, rel=1e-6)


@pytest.mark.parametrize("parameters, image", [*SPACES[:3], SPACES[-1]])
def test_a_thin_lens_is_sharp_at_the_focus_distance(rgb, parameters, image):
    """Rays from all over the lens go on to the image of the target, and from its rim elsewhere if
    the lens is focused a fifth further away."""
    integrator = nil(**parameters)
    place = integrator.space().to_scene
    eye, target = (list(zip(*place(mi.Point3f(p))))[0] for p in (EYE, TARGET))
    to_world, distance = look_at(integrator, eye, target, image=image)
    rng = mi.PCG32(100)
    lens = mi.Point2f(rng.next_float32(), rng.next_float32())
    target = geometry.multiply(mi.Point3i(image), mi.Point3f(TARGET), integrator.twist)

    def largest_miss(focus):
        sensor = camera_at(to_world, "thinlens", aperture_radius=0.05, focus_distance=focus)
        p, v = central(sensor, integrator, lens)
        way = geometry.connect(p, target, integrator.twist)
        return dr.max(dr.norm(way.direction - v) * way.distance)[0]

    assert largest_miss(distance) < 2e-5
    assert largest_miss(1.2 * distance) > 2e-3


def test_a_scene_is_as_good_as_its_integrator(rgb):
    integrator = nil(twist=2)
    scene = mi.load_dict({"type": "scene", "nil": integrator})
    points = [mi.ScalarPoint3f(EYE), mi.Point3f(TARGET)]
    assert look_at(scene, *points).focus_distance == look_at(integrator, EYE, TARGET).focus_distance


def test_an_integrator_is_aimed_for_that_holds_nil(rgb):
    bent = {"type": "nil", "twist": 2}
    layers = {"type": "aov", "aovs": "d:depth", "within": bent}
    expected = look_at(mi.load_dict(bent), EYE, TARGET)
    for holder in (layers, {"type": "moment", "within": layers}):
        integrator = mi.load_dict(holder)
        for given in (integrator, mi.load_dict({"type": "scene", "around": integrator})):
            found = look_at(given, EYE, TARGET)
            assert found.focus_distance == expected.focus_distance
            assert dr.all(found.to_world.matrix == expected.to_world.matrix, axis=None)


@pytest.mark.parametrize(
    "parameters, arguments, sentence",
    [
        ({}, {"target": EYE}, r"^the target is where the camera is, at \(0.2, 0.1, 0.7\)\.$"),
        ({}, {"target": (0.2, 0.1, 0.7 + 1e-8)}, "^the target is where the camera is"),
        ({}, {"image": (20, 0, 0)}, r"image in the cell \(20, 0, 0\) is 20.* max_distance = 12"),
        ({}, {"image": (10**200, 0, 0)}, "rays end at max_distance = 12"),
        ({"max_distance": 0.5}, {}, "^the target is 0.98.* cells away, .* max_distance = 0.5"),
        ({"quotient": False}, {"image": (0, 1, 0)}, r"^plain Nil has no images .*\(0, 1, 0\)"),
        ({}, {"image": (0.5, 0, 0)}, '"image" must be three whole numbers'),
        ({}, {"image": 3}, '"image" must be three whole numbers'),
        ({}, {"target": (0.2, 0.1, 0.2)}, r"^up = \(0, 0, 1\) does not say .* such as \(1, 0, 0\)"),
        ({}, {"up": (0, 0, 0)}, "does not say where up is"),
        ({}, {"origin": (1, 2)}, '^"origin" must be three numbers below 1e15'),
        ({}, {"target": (1, 2, math.inf)}, '^"target" must be three numbers below 1e15'),
        ({}, {"target": (1e38, 0, 0)}, '^"target" must be three numbers below 1e15'),
        ({}, {"target": "ball"}, '^"target" must be three numbers below 1e15, and it is ball'),
        ({}, {"up": (0, math.nan, 1)}, '^"up" must be three numbers below 1e15'),
    ],
)
def test_where_nothing_can_be_aimed_at_is_told(rgb, parameters, arguments, sentence):
    arguments = {"origin": EYE, "target": TARGET} | arguments
    with pytest.raises(ValueError, match=sentence):
        look_at(nil(**parameters), **arguments)


def test_aiming_needs_the_integrator_that_bends(rgb):
    path = mi.load_dict({"type": "path"})
    for given in (path, mi.load_dict({"type": "scene", "path": path}), None):
        with pytest.raises(ValueError, match='^look_at needs an integrator "nil"'):
            look_at(given, EYE, TARGET)


@pytest.mark.parametrize(
    "up, forward, expected",
    [
        ((0, 1, 0), (0.3, -0.2, 1), (0, 1, 0)),
        ((0, 0, -1), (1, 2, -5), (0, 0, -1)),  # steeply
        ((0, 1, 0), (0, 0, 1), (0, 1, 0)),
        ((1, 0.02, 0), (0, 0.3, 1), None),  # rolled about its view: its own
    ],
)
def test_a_camera_holds_an_axis_upright_if_it_is_level(rgb, up, forward, expected):
    to_world = mi.Transform4f().look_at([0, 0, 0], forward, up)
    found = aiming.up_of(to_world)
    own = aiming.columns_of(to_world)[1]
    assert found == pytest.approx(expected or own, abs=1e-6)


# ------------------------------------------------------------------------ the command

CAMERA = """
    <sensor type="{kind}">
        <transform name="to_world">
            {scale}<lookat origin="0.2, 0.1, 0.7" target="0.3, 0.9, 0.6" up="0, 0, 1"/>
        </transform>
        <float name="near_clip" value="0.001"/>{more}
        <film type="hdrfilm">
            <integer name="width" value="8"/><integer name="height" value="8"/>
        </film>
    </sensor>
"""
PLAIN = CAMERA.format(kind="perspective", scale="", more="")
BOX = "".join(
    f'''
    <shape type="obj" id="{name}"><string name="filename" value="box.obj"/>
        <transform name="to_world">
            <scale value="0.05"/><translate value="{x}, 0.8, 0.4"/>
        </transform>
    </shape>
    '''
    for name, x in (("box", 0.6), ("other", 0.1))
)
NIL = '<integrator type="nil"/>'


@pytest.fixture
def aim(command, folder):
    """Aims the camera of a scene by the command, and pastes what it prints."""
    (folder / "box.obj").write_text("v -1 -1 -1\nv 1 1 -1\nv 1 -1 1\nf 1 2 3\n")

    def run(camera, *arguments):
        (folder / "scene.xml").write_text(scene(NIL, camera, BOX))
        status, out, err = command("aim", "scene.xml", *arguments)
        assert (status, err) == (0, "")
        text = re.sub(r'<float name="focus_distance".*?/>', "", camera)
        return mi.load_string(
            scene(
                NIL, re.sub(r"<transform.*?</transform>", out.replace("\\", ""), text, flags=re.S)
            )
        ).sensors()[0], float(re.search(r'"focus_distance" value="(.*?)"', out)[1])

    return run


@pytest.mark.parametrize(
    "kind, scale, more, options",
    [
        ("perspective", "", "", ["--at", "box"]),
        ("perspective", '<scale x="-1"/>', "", ["--at", "0.6,0.8,0.4", "--image", "1,0,-1"]),
        ("orthographic", '<scale value="0.3"/>', "", ["--at", "box", "-P", "fibres=y"]),
        (
            "thinlens",
            "",
            '<float name="aperture_radius" value="0.05"/><float name="focus_distance" value="9"/>',
            ["--at", "box", "--up", "0,1,0", "--from", "0.9,0.1,0.3"],
        ),
    ],
)
def test_what_the_command_prints_can_be_pasted(aim, kind, scale, more, options):
    camera = CAMERA.format(kind=kind, scale=scale, more=more)
    before = mi.load_string(scene(camera)).sensors()[0].world_transform()
    sensor, distance = aim(camera, *options)
    integrator = nil(fibres="y" if "fibres=y" in options else "z")
    there, cell = arrival(sensor, integrator, distance)
    assert dr.allclose(integrator.space().to_scene(there), mi.Point3f(TARGET), atol=1e-5)
    if "--image" in options:
        assert [int(c[0]) for c in cell] == [1, 0, -1]
    # A mirrored or scaled camera stays so, and stands where it stood
    after = sensor.world_transform()
    assert dr.allclose(dr.det(after.matrix), dr.det(before.matrix), rtol=1e-4)
    origin = [0.9, 0.1, 0.3] if "--from" in options else EYE
    assert aiming.columns_of(after)[3] == pytest.approx(origin, abs=1e-7)
    assert aiming.up_of(after) == ((0, 1, 0) if "--up" in options else (0, 0, 1))
    if kind == "thinlens":
        assert mi.traverse(sensor)["focus_distance"][0] == pytest.approx(distance, rel=1e-6)


def test_a_radiancemeter_has_no_focus(command, folder):
    meter = CAMERA.format(kind="radiancemeter", scale="", more="").replace('value="8"', 'value="1"')
    meter = meter.replace('<float name="near_clip" value="0.001"/>', "")
    (folder / "scene.xml").write_text(scene(NIL, meter))
    status, out, _ = command("aim", "scene.xml", "--at", "-0.6,0.8,0.4")
    assert status == 0 and "</transform>" in out and "focus" not in out


def test_one_of_several_sensors_is_aimed(command, folder):
    other = PLAIN.replace("0.2, 0.1, 0.7", "0.9, 0.1, 0.3")
    (folder / "scene.xml").write_text(scene(NIL, PLAIN, other))
    status, out, _ = command("aim", "scene.xml", "-s", "1", "--at", "0.6,0.8,0.4")
    assert status == 0 and '<translate value="0.9, 0.1, 0.3"/>' in out


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["--at", "wall"], 'no shape has the id "wall": there are box, other.'),
        (["--at", "bix"], 'no shape has the id "bix": did you mean "box"? there are box, other.'),
        (["--at", "0.2,0.1,0.7"], "the target is where the camera is, at (0.2, 0.1, 0.7)."),
        (["--at", "box", "--image", "40,0,0"], "max_distance = 12"),
        (["--at", "box", "--image", "1,0"], 'expected three whole numbers i,j,k, and "1,0" is not'),
        (["--at", "box", "-P", "quotient=false", "--image", "1,0,0"], "plain Nil has no images"),
        (["--at", "box", "--from", "1,2,nan"], "expected three numbers x,y,z"),
        (["--at", "1,2"], 'expected three numbers x,y,z, and "1,2" is not'),
        (["--at", "1,nan,2"], 'expected three numbers x,y,z, and "1,nan,2" is not'),
        (["--at", "1, 2,"], 'expected three numbers x,y,z, and "1, 2," is not'),
        (["--at", "a,1"], 'no shape has the id "a,1"'),
        (["--at", "0.2,0.1,0.1"], "up = (0, 0, 1) does not say where up is"),
        (["--at", "box", "-s", "1"], "has no sensor 1"),
        (["--at", "box", "--from", "0,0,0", "--fit", "camera"], "--from moves it"),
        (["--at", "box", "--from", "0,0,0", "--fit"], "give the -P that it prints"),
    ],
)
def test_what_cannot_be_aimed_at_is_told_in_one_sentence(command, folder, arguments, sentence):
    (folder / "box.obj").write_text("v -1 -1 -1\nv 1 1 -1\nv 1 -1 1\nf 1 2 3\n")
    (folder / "scene.xml").write_text(scene(NIL, PLAIN, BOX))
    status, out, err = command("aim", "scene.xml", *arguments)
    assert status and not out and sentence in complaint(err)


GROUP = """
    <shape type="shapegroup" id="tree"><shape type="sphere" id="crown"/></shape>
    <shape type="instance"{}><ref id="tree"/>
        <transform name="to_world">
            <scale value="0.1"/><translate value="0.6, 0.8, 0.4"/>
        </transform>
    </shape>
"""


def test_instances_are_aimed_at_and_their_groups_are_not(command, folder):
    (folder / "scene.xml").write_text(scene(NIL, PLAIN, GROUP.format(' id="oak"')))
    assert command("aim", "scene.xml", "--at", "oak")[0] == 0
    for name in ("tree", "crown"):
        status, _, err = command("aim", "scene.xml", "--at", name)
        assert status == 1 and f'"{name}" belongs to a shapegroup' in complaint(err)
        assert complaint(err).endswith("name an instance of it, such as oak.")


def test_a_shape_outside_of_the_cell_is_told_at_aiming(command, folder):
    ball = '<shape type="sphere" id="ball"><point name="center" value="0.6, 3, 0.4"/></shape>'
    (folder / "scene.xml").write_text(scene(NIL, PLAIN, ball))

    def said(*arguments):
        status, out, err = command("aim", "scene.xml", *arguments)
        assert status == 0 and "<transform" in out
        return err

    note = (
        'the middle of the shape "ball", (0.6, 3, 0.4), lies outside of the cell, which reaches '
        "from (0, 0, 0) to (1, 1, 1), and is cut off: add --fit camera, or set cell_size and "
        "cell_origin.\n"
    )
    assert said("--at", "ball") == note
    assert "lies outside" not in said("--at", "ball", "--fit", "camera")
    for options in (["--at", "0.6,3,0.4"], ["--at", "ball", "-P", "quotient=false"]):
        assert said(*options) == ""


def test_a_batch_is_no_camera_to_aim(command, folder):
    batch = f'<sensor type="batch">{PLAIN}<film type="hdrfilm"/></sensor>'
    (folder / "scene.xml").write_text(scene(NIL, batch))
    status, _, err = command("aim", "scene.xml", "--at", "0.6,0.8,0.4")
    assert status == 1 and "the sensor 0 is a batch" in complaint(err)
