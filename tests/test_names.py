"""How sentences name what has no name of its own."""

import mitsuba as mi

from nil_mitsuba.shapes import name_of

TRIANGLE = "v 0.1 0.1 .9\nv 0.9 0.1 .9\nv 0.1 0.9 1.9\nf 1 3 2\n"


def shapes(folder, text, **options):
    for name in ("one.obj", "two.obj"):
        (folder / name).write_text(TRIANGLE)
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{text}</scene>')
    return mi.load_file(str(folder / "scene.xml"), **options).shapes()


def obj(file, more=""):
    return f'<shape type="obj" {more}><string name="filename" value="{file}"/><ref id="b"/></shape>'


def test_a_shape_is_named_by_its_id_or_by_type_file_and_place(rgb, tmp_path):
    found = shapes(
        tmp_path,
        '<bsdf type="diffuse" id="b"/>'
        + obj("one.obj")
        + obj("one.obj", 'id="mine"')
        + '<shape type="sphere"><point name="center" x="1" y="2" z="-.5"/></shape>'
        '<shape type="cube"/>',
        optimize=False,
    )
    assert sorted(map(name_of, found)) == sorted(
        [
            'OBJMesh "one.obj" at (0.5, 0.5, 1.4)',
            '"mine"',
            "Sphere at (1, 2, -0.5)",
            "Cube at (0, 0, 0)",
        ]
    )


def test_a_merged_mesh_is_named_by_the_files_it_came_from(rgb, tmp_path):
    (merged,) = shapes(tmp_path, '<bsdf type="diffuse" id="b"/>' + obj("one.obj") + obj("two.obj"))
    assert name_of(merged) == 'Mesh "one.obj + two.obj" at (0.5, 0.5, 1.4)'


def test_a_mesh_of_many_files_has_a_name_that_one_can_read(rgb, tmp_path):
    text = '<bsdf type="diffuse" id="b"/>' + 40 * obj("one.obj")
    (merged,) = shapes(tmp_path, text)
    assert len(name_of(merged)) < 100 and name_of(merged).startswith('Mesh "one.obj + one.obj')


def test_a_warning_names_a_shape_without_an_id(rgb, tmp_path, capfd):
    place = "0.5, 0.5, 3"
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><integrator type="nil"/><sensor type="perspective">'
        '<film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/>'
        '</film></sensor><emitter type="constant"/>'
        f'<shape type="sphere"><point name="center" value="{place}"/>'
        '<float name="radius" value="0.1"/></shape></scene>'
    )
    mi.render(mi.load_file(str(tmp_path / "scene.xml")), spp=1)
    out, err = capfd.readouterr()
    assert f"shape Sphere at ({place}) " in out + err
