import json
import math
import os
import pathlib
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from functools import reduce

import drjit as dr
import mitsuba as mi
import pytest

import nil_mitsuba
from nil_mitsuba import checkpoint, jobs, stills
from nil_mitsuba.jobs import Job
from nil_mitsuba.scene_files import SceneFiles

HERE = pathlib.Path(__file__).parent

SCENE = """
<scene version="3.0.0">
    <default name="spp" value="16"/>
    <default name="resolution" value="12"/>
    <default name="twist" value="1"/>
    <integrator type="nil"><float name="twist" value="$twist"/></integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0.1, 0.1, 0.6" target="0.7, 1, 0.4" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resolution"/>
            <integer name="height" value="$resolution"/>
            <string name="component_format" value="float32"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant"/>
    <shape type="obj"><string name="filename" value="triangle.obj"/></shape>
    <shape type="sphere">
        <point name="center" value="0.5, 0.5, 0.5"/><float name="radius" value="0.2"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.2, 0.1"/></bsdf>
    </shape>
</scene>
"""
TRIANGLE = "v 0.1 0.1 .9\nv 0.9 0.1 .9\nv 0.1 0.9 .9\nf 1 3 2\n"


def description(size=8, rfilter="box", **integrator):
    return {
        "type": "scene",
        "integrator": {"type": "nil", "max_depth": 4} | integrator,
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0.1, 0.1, 0.6], [0.7, 1, 0.4], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size, "height": size,
                     "component_format": "float32", "rfilter": {"type": rfilter}},
        },
        "lamp": {"type": "sphere", "center": [0.3, 0.4, 0.8], "radius": 0.1,
                 "light": {"type": "area"}},
        "sky": {"type": "constant", "radiance": 0.1},
        "ball": {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.2,
                 "bsdf": {"type": "diffuse"}},
    }


@pytest.fixture
def small(rgb, monkeypatch):
    """A scene of 8 × 8 pixels, of which rules that need looks get passes of 16 samples each."""
    monkeypatch.setattr(stills, "LOOK_SAMPLES", 8 * 8 * 16)
    return mi.load_dict(description())


@pytest.fixture
def folder(tmp_path, rgb):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "triangle.obj").write_text(TRIANGLE)
    return tmp_path


def still_of(scene, spp=64, pass_spp=16, seed=0, **more):
    return stills.Still(scene, seed=seed, rules=stills.Rules(spp=spp), pass_spp=pass_spp, **more)


def equal(a, b):
    return dr.all(a.array == b.array, axis=None)


def sums_of(still, *indices):
    state = still.nothing()
    for index in indices:
        state = state.plus(still.render(index))
    return state


# ----------------------------------------------------------------------- passes


def test_a_still_is_the_mean_of_renders_with_the_seeds_of_its_passes(small):
    from nil_mitsuba.passes import pass_seed

    still = still_of(small, seed=5)
    image = still.develop(sums_of(still, *range(4)))
    separate = [mi.render(small, spp=16, seed=pass_seed(5, index)) for index in range(4)]
    mean = sum(separate[1:], separate[0]) / 4
    assert not equal(separate[0], separate[1])
    assert dr.allclose(image, mean, rtol=1e-6, atol=1e-7)


def test_it_is_what_mitsuba_renders(small):
    assert dr.allclose(nil_mitsuba.render(small, spp=24, seed=3), mi.render(small, spp=24, seed=3))


def test_no_pass_compiles_anything_after_the_first(small):
    kernels = []

    def kernels_of_this_pass(_):
        history = dr.kernel_history([dr.KernelType.JIT])
        kernels.append({entry["hash"] for entry in history})
        dr.kernel_history_clear()

    still = still_of(small)
    state = still.nothing()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        still.accumulate(state, (still.render(i) for i in range(3)), kernels_of_this_pass)
    before, *passes = kernels
    assert len(passes) == 3 and len(passes[0]) > 2
    assert passes[1] <= passes[0] | before and passes[2] == passes[1]


def test_sizes_of_passes_follow_from_the_scene_and_the_settings_alone(small):
    sizes = []
    for threads in (1, 2):
        dr.set_thread_count(threads)
        still = stills.Still(small, rules=stills.Rules(spp=10**6))
        sizes.append((still.passes.spp, still.count))
    assert sizes[0] == sizes[1]
    size, count = sizes[0]
    assert 64 * size <= 2**21 and size * count >= 10**6 > size * (count - 1)


