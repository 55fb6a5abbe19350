"""The command's checkpoints and parts: going on, merging, rendering again."""

import pytest

from command_line import LAMP, NIL, SENSOR, complaint, planes, read, remarks, scene
from nil_mitsuba import stills


def test_a_checkpoint_that_is_named_stays_and_more_samples_go_on_with_it(command, folder):
    for spp in ("8", "24"):
        status, out, err = command(
            "render", "scene.xml", "--spp", spp, "--checkpoint", "a.sums", "--resume", "-q"
        )
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
    assert remarks(err) == 'there is no checkpoint "scene.sums": beginning with the first pass.\n'
    assert sorted(p.name for p in folder.iterdir()) == ["scene.exr", "scene.xml"]


def test_parts_merge_to_the_picture_of_one_run(command, repeatable, monkeypatch):
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
    assert remarks(err) == "the passes 1:2 of 0:4 are missing.\n"
    status, out, err = command(
        "merge", *parts, "scene.1-2.sums", "-o", "merged.exr", "--png", "merged.png"
    )
    assert (status, out, remarks(err)) == (0, "merged.exr\nmerged.png\n", "")
    merged = planes("merged.exr")
    for name in "RGB":
        for row, expected in zip(merged[name], whole[name]):
            assert row == pytest.approx(expected, rel=1e-6)
    header, sound = read("merged.exr")[0], read("scene.exr")[0]
    for name in ("spp", "seed", "sceneHash", "integrator", "twist", "passes", "noise"):
        assert header[name] == sound[name]

    # In steps, too
    assert command("merge", *parts, "-o", "two.sums")[0] == 0
    assert command("merge", "scene.1-2.sums", "two.sums", "-o", "again.exr")[0] == 0
    assert planes("again.exr") == merged

    # Bad parts get a sentence, and the picture stays
    before = (repeatable / "merged.exr").read_bytes()
    command("render", "scene.xml", "--spp", "16", "--passes", "0:1", "--seed", "1", "-o", "b.sums")
    (repeatable / "c.sums").write_text("nothing")
    for names, fragments in (
        (["scene.0-1.sums", "two.sums"], ["passes 0:1", "twice"]),
        (["scene.2-4.sums", "b.sums"], ["seed is 0 there and 1 here"]),
        (["scene.2-4.sums", "c.sums"], ["c.sums", "no checkpoint"]),
        (["scene.2-4.sums", "d.sums"], ["d.sums", "No such file"]),
    ):
        status, _, err = command("merge", *names, "-o", "merged.exr")
        line = complaint(err)
        assert status == 1 and [f for f in fragments if f not in line] == []
    assert (repeatable / "merged.exr").read_bytes() == before


def test_merged_parts_can_be_denoised(command, meshes):
    pytest.importorskip("mitsuba_oidn")
    command("render", "scene.xml", "--spp", "8", "--passes", "0:1", "-o", "a.sums")
    status, _, err = command("merge", "a.sums", "-o", "a.exr", "--denoise")
    assert status == 1 and "--denoise needs the layers albedo and normal" in complaint(err)
    command(
        "render",
        "scene.xml",
        "--spp",
        "8",
        "--passes",
        "0:1",
        "-o",
        "b.sums",
        "--layers",
        "albedo,normal",
    )
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
    assert len(remarks(err).splitlines()) == 1 and "No space left on device" in err


def test_a_part_goes_on_with_other_passes(command, monkeypatch):
    from nil_mitsuba import checkpoint, passes

    monkeypatch.setattr(passes, "WAVEFRONT_SAMPLES", 12 * 8 * 4)
    part = ("render", "scene.xml", "--spp", "16", "-o", "p.sums", "--passes")
    assert command(*part, "0:1")[:2] == (0, "p.sums\n")
    assert command(*part, "2:4", "--resume")[:2] == (0, "p.sums\n")
    assert checkpoint.load("p.sums").sums.passes == ((0, 1), (2, 4))
    assert command(*part, "0:4", "--resume")[0] == 0
    assert checkpoint.load("p.sums").sums.passes == ((0, 4),)


def test_a_merged_picture_tells_all_that_it_took(command, repeatable, monkeypatch):
    from nil_mitsuba import passes

    monkeypatch.setattr(passes, "WAVEFRONT_SAMPLES", 12 * 8 * 4)
    for part in ("0:1", "1:2"):
        command("render", "scene.xml", "--spp", "8", "-D", "format=float32", "--passes", part)
    command("merge", "scene.0-1.sums", "scene.1-2.sums", "-o", "scene.exr")
    before, lines = planes("scene.exr"), read("scene.exr")[0]["commandLine"].splitlines()
    assert len(lines) == 3 and all("-D format=float32" in line for line in lines[:2])
    for name in ("scene.0-1.sums", "scene.1-2.sums", "scene.exr"):
        (repeatable / name).unlink()
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


def test_the_size_of_passes_renders_a_picture_again(command, repeatable, monkeypatch):
    monkeypatch.setattr(stills, "LOOK_SAMPLES", 12 * 8 * 2)
    floats = ("render", "scene.xml", "-D", "format=float32")
    command(*floats, "--noise", "1e-9", "--spp", "8")
    timed, header = planes("scene.exr"), read("scene.exr")[0]
    assert header["passes"] == "0:4 of 2 samples per pixel"
    command(*floats, "--spp", "8")
    assert planes("scene.exr") != timed
    command(*floats, "--spp", "8", "--pass-spp", "2")
    assert planes("scene.exr") == timed
