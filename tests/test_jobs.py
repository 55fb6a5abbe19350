"""Jobs: every process that opens one gets the same scene, or a sentence."""

import pathlib
import re
from dataclasses import replace
from functools import reduce

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import checkpoint, jobs, registration, stills
from nil_mitsuba.layers import LAYERS, RENDERED
from small_stills import TRIANGLE, equal, sums_of

PACKAGE = pathlib.Path(jobs.__file__).parent

SCENE = """
<scene version="3.0.0">
    <integrator type="nil"/>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0.1, 0.1, 0.6" target="0.7, 1, 0.4" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="8"/><integer name="height" value="8"/>
        </film>
    </sensor>
    <emitter type="constant"/>
    <shape type="obj"><string name="filename" value="triangle.obj"/></shape>
</scene>
"""


@pytest.fixture
def job(tmp_path, rgb):
    """A job whose cell is fitted and whose picture is to be denoised."""
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "triangle.obj").write_text(TRIANGLE)
    return jobs.Job(
        str(tmp_path / "scene.xml"),
        spp=8,
        pass_spp=4,
        seed=3,
        fit="shapes",
        denoise=True,
        properties={"aovs": "distance", "twist": "2"},
    )


def test_a_cell_is_fitted_for_what_a_wrapper_holds(job):
    """Plain Nil within another integrator is fitted as plain Nil."""
    path = pathlib.Path(job.path)
    nil = '<integrator type="nil"><boolean name="quotient" value="false"/></integrator>'
    cells = []
    for integrator in (nil, f'<integrator type="moment">{nil}</integrator>'):
        path.write_text(SCENE.replace('<integrator type="nil"/>', integrator))
        notes = []
        opened = jobs.open_scene(replace(job, denoise=False, properties={}), notes.append)
        assert not opened.nil.quotient and not any("carried" in sentence for sentence in notes)
        cells.append(opened.job.properties["cell_origin"])
    assert cells[0] == cells[1]


def test_a_cell_is_not_fitted_and_given(job):
    with pytest.raises(ValueError, match="-P gives cell_size: give one of the two"):
        jobs.open_scene(replace(job, properties={"cell_size": "3"}))


def test_what_a_job_opens_to_is_what_its_workers_open(job):
    opened = jobs.open_scene(job)
    here = opened.still(stills.Rules(spp=8))
    assert not opened.job.fit and opened.job.scene_hash
    assert jobs.open_still(opened.job).settings == here.settings
    assert here.settings["integrator"]["cell_size"] == pytest.approx(0.8 * (1 + 1e-3), rel=1e-6)
    assert here.settings["layers"] == ["distance", "normal", "albedo"]
    assert here.settings["film"]["filter"].startswith("BoxFilter")
    assert opened.layers == ("distance",)


def test_a_scene_that_has_changed_is_not_opened(job, tmp_path):
    opened = jobs.open_scene(job)
    (tmp_path / "triangle.obj").write_text(TRIANGLE.replace(".9", ".8"))
    with pytest.raises(ValueError, match="differs from the one expected"):
        jobs.open_scene(opened.job)


def test_a_scene_without_its_files_does_not_find_those_of_an_earlier_one(job, tmp_path):
    jobs.open_scene(job)
    other = tmp_path / "other"
    other.mkdir()
    (other / "scene.xml").write_text(SCENE)
    with pytest.raises(RuntimeError, match="triangle.obj"):
        jobs.open_scene(replace(job, path=str(other / "scene.xml")))


def test_opening_leaves_threads_and_folders_as_they_were(job):
    resolver, threads = mi.file_resolver(), dr.thread_count()
    dr.set_thread_count(1)
    try:
        jobs.open_scene(job)
        assert dr.thread_count() == 1
    finally:
        dr.set_thread_count(threads)
    assert list(map(str, mi.file_resolver())) == list(map(str, resolver))


def test_a_sensor_that_is_not_there_is_refused(job):
    with pytest.raises(ValueError, match=r"no sensor 2: its sensors are numbered from 0 to 0"):
        jobs.open_scene(replace(job, sensor=2))


def test_an_image_holds_layers_in_the_order_of_their_rules():
    rules = [LAYERS[layer].rule for layer in RENDERED]
    assert rules == sorted(rules, key=["mean", "first", "count"].index)


def test_rendering_needs_no_file_format():
    needed, new = set(), {name.partition(".")[2] for name in registration.VARIANT_MODULES}
    while new:
        needed |= new
        text = "".join((PACKAGE / f"{name}.py").read_text() for name in new)
        imports = re.findall(r"^ *from \.(\w+) import|^ *from \. import (.+)$", text, re.M)
        new = {name for one, several in imports for name in (one or several).split(", ")} - needed
    assert {"integrator", "sums", "layers"} <= needed
    assert not needed & {"exr", "png", "checkpoint", "stills", "scene_files"}


def test_parts_of_processes_of_their_own_merge_to_the_whole(still_folder):
    job = jobs.Job(str(still_folder / "scene.xml"), spp=64, pass_spp=16, seed=7)
    still = jobs.open_still(job)
    job = jobs.Job(job.path, spp=64, pass_spp=16, seed=7, scene_hash=still.settings["scene"])
    parts = [jobs.render_part(job, first, stop) for first, stop in ((2, 4), (0, 1), (1, 2))]
    states = [checkpoint.Checkpoint.from_bytes(part) for part in parts]
    merged = reduce(checkpoint.Checkpoint.plus, states)
    assert merged.sums.passes == ((0, 4),)
    merged.require(still.settings)
    assert dr.allclose(still.develop(merged), still.develop(sums_of(still, 0, 1, 2, 3)), rtol=1e-6)
    # Without the scene, too
    assert equal(stills.picture_of(merged).image, still.develop(merged))

    with pytest.raises(ValueError, match="passes 0:1 are there twice"):
        merged.plus(states[1])
    (still_folder / "triangle.obj").write_text(TRIANGLE.replace(".9", ".8"))
    jobs._opened.clear()
    with pytest.raises(ValueError, match="differs"):
        jobs.render_part(job, 0, 1)
