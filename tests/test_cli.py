import os
import re
import signal
import sys

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import cli, exr, scene_files, stills

SENSOR = """
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0.5, 0.5, 0.1" target="0.5, 0.5, 1" up="0, 1, 0"/>
        </transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="12"/>
            <integer name="height" value="8"/>
            <string name="component_format" value="$format"/>
        </film>
    </sensor>
"""
LAMP = """
    <shape type="sphere">
        <point name="center" x="0.5" y="0.5" z="0.7"/>
        <float name="radius" value="0.15"/>
        <emitter type="area"/>
    </shape>
"""
NIL = '<integrator type="nil"><float name="max_distance" value="1"/></integrator>'  # one lamp
DEFAULTS = '<default name="spp" value="4"/><default name="format" value="float16"/>'


def scene(*parts):
    return f'<scene version="3.0.0">{DEFAULTS}{"".join(parts)}</scene>'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a scene in it."""
    (tmp_path / "scene.xml").write_text(scene(NIL, SENSOR, LAMP))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def command(folder, monkeypatch, capfd):
    """Runs the command in `folder`: its status, what it printed and its complaints."""
    resolver, level, threads = mi.file_resolver(), mi.log_level(), dr.thread_count()

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["nil-mitsuba", *arguments])
        mi.set_file_resolver(resolver)
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        out, err = capfd.readouterr()
        return stopped.value.code or 0, out, err

    yield run
    mi.set_file_resolver(resolver)
    mi.set_log_level(level)
    dr.set_thread_count(threads)
    mi.set_variant("llvm_ad_rgb")


def read(path):
    """Header, pixel types and pixels of an EXR file; pixels as a Mitsuba tensor."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = dict(file.header())
        types = {name: str(channel.pixels.dtype) for name, channel in file.channels().items()}
    bitmap = mi.Bitmap(str(path))
    if bitmap.component_format() != mi.Struct.Type.Float32:
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32)
    return header, types, mi.TensorXf32(bitmap)


# ------------------------------------------------------------------- pictures


def test_the_file_holds_what_the_integrator_renders(command):
    status, out, err = command("render", "scene.xml", "-D", "format=float32", "--seed", "3")
    assert (status, out) == (0, "scene.exr\n"), err
    _, types, pixels = read("scene.exr")
    assert types == {"R": "float32", "G": "float32", "B": "float32"}
    image = mi.render(mi.load_file("scene.xml", format="float32"), seed=3)
    assert dr.allclose(pixels, image)
    assert dr.min(image.array)[0] < 0.1 and dr.max(image.array)[0] > 0.9


def test_a_film_of_half_floats_is_written_as_half_floats(command):
    assert command("render", "scene.xml", "-o", "half.exr")[0] == 0
    assert set(read("half.exr")[1].values()) == {"float16"}


def test_the_file_tells_how_it_was_made(command):
    command("render", "scene.xml", "--spp", "8", "--seed", "5", "-P", "twist=2")
    header = read("scene.exr")[0]
    assert (header["spp"], header["seed"], header["twist"]) == (8, 5, 2)
    assert (header["quotient"], header["tolerance"]) == ("true", 0.25)
    assert header["scene"] == "scene.xml"
    for name in ("nil_mitsuba 0", "Mitsuba 3", "Dr.Jit 1"):
        assert name in header["software"]
    assert header["commandLine"].endswith("--seed 5 -P twist=2")


def test_the_picture_lies_beside_its_scene(command, folder):
    (folder / "elsewhere").mkdir()
    (folder / "elsewhere" / "two.xml").write_text(scene(NIL, SENSOR, LAMP))
    assert command("render", "elsewhere/two.xml")[1] == "elsewhere/two.exr\n"
    assert (folder / "elsewhere" / "two.exr").exists()


def test_a_png_is_srgb(command, folder):
    sky = '<emitter type="constant"><float name="radiance" value="0.5"/></emitter>'
    (folder / "sky.xml").write_text(scene(NIL, SENSOR, sky))
    status, out, err = command("render", "sky.xml", "--png", "sky.png", "-P", "quotient=false")
    assert (status, out) == (0, "sky.exr\nsky.png\n"), err
    value = mi.TensorXu8(mi.Bitmap("sky.png"))[4, 6, 0].array[0]
    assert value in (187, 188)  # 255 (1.055 · 0.5^(1/2.4) − 0.055) = 187.5


def test_seeds_make_pictures_repeatable(command):
    pictures = []
    for seed in ("1", "1", "2"):
        command("render", "scene.xml", "--seed", seed)
        pictures.append(read("scene.exr")[2])
    assert dr.allclose(pictures[0], pictures[1])
    assert not dr.allclose(pictures[0], pictures[2])


def test_the_sensor_is_chosen_by_its_number(command, folder):
    wide = SENSOR.replace('value="12"', 'value="16"')
    (folder / "scene.xml").write_text(scene(NIL, SENSOR, wide, LAMP))
    command("render", "scene.xml", "-s", "1")
    assert read("scene.exr")[2].shape == (8, 16, 3)


