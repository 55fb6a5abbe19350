"""Frames of a flight: what they show, what is kept of them, and what is refused."""

import json
import os
import re
import signal
import sys
import threading
import unittest.mock

import drjit as dr
import mitsuba as mi
import pytest

import nil_mitsuba
from command_line import BALL, BOX, LAMP, NIL, SENSOR, complaint, planes, read, scene
from nil_mitsuba import cli, frames, jobs, keys, stills
from nil_mitsuba.keys import Key
from nil_mitsuba.output import Output, metadata_of
from small_stills import equal

THIN = BOX.replace("perspective", "thinlens").replace(
    "<film",
    '<float name="aperture_radius" value="0.02"/><float name="focus_distance" value="0.5"/><film',
)
ROOM = LAMP + BALL.partition('<bsdf type="diffuse" id')[0] + '<emitter type="constant"/>'
FLY = ("fly", "scene.xml", "--keys", "cameras.json", "--spp", "4", "-o", "film")


def matrix(origin, target):
    transform = mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0]).matrix
    return [transform[i, j] for i in range(4) for j in range(4)]


def start():
    return Key(matrix([0.5, 0.5, 0.1], [0.5, 0.5, 1]))


def end(**more):
    return Key(matrix([0.7, 0.4, 0.2], [0.3, 0.5, 0.9]), (0, 0, 1), more)


@pytest.fixture
def film(folder, rgb):
    """A folder with a scene and a flight by two keys."""
    (folder / "scene.xml").write_text(scene(NIL, BOX, ROOM))
    keys.save("cameras.json", [start(), end()])
    return folder


def names(folder="film"):
    return sorted(os.listdir(folder))


# -------------------------------------------------------------------------- frames


def test_a_frame_is_the_still_of_a_sensor_that_stands_there(command, film):
    status, out, err = command(*FLY, "--frames", "3", "--seed", "5")
    assert (status, out) == (0, "".join(f"film/000{i}.exr\n" for i in range(3)))
    assert re.search(
        r"^a flight of [\d.]+ cells\.\n3 frames; the noisiest: 4 samples per", err, re.M
    )
    header, _, pixels = read("film/0001.exr")
    assert (header["frame"], header["frames"], header["seed"]) == (1, 3, 6)
    numbers = json.loads(header["toWorld"])
    lookat = '<transform name="to_world"><matrix value="' + " ".join(map(str, numbers)) + '"/>'
    moved = re.sub(r'<transform name="to_world">\s*<lookat[^>]*>', lookat, scene(NIL, BOX, ROOM))
    there = mi.load_string(moved, spp=4)
    assert dr.allclose(pixels, nil_mitsuba.render(there, seed=6), rtol=1e-5, atol=1e-6)


def test_all_frames_have_noise_of_their_own(command, film):
    keys.save("cameras.json", [start(), start()])
    assert command(*FLY, "--frames", "3")[0] == 0
    pictures = [read(f"film/{name}")[2] for name in names()]
    for i, picture in enumerate(pictures):
        assert not equal(picture, pictures[i - 1])
        assert dr.allclose(dr.mean(picture), dr.mean(pictures[0]), rtol=0.2)


def kernels_of(path, plan, folder):
    """Hashes of the kernels that each frame takes, until its picture is written."""
    opened = jobs.open_scene(jobs.Job(str(path), denoise=True, flight=plan))
    shots, found = frames.Frames(opened, plan), []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for index in range(plan.count):
            state = shots.render(index)
            out = Output(png=folder / "a.png", denoise=True)
            out.write(stills.picture_of(state, shots.film), metadata_of(state))
            found.append({entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])})
    return found


@pytest.mark.parametrize("sensor", [BOX, THIN], ids=["perspective", "thinlens"])
def test_no_frame_compiles_anything_after_the_first(rgb, folder, sensor):
    pytest.importorskip("mitsuba_oidn")
    (folder / "scene.xml").write_text(scene(NIL, sensor, ROOM))
    more = {"focus_distance": 0.8, "aperture_radius": 0.01} if sensor is THIN else {}
    plan = frames.Plan((start(), end(x_fov=30.0, **more)), 3, stills.Rules(spp=4))
    first, *later = kernels_of(folder / "scene.xml", plan, folder)
    assert len(first) > 5
    assert later[0] <= first and later[1] <= first


