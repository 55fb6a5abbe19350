import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import re

import drjit as dr
import pytest

from conftest import ROOT

SCENES = sorted(path.stem for path in (ROOT / "scenes").glob("*.xml"))
QUICK = ("showcase", "nave")  # of whom the twist is tried each time
SMALL = {"resx": "40", "resy": "30", "spp": "8"}


def load(mi, name, **parameters):
    return mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), **(SMALL | parameters))


def test_there_are_at_least_five_scenes():
    assert len(SCENES) >= 5


@pytest.mark.parametrize("name", SCENES)
def test_scene_is_a_picture_with_light_and_shade(rgb, name):
    scene = load(rgb, name)
    assert type(scene.integrator()).__name__ == "NilIntegrator"
    image = rgb.render(scene)
    assert image.shape == (30, 40, 3)
    assert dr.all(dr.isfinite(image), axis=None)
    luminance = rgb.luminance(dr.unravel(rgb.Color3f, image.array))
    assert dr.mean(luminance)[0] > 0.05
    assert dr.max(luminance)[0] > 1.5 * dr.min(luminance)[0]


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.verify) for name in SCENES],
)
def test_twist_changes_what_is_seen(rgb, name):
    # In air a pixel of few samples is noise
    spp = "8" if name in QUICK else "256"

    def render(twist, seed):
        # As it is shown, where single samples do not outshine all others
        return dr.minimum(rgb.render(load(rgb, name, twist=twist, spp=spp), seed=seed), 1)

    def difference(a, b):
        return dr.mean(dr.abs(a - b), axis=None).array[0]

    bent = render("1", 0)
    noise = difference(bent, render("1", 1))
    assert difference(bent, render("0", 1)) > 1.5 * noise  # it is more than twice the noise


@pytest.mark.parametrize("name", SCENES)
def test_shapes_of_a_quotient_lie_inside_its_cube(rgb, name):
    scene = load(rgb, name)
    integrator = scene.integrator()
    if not integrator.quotient:
        pytest.skip("plain Nil has no cube")
    for shape in scene.shapes():
        box = shape.bbox()
        for i in range(3):
            lower = integrator.cell_origin[i]
            assert lower < box.min[i] <= box.max[i] < lower + integrator.cell_size, shape.id()


@pytest.mark.parametrize("name", SCENES)
def test_scene_says_in_a_few_lines_what_one_sees(name):
    text = (ROOT / "scenes" / f"{name}.xml").read_text(encoding="utf-8")
    comment = re.search(r"<scene[^>]*>\s*<!--(.*?)-->", text, re.DOTALL)
    assert comment and 3 <= len(comment[1].strip().splitlines()) <= 6


def test_one_scene_has_a_mesh_of_more_than_50_000_triangles(rgb):
    shapes = load(rgb, "knot").shapes()
    assert max(shape.face_count() for shape in shapes if shape.is_mesh()) > 50_000