def test_threads_and_other_variants(command, folder):
    mi.Bitmap(dr.full(mi.TensorXf, 1, (4, 8, 3))).write("sky.exr")
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    (folder / "scene.xml").write_text(scene(NIL, SENSOR, LAMP, sky))
    status, _, err = command("render", "scene.xml", "-t", "1", "-m", "llvm_ad_spectral")
    assert status == 0, err
    assert dr.thread_count() == 1 and mi.variant() == "llvm_ad_spectral"
    dr.set_thread_count(2)  # without a worker thread Mitsuba's reader never ends
    assert read("scene.exr")[0]["variant"] == "llvm_ad_spectral"


def test_no_progress_bar_where_no_one_watches(command):
    assert command("render", "scene.xml")[2] == ""


def test_help_and_version_are_no_errors(command):
    status, out, _ = command("render", "--help")
    assert status == 0 and "--fit" in out
    status, out, _ = command("--version")
    assert status == 0 and out.startswith("nil-mitsuba ")


# ------------------------------------------------------- layers and pictures


BOX = SENSOR.replace("</film>", '<rfilter type="box"/></film>').replace("$format", "float32")
BALL = """
    <shape type="sphere" id="ball">
        <point name="center" x="0.3" y="0.5" z="0.6"/><float name="radius" value="0.1"/>
        <bsdf type="diffuse"/>
    </shape>
    <bsdf type="diffuse" id="paper"/>
    <shape type="ply"><string name="filename" value="a.ply"/><ref id="paper"/></shape>
    <shape type="ply"><string name="filename" value="b.ply"/><ref id="paper"/></shape>
"""
TRIANGLE = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
{x} .1 .9
{x} .9 .9
.5 .5 .9
3 0 1 2
"""


@pytest.fixture
def meshes(folder):
    """A scene with two meshes, which Mitsuba would make one of."""
    (folder / "a.ply").write_text(TRIANGLE.format(x=0.05))
    (folder / "b.ply").write_text(TRIANGLE.format(x=0.95))
    (folder / "scene.xml").write_text(scene(NIL, BOX, LAMP, BALL))
    return folder


def planes(path):
    """The channels of a file by name, as lists of rows."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.tolist() for name, channel in file.channels().items()}


def assert_close(rows, others):
    """Other kernels round otherwise."""
    for row, expected in zip(rows, others):
        assert row == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_layers_are_in_the_file_and_shapes_have_the_numbers_of_the_scene(command, meshes):
    status, _, err = command("render", "scene.xml", "--spp", "8", "--layers",
                             "samples,shape, distance,position,normal,albedo,cell")
    assert (status, err) == (0, "")
    header, types, _ = read("scene.exr")
    vectors = [f"{layer}.{c}" for layer in ("cell", "normal", "position") for c in "XYZ"]
    assert set(types) == {"R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "depth.Z",
                          "samples.X", "shape.X", *vectors}
    found = planes("scene.exr")
    assert {value for row in found["samples.X"] for value in row} == {8}
    numbers = {value for row in found["shape.X"] for value in row}
    assert numbers == {-1, 0, 1, 2, 3}  # background, lamp, ball, two meshes
    assert header["layers"] == "distance,position,normal,albedo,cell,shape,samples"
    command("render", "scene.xml", "--spp", "8", "-o", "plain.exr")  # with merged meshes
    assert_close(found["R"], planes("plain.exr")["R"])


def test_denoising_keeps_the_noisy_picture(command, meshes):
    pytest.importorskip("mitsuba_oidn")
    status, _, err = command("render", "scene.xml", "--denoise", "--png", "a.png", "--spp", "8")
    assert (status, err) == (0, "")
    found = planes("scene.exr")
    assert set(found) == {"R", "G", "B", "noisy.R", "noisy.G", "noisy.B"}
    assert found["R"] != found["noisy.R"]
    command("render", "scene.xml", "--spp", "8", "-o", "plain.exr")
    assert_close(found["noisy.R"], planes("plain.exr")["R"])

    # A filter that spreads noise over pixels gives way.
    (meshes / "scene.xml").write_text(scene(NIL, SENSOR, LAMP, BALL))
    status, _, err = command("render", "scene.xml", "--denoise", "--layers", "normal")
    assert status == 0 and '"gaussian" is replaced by "box"' in err
    assert "normal.X" in planes("scene.exr") and "albedo.R" not in planes("scene.exr")


def test_exposure_and_a_filmic_curve_change_the_png_alone(command, folder):
    sky = '<emitter type="constant"><float name="radiance" value="0.5"/></emitter>'
    (folder / "sky.xml").write_text(scene(NIL, BOX, sky))
    plain = ("render", "sky.xml", "--png", "sky.png", "-P", "quotient=false")
    levels = []
    for options in ((), ("--exposure", "-1"), ("--filmic",), ("--exposure", "3")):
        assert command(*plain, *options)[0] == 0
        levels.append(mi.TensorXu8(mi.Bitmap("sky.png"))[4, 6, 0].array[0])
        assert planes("sky.exr")["R"][0][0] == 0.5
    assert levels[1] in (136, 137)  # 255 (1.055 · 0.25^(1/2.4) − 0.055) = 136.96
    assert levels[0] != levels[2] < 255 == levels[3]


