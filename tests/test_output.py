"""Pictures of the command: what they hold and tell, and that no failure to write loses any."""

import os
import re
import signal

import drjit as dr
import mitsuba as mi
import pytest

from command_line import (
    BALL,
    BOX,
    LAMP,
    NIL,
    SENSOR,
    assert_close,
    complaint,
    planes,
    read,
    remarks,
    scene,
)
from nil_mitsuba import exr, stills


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


def test_layers_are_in_the_file_and_shapes_have_the_numbers_of_the_scene(command, meshes):
    status, _, err = command(
        "render",
        "scene.xml",
        "--spp",
        "8",
        "--layers",
        "samples,shape, distance,position,normal,albedo,cell",
    )
    assert (status, remarks(err)) == (0, "")
    header, types, _ = read("scene.exr")
    vectors = [f"{layer}.{c}" for layer in ("cell", "normal", "position") for c in "XYZ"]
    assert set(types) == {
        "R",
        "G",
        "B",
        "albedo.R",
        "albedo.G",
        "albedo.B",
        "depth.Z",
        "samples.X",
        "shape.X",
        *vectors,
    }
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
    assert (status, remarks(err)) == (0, "")
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


def test_info_tells_how_to_render_it_again(command, repeatable):
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