def test_sums_of_more_than_2_to_the_32_samples_lose_nothing(small):
    still = still_of(small, spp=2**34)
    state = sums_of(still, 0)
    many = 2**33 // 16
    far = checkpoint.Checkpoint(state.settings, type(state.sums)(
        state.sums.values * many, state.sums.moments * many, state.sums.points, ((0, many),)
    ))
    index = next(still.todo(far))
    assert index == many
    more = far.plus(still.render(index))

    weight = more.sums.values.array[3]
    assert weight == 2**33 + 16  # float32 would know multiples of 1024 here
    assert more.sums.count * 16 == 2**33 + 16
    assert dr.allclose(still.develop(more), still.develop(state), rtol=1e-6)
    assert not still.rules.met(stills.Progress(many, 2**33, 1.0, None, still.rules))
    assert still.rules.met(stills.Progress(2 * many, 2**34, 1.0, None, still.rules))


def test_the_order_of_passes_does_not_matter(rgb):
    scene = mi.load_dict(description(aovs="shape, cell"))
    still = still_of(scene)
    forth = still.develop(sums_of(still, 0, 1, 2, 3))
    back = still.develop(sums_of(still, 3, 1, 0, 2))
    assert dr.allclose(forth, back, rtol=1e-6)
    assert equal(forth[:, :, 3:], back[:, :, 3:])


@pytest.mark.parametrize(
    "present, expected", [([], [0, 1, 2, 3, 4]), ([(0, 3)], [3, 4]), ([(1, 2), (4, 5)], [0, 2, 3])]
)
def test_passes_that_are_there_are_not_rendered_again(small, present, expected):
    still = still_of(small)
    state = still.nothing()
    state.sums.passes = tuple(present)
    assert list(still.todo(state, stop=5)) == expected
    endless = still.todo(state)
    assert [next(endless) for _ in expected] == expected


def test_a_wrapper_renders_in_one_go_only(rgb):
    scene = mi.load_dict(description() | {"integrator": {"type": "moment", "of": {"type": "nil"}}})
    with pytest.raises(ValueError, match="in one go"):
        nil_mitsuba.render(scene)


# ------------------------------------------------------------------------ rules


def test_rules_end_a_still_whichever_comes_first(small):
    reports = []
    nil_mitsuba.render(small, spp=50, noise=1e-9, seconds=1e6, progress=reports.append)
    assert reports[-1].samples == 64 and reports[-2].samples == 48

    nil_mitsuba.render(small, spp=10**7, noise=0.3, progress=reports.append)
    assert reports[-1].noise <= 0.3 and reports[-1].samples < 10**6
    assert all(r.noise > 0.3 for r in reports[6:-1] if r.passes >= stills.NOISE_PASSES)

    nil_mitsuba.render(small, seconds=0.01, progress=reports.append)
    assert reports[-1].seconds >= 0.01 > reports[-2].seconds


def test_without_rules_the_samples_are_those_of_the_scene(small):
    reports = []
    nil_mitsuba.render(small, progress=reports.append)
    assert reports[-1].samples == small.sensors()[0].sampler().sample_count()


def test_time_left_is_that_of_the_nearest_rule():
    rules = stills.Rules(spp=400, seconds=50.0, noise=0.1)

    def left(samples, seconds, noise, rules=rules):
        return stills.Progress(1, samples, seconds, noise, rules).left

    assert left(100, 10.0, 0.4) == 30    # samples: three times as long again
    assert left(10, 10.0, 1.0) == 40     # time
    assert left(100, 10.0, 0.15) == pytest.approx(12.5)  # 10 (1.5² − 1)
    assert left(0, 0.0, None, stills.Rules(spp=3)) is None
    assert left(100, 10.0, 0.15, stills.Rules(noise=1e-200)) == math.inf


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_noise_is_the_error_that_there_is(rgb, rfilter):
    # Means over 24 renders of squared errors and of squared estimates; sound estimates fail for
    # |z| > 3.5 once in 2,100 runs.
    scene = mi.load_dict(description(16, rfilter, twist=0, quotient=False))  # quick
    true, reference = luminances(scene, 4096, 2048, seed=10**6)
    scale = dr.maximum(true, dr.mean(true))
    differences = []
    for seed in range(24):
        image, estimate = luminances(scene, 64, 16, seed)
        error = dr.mean(dr.square((image - true) / scale))[0]
        differences.append(estimate**2 + reference**2 - error)
    mean = sum(differences) / 24
    variance = sum((d - mean) ** 2 for d in differences) / 23 / 24
    assert abs(mean) < 3.5 * math.sqrt(variance)
    assert math.sqrt(variance) < 0.1 * estimate**2  # 35 % of the square would be found