def test_the_lens_changes_on_the_way(command, film):
    (film / "scene.xml").write_text(scene(NIL, THIN, ROOM))
    keys.save("cameras.json", [start(), end(x_fov=30.0, focus_distance=0.9)])
    assert command(*FLY, "--frames", "3")[0] == 0
    headers = [read(f"film/{name}")[0] for name in names()]
    assert [h["focus_distance"] for h in headers] == pytest.approx([0.5, 0.7, 0.9])
    assert [h["aperture_radius"] for h in headers] == pytest.approx([0.02] * 3)
    assert headers[2]["x_fov"] == pytest.approx(30) and 30 < headers[1]["x_fov"] < 50


def test_a_loop_is_told(command, film):
    last = Key(start().to_world, (0, 0, 1))
    keys.save("cameras.json", [start(), last])
    err = command(*FLY, "--frames", "2")[2]
    assert "a loop of 1 cells: behind its last frame comes its first." in err
    assert json.loads(read("film/0001.exr")[0]["toWorld"])[11] == pytest.approx(0.6)


def test_what_is_wrong_with_the_scene_is_warned_of_once(command, film):
    (film / "scene.xml").write_text(scene(NIL, BOX, ROOM.replace('z="0.7"', 'z="1"')))
    status, out, err = command(*FLY, "--frames", "3")
    assert status == 0 and (out + err).count("what lies outside is never seen") == 1


def test_names_have_as_many_digits_as_the_last():
    folder = frames.Path("film")
    assert frames.path_of(folder, 7, 10_000, ".exr").name == "0007.exr"
    assert frames.path_of(folder, 7, 10_001, ".png").name == "00007.png"


def test_frames_are_denoised_and_have_layers(command, film):
    pytest.importorskip("mitsuba_oidn")
    status, _, err = command(*FLY, "--frames", "1", "--denoise", "--layers", "distance")
    assert status == 0 and err.endswith("before denoising.\n")
    channels = planes("film/0000.exr")
    assert set(channels) == {*"RGB", *(f"noisy.{c}" for c in "RGB"), "depth.Z"}
    assert channels["R"] != channels["noisy.R"]
    # The denoiser has its albedo rendered in any case
    err = command(*FLY, "--frames", "1", "--denoise", "--layers", "distance,albedo")[2]
    assert "layers is distance there and distance,albedo here" in err


# -------------------------------------------------------------------- what is kept


@pytest.mark.parametrize("form", ["exr", "png"])
def test_frames_that_are_there_are_kept(command, film, monkeypatch, form):
    fly = (*FLY, "--frames", "3", "--format", form)
    assert command(*fly)[0] == 0
    before = {name: (film / "film" / name).read_bytes() for name in names()}
    (film / "film" / f"0001.{form}").unlink()
    rendered, render = [], frames.Frames.render

    def counted(self, index):
        rendered.append(index)
        return render(self, index)

    monkeypatch.setattr(frames.Frames, "render", counted)
    status, out, err = command(*fly)
    assert (status, out, rendered) == (0, f"film/0001.{form}\n", [1])
    assert err.startswith("kept 2 frames.\n") and "\n1 frame; " in err
    after = {name: (film / "film" / name).read_bytes() for name in names()}
    if form == "exr":  # which tells when it was written
        again = read(film / "film" / "0001.exr")[2]
        (film / "old.exr").write_bytes(before.pop("0001.exr"))
        assert equal(again, read(film / "old.exr")[2])
    assert before.items() <= after.items()
    assert command(*fly) == (0, "", "kept 3 frames.\n") and rendered == [1]