def test_compression_is_chosen(command):
    assert command("render", "scene.xml", "--compression", "piz")[0] == 0
    assert "compression piz" in command("info", "scene.exr")[1]


def test_info_tells_how_to_render_it_again(command):
    command("render", "scene.xml", "--seed", "5", "--layers", "distance")
    first = planes("scene.exr")
    status, out, err = command("info", "scene.exr")
    assert (status, err) == (0, "")
    assert re.search(r"^  seed +5$", out, re.M) and re.search(r"^  sceneHash +\w{64}$", out, re.M)
    line = re.search(r"^  commandLine +nil-mitsuba (.*)$", out, re.M)[1]
    assert command(*line.split())[0] == 0
    assert planes("scene.exr") == first


def test_a_picture_tells_another_time_from_another_scene(command, folder):
    hashes = []
    for text in (scene(NIL, SENSOR, LAMP), scene(NIL, SENSOR, LAMP).replace("0.15", "0.16")):
        (folder / "scene.xml").write_text(text)
        command("render", "scene.xml", "--spp", "9")
        hashes.append(read("scene.exr")[0]["sceneHash"])
    assert hashes[0] != hashes[1]


# ------------------------------------------------------ checkpoints and parts


def test_a_still_is_rendered_for_a_time_or_down_to_a_noise(command, monkeypatch):
    monkeypatch.setattr(stills, "LOOK_SAMPLES", 12 * 8 * 4)
    assert command("render", "scene.xml", "--noise", "0.2")[0] == 0
    by_noise = read("scene.exr")[0]["spp"]
    assert by_noise >= 16 and by_noise % 4 == 0
    assert command("render", "scene.xml", "--time", "0.4s")[0] == 0
    header = read("scene.exr")[0]
    assert 0.4 <= header["renderTime"] < 20 and header["spp"] % 4 == 0
    assert command("render", "scene.xml", "--time", "1h", "--noise", "1e-9", "--spp", "8")[0] == 0
    assert read("scene.exr")[0]["spp"] == 8


@pytest.mark.parametrize(
    "text, seconds",
    [("90", 90), ("90s", 90), ("30m", 1800), ("1.5h", 5400), ("1h30m", 5400), ("2m5s", 125)],
)
def test_times_are_read(text, seconds):
    assert cli.Duration().convert(text, None, None) == seconds


def test_a_checkpoint_that_is_named_stays_and_more_samples_go_on_with_it(command, folder):
    for spp in ("8", "24"):
        status, out, err = command("render", "scene.xml", "--spp", spp, "--checkpoint", "a.sums",
                                   "--resume", "-q")
        assert (status, out, err) == (0, "", "")
    assert (folder / "a.sums").exists()
    header, _, pixels = read("scene.exr")
    assert (header["spp"], header["passes"]) == (24, "0:3 of 8 samples per pixel")
    assert "passes" in command("info", "a.sums")[1]

    status, _, err = command("render", "scene.xml", "--spp", "24", "--checkpoint", "a.sums")
    assert status == 1 and "--resume" in complaint(err)
    (folder / "scene.xml").write_text(scene(NIL, SENSOR, LAMP.replace("0.15", "0.2")))
    status, _, err = command("render", "scene.xml", "--checkpoint", "a.sums", "--resume")
    assert status == 1 and "has changed" in complaint(err)


def test_without_a_checkpoint_resuming_begins_anew_and_says_so(command, folder):
    status, out, err = command("render", "scene.xml", "--resume")
    assert (status, out) == (0, "scene.exr\n")
    assert err == 'there is no checkpoint "scene.sums": beginning with the first pass.\n'
    assert sorted(p.name for p in folder.iterdir()) == ["scene.exr", "scene.xml"]


def test_parts_merge_to_the_picture_of_one_run(command, folder, monkeypatch):
    from nil_mitsuba import passes

    monkeypatch.setattr(passes, "WAVEFRONT_SAMPLES", 12 * 8 * 4)
    render = ("render", "scene.xml", "--spp", "16", "-D", "format=float32")
    assert command(*render)[0] == 0
    whole = planes("scene.exr")
    for part in ("2:4", "0:1", "1:2"):
        name = f"scene.{part.replace(':', '-')}.sums"
        assert command(*render, "--passes", part)[:2] == (0, name + "\n")

    parts = ["scene.0-1.sums", "scene.2-4.sums"]
    status, out, err = command("merge", *parts, "-o", "merged.exr")
    assert (status, out) == (0, "merged.exr\n")
    assert err == "the passes 1:2 of 0:4 are missing.\n"
    status, out, err = command("merge", *parts, "scene.1-2.sums", "-o", "merged.exr", "--png",
                               "merged.png")
    assert (status, out, err) == (0, "merged.exr\nmerged.png\n", "")
    merged = planes("merged.exr")
    for name in "RGB":
        for row, expected in zip(merged[name], whole[name]):
            assert row == pytest.approx(expected, rel=1e-6)
    header, sound = read("merged.exr")[0], read("scene.exr")[0]
    for name in ("spp", "seed", "sceneHash", "integrator", "twist", "passes"):
        assert header[name] == sound[name]

    # In steps, too
    assert command("merge", *parts, "-o", "two.sums")[0] == 0
    assert command("merge", "scene.1-2.sums", "two.sums", "-o", "again.exr")[0] == 0
    assert planes("again.exr") == merged

    # Bad parts get a sentence, and the picture stays
    before = (folder / "merged.exr").read_bytes()
    command("render", "scene.xml", "--spp", "16", "--passes", "0:1", "--seed", "1", "-o", "b.sums")
    (folder / "c.sums").write_text("nothing")
    for names, fragments in (
        (["scene.0-1.sums", "two.sums"], ["passes 0:1", "twice"]),
        (["scene.2-4.sums", "b.sums"], ["seed is 0 there and 1 here"]),
        (["scene.2-4.sums", "c.sums"], ["c.sums", "no checkpoint"]),
        (["scene.2-4.sums", "d.sums"], ["d.sums", "No such file"]),
    ):
        status, _, err = command("merge", *names, "-o", "merged.exr")
        line = complaint(err)
        assert status == 1 and [f for f in fragments if f not in line] == []
    assert (folder / "merged.exr").read_bytes() == before