def luminances(scene, spp, pass_spp, seed):
    """Luminance of each pixel, and the estimated noise."""
    from nil_mitsuba.sums import luminance

    still = still_of(scene, spp, pass_spp, seed)
    state = sums_of(still, *range(still.count))
    total, weight = luminance(still.film, state.sums.values)
    return mi.Float(total / weight), stills.noise(still.film, state.sums)


def test_one_pixel_of_fireflies_does_not_hide_the_rest(small):
    still = still_of(small)
    state = sums_of(still, 0, 1, 2, 3)
    calm = stills.noise(still.film, state.sums)
    # In one pass one pixel is a million times as bright
    bright = still.render(4)
    values = bright.sums.values.array
    dr.scatter(values, 1e6 * 16, dr.arange(mi.UInt32, 3) + 4 * 20)
    bright.sums.values = mi.TensorXd(values, bright.sums.values.shape)
    bright.sums.moments = still.passes._moments(bright.sums.values)
    noisy = stills.noise(still.film, state.plus(bright).sums)
    assert noisy <= math.sqrt(calm**2 + 1 / 64)


@pytest.mark.parametrize("radiance", [math.inf, math.nan])
def test_pixels_that_are_not_finite_do_not_hide_the_noise_of_others(small, radiance):
    still = still_of(small)
    state = sums_of(still, 0, 1, 2, 3)
    calm = stills.noise(still.film, state.sums)
    broken = still.render(4)
    values = broken.sums.values.array
    dr.scatter(values, radiance, dr.arange(mi.UInt32, 3) + 4 * 20)
    broken.sums.values = mi.TensorXd(values, broken.sums.values.shape)
    broken.sums.moments = still.passes._moments(broken.sums.values)
    assert 0.5 * calm < stills.noise(still.film, state.plus(broken).sums) < 1.5 * calm

    nothing = still.nothing()
    values = dr.full(mi.TensorXd, radiance, broken.sums.values.shape)
    nothing.sums.values, nothing.sums.passes = values, ((0, 2),)
    nothing.sums.moments = still.passes._moments(values)
    assert stills.noise(still.film, nothing.sums) == math.inf


def test_the_shortest_time_is_that_of_one_pass(small):
    reports = []
    nil_mitsuba.render(small, seconds=1e-9, progress=reports.append)
    assert [report.passes for report in reports] == [0, 1]


@pytest.mark.parametrize(
    "wrong, fragment",
    [({"spp": 0}, "spp"), ({"spp": 1.5}, "spp"), ({"seconds": 0}, "seconds"),
     ({"noise": -1}, "noise"), ({"noise": math.nan}, "noise"), ({"seconds": math.inf}, "seconds"),
     ({"spp": math.nan}, "spp"), ({"spp": math.inf}, "spp"), ({"noise": "0.1"}, "noise"),
     ({"seed": -1}, "seed"), ({"seed": 2**32}, "seed"), ({"sensor": 1}, "1 sensors"),
     ({"sensor": -1}, "1 sensors")],
)  # fmt: skip
def test_rules_that_mean_nothing_are_refused(small, wrong, fragment):
    with pytest.raises(ValueError, match=fragment):
        nil_mitsuba.render(small, **wrong)


# ------------------------------------------------------------------ checkpoints


def test_a_resumed_still_is_the_uninterrupted_one(small, tmp_path):
    path = tmp_path / "a.sums"
    whole = nil_mitsuba.render(small, spp=96, noise=1e-9, seed=2)
    nil_mitsuba.render(small, spp=32, noise=1e-9, seed=2, checkpoint=path)
    again = []
    image = nil_mitsuba.render(small, spp=96, noise=1e-9, seed=2, checkpoint=path, resume=True,
                               progress=again.append)
    assert [r.samples for r in again] == [32, 48, 64, 80, 96]
    assert equal(image, whole)


