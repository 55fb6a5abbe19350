"""The command: its options, its complaints, its progress."""

import os
import sys

import drjit as dr
import mitsuba as mi
import pytest

from command_line import LAMP, NIL, SENSOR, complaint, read, scene
from nil_mitsuba import cli, stills


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


def test_help_and_version_are_no_errors(command):
    status, out, _ = command("render", "--help")
    assert status == 0 and "--fit" in out
    status, out, _ = command("--version")
    assert status == 0 and out.startswith("nil-mitsuba ")


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


@pytest.mark.parametrize(
    "option",
    [
        "--noise=1",
        "--time=1s",
        "--resume",
        "--checkpoint=a.sums",
        "--passes=0:1",
        "--pass-spp=1",
        "--layers=cell",
    ],
)
def test_what_needs_passes_is_refused_for_wrappers(command, folder, option):
    moment = '<integrator type="moment"><integrator type="nil"/></integrator>'
    (folder / "scene.xml").write_text(scene(moment, SENSOR, LAMP))
    status, _, err = command("render", "scene.xml", option)
    assert status == 1 and option.partition("=")[0] in complaint(err)
    assert [p.name for p in folder.iterdir()] == ["scene.xml"]


@pytest.mark.parametrize(
    "arguments, expected, fragments",
    [
        (["info", "a.exr"], 1, ["a.exr"]),
        (["info", "scene.xml"], 1, ["scene.xml"]),
        (["info", "a.sums"], 1, ["a.sums", "No such file"]),
        (["merge", "-o", "a.exr"], 2, ["PARTS"]),
        (["merge", "scene.xml"], 2, ["-o"]),
        (["merge", "scene.xml", "-o", "a.exr"], 1, ["scene.xml", "no checkpoint"]),
    ],
)
def test_files_that_are_not_there_or_something_else(command, arguments, expected, fragments):
    status, out, err = command(*arguments)
    line = complaint(err)
    assert (status, out) == (expected, "")
    assert [fragment for fragment in fragments if fragment not in line] == []


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
        "[parser.cpp:1718] At my scene.xml (line 4, col 4): failed to instantiate integrator "
        'plugin of type "nil": Traceback (most recent call last):\n'
        '  File "/x/registration.py", line 66, in construct\n'
        "    return f(props)\n           ^^^^^^^^\n"
        '  File "/x/integrator.py", line 5, in __init__\n'
        'RuntimeError: "twist" = 0.5 does not glue'
    )
    assert cli.tidy(nested) == (
        'my scene.xml (line 4, col 4): failed to instantiate integrator plugin of type "nil": '
        '"twist" = 0.5 does not glue'
    )
    listed = "[parser.cpp:111] Found unused parameters:\n  - $a=1\n  - $b=2"
    assert cli.tidy(listed) == "Found unused parameters: $a=1 $b=2"


@pytest.mark.parametrize("name", [250 * "a" + ".exr", 62 * "\N{GREEK SMALL LETTER ALPHA}" + ".exr"])
def test_names_may_be_as_long_as_the_file_system_allows(command, folder, name):
    assert command("render", "scene.xml", "-q", "-o", name, "--checkpoint", "a.sums")[0] == 0
    assert (folder / name).is_file()


@pytest.mark.parametrize(
    "name, fragment",
    [
        (300 * "a" + ".exr", "too long"),
        (251 * "a" + ".exr", "too long"),  # of its .sums
        ("caf\udce9.exr", "UTF-8"),
        ("pipe.exr", "not an ordinary file"),
        ("link.exr", "cannot write to the folder"),
    ],
)
def test_names_that_cannot_be_written_are_refused_before_rendering(
    command, folder, rendering_is_an_error, name, fragment
):
    os.mkfifo(folder / "pipe.exr")
    (folder / "link.exr").symlink_to(folder / "nowhere" / "a.exr")
    status, _, err = command("render", "scene.xml", "-o", name)
    assert status == 1 and fragment in complaint(err)


def test_a_tiny_noise_and_a_tiny_time_are_rules_as_others(command, monkeypatch):
    monkeypatch.setattr(cli._Display, "FORM", "{desc}")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    status, _, err = command("render", "scene.xml", "--noise", "1e-200", "--spp", "8")
    assert status == 0, err
    status, _, err = command("render", "scene.xml", "--time", ".000001")
    assert (status, err.count("nil-mitsuba:")) == (0, 0), err
    assert read("scene.exr")[0]["spp"] >= 1