OTHERS = {
    ("--frames", "3"): "frames is 2 there and 3 here",
    ("--spp", "8"): "spp is 4 there and 8 here",
    ("--seed", "1"): "seed is 0 there and 1 here",
    ("-P", "twist=2"): "twist is 1.0 there and 2.0 here",
    ("-P", "tolerance=1"): "tolerance is 0.25 there and 1.0 here",
    ("--layers", "distance"): "layers is none there and distance here",
    ("--compression", "piz"): "compression is zip there and piz here",
    ("--noise", "0.5"): "noise is none there and 0.5 here",
    ("--fog", "0.5"): "fog is none there and 0.5 here",
}


def test_frames_of_another_flight_are_refused(command, film):
    assert command(*FLY, "--frames", "2")[0] == 0
    for arguments, words in OTHERS.items():
        status, out, err = command(*FLY, "--frames", "2", *arguments)
        line = err.splitlines()[-1]
        assert (status, out) == (1, "") and words in line, line
        assert line.startswith('nil-mitsuba: "film/0000.exr" is a frame of another flight: ')
        assert line.endswith("; remove it, or write to another folder (-o).")


def test_frames_that_are_written_otherwise_are_refused(command, film):
    for form, *arguments, words in (
        ("png", "--exposure", "1", "exposure is 0.0 there and 1.0 here"),
        ("png", "--filmic", "filmic is False there and True here"),
        ("exr", "--denoise", "denoise is False there and True here"),
    ):
        if "--denoise" in arguments:
            pytest.importorskip("mitsuba_oidn")
        fly = (*FLY, "--frames", "1", "--format", form)
        assert command(*fly)[0] == 0
        status, out, err = command(*fly, *arguments)
        assert (status, out) == (1, "") and words in complaint(err)


def test_frames_by_other_keys_or_of_another_scene_are_refused(command, film):
    fly = (*FLY, "--frames", "2", "--format", "png")
    assert command(*fly)[0] == 0
    keys.save("cameras.json", [start(), end(x_fov=40.0)])
    status, _, err = command(*fly)
    assert status == 1 and '0000.png" is a frame of another flight: the keys' in complaint(err)
    keys.save("cameras.json", [start(), end()])
    (film / "scene.xml").write_text(scene(NIL, BOX, ROOM.replace("0.15", "0.16")))
    status, _, err = command(*fly)
    assert status == 1 and "the scene or a file that it names has changed" in complaint(err)


def test_a_frame_by_a_thousand_keys_is_no_larger(command, film):
    sizes = []
    for middle in (0, 998):
        keys.save("cameras.json", [start(), *[end()] * middle, end()])
        out = f"film{middle}"
        assert command(*FLY, "--frames", "2", "-o", out)[0] == 0
        sizes.append((film / out / "0000.exr").stat().st_size)
    assert sizes[1] < sizes[0] + 100


def test_what_is_no_frame_is_refused_before_anything_is_rendered(
    command, film, rendering_is_an_error
):
    (film / "film").mkdir()
    plain = Output(exr=film / "film" / "0001.exr", png=film / "film" / "0001.png")
    plain.write(stills.Picture(["R", "G", "B"], dr.ones(mi.TensorXf, (2, 2, 3)), {}, "float16"), {})
    for form in ("exr", "png"):
        status, _, err = command(*FLY, "--frames", "2", "--format", form)
        assert (status, complaint(err)) == (
            1,
            f'nil-mitsuba: "film/0001.{form}" is no frame of a flight: remove it, or write to '
            "another folder (-o).",
        )
        (film / "film" / f"0001.{form}").write_text("hello")
        status, _, err = command(*FLY, "--frames", "2", "--format", form)
        assert status == 1 and re.search(
            f'"film/0001.{form}" is not an? .*: remove it, or write', complaint(err)
        )


@pytest.mark.parametrize("mark", [5, "hello", "[]", "null"])
@pytest.mark.parametrize("form", ["exr", "png"])
def test_what_other_programs_tell_of_a_flight_makes_no_frame(film, form, mark):
    path = film / f"a.{form}"
    picture = mi.Bitmap(dr.ones(mi.TensorXf, (2, 2, 3)))
    if form == "png":
        mark, picture = str(mark), picture.convert(component_format=mi.Struct.Type.UInt8)
    picture.metadata()["flight"] = mark
    picture.write(str(path))
    with pytest.raises(ValueError, match=f'a.{form}" is no frame of a flight: remove it, or'):
        frames.is_there(path, {})