def test_seconds_count_what_was_done_before(small, tmp_path):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, seconds=0.2, checkpoint=path)
    reports = []
    nil_mitsuba.render(small, seconds=0.2, checkpoint=path, resume=True, progress=reports.append)
    assert len(reports) == 1 and reports[0].seconds >= 0.2


def test_a_checkpoint_is_not_overwritten_by_accident(small, tmp_path):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    contents = path.read_bytes()
    with pytest.raises(FileExistsError, match="resume"):
        nil_mitsuba.render(small, spp=16, checkpoint=path)
    assert path.read_bytes() == contents


def test_with_nothing_to_resume_it_begins_at_the_beginning(small, tmp_path):
    image = nil_mitsuba.render(small, spp=16, checkpoint=tmp_path / "a.sums", resume=True)
    assert equal(image, nil_mitsuba.render(small, spp=16))


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_what_a_callback_raises_loses_no_pass(small, tmp_path, error):
    def fail(progress):
        if progress.passes == 2:
            raise error("of its own")

    path = tmp_path / "a.sums"
    with pytest.raises(error, match="of its own"):
        nil_mitsuba.render(small, spp=96, noise=1e-9, checkpoint=path, progress=fail)
    assert checkpoint.load(path).sums.passes == ((0, 2),)


def test_renders_in_between_change_no_scene(small, tmp_path):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    depth = mi.load_dict({"type": "aov", "aovs": "d:depth"})
    mi.render(small, spp=33)
    mi.render(small, spp=9, integrator=depth)
    image = nil_mitsuba.render(small, spp=32, checkpoint=path, resume=True)
    assert image.shape == (8, 8, 3)
    assert checkpoint.load(path).sums.passes == ((0, 2),)


def test_whole_numbers_may_be_of_any_kind(small, tmp_path):
    class Whole:  # as NumPy's, which JSON does not know
        def __index__(self):
            return 1

    path = tmp_path / "a.sums"
    image = nil_mitsuba.render(small, spp=16, seed=Whole(), checkpoint=path)
    assert checkpoint.load(path).settings["seed"] == 1
    assert equal(image, nil_mitsuba.render(small, spp=16, seed=1))


CHANGES = {
    "twist": (lambda: mi.load_dict(description(twist=2)), {}, "twist is 1.0 there and 2.0 here"),
    "size": (lambda: mi.load_dict(description(9)), {}, "size is 8,8 there and 9,9 here"),
    "layers": (lambda: mi.load_dict(description(aovs="shape")), {}, "layers is none there"),
    "seed": (lambda: mi.load_dict(description()), {"seed": 1}, "seed is 0 there and 1 here"),
    "scene": (lambda: mi.load_dict(description() | {"sky": {"type": "constant", "radiance": 0.2}}),
              {}, "the scene or a file that it names has changed"),
}  # fmt: skip


@pytest.mark.parametrize("what", CHANGES)
def test_the_checkpoint_of_another_still_is_refused_in_a_sentence(small, tmp_path, what):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    contents = path.read_bytes()
    make, arguments, sentence = CHANGES[what]
    with pytest.raises(ValueError, match=f"cannot go on with .*{sentence}"):
        nil_mitsuba.render(make(), spp=32, checkpoint=path, resume=True, **arguments)
    assert path.read_bytes() == contents


def test_the_checkpoint_of_another_version_is_refused_in_a_sentence(small, tmp_path, monkeypatch):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    monkeypatch.setattr(stills, "__version__", "9.9")
    with pytest.raises(ValueError, match="cannot go on with .*nil_mitsuba is .* and 9.9 here"):
        nil_mitsuba.render(small, spp=32, checkpoint=path, resume=True)


def test_damaged_checkpoints_are_refused_in_a_sentence(small, tmp_path):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[-1000] ^= 1
    for contents in (whole[:-1], whole[:100], whole[:25], bytes(flipped), whole + b"\0"):
        path.write_bytes(contents)
        with pytest.raises(ValueError, match='a.sums" is damaged'):
            nil_mitsuba.render(small, spp=32, checkpoint=path, resume=True)
    for contents in (b"", b"something else"):
        path.write_bytes(contents)
        with pytest.raises(ValueError, match='a.sums" is no checkpoint'):
            nil_mitsuba.render(small, spp=32, checkpoint=path, resume=True)


