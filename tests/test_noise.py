"""What is told of a still's noise and progress: in its files, at the end, and meanwhile."""

import errno
import hashlib
import io
import os
import re
import signal
import struct
import sys
import time

import mitsuba as mi
import pytest

import nil_mitsuba
from command_line import BOX, LAMP, NIL, SENSOR, planes, scene
from nil_mitsuba import checkpoint, cli, exr, exr_header, stills
from small_stills import still_of, sums_of

FOUR_PASSES = ("render", "scene.xml", "--spp", "16", "--pass-spp", "4")


def told(command, file="scene.exr"):
    """The noise that "info" tells of a file."""
    return re.search(r"^  noise +(.*)$", command("info", file)[1], re.M)[1]


def stated():
    """The noise in the picture's header."""
    return exr_header.read("scene.exr")[0]["noise"].value


# ---------------------------------------------------------------- in files, at the end


def test_the_end_the_header_and_info_tell_one_noise(command):
    status, out, err = command(*FOUR_PASSES)
    noise = stated()
    assert 0.001 < noise < 1
    assert (status, out) == (0, "scene.exr\n")
    assert err == f"16 samples per pixel, noise {noise:.3g}.\n"
    assert told(command) == f"{noise:.3g}"


def test_a_resumed_still_ends_with_the_noise_of_all_its_passes(command, repeatable):
    command(*FOUR_PASSES)
    whole = stated()
    eight = ("render", "scene.xml", "--spp", "8", "--pass-spp", "4", "--checkpoint", "a.sums")
    command(*eight)
    half = stated()
    assert told(command, "a.sums") == f"{half:.3g}"
    command(*FOUR_PASSES, "--checkpoint", "a.sums", "--resume")
    assert stated() == whole < half


def test_parts_in_one_file_tell_their_noise(command):
    for part in ("0:1", "1:2"):
        command(*FOUR_PASSES, "--passes", part, "-o", part[0] + ".sums")
    assert told(command, "0.sums") == "not estimated: one pass"
    _, _, err = command("merge", "0.sums", "1.sums", "-o", "both.sums")
    assert err.splitlines()[-1] == f"8 samples per pixel, noise {told(command, 'both.sums')}."
    assert float(told(command, "both.sums")) > 0


def test_a_picture_of_one_pass_tells_the_noise_that_its_halves_show(command):
    whole = ("render", "scene.xml", "--spp", "16", "--checkpoint", "a.sums")
    _, _, err = command(*whole)
    noise = stated()
    assert 0.001 < noise < 1
    assert err == f"16 samples per pixel, noise {noise:.3g}.\n"
    assert told(command) == told(command, "a.sums") == f"{noise:.3g}"
    command("merge", "a.sums", "-o", "merged.exr")
    assert told(command, "merged.exr") == f"{noise:.3g}"
    # Resumed with nothing to do; and with more passes, which are judged as ever
    assert command(*whole, "--resume")[2] == err
    command("render", "scene.xml", "--spp", "32", "--checkpoint", "a.sums", "--resume")
    assert 0 < stated() < noise


def test_one_sample_has_no_noise(command):
    _, _, err = command("render", "scene.xml", "--spp", "1")
    assert err == "1 sample per pixel, noise not estimated: one pass.\n"
    assert stated() == told(command) == "not estimated: one pass"


def test_a_pass_whose_samples_depend_on_each_other_says_how_to_have_an_estimate(command, folder):
    stratified = SENSOR.replace("independent", "stratified")
    assert stratified != SENSOR
    (folder / "scene.xml").write_text(scene(NIL, stratified, LAMP))
    _, _, err = command("render", "scene.xml", "--spp", "16")
    assert err == (
        "16 samples per pixel, noise not estimated: one pass (--pass-spp 4 makes more).\n"
    )


def test_what_is_rendered_in_one_go_says_that_there_is_no_estimate(command, folder):
    moment = '<integrator type="moment"><integrator type="nil"/></integrator>'
    (folder / "scene.xml").write_text(scene(moment, SENSOR, LAMP))
    _, _, err = command("render", "scene.xml")
    assert err == "4 samples per pixel, noise not estimated: rendered in one go.\n"
    assert told(command) == "not estimated: rendered in one go"