def test_merged_parts_can_be_denoised(command, meshes):
    pytest.importorskip("mitsuba_oidn")
    command("render", "scene.xml", "--spp", "8", "--passes", "0:1", "-o", "a.sums")
    status, _, err = command("merge", "a.sums", "-o", "a.exr", "--denoise")
    assert status == 1 and "--denoise needs the layers albedo and normal" in complaint(err)
    command("render", "scene.xml", "--spp", "8", "--passes", "0:1", "-o", "b.sums", "--layers",
            "albedo,normal")
    assert command("merge", "b.sums", "-o", "b.exr", "--denoise")[0] == 0
    assert "noisy.R" in planes("b.exr")


def test_a_checkpoint_that_cannot_be_written_is_told_once(command, folder, monkeypatch):
    def full(*_):
        raise OSError('cannot write "scene.sums": No space left on device.')

    monkeypatch.setattr(stills, "CHECKPOINT_SECONDS", 0)
    monkeypatch.setattr(stills, "LOOK_SAMPLES", 12 * 8)
    monkeypatch.setattr(stills.checkpoint, "save", full)
    status, out, err = command("render", "scene.xml", "--noise", "1e-9", "--spp", "4")
    assert (status, out) == (0, "scene.exr\n")
    assert len(err.splitlines()) == 1 and "No space left on device" in err


def test_a_bar_tells_samples_rate_time_and_noise_on_a_terminal(command, monkeypatch):
    import io

    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(stills, "LOOK_SAMPLES", 12 * 8 * 4)
    command("render", "scene.xml", "--noise", "1e-9", "--spp", "16")
    bar = terminal.getvalue()
    for fragment in ("16/16 samples per pixel", "M/s", "elapsed", "left", "noise 0."):
        assert fragment in bar
    terminal.truncate(0)
    command("render", "scene.xml", "--quiet")
    assert terminal.getvalue().strip("\0") == ""


# --------------------------------------------------------- scenes as they are


@pytest.mark.parametrize("integrator", ["path", "never_written"])
def test_another_integrator_is_replaced_before_it_is_built(command, folder, integrator):
    other = (
        f'<integrator type="{integrator}"><integer name="max_depth" value="3"/>'
        '<string name="of_its_own" value="x"/></integrator>'
    )
    (folder / "scene.xml").write_text(scene(other, SENSOR, LAMP))
    status, _, err = command("render", "scene.xml", "-P", "rr_depth=7")
    assert status == 0
    assert err == f'scene.xml: the integrator "{integrator}" is replaced by "nil".\n'
    header = read("scene.exr")[0]
    assert (header["max_depth"], header["rr_depth"]) == (3, 7)


def test_a_scene_without_integrator_is_rendered_with_nil(command, folder):
    (folder / "scene.xml").write_text(scene(SENSOR, LAMP))
    status, _, err = command("render", "scene.xml", "-P", "twist=0")
    assert (status, err) == (0, 'scene.xml has no integrator: rendering with "nil".\n')
    assert read("scene.exr")[0]["twist"] == 0


def test_wrappers_of_nil_stay_and_others_go(command, folder):
    moment = '<integrator type="moment"><integrator type="{}"/></integrator>'
    film = SENSOR.replace("$format", "float32")
    (folder / "nil.xml").write_text(scene(moment.format("nil"), film, LAMP))
    (folder / "path.xml").write_text(scene(moment.format("path"), film, LAMP))

    status, _, err = command("render", "nil.xml", "-P", "twist=2", "--png", "nil.png")
    assert (status, err) == (0, "")
    assert len(read("nil.exr")[1]) > 3

    status, _, err = command("render", "path.xml")
    assert (status, err) == (0, 'path.xml: the integrator "moment" is replaced by "nil".\n')
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
    status, _, err = command("render", "a/scene.xml", "-D", "mesh=parts/triangle.obj",
                             "-D", "spp=16")
    assert status == 0, err
    header, _, pixels = read("a/scene.exr")
    assert header["spp"] == 16
    assert dr.max(pixels.array)[0] > 0.5