def test_half_a_frame_is_told(command, film):
    assert command(*FLY, "--frames", "2")[0] == 0
    assert command(*FLY, "--frames", "2", "--format", "png")[0] == 0
    for form in ("exr", "png"):
        path = film / "film" / f"0001.{form}"
        path.write_bytes(path.read_bytes()[:-50])
        status, _, err = command(*FLY, "--frames", "2", "--format", form)
        assert status == 1 and f'0001.{form}" is damaged: remove it' in complaint(err)


# --------------------------------------------------------------------- interruptions


def interrupting(monkeypatch, times):
    """So many signals come while the second frame is being rendered."""
    render = stills.Still.render

    def interrupt(self, index):
        if self.settings["seed"] == 1:
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGINT)
        return render(self, index)

    monkeypatch.setattr(stills.Still, "render", interrupt)


def test_a_signal_finishes_the_frame_and_the_same_command_goes_on(command, film, monkeypatch):
    fly = (*FLY, "--frames", "3")
    with monkeypatch.context() as patch:
        interrupting(patch, 1)
        status, out, err = command(*fly)
    assert (status, out) == (130, "film/0000.exr\nfilm/0001.exr\n")
    line = "nil-mitsuba: interrupted at 2 frames of 3; the same command goes on."
    assert err.splitlines()[1:] == [line]  # behind what is said of the flight
    assert command(*fly)[:2] == (0, "film/0002.exr\n")


def test_a_second_signal_does_not_wait_and_leaves_whole_frames(command, film, monkeypatch):
    with monkeypatch.context() as patch:
        interrupting(patch, 2)
        # Which would end this process, too, if something else kept it from its end
        patch.setattr(threading, "Timer", unittest.mock.Mock())
        status, out, err = command(*FLY, "--frames", "3")
    assert (status, out, names()) == (130, "film/0000.exr\n", ["0000.exr"])
    assert err.endswith("nil-mitsuba: interrupted at 1 frame of 3; the same command goes on.\n")


# -------------------------------------------------------------------------- progress


def test_a_terminal_gets_a_bar_of_frames(command, film, monkeypatch):
    import io

    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(cli._FramesDisplay, "BAR_SECONDS", 0.001)
    assert command(*FLY, "--frames", "2")[0] == 0, terminal.getvalue()
    text = terminal.getvalue()
    assert re.search(r"1/2 frames, \d\d:\d\d left, \d\d:\d\d elapsed", text)
    parts = list(map(int, re.findall(r"(\d+)% \|", text)))
    assert parts[0] == 0 and any(50 <= part < 100 for part in parts)


def test_quiet_means_nothing_but_errors(command, film):
    assert command(*FLY, "--frames", "1", "--quiet") == (0, "", "")


# ----------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    "arguments, status, words",
    [
        (["--frames", "0"], 2, "0 is not in the range 1<=x<=1000000"),
        (["--frames", "1000001"], 2, "1000001 is not in the range"),
        ([], 2, "Missing option '--frames'"),
        (["--frames", "2", "--keys", "none.json"], 1, 'cannot read "none.json": No such file'),
        (["--frames", "2", "--keys", "scene.xml"], 1, '"scene.xml" is not JSON'),
        (["--frames", "2", "--keys", "one.json"], 1, '"one.json" has one key, and a flight leads'),
        (["--frames", "2", "--keys", "lens.json"], 1, '"lens.json", key 2 of 2: .* no "focus_dis'),
        (["--frames", "2", "--keys", "large.json"], 1, '"large.json", key 1 of 2: .*Scale factors'),
        (["--frames", "2", "-P", "quotient=false"], 1, '"cameras.json", key 2 of 2: plain Nil has'),
        (
            ["--frames", "2", "-o", "scene.xml"],
            1,
            'cannot write to "scene.xml": it is not a folder',
        ),
        (["--frames", "2", "-o", "scene.xml/a"], 1, 'cannot make the folder "scene.xml/a": Not a'),
        (["--frames", "2", "--filmic"], 2, "--filmic goes with --format png"),
        (["--frames", "2", "--exposure", "1"], 2, "--exposure goes with --format png"),
        (
            ["--frames", "2", "--format", "png", "--layers", "cell"],
            2,
            "--layers goes with --format",
        ),
        (
            ["--frames", "2", "--format", "png", "--compression", "piz"],
            2,
            "--compression goes with",
        ),
        (["--frames", "2", "--workers", "2", "--scheduler", "tcp://a:1"], 2, "names another"),
        (["--frames", "2", "-s", "1"], 1, "has no sensor 1"),
    ],
    ids=range(17),
)
def test_a_flight_that_cannot_begin_is_refused_in_a_sentence(
    command, film, rendering_is_an_error, arguments, status, words
):
    keys.save("one.json", [start()])
    keys.save("lens.json", [start(), end(focus_distance=1.0)])
    keys.save("large.json", [Key([2 * c for c in start().to_world[:12]] + [0, 0, 0, 1]), end()])
    found, out, err = command(*FLY, *arguments)
    assert (found, out) == (status, "") and re.search(words, complaint(err)), err
    assert not (film / "film").exists()