def test_a_checkpoint_is_read_as_it_was_written(rgb):
    still = still_of(mi.load_dict(description(aovs="distance, cell, samples")))
    state = sums_of(still, 0, 2)
    state.seconds, state.about = 0.1, {"scene": "Größe \ud800"}
    back = checkpoint.Checkpoint.from_bytes(state.to_bytes())
    assert (back.settings, back.seconds, back.about) == (state.settings, 0.1, state.about)
    assert back.sums.passes == ((0, 1), (2, 3))
    for name in ("values", "moments", "points"):
        assert equal(getattr(back.sums, name), getattr(state.sums, name))


@pytest.mark.parametrize("pass_seconds, write_seconds", [(0.3, 0.1), (7, 2), (25, 6), (40, 1)])
def test_a_checkpoint_is_never_older_than_a_minute(monkeypatch, pass_seconds, write_seconds):
    now, state_at, saved_at, oldest = [0.0], [0.0], [0.0], [0.0]

    def write(_path, _state):
        now[0] += write_seconds
        oldest[0] = max(oldest[0], now[0] - saved_at[0])
        saved_at[0] = state_at[0]

    monkeypatch.setattr(stills.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(checkpoint, "save", write)
    saver = stills.Saver("a.sums", pytest.fail)
    writes = 0
    while now[0] < 1000:
        now[0] += pass_seconds
        state_at[0] = now[0]
        before = now[0]
        saver.after_pass(None)
        writes += now[0] > before
    # The first writing takes by surprise
    assert oldest[0] <= 60 + write_seconds
    assert writes <= 1000 / (60 - 2 * pass_seconds - 2 * write_seconds) if pass_seconds < 20 else 1


def test_a_full_disk_costs_no_samples(small, tmp_path, monkeypatch):
    path = tmp_path / "a.sums"
    whole = nil_mitsuba.render(small, spp=64, noise=1e-9)
    nil_mitsuba.render(small, spp=16, noise=1e-9, checkpoint=path)
    contents = path.read_bytes()
    monkeypatch.setattr(stills, "CHECKPOINT_SECONDS", 0.0)  # after each pass
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.warns(UserWarning, match='cannot write ".*a.sums": File too large') as warned:
            image = nil_mitsuba.render(small, spp=64, noise=1e-9, checkpoint=path, resume=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(warned) == 1
    assert equal(image, whole)
    assert path.read_bytes() == contents and list(tmp_path.iterdir()) == [path]


# --------------------------------------------------------------- interruptions


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


def command(folder, *arguments, interval=60, **options):
    """Start `nil-mitsuba` with checkpoints every ``interval`` seconds, as a process of its own."""
    code = (
        f"from nil_mitsuba import cli, stills\nstills.CHECKPOINT_SECONDS = {interval}\n"
        "stills.LOOK_SAMPLES = 12 * 12 * 16\ncli.main()"
    )
    return subprocess.Popen([sys.executable, "-c", code, *arguments], cwd=folder, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)


def wait_for(path, process, seconds=100):
    end = time.monotonic() + seconds
    while not path.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.05)


def pixels(path):
    return mi.TensorXf(mi.Bitmap(str(path)))


def test_a_terminated_process_writes_the_picture_so_far_and_can_be_resumed(folder):
    arguments = ["render", "scene.xml", "--noise", "1e-9", "--spp", "160000"]
    process = command(folder, *arguments, interval=0)
    wait_for(folder / "scene.sums", process)
    process.terminate()
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (143, "scene.exr\n"), err
    assert "nil-mitsuba: interrupted at " in err and '--resume goes on from "scene.sums"' in err
    state = checkpoint.load(folder / "scene.sums")
    done = state.sums.count * 16
    assert 0 < done < 160000 and pixels(folder / "scene.exr").shape == (12, 12, 3)

    arguments[-1] = str(done + 160)
    process = command(folder, *arguments, "--resume")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "scene.exr\n", "")
    assert not (folder / "scene.sums").exists()
    whole = command(folder, *arguments, "-o", "whole.exr")
    assert whole.wait(60) == 0
    assert equal(pixels(folder / "scene.exr"), pixels(folder / "whole.exr"))