def test_fit_puts_the_scene_into_the_cell(command, folder):
    lamp = LAMP.replace('x="0.5"', 'x="-7"')
    (folder / "scene.xml").write_text(scene(SENSOR, lamp))
    status, _, err = command("render", "scene.xml", "--fit")
    assert status == 0
    corner, size = re.search(r"cell_origin=(\S+) cell_size=(\S+)", err).groups()
    x, y, z = map(float, corner.split(","))
    size = float(size)
    assert size == pytest.approx(0.3 * (1 + 1e-3), rel=1e-6)
    assert (x + size / 2, y + size / 2, z + size / 2) == pytest.approx((-7, 0.5, 0.7), rel=1e-6)
    assert read("scene.exr")[0]["cell_origin"] == corner

    # What --fit prints can be typed in.
    status, _, _ = command("render", "scene.xml", "-P", f"cell_origin={corner}",
                           "-P", f"cell_size={size!r}")  # fmt: skip
    assert (status, read("scene.exr")[0]["cell_origin"]) == (0, corner)


@pytest.mark.parametrize(
    "text, value",
    [("3", 3), ("-2", -2), ("0.5", 0.5), ("1e-3", 1e-3), ("true", True), ("False", False),
     ("abc", "abc"), ("1,2", "1,2")],
)  # fmt: skip
def test_properties_have_the_type_they_look_like(rgb, text, value):
    parsed = scene_files.parse_value(text)
    assert parsed == value and type(parsed) is type(value)


def test_three_numbers_are_a_vector(rgb):
    assert list(scene_files.parse_value("-1,0.5,2")) == [-1, 0.5, 2]


# ------------------------------------------------------------------ bad input


BAD_MESH = '<shape type="obj"><string name="filename" value="missing.obj"/></shape>'
BAD_PLUGIN = '<shape type="spere"/>'
BAD_PROPERTY = '<shape type="sphere"><float name="raduis" value="1"/></shape>'

BAD_SCENES = {
    "broken XML": ("<scene version='3.0.0'><shape", ["bad.xml"]),
    "no version": ("<scene/>", ["version"]),
    "not a scene": ('<shape version="3.0.0" type="sphere"/>', ["<scene>"]),
    "missing mesh": (scene(NIL, SENSOR, BAD_MESH), ["bad.xml (line", "missing.obj"]),
    "unknown plugin": (scene(NIL, SENSOR, BAD_PLUGIN), ["bad.xml (line", '"spere" not found']),
    "unknown property": (scene(NIL, SENSOR, BAD_PROPERTY), ["bad.xml (line", '"raduis"']),
    "undefined constant": (scene(NIL, SENSOR, LAMP).replace("0.15", "$r"), ["$r"]),
    "no sensor": (scene(NIL, LAMP), ["no sensor"]),
    "two integrators": (scene(NIL, NIL, SENSOR, LAMP), ["only one integrator"]),
}