def test_a_black_picture_has_passes_that_are_equal(command, folder):
    (folder / "scene.xml").write_text(scene(NIL, SENSOR))
    assert command(*FOUR_PASSES)[2] == ("16 samples per pixel, noise 0: all passes are equal.\n")
    assert stated() == 0 and told(command) == "0"


def test_a_single_pixel_has_a_noise(command, folder):
    pixel = SENSOR.replace('value="12"', 'value="1"').replace('value="8"', 'value="1"')
    (folder / "scene.xml").write_text(scene(NIL, pixel, LAMP))
    assert command(*FOUR_PASSES)[0] == 0
    assert 0 < stated() < 1


def test_pictures_of_earlier_versions_do_not_state_their_noise(rgb, tmp_path):
    picture = (["R"], mi.TensorXf([1.0], (1, 1, 1)))
    exr.write(tmp_path / "old.exr", picture, {}, {"software": "nil_mitsuba 0.1.0, Mitsuba 3.9.1"})
    assert re.search(r"^  noise +not stated$", exr.describe(tmp_path / "old.exr"), re.M)
    exr.write(tmp_path / "other.exr", picture, {}, {"software": "another"})
    assert "noise" not in exr.describe(tmp_path / "other.exr")


def test_sums_of_earlier_versions_do_not_state_their_noise(small, tmp_path):
    still = still_of(small)
    data = sums_of(still, 0, 1).to_bytes()[:-32]
    stated = b'"noise": null, '
    assert stated in data
    data = data.replace(stated, b" " * len(stated))
    (tmp_path / "old.sums").write_bytes(data + hashlib.sha256(data).digest())
    described = checkpoint.describe(tmp_path / "old.sums")
    assert re.search(r"^  noise +not stated$", described, re.M)
    # Whoever goes on with them has an estimate at once
    reports = []
    nil_mitsuba.render(
        small,
        spp=32,
        noise=1e-9,
        checkpoint=tmp_path / "old.sums",
        resume=True,
        progress=reports.append,
    )
    assert [report.passes for report in reports] == [2] and reports[0].noise > 0


def test_the_noise_of_a_denoised_picture_is_that_before(command, folder):
    pytest.importorskip("mitsuba_oidn")
    (folder / "scene.xml").write_text(scene(NIL, BOX, LAMP))
    command(*FOUR_PASSES)
    plain = told(command)
    _, _, err = command(*FOUR_PASSES, "--denoise")
    assert err == f"16 samples per pixel, noise {plain} before denoising.\n"
    assert "noisy.R" in planes("scene.exr") and told(command) == f"{plain} (before denoising)"


def test_an_interrupted_render_call_tells_its_noise(small):
    def interrupt(progress):
        if progress.passes == 2:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(stills.Interrupted, match=r"at 32 samples per pixel, noise 0\.\d+; "):
        nil_mitsuba.render(small, spp=96, noise=1e-9, progress=interrupt)


# ------------------------------------------------------------------------- meanwhile


@pytest.fixture
def slow(monkeypatch):
    """Passes take a twentieth of a second more, and a line is due several times in each."""
    render = stills.Still.render

    def wait(self, index):
        time.sleep(0.05)
        return render(self, index)

    monkeypatch.setattr(stills.Still, "render", wait)
    monkeypatch.setattr(cli._Display, "LINE_SECONDS", 0.01)
    monkeypatch.setattr(cli._Display, "BAR_SECONDS", 0.01)


def as_terminal(monkeypatch):
    """Make stderr a terminal; returns what keeps what is written to it."""
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)  # in the test itself: pytest sets it before that
    return terminal


def test_lines_due_are_ten_seconds_apart():
    assert cli._Display.LINE_SECONDS == 10


