"""Signals, kills and other threads: nothing that was rendered is lost."""

import os
import random
import re
import signal
import subprocess
import sys
import threading
import time

import mitsuba as mi
import pytest

import nil_mitsuba
from command_line import remarks
from nil_mitsuba import checkpoint, stills
from small_stills import equal


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_finishes_the_pass_and_saves_it(small, tmp_path, number):
    path, handlers = tmp_path / "a.sums", signal.getsignal(number)

    def interrupt(progress):
        if progress.passes == 2:
            os.kill(os.getpid(), number)

    with pytest.raises(KeyboardInterrupt) as stopped:
        nil_mitsuba.render(small, spp=96, noise=1e-9, checkpoint=path, progress=interrupt)
    assert signal.getsignal(number) is handlers
    assert checkpoint.load(path).sums.passes == ((0, 2),)
    assert equal(stopped.value.image, nil_mitsuba.render(small, spp=32, noise=1e-9))
    image = nil_mitsuba.render(small, spp=96, noise=1e-9, checkpoint=path, resume=True)
    assert equal(image, nil_mitsuba.render(small, spp=96, noise=1e-9))


def test_a_second_signal_does_not_wait(small):
    def interrupt(_):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as stopped:
        nil_mitsuba.render(small, spp=96, progress=interrupt)
    assert not isinstance(stopped.value, stills.Interrupted)
    assert signal.getsignal(signal.SIGINT) is handler


def test_it_renders_in_other_threads_too(small):
    images = []
    thread = threading.Thread(target=lambda: images.append(nil_mitsuba.render(small, spp=16)))
    thread.start()
    thread.join(60)
    assert equal(images[0], nil_mitsuba.render(small, spp=16))


def command(still_folder, *arguments, interval=60, **options):
    """Start `nil-mitsuba` with checkpoints every ``interval`` seconds, as a process of its own."""
    code = (
        f"from nil_mitsuba import cli, stills\nstills.CHECKPOINT_SECONDS = {interval}\n"
        "stills.LOOK_SAMPLES = 12 * 12 * 16\ncli.main()"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=still_folder,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        **options,
    )


def wait_for(path, process, seconds=100):
    end = time.monotonic() + seconds
    while not path.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.05)


def pixels(path):
    return mi.TensorXf(mi.Bitmap(str(path)))


def test_a_terminated_process_writes_the_picture_so_far_and_can_be_resumed(still_folder):
    arguments = ["render", "scene.xml", "--noise", "1e-9", "--spp", "160000"]
    process = command(still_folder, *arguments, interval=0)
    wait_for(still_folder / "scene.sums", process)
    process.terminate()
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (143, "scene.exr\n"), err
    told = r"nil-mitsuba: interrupted at \d+ samples per pixel, noise ([\d.]+|not \w+: one pass); "
    assert re.search(told, err)
    assert '--resume goes on from "scene.sums"' in err
    state = checkpoint.load(still_folder / "scene.sums")
    done = state.sums.count * 16
    assert 0 < done < 160000 and pixels(still_folder / "scene.exr").shape == (12, 12, 3)

    arguments[-1] = str(done + 160)
    process = command(still_folder, *arguments, "--resume")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, remarks(err)) == (0, "scene.exr\n", "")
    assert not (still_folder / "scene.sums").exists()
    whole = command(still_folder, *arguments, "-o", "whole.exr")
    assert whole.wait(60) == 0
    assert equal(pixels(still_folder / "scene.exr"), pixels(still_folder / "whole.exr"))


@pytest.mark.verify
def test_killed_at_any_moment_it_loses_no_checkpoint(still_folder):
    # Killed while it loads, renders or writes; a checkpoint after each pass, so that about one in
    # three of the kills falls into its writing.
    arguments = ["render", "scene.xml", "-D", "resolution=200", "--noise", "1e-9", "--spp", "150"]
    random.seed(1)
    path, passes, kills = still_folder / "scene.sums", [0], 0
    while kills < 20:
        process = command(still_folder, *arguments, "--resume", interval=0)
        if random.random() < 0.8:
            before = path.stat().st_mtime_ns if path.exists() else None
            while process.poll() is None and (
                not path.exists() or path.stat().st_mtime_ns == before
            ):
                time.sleep(0.01)
        time.sleep(random.uniform(0, 0.5))
        process.kill()
        process.communicate()
        kills += process.returncode == -signal.SIGKILL
        if path.exists():
            passes.append(checkpoint.load(path).sums.count)  # whole, whatever happened
        if process.returncode == 0:
            break
    assert kills == 20 and passes == sorted(passes) and passes[-1] > 5
    assert command(still_folder, *arguments, "--resume").wait(600) == 0
    assert command(still_folder, *arguments, "-o", "whole.exr").wait(600) == 0
    assert equal(pixels(still_folder / "scene.exr"), pixels(still_folder / "whole.exr"))