BAD_ARGUMENTS = {
    "missing scene": (["nowhere.xml"], 1, ['"nowhere.xml" does not exist']),
    "a folder": (["."], 1, ["is not a file"]),
    "no such sensor": (["scene.xml", "-s", "1"], 1, ["no sensor 1", "0 to 0"]),
    "unused constant": (["scene.xml", "-D", "foo=1"], 1, ["unused", "foo"]),
    "reserved constant": (["scene.xml", "-D", "filename=1"], 1, ["filename"]),
    "half a twist": (["scene.xml", "-P", "twist=0.5"], 1, ["twist", "integer", "quotient"]),
    "no tolerance": (["scene.xml", "-P", "tolerance=0"], 1, ["tolerance"]),
    "NaN": (["scene.xml", "-P", "cell_size=nan"], 1, ["cell_size"]),
    "infinity": (["scene.xml", "-P", "max_distance=inf"], 1, ["max_distance"]),
    "wrong type": (["scene.xml", "-P", "max_depth=1.5"], 1, ["max_depth", "integer"]),
    "wrong range": (["scene.xml", "-P", "max_depth=-2"], 1, ["max_depth"]),
    "unknown property": (["scene.xml", "-P", "twits=1"], 1, ["twits", "nil"]),
    "unknown variant": (["scene.xml", "-m", "llvm_rgb"], 1, ["llvm_rgb", "llvm_ad_rgb"]),
    "scalar variant": (["scene.xml", "-m", "scalar_rgb"], 1, ["scalar_rgb", '"llvm_ad_rgb"']),
    "polarized": (["scene.xml", "-m", "llvm_ad_mono_polarized"], 1, ['"llvm_ad_rgb"']),
    "no folder": (["scene.xml", "-o", "nowhere/a.exr"], 1, ["cannot write", "nowhere"]),
    "a file as folder": (["scene.xml", "-o", "scene.xml/a.exr"], 1, ["cannot write", "scene.xml"]),
    "a folder as file": (["scene.xml", "-o", "dir.exr"], 1, ["dir.exr", "folder"]),
    "not an EXR": (["scene.xml", "-o", "a.jpg"], 2, ["-o", ".exr"]),
    "not a PNG": (["scene.xml", "--png", "a.jpg"], 2, ["--png", ".png"]),
    "no samples": (["scene.xml", "--spp", "0"], 2, ["--spp"]),
    "negative seed": (["scene.xml", "--seed", "-1"], 2, ["--seed"]),
    "no value": (["scene.xml", "-P", "twist"], 2, ["key=value", "twist"]),
    "unknown option": (["scene.xml", "--sp", "3", "--foo"], 2, ["--"]),
    "no scene": ([], 2, ["SCENE.xml"]),
    "unknown layer": (["scene.xml", "--layers", "depth"], 1, ['"depth"', "distance"]),
    "unknown compression": (["scene.xml", "--compression", "jpg"], 2, ["--compression", "zip"]),
    "no time": (["scene.xml", "--time", "soon"], 2, ["--time", "30m"]),
    "no unit": (["scene.xml", "--time", "1h30"], 2, ["--time", "1h30m"]),
    "no time at all": (["scene.xml", "--time", "0s"], 2, ["--time", "30m"]),
    "no noise": (["scene.xml", "--noise", "0"], 2, ["--noise"]),
    "NaN noise": (["scene.xml", "--noise", "nan"], 2, ["noise"]),
    "NaN light": (["scene.xml", "--exposure", "nan"], 2, ["--exposure", "nan"]),
    "too much light": (["scene.xml", "--exposure", "1000"], 2, ["--exposure"]),
    "not a checkpoint": (["scene.xml", "--checkpoint", "a.exr"], 2, ["--checkpoint", ".sums"]),
    "no folder for it": (["scene.xml", "--checkpoint", "no/a.sums"], 1, ["cannot write", "no"]),
    "no passes": (["scene.xml", "--passes", "3:3"], 2, ["--passes", "a < b"]),
    "passes of another kind": (["scene.xml", "--passes", "3"], 2, ["--passes", "a:b"]),
    "too many passes": (["scene.xml", "--passes", "0:2"], 1, ["0:1", "4 samples"]),
    "a part as picture": (["scene.xml", "--passes", "0:1", "-o", "a.exr"], 2, [".sums"]),
    "a part of a time": (["scene.xml", "--passes", "0:1", "--time", "3s"], 2, ["--time"]),
}


def complaint(err):
    """The one line of complaint; what was said before it is a note on the integrator."""
    lines = err.splitlines()
    assert lines[-1].startswith("nil-mitsuba: ") and "Traceback" not in err
    assert not [line for line in lines[:-1] if line and '"nil"' not in line]
    assert not re.search(r"\.cpp|\.py", lines[-1])
    return lines[-1]


@pytest.fixture
def rendering_is_an_error(monkeypatch):
    def render(*_):
        raise AssertionError("rendering began")

    monkeypatch.setattr(stills.Still, "accumulate", render)
    monkeypatch.setattr(cli, "_render_in_one_go", render)


@pytest.mark.parametrize("name", BAD_SCENES)
def test_a_bad_scene_gets_one_sentence_before_rendering(
    command, folder, rendering_is_an_error, name
):
    text, fragments = BAD_SCENES[name]
    (folder / "bad.xml").write_text(text)
    (folder / "bad.exr").write_text("an earlier picture")
    status, out, err = command("render", "bad.xml")
    assert (status, out) == (1, "")
    line = complaint(err)
    assert [fragment for fragment in fragments if fragment not in line] == []
    assert (folder / "bad.exr").read_text() == "an earlier picture"
    assert sorted(p.name for p in folder.iterdir()) == ["bad.exr", "bad.xml", "scene.xml"]


@pytest.mark.parametrize("name", BAD_ARGUMENTS)
def test_bad_arguments_get_one_sentence_before_rendering(
    command, folder, rendering_is_an_error, name
):
    arguments, expected, fragments = BAD_ARGUMENTS[name]
    (folder / "dir.exr").mkdir()
    (folder / "scene.exr").write_text("an earlier picture")
    status, out, err = command("render", *arguments)
    assert (status, out) == (expected, "")
    line = complaint(err)
    assert [fragment for fragment in fragments if fragment not in line] == []
    assert (folder / "scene.exr").read_text() == "an earlier picture"
    assert sorted(p.name for p in folder.iterdir()) == ["dir.exr", "scene.exr", "scene.xml"]


@pytest.mark.parametrize("option", ["--noise=1", "--time=1s", "--resume", "--checkpoint=a.sums",
                                    "--passes=0:1", "--pass-spp=1", "--layers=cell"])  # fmt: skip
def test_what_needs_passes_is_refused_for_wrappers(command, folder, option):
    moment = '<integrator type="moment"><integrator type="nil"/></integrator>'
    (folder / "scene.xml").write_text(scene(moment, SENSOR, LAMP))
    status, _, err = command("render", "scene.xml", option)
    assert status == 1 and option.partition("=")[0] in complaint(err)
    assert [p.name for p in folder.iterdir()] == ["scene.xml"]