@pytest.mark.verify
def test_killed_at_any_moment_it_loses_no_checkpoint(folder):
    # Killed while it loads, renders or writes; a checkpoint after each pass, so that about one in
    # three of the kills falls into its writing.
    arguments = ["render", "scene.xml", "-D", "resolution=200", "--noise", "1e-9", "--spp", "150"]
    random.seed(1)
    path, passes, kills = folder / "scene.sums", [0], 0
    while kills < 20:
        process = command(folder, *arguments, "--resume", interval=0)
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
    assert command(folder, *arguments, "--resume").wait(600) == 0
    assert command(folder, *arguments, "-o", "whole.exr").wait(600) == 0
    assert equal(pixels(folder / "scene.exr"), pixels(folder / "whole.exr"))


@pytest.mark.verify
def test_full_hd_stays_below_4_gibibytes(folder):
    code = (
        "import resource, sys\nfrom nil_mitsuba import cli\n"
        "try: cli.main()\nfinally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    sizes = []
    for spp in ("2", "6"):  # the second pass meets the sums of the first
        run = subprocess.run(
            [sys.executable, "-c", code, "render", str(HERE.parent / "scenes" / "cornell-box.xml"),
             "-D", "resx=1920", "-D", "resy=1080", "-P", "max_depth=2", "--spp", spp,
             "-o", str(folder / "a.exr"),
             "--layers", "distance,position,normal,albedo,cell,shape,samples"],
            capture_output=True, text=True, timeout=600,
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
        sizes.append(int(run.stdout.split()[-1]))  # KiB
    assert sizes[1] < 4 * 2**20
    assert sizes[1] < 1.1 * sizes[0]


# ------------------------------------------------------------------------ parts


def test_parts_of_processes_of_their_own_merge_to_the_whole(folder):
    job = Job(str(folder / "scene.xml"), spp=64, pass_spp=16, seed=7)
    still = jobs.open_still(job)
    job = Job(job.path, spp=64, pass_spp=16, seed=7, scene_hash=still.settings["scene"])
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
    (folder / "triangle.obj").write_text(TRIANGLE.replace(".9", ".8"))
    jobs._opened.clear()
    with pytest.raises(ValueError, match="differs"):
        jobs.render_part(job, 0, 1)


@pytest.mark.parametrize(
    "passes, count, gaps",
    [(((0, 4),), 4, []), (((1, 2), (3, 4)), 6, [(0, 1), (2, 3), (4, 6)]), ((), 2, [(0, 2)]),
     (((0, 8),), 4, [])],
)  # fmt: skip
def test_missing_passes_are_named(small, passes, count, gaps):
    state = still_of(small).nothing()
    state.sums.passes, state.about = passes, {"count": count}
    assert stills.missing(state) == gaps


def test_the_hash_of_a_scene_tells_what_it_shows(folder):
    def scene_hash(**parameters):
        return SceneFiles("scene.xml", parameters, {}).hash

    resolver = mi.file_resolver()
    here = os.getcwd()
    os.chdir(folder)
    mi.set_file_resolver(mi.FileResolver())
    try:
        plain = scene_hash()
        assert scene_hash(spp="99") == plain and scene_hash(twist="2") == plain
        assert scene_hash(resolution="13") != plain
        (folder / "triangle.obj").write_text(TRIANGLE.replace(".9", ".8"))
        assert scene_hash() != plain
    finally:
        os.chdir(here)
        mi.set_file_resolver(resolver)


def test_a_scene_made_in_python_has_the_same_hash_in_every_process(small, fresh_python):
    code = (
        "import nil_mitsuba, mitsuba as mi\nmi.set_variant('llvm_ad_rgb')\n"
        "import test_stills\nfrom nil_mitsuba import stills\n"
        "print(stills.hash_of(mi.load_dict(test_stills.description())))"
    )
    run = fresh_python(code, PYTHONPATH="tests")
    assert run.stdout.strip() == stills.hash_of(small), run.stderr


def test_settings_are_plain_values(small):
    settings = still_of(small).settings
    assert json.loads(json.dumps(settings)) == settings
