import re
import runpy
import subprocess
import sys

import drjit as dr
import pytest

from conftest import ENVIRONMENT, ROOT


def run(program, *arguments):
    """Run a program of examples/; the one line it prints last."""
    result = subprocess.run(
        [sys.executable, str(ROOT / "examples" / program), *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        env=ENVIRONMENT,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()[-1]


def shows_something(mi, path, height=None, width=None):
    """Whether a picture holds finite numbers, and not one colour only; its shape.

    On a contact sheet, whose gaps are white, height and width are those of its first picture.
    """
    picture = mi.TensorXf(mi.Bitmap(str(path)).convert(component_format=mi.Struct.Type.Float32))
    assert dr.all(dr.isfinite(picture), axis=None)
    first = picture[:height, :width]
    assert dr.max(first) > 1.2 * dr.min(first) + 0.05
    return picture.shape


@pytest.mark.parametrize(
    "program, arguments, shape, first",
    [
        ("render_from_python.py", ["--size", "48", "--spp", "2"], (56, 48), (24, 48)),
        (
            "walk.py",
            ["--size", "32", "--spp", "1", "--frames", "3", "--columns", "2"],
            (44, 72),
            (18, 32),
        ),
        ("twist.py", ["--size", "24", "--spp", "2"], (24, 88), (24, 24)),
        ("own_mesh.py", ["--size", "48", "--spp", "2"], (27, 48), (27, 48)),
        ("all_around.py", ["--size", "48", "--spp", "2"], (24, 48), (24, 48)),
        pytest.param(
            "all_around.py",
            ["--kind", "pair", "--size", "32", "--spp", "2"],
            (24, 72),
            (24, 32),
            marks=pytest.mark.verify,
        ),
    ],
)
def test_example_ends_in_a_picture(rgb, tmp_path, program, arguments, shape, first):
    picture = tmp_path / "picture.exr"  # EXR would keep a NaN
    line = run(program, "-o", str(picture), *arguments)
    assert line.startswith(f"{picture}: ")
    assert shows_something(rgb, picture, *first)[:2] == shape


def test_walk_writes_frames_for_a_film(rgb, tmp_path):
    run(
        "walk.py",
        "-o",
        str(tmp_path / "sheet.png"),
        "--frames-to",
        str(tmp_path / "film"),
        "--frames",
        "2",
        "--size",
        "32",
        "--spp",
        "1",
    )
    assert [path.name for path in sorted((tmp_path / "film").iterdir())] == ["0000.png", "0001.png"]


def test_walk_of_four_cells_comes_back_one_storey_higher(rgb):
    from nil_mitsuba import geometry, keys

    start, end = keys.load(ROOT / "scenes" / "showcase-walk.json")
    there = rgb.Point3f(start.to_world[3:12:4])
    last, direction = geometry.flow(there, rgb.Vector3f(0, 1, 0), rgb.Float(4), 1)
    place, cell = geometry.wrap(last, 1)
    assert dr.allclose(place, there, atol=1e-6)
    assert end.to_world == start.to_world and dr.all(cell == rgb.Vector3i(end.cell))
    assert dr.allclose(direction, rgb.Vector3f(0, 1, 0))


def test_any_mesh_stands_in_the_cube(rgb, tmp_path):
    # Upright along y, large and far from the origin
    mesh = tmp_path / "tower.obj"
    corners = [(100 + x, 20 + 9 * y, -50 + z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    faces = [
        (1, 3, 4),
        (1, 4, 2),
        (5, 6, 8),
        (5, 8, 7),
        (1, 5, 7),
        (1, 7, 3),
        (2, 4, 8),
        (2, 8, 6),
        (3, 7, 8),
        (3, 8, 4),
    ]
    mesh.write_text(
        "\n".join(
            ["v {} {} {}".format(*c) for c in corners] + ["f {} {} {}".format(*f) for f in faces]
        )
    )
    picture = tmp_path / "picture.exr"
    run("own_mesh.py", str(mesh), "--up", "y", "-o", str(picture), "--size", "32", "--spp", "1")
    shows_something(rgb, picture)

    own_mesh = runpy.run_path(str(ROOT / "examples" / "own_mesh.py"))
    foot, extent = own_mesh["FOOT"], own_mesh["EXTENT"]
    box = own_mesh["load"](mesh, "y").bbox()
    assert dr.allclose(box.min, [foot[0] - extent / 18, foot[1] - extent / 18, foot[2]], atol=1e-5)
    assert dr.allclose(box.max.z, foot[2] + extent, atol=1e-5)


COLOURED = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property uchar alpha
element face 1
property list uchar int vertex_indices
end_header
0 0 0 0 188 0 255
1 0 0 0 188 0 255
.5 0 1 0 188 0 255
3 0 1 2
"""


@pytest.mark.parametrize("kind", ["material", "texture", "vertices"])
def test_own_mesh_keeps_its_colours(rgb, tmp_path, kind):
    """188 is half of the light in sRGB."""
    green = rgb.Bitmap(rgb.TensorXf([0.0, 0.5, 0.0], (1, 1, 3)))
    (tmp_path / "maps").mkdir()
    path = tmp_path / "maps" / "green.png"
    green.convert(component_format=rgb.Struct.Type.UInt8, srgb_gamma=True).write(str(path))
    (tmp_path / "paint.mtl").write_text("newmtl a\nKd 1 0 0\nmap_Kd -s 1 1 1 maps\\green.png\n")
    (tmp_path / "mesh.obj").write_text(
        ("mtllib paint.mtl\n" if kind == "material" else "")
        + "v 0 0 0\nv 1 0 0\nv .5 0 1\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "mesh.ply").write_text(COLOURED)
    own_mesh = runpy.run_path(str(ROOT / "examples" / "own_mesh.py"))
    file = tmp_path / ("mesh.ply" if kind == "vertices" else "mesh.obj")
    texture = own_mesh["texture_of"](file)
    assert texture == (path if kind == "material" else None)
    mesh = own_mesh["load"](file, "z", path if kind == "texture" else texture)
    scene = rgb.load_dict({"type": "scene", "mesh": mesh})
    (x, y, _), z = own_mesh["FOOT"], own_mesh["FOOT"][2] + 0.1
    si = scene.ray_intersect(rgb.Ray3f([x, y - 1, z], [0, 1, 0]))
    seen = si.bsdf().eval_diffuse_reflectance(si)
    assert dr.allclose(seen, [0, 0.5, 0], atol=0.01)


def test_own_mesh_says_what_it_reads():
    result = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "own_mesh.py"), "a.stl"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 2
    assert '"a.stl" is no mesh that this program reads: give a .ply or .obj.' in result.stderr


POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
TABLE = COLOURED.split("3 0 1 2")[0]


@pytest.mark.parametrize(
    "name, text, sentence",
    [
        ("a.ply", "", "holds no mesh that can be read: "),
        ("a.obj", "", "holds no mesh that can be read: "),
        ("a.obj", POINTS + "f 1 2 4\n", "reference to invalid vertex 4!"),
        ("a.obj", "v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2 3\n", "has no extent"),
        ("a.ply", TABLE + "3 0 1 7\n", "some whose corners are not in it"),
        ("a.ply", TABLE, "holds no mesh that can be read: "),
    ],
)
def test_own_mesh_says_in_a_sentence_that_a_file_is_broken(rgb, tmp_path, name, text, sentence):
    (tmp_path / name).write_text(text)
    own_mesh = runpy.run_path(str(ROOT / "examples" / "own_mesh.py"))
    with pytest.raises(ValueError, match=re.escape(sentence)) as raised:
        own_mesh["load"](tmp_path / name, "z")
    assert str(raised.value).startswith(f'"{tmp_path / name}" h') and "\n" not in str(raised.value)


def test_a_ball_holds_as_many_images_of_a_light_as_it_has_volume(rgb, tmp_path):
    pytest.importorskip("altair")
    pytest.importorskip("vl_convert")
    chart = tmp_path / "chart.png"
    line = run("light_images.py", "-o", str(chart), "--length", "9", "--size", "100")
    shows_something(rgb, chart)
    counted, volume = map(int, re.search(r"(\d+) images \(theory (\d+)\)", line).groups())
    # No randomness here: over random pairs of points the count stays within 1 % of the volume,
    # which would be a tenth larger at twist 1.1, and half at twist 0.
    assert abs(counted - volume) < 0.01 * volume


def test_fibres_are_seen_as_straight_lines_that_lean_with_their_distance(rgb):
    import mitsuba as mi

    from nil_mitsuba import geometry

    eye = mi.Point3f(0.2, -0.3, 0.1)
    for distance in (0.5, 1, 2, 4, 8):
        height = dr.linspace(mi.Float, 0.1, 3, 8)
        fibre = geometry.multiply(eye, mi.Point3f(0, distance, height), 1)
        d = geometry.connect(eye, fibre, 1).direction
        # On the image plane of a camera that looks along y
        assert dr.allclose(d.x / d.z, 0.5 * distance, rtol=1e-4)


def test_a_floor_behind_a_corner_of_the_cell_is_one_storey_up(rgb):
    """What docs/looking-at-nil.md says: x, y, −x, −y leads k cells up."""
    import mitsuba as mi

    from nil_mitsuba import geometry

    for twist in (1, 2, -1):
        p = mi.Point3f(0)
        for step in ((1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)):
            p = geometry.multiply(p, mi.Point3f(*step), twist)
        assert dr.all(p == mi.Point3f(0, 0, twist))


def test_winding_floor_goes_on_from_cell_to_cell(rgb):
    floor = rgb.load_dict(
        {"type": "ply", "filename": str(ROOT / "scenes" / "meshes" / "winding-floor.ply")}
    )
    points = dr.unravel(rgb.Point3f, rgb.traverse(floor)["vertex_positions"])
    points = list(zip(*points))
    for axis, shear in ((0, 1), (1, 0)):
        edges = []
        for end in (min, max):
            side = end(p[axis] for p in points)
            edges.append([p for p in points if p[axis] == side and 0.01 < p[2] < 0.99])
        # Along the face, to the height modulo 1 as the glued neighbour has it
        here = {round(p[1 - axis], 4): p[2] + shear * p[1] for p in edges[0]}
        there = [(here[along], p[2]) for p in edges[1] if (along := round(p[1 - axis], 4)) in here]
        assert len(there) > 40
        for expected, z in there:
            off = expected - z
            # The mesh ends a little before the faces.
            assert abs(off - round(off)) < 3e-4


@pytest.mark.verify
def test_pictures_of_the_explanation_are_made_by_their_script(rgb, tmp_path):
    pytest.importorskip("altair")
    pytest.importorskip("vl_convert")
    result = subprocess.run(
        [
            sys.executable,
            str(ROOT / "docs" / "pictures.py"),
            "--size",
            "96",
            "--spp",
            "1",
            "--to",
            str(tmp_path),
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    pictures = sorted(path.name for path in tmp_path.iterdir())
    pages = [ROOT / "docs" / f"{name}.md" for name in ("looking-at-nil", "your-own-scene")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    assert pictures == sorted(re.findall(r"!\[[^]]*\]\(([\w-]+\.\w+)\)", text))
    for name in pictures:
        shows_something(rgb, tmp_path / name)


def test_gallery_renders_stills_and_their_contact_sheet(rgb, tmp_path):
    line = run(
        "gallery.py",
        "nave",
        "shell",
        "--to",
        str(tmp_path),
        "--size",
        "32",
        "--spp",
        "1",
        "--no-denoise",
    )
    assert line == f"{tmp_path / 'contact-sheet.jpg'}: 2 stills"
    assert shows_something(rgb, tmp_path / "nave.jpg")[:2] == (18, 32)
    assert shows_something(rgb, tmp_path / "contact-sheet.jpg", 18, 32)[:2] == (18, 72)