@pytest.mark.parametrize(
    "arguments, expected, fragments",
    [(["info", "a.exr"], 1, ["a.exr"]), (["info", "scene.xml"], 1, ["scene.xml"]),
     (["info", "a.sums"], 1, ["a.sums", "No such file"]), (["merge", "-o", "a.exr"], 2, ["PARTS"]),
     (["merge", "scene.xml"], 2, ["-o"]),
     (["merge", "scene.xml", "-o", "a.exr"], 1, ["scene.xml", "no checkpoint"])],
)  # fmt: skip
def test_files_that_are_not_there_or_something_else(command, arguments, expected, fragments):
    status, out, err = command(*arguments)
    line = complaint(err)
    assert (status, out) == (expected, "")
    assert [fragment for fragment in fragments if fragment not in line] == []


def test_fit_needs_something_to_fit(command, folder):
    (folder / "scene.xml").write_text(scene(NIL, SENSOR))
    status, _, err = command("render", "scene.xml", "--fit")
    assert status == 1 and "--fit needs a scene" in complaint(err)


def test_a_failed_write_leaves_the_earlier_pictures(command, folder, monkeypatch):
    for name in ("scene.exr", "scene.png"):
        (folder / name).write_text("an earlier picture")

    def full(path, _):
        open(path, "w").write("half a pict")
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(exr, "_write", full)
        status, _, err = command("render", "scene.xml", "--png", "scene.png")
    assert status == 1 and "No space left on device" in complaint(err)
    assert '"scene.sums"' in err and "--resume" in err
    names = ["scene.exr", "scene.png", "scene.sums", "scene.xml"]
    assert sorted(p.name for p in folder.iterdir()) == names
    for name in ("scene.exr", "scene.png"):
        assert (folder / name).read_text() == "an earlier picture"

    # Nothing is rendered again.
    monkeypatch.setattr(stills.Still, "render", None)
    assert command("render", "scene.xml", "--resume")[:2] == (0, "scene.exr\n")
    assert read("scene.exr")[0]["spp"] == 4