@pytest.mark.parametrize(
    "parts, words",
    [
        ([NIL, '<sensor type="batch">', SENSOR, SENSOR, "</sensor>"], "is a batch of several"),
        (['<integrator type="moment">', NIL, "</integrator>", SENSOR], "renders in one go"),
    ],
    ids=["batch", "moment"],
)
def test_scenes_that_no_camera_flies_through_are_refused(command, film, parts, words):
    (film / "scene.xml").write_text(scene(*parts, ROOM))
    status, _, err = command(*FLY, "--frames", "2")
    assert status == 1 and words in complaint(err)


def test_a_frame_that_cannot_be_written_ends_the_flight_and_leaves_the_others(
    command, film, monkeypatch
):
    write = Output.write

    def full(self, *arguments):
        if self.exr.name == "0001.exr":
            raise OSError('cannot write "film/0001.exr": No space left on device.')
        write(self, *arguments)

    monkeypatch.setattr(Output, "write", full)
    status, out, err = command(*FLY, "--frames", "3")
    assert (status, out) == (1, "film/0000.exr\n")
    assert err.endswith('nil-mitsuba: cannot write "film/0001.exr": No space left on device.\n')
    assert names() == ["0000.exr"]


# ---------------------------------------------------------------------------- clusters


def test_frames_are_handed_out_one_by_one():
    pytest.importorskip("distributed")
    from nil_mitsuba import cluster

    queue = cluster.Queue([0, 1, 2, 5], 4, most=1)
    assert queue.size(1, 1e-3) == 1
    found = []
    while queue:
        found.append(queue.take(queue.size(1, 1e-3)))
    assert found == [(0, 1), (1, 2), (2, 3), (5, 6)]


def assert_the_same_frames(folder, other):
    assert names(folder) == names(other)
    for name in names(folder):
        one, two = read(f"{folder}/{name}"), read(f"{other}/{name}")
        assert dr.allclose(one[2], two[2], rtol=1e-5, atol=1e-6)
        assert one[0]["toWorld"] == two[0]["toWorld"] and one[0]["seed"] == two[0]["seed"]


def test_a_cluster_renders_the_same_frames(command, film):
    distributed = pytest.importorskip("distributed")
    assert command(*FLY, "--frames", "3", "-o", "alone")[0] == 0
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    ) as workers:
        address = workers.scheduler_address
        status, out, err = command(*FLY, "--frames", "3", "--scheduler", address)
    assert status == 0, err
    assert sorted(out.split()) == [f"film/000{i}.exr" for i in range(3)]
    assert_the_same_frames("alone", "film")


@pytest.mark.verify
def test_processes_render_the_same_frames(command, film):
    pytest.importorskip("distributed")
    assert command(*FLY, "--frames", "3", "-o", "alone")[0] == 0
    assert command(*FLY, "--frames", "3", "--workers", "2")[0] == 0
    assert_the_same_frames("alone", "film")