def test_a_pipe_gets_a_line_now_and_then(command, slow):
    status, out, err = command("render", "scene.xml", "--spp", "12", "--pass-spp", "4")
    assert (status, out) == (0, "scene.exr\n")
    assert err.isprintable() or set(filter(lambda c: not c.isprintable(), err)) == {"\n"}
    *lines, end = err.splitlines()
    assert end.startswith("12 samples per pixel, noise 0.")
    assert len(lines) > 4  # within passes, too
    form = (
        r"(\d+)/12 spp, (noise 0\.\d+, )?(\d+:\d+ left, )?\d+:\d+ elapsed, "
        r"(\d)/3 passes(, [\d.]+ M/s)?"
    )
    matches = [re.fullmatch(form, line) for line in lines]
    assert all(matches), lines
    done = [int(match[1]) for match in matches]
    assert done == sorted(done) and set(done) <= {0, 4, 8, 12} and 8 in done
    for match in matches:
        assert int(match[1]) == 4 * int(match[4])
        assert bool(match[2]) == (int(match[4]) > 1)  # from the second pass on


def test_without_a_number_of_samples_a_line_tells_what_is_done(command, slow, monkeypatch):
    monkeypatch.setattr(stills, "LOOK_SAMPLES", 12 * 8 * 4)
    err = command("render", "scene.xml", "--noise", "0.5")[2]  # four passes
    assert re.search(r"^8 spp, noise [\d.]+, 00:00 left, .*, 2 passes, ", err, re.M)


def test_quiet_means_no_line_and_no_bar(command, slow, monkeypatch):
    quiet = ("render", "scene.xml", "--spp", "8", "--pass-spp", "4", "--quiet")
    assert command(*quiet) == (0, "", "")
    terminal = as_terminal(monkeypatch)
    assert command(*quiet)[0] == 0
    assert terminal.getvalue() == ""


def test_a_terminal_gets_a_bar_with_the_noise_from_the_second_pass_on(command, slow, monkeypatch):
    terminal = as_terminal(monkeypatch)
    command(*FOUR_PASSES)
    *bars, end = re.split(r"[\r\n]+", terminal.getvalue().strip())
    assert end.startswith("16 samples per pixel, noise 0.")
    for fragment in ("16/16 spp", "M/s", "elapsed", "left", "noise 0."):
        assert fragment in " ".join(bars)
    for bar in filter(None, map(str.strip, bars)):
        passes = re.search(r"(\d)/4 passes", bar)
        assert not passes or ("noise" in bar) == (int(passes[1]) > 1)


def test_a_narrow_terminal_shows_samples_and_noise(command, monkeypatch):
    fcntl, termios = pytest.importorskip("fcntl"), pytest.importorskip("termios")
    main, terminal = os.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("4H", 24, 40, 0, 0))
    with open(terminal, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        command(*FOUR_PASSES)
        text = os.read(main, 10000).decode()  # less than a terminal holds until it is read
    os.close(main)
    bars = [bar for bar in text.split("\r") if "%" in bar]
    assert bars and max(map(len, bars)) <= 40
    assert any("16/16 spp, noise 0." in bar for bar in bars)


@pytest.mark.parametrize(
    "stream, number, status",
    [
        ("stdout", errno.EPIPE, 1),  # no one learns where the picture is
        ("stdout", errno.ENOSPC, 1),
        ("stderr", errno.EPIPE, 0),
        ("stderr", None, 0),  # closed from the start
    ],
)
def test_a_reader_that_is_gone_loses_no_picture(
    command, folder, monkeypatch, stream, number, status
):
    class Gone(io.StringIO):
        def write(self, _):
            raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(cli._Display, "LINE_SECONDS", 0.001)
        patch.setattr(sys, stream, Gone() if number else None)
        found, _, err = command("render", "scene.xml", "--spp", "8", "--pass-spp", "4")
    assert found == status
    assert number != errno.ENOSPC or '"scene.exr" is written, but' in err
    assert exr_header.read("scene.exr")[0]["spp"].value == 8
    assert sorted(path.name for path in folder.iterdir()) == ["scene.exr", "scene.xml"]