def test_a_second_interruption_does_not_wait(command, folder, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(stills.Still, "render", interrupted)
    status, _, err = command("render", "scene.xml")
    assert status == 130 and "interrupted" in complaint(err)
    assert [p.name for p in folder.iterdir()] == ["scene.xml"]


def test_a_traceback_is_there_for_those_who_ask(folder, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["nil-mitsuba", "render", "scene.xml", "-P", "a=1", "-vv"])
    level = mi.log_level()
    with pytest.raises(RuntimeError):
        cli.main()
    mi.set_log_level(level)


def test_mitsubas_messages_become_one_line():
    nested = (
        '[parser.cpp:1718] At my scene.xml (line 4, col 4): failed to instantiate integrator '
        'plugin of type "nil": Traceback (most recent call last):\n'
        '  File "/x/registration.py", line 66, in construct\n'
        "    return f(props)\n           ^^^^^^^^\n"
        "  File \"/x/integrator.py\", line 5, in __init__\n"
        'RuntimeError: "twist" = 0.5 does not glue'
    )
    assert cli.tidy(nested) == (
        'my scene.xml (line 4, col 4): failed to instantiate integrator plugin of type "nil": '
        '"twist" = 0.5 does not glue'
    )
    listed = "[parser.cpp:111] Found unused parameters:\n  - $a=1\n  - $b=2"
    assert cli.tidy(listed) == "Found unused parameters: $a=1 $b=2"


# ------------------------------------------------------- nothing rendered is lost


def test_whatever_ends_the_writing_the_samples_are_kept(command, folder, monkeypatch):
    def impossible(*_):
        raise TypeError("a string was expected")

    with monkeypatch.context() as patch:
        patch.setattr(exr, "_write", impossible)
        status, _, err = command("render", "scene.xml")
    assert status == 1 and "a string was expected" in complaint(err)
    assert '"scene.sums"' in err and "--resume" in err
    monkeypatch.setattr(stills.Still, "render", None)
    assert command("render", "scene.xml", "--resume")[:2] == (0, "scene.exr\n")
    assert sorted(p.name for p in folder.iterdir()) == ["scene.exr", "scene.xml"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_picture_is_written_loses_no_samples(
    command, folder, monkeypatch, number
):
    with monkeypatch.context() as patch:
        patch.setattr(exr, "_write", lambda *_: os.kill(os.getpid(), number))
        status, out, err = command("render", "scene.xml")
    assert (status, out) == (128 + number, "") and '"scene.sums"' in complaint(err)
    assert sorted(p.name for p in folder.iterdir()) == ["scene.sums", "scene.xml"]
    monkeypatch.setattr(stills.Still, "render", None)
    assert command("render", "scene.xml", "--resume")[:2] == (0, "scene.exr\n")


@pytest.mark.parametrize("name", [250 * "a" + ".exr", 62 * "\N{GREEK SMALL LETTER ALPHA}" + ".exr"])
def test_names_may_be_as_long_as_the_file_system_allows(command, folder, name):
    assert command("render", "scene.xml", "-q", "-o", name, "--checkpoint", "a.sums")[0] == 0
    assert (folder / name).is_file()


@pytest.mark.parametrize(
    "name, fragment",
    [(300 * "a" + ".exr", "too long"), (251 * "a" + ".exr", "too long"),  # of its .sums
     ("caf\udce9.exr", "UTF-8"), ("pipe.exr", "not an ordinary file"),
     ("link.exr", "cannot write to the folder")],
)  # fmt: skip
def test_names_that_cannot_be_written_are_refused_before_rendering(
    command, folder, rendering_is_an_error, name, fragment
):
    os.mkfifo(folder / "pipe.exr")
    (folder / "link.exr").symlink_to(folder / "nowhere" / "a.exr")
    status, _, err = command("render", "scene.xml", "-o", name)
    assert status == 1 and fragment in complaint(err)


def test_a_tiny_noise_and_a_tiny_time_are_rules_as_others(command, monkeypatch):
    monkeypatch.setattr(cli._Bar, "FORM", "{postfix}")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    status, _, err = command("render", "scene.xml", "--noise", "1e-200", "--spp", "8")
    assert status == 0, err
    status, _, err = command("render", "scene.xml", "--time", ".000001")
    assert (status, err.count("nil-mitsuba:")) == (0, 0), err
    assert read("scene.exr")[0]["spp"] >= 1


SPECIAL = SENSOR.replace("hdrfilm", "specfilm").replace(
    '<string name="component_format" value="$format"/>',
    '<spectrum name="low" value="450:1, 500:1"/><spectrum name="high" value="500:1, 600:1"/>',
)


def test_a_film_with_channels_of_its_own_is_written(command, folder):
    (folder / "scene.xml").write_text(scene(NIL, SPECIAL, LAMP))
    spectral = ("render", "scene.xml", "-m", "llvm_ad_spectral")
    status, out, err = command(*spectral, "--layers", "shape")
    assert (status, out) == (0, "scene.exr\n"), err
    assert len(planes("scene.exr")) == 3
    for options in (["--png", "a.png"], ["--passes", "0:1"]):
        status, _, err = command(*spectral, *options)
        assert status == 1 and "pecFilm" in complaint(err)
    assert sorted(p.name for p in folder.iterdir()) == ["scene.exr", "scene.xml"]


# --------------------------------------------------------------- rendered again


def test_a_part_goes_on_with_other_passes(command, monkeypatch):
    from nil_mitsuba import checkpoint, passes

    monkeypatch.setattr(passes, "WAVEFRONT_SAMPLES", 12 * 8 * 4)
    part = ("render", "scene.xml", "--spp", "16", "-o", "p.sums", "--passes")
    assert command(*part, "0:1")[:2] == (0, "p.sums\n")
    assert command(*part, "2:4", "--resume")[:2] == (0, "p.sums\n")
    assert checkpoint.load("p.sums").sums.passes == ((0, 1), (2, 4))
    assert command(*part, "0:4", "--resume")[0] == 0
    assert checkpoint.load("p.sums").sums.passes == ((0, 4),)


def test_a_merged_picture_tells_all_that_it_took(command, folder, monkeypatch):
    from nil_mitsuba import passes

    monkeypatch.setattr(passes, "WAVEFRONT_SAMPLES", 12 * 8 * 4)
    for part in ("0:1", "1:2"):
        command("render", "scene.xml", "--spp", "8", "-D", "format=float32", "--passes", part)
    command("merge", "scene.0-1.sums", "scene.1-2.sums", "-o", "scene.exr")
    before, lines = planes("scene.exr"), read("scene.exr")[0]["commandLine"].splitlines()
    assert len(lines) == 3 and all("-D format=float32" in line for line in lines[:2])
    for name in ("scene.0-1.sums", "scene.1-2.sums", "scene.exr"):
        (folder / name).unlink()
    for line in lines:
        assert command(*line.split()[1:])[0] == 0
    assert planes("scene.exr") == before


def test_merging_overwrites_no_samples_but_those_of_its_parts(command, folder):
    command("render", "scene.xml", "--passes", "0:1", "-o", "a.sums")
    command("render", "scene.xml", "--passes", "0:1", "-o", "b.sums", "--seed", "1")
    contents = (folder / "b.sums").read_bytes()
    status, _, err = command("merge", "a.sums", "-o", "b.sums")
    assert status == 1 and '"b.sums" holds samples' in complaint(err)
    assert (folder / "b.sums").read_bytes() == contents
    assert command("merge", "a.sums", "-o", "a.sums")[0] == 0


def test_the_size_of_passes_renders_a_picture_again(command, monkeypatch):
    monkeypatch.setattr(stills, "LOOK_SAMPLES", 12 * 8 * 2)
    floats = ("render", "scene.xml", "-D", "format=float32")
    command(*floats, "--noise", "1e-9", "--spp", "8")
    timed, header = planes("scene.exr"), read("scene.exr")[0]
    assert header["passes"] == "0:4 of 2 samples per pixel"
    command(*floats, "--spp", "8")
    assert planes("scene.exr") != timed
    command(*floats, "--spp", "8", "--pass-spp", "2")
    assert planes("scene.exr") == timed


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
