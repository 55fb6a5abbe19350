"""A second signal ends the command, whatever it is doing, and nothing but the command."""

import os
import signal
import subprocess
import sys
import threading
import time

import mitsuba as mi
import pytest

import nil_mitsuba
from nil_mitsuba import checkpoint, files, signals

# A closed white room, whose paths end where max_depth says.
ROOM = """
<scene version="3.0.0">
    <integrator type="nil">
        <integer name="max_depth" value="4"/><integer name="rr_depth" value="2000000000"/>
    </integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0.3, 0.3, 0.5" target="0.7, 1, 0.4" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"/>
        <film type="hdrfilm">
            <integer name="width" value="8"/><integer name="height" value="8"/>
        </film>
    </sensor>
    <emitter type="point"><point name="position" value="0.5, 0.5, 0.7"/></emitter>
    <shape type="cube">
        <transform name="to_world"><scale value="0.4"/><translate value="0.5"/></transform>
        <bsdf type="twosided">
            <bsdf type="diffuse"><rgb name="reflectance" value="1, 1, 1"/></bsdf>
        </bsdf>
    </shape>
</scene>
"""

# The first pass is saved; the second one stays in a kernel, or in Python, for hours.
COMMAND = """
import os, time
from nil_mitsuba import cli, stills

stills.CHECKPOINT_SECONDS = 0
render = stills.Still.render

def slow(self, index):
    if index == 0:
        return render(self, index)
    if os.environ["WHERE"] == "Python":
        open("slow", "w").close()
        time.sleep(10000)
    passes = self.passes
    passes.integrator.max_depth = 2 * 10**9
    finish = passes._finish

    def say(lanes, start):
        if lanes:  # the kernel has been compiled and is running
            open("slow", "w").close()
        finish(lanes, start)

    passes._finish = say
    return render(self, index)

stills.Still.render = slow
cli.main()
"""


def wait_for(path, process):
    end = time.monotonic() + 100
    while not path.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.05)


@pytest.mark.parametrize(
    "number, where",
    [
        (signal.SIGINT, "a kernel"),
        (signal.SIGTERM, "Python"),
        pytest.param(signal.SIGTERM, "a kernel", marks=pytest.mark.verify),
        pytest.param(signal.SIGINT, "Python", marks=pytest.mark.verify),
    ],
)
def test_a_second_signal_ends_the_command_within_three_seconds(rgb, tmp_path, number, where):
    (tmp_path / "room.xml").write_text(ROOM)
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, "render", "room.xml", "--spp", "64", "--pass-spp", "4"],
        cwd=tmp_path,
        env=os.environ | {"WHERE": where},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        wait_for(tmp_path / "slow", process)
        process.send_signal(number)
        time.sleep(signals.EXPLAIN_SECONDS + 0.5)
        assert process.poll() is None  # it waits for the pass
        start = time.monotonic()
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
        seconds = time.monotonic() - start
    finally:
        process.kill()
    assert seconds < 3
    assert (process.returncode, out) == (128 + number, "")
    finishing, interrupted = filter(None, err.splitlines())
    assert finishing == (
        "nil-mitsuba: finishing the pass that is being rendered; a second signal ends this at once."
    )
    assert interrupted == (
        "nil-mitsuba: interrupted, no picture was written; the same command "
        'with --resume goes on from "room.sums".'
    )
    assert checkpoint.load(tmp_path / "room.sums").sums.passes == ((0, 1),)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"room.xml", "room.sums", "slow"}


def test_what_is_being_written_does_not_stay(tmp_path):
    (tmp_path / "a.sums").write_text("before")
    with pytest.raises(OSError):
        with files.replacing(tmp_path / "a.sums") as part:
            assert len(list(tmp_path.iterdir())) == 2
            files.abandon()
            assert not os.path.exists(part)
    assert (tmp_path / "a.sums").read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 1


def test_the_watch_is_over_with_the_command():
    threads = threading.active_count()
    with signals.Watch("never said"):
        inside = signal.set_wakeup_fd(-1)
        signal.set_wakeup_fd(inside)
        assert inside != -1 and threading.active_count() == threads + 1
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)  # a single one
            time.sleep(10)
    assert signal.set_wakeup_fd(-1) == -1 and threading.active_count() == threads


@pytest.fixture
def scene(rgb):
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nil", "quotient": False},
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
            "sky": {"type": "constant"},
            "ball": {"type": "sphere", "center": [0, 0, 3]},
        }
    )


def test_no_render_from_python_is_watched(scene):
    found = []

    def look(_):
        found.append(signal.set_wakeup_fd(-1))

    nil_mitsuba.render(scene, spp=4, progress=look)
    assert found == [-1, -1]


def test_a_signal_from_the_keyboard_arrives_between_wavefronts(scene, monkeypatch):
    from nil_mitsuba import passes

    for name in ("FIRST_SAMPLES", "STEP_SAMPLES", "WAVEFRONT_SAMPLES"):
        monkeypatch.setattr(passes, name, 64)
    done = []
    finish = passes.Passes._finish

    def interrupted(self, lanes, start):
        finish(self, lanes, start)
        done.append(lanes)
        if len(done) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(passes.Passes, "_finish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        scene.integrator().render(scene, spp=64)
    assert len(done) == 3


def test_a_signal_while_loops_are_recorded_is_no_error_of_theirs(scene, monkeypatch):
    module = sys.modules["nil_mitsuba.integrator"]
    monkeypatch.setattr(
        module, "surface_interaction", lambda *_: os.kill(os.getpid(), signal.SIGINT)
    )
    with pytest.raises(KeyboardInterrupt):
        scene.integrator().render(scene, spp=4)
