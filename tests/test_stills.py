"""Stills: when they end, how noisy they are, and how they go on."""

import json
import math
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import pytest

import nil_mitsuba
from benchmarks.worker import alone
from conftest import ROOT
from nil_mitsuba import checkpoint, stills
from nil_mitsuba.sums import name_noise
from small_stills import description, equal, still_of, sums_of


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

    assert left(100, 10.0, 0.4) == 30  # samples: three times as long again
    assert left(10, 10.0, 1.0) == 40  # time
    assert left(100, 10.0, 0.15) == pytest.approx(12.5)  # 10 (1.5² − 1)
    assert left(0, 0.0, None, stills.Rules(spp=3)) is None
    assert left(100, 10.0, 0.15, stills.Rules(noise=1e-200)) == math.inf


@pytest.mark.parametrize(
    "rfilter, spp, pass_spp",
    [
        ("box", 64, 16),
        ("box", 32, 16),
        ("box", 31, 31),
        pytest.param("gaussian", 64, 16, marks=pytest.mark.verify),
        pytest.param("gaussian", 64, 64, marks=pytest.mark.verify),
    ],
)
def test_noise_is_the_spread_of_renders_with_other_seeds(rgb, rfilter, spp, pass_spp):
    # Each of 48 renders differs from their mean as it says that it does: the squares agree within
    # 25 %, the noise therefore within 13 %. An estimate that is further off passes once in 4,300
    # sets of seeds (3.5 standard errors on one side). 32 samples are two passes of 16, the fewest
    # that can be compared; 31 are one, which is judged by its halves.
    scene = mi.load_dict(description(16, rfilter, twist=0, quotient=False))  # quick
    count = 48
    renders = [luminances(scene, spp, pass_spp, seed) for seed in range(count)]
    mean = sum(image for image, _ in renders) / count
    scale = dr.maximum(mean, dr.mean(mean))
    differences = []
    for image, estimate in renders:
        spread = dr.mean(dr.square((image - mean) / scale))[0] * count / (count - 1)
        differences.append(estimate**2 - spread)
    difference = sum(differences) / count
    error = math.sqrt(sum((d - difference) ** 2 for d in differences) / (count - 1) / count)
    square = sum(estimate**2 for _, estimate in renders) / count
    assert abs(difference) + 3.5 * error < 0.25 * square


def luminances(scene, spp, pass_spp, seed):
    """Luminance of each pixel, and the estimated noise."""
    from nil_mitsuba.sums import luminance

    still = still_of(scene, spp, pass_spp, seed)
    state = sums_of(still, *range(still.count))
    total, weight = luminance(still.film, state.sums.values)
    return mi.Float(total / weight), state.noise or stills.noise(still.film, state.sums)


def test_judging_a_pass_by_its_halves_changes_no_bit_of_the_picture(rgb):
    scene = mi.load_dict(description(8, "box"))  # others add samples up in any order
    one = sums_of(still_of(scene, 16, 16), 0)
    assert one.noise > 0
    # As the first of two passes it is not judged
    first = sums_of(still_of(scene, 32, 16), 0)
    assert first.noise is None
    for name in ("values", "moments", "points"):
        assert equal(getattr(one.sums, name), getattr(first.sums, name))


def with_luminances(still, *passes):
    """Sums of passes in each of which all pixels have one value."""
    state = still.nothing()
    for index, value in enumerate(passes):
        sums = still.nothing().sums
        sums.values += value
        weights = dr.arange(mi.UInt32, 8 * 8) * 4 + 3
        dr.scatter(sums.values.array, mi.Float64(1), weights)
        sums.moments, sums.passes = still.passes._moments(sums.values), ((index, index + 1),)
        state = state.plus(checkpoint.Checkpoint(still.settings, sums))
    return state


def test_noise_of_passes_that_differ_by_a_known_amount(small):
    still = still_of(small)
    # Standard error of the mean of 1 and 3: 1, half of that mean
    assert stills.noise(still.film, with_luminances(still, 1, 3).sums) == pytest.approx(0.5)
    below_black = with_luminances(still, -1, -3).sums
    assert stills.noise(still.film, below_black) == pytest.approx(0.5)
    for black in ((0, 0), (0, 0, 0)):
        assert stills.noise(still.film, with_luminances(still, *black).sums) == 0
    for few in ((), (1,)):
        assert stills.noise(still.film, with_luminances(still, *few).sums) is None


@pytest.mark.parametrize(
    "noise, passes, words",
    [
        (None, 0, "not estimated: no passes"),
        (None, 1, "not estimated: one pass"),
        (None, 2, "not stated"),  # as by an earlier version
        (0.02, 1, "0.02"),
        (0.0, 1, "0: both halves of the pass are equal"),
        (0.0, 2, "0: all passes are equal"),
        (math.inf, 2, "infinite: no pixel is finite"),
        (0.0123456, 2, "0.0123"),
        (1e-9, 9, "1e-09"),
    ],
)
def test_noise_is_told_or_why_it_is_not(noise, passes, words):
    assert name_noise(noise, passes) == words


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
    [
        ({"spp": 0}, "spp"),
        ({"spp": 1.5}, "spp"),
        ({"seconds": 0}, "seconds"),
        ({"noise": -1}, "noise"),
        ({"noise": math.nan}, "noise"),
        ({"seconds": math.inf}, "seconds"),
        ({"spp": math.nan}, "spp"),
        ({"spp": math.inf}, "spp"),
        ({"noise": "0.1"}, "noise"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**32}, "seed"),
        ({"sensor": 1}, "1 sensors"),
        ({"sensor": -1}, "1 sensors"),
    ],
)
def test_rules_that_mean_nothing_are_refused(small, wrong, fragment):
    with pytest.raises(ValueError, match=fragment):
        nil_mitsuba.render(small, **wrong)


def test_a_resumed_still_is_the_uninterrupted_one(small, tmp_path):
    path = tmp_path / "a.sums"
    whole = nil_mitsuba.render(small, spp=96, noise=1e-9, seed=2)
    nil_mitsuba.render(small, spp=32, noise=1e-9, seed=2, checkpoint=path)
    again = []
    image = nil_mitsuba.render(
        small, spp=96, noise=1e-9, seed=2, checkpoint=path, resume=True, progress=again.append
    )
    assert [r.samples for r in again] == [32, 48, 64, 80, 96]
    assert equal(image, whole)


def test_seconds_count_what_was_done_before(small, tmp_path):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, seconds=0.2, checkpoint=path)
    reports = []
    nil_mitsuba.render(small, seconds=0.2, checkpoint=path, resume=True, progress=reports.append)
    assert len(reports) == 1 and reports[0].seconds >= 0.2


def test_with_nothing_to_resume_it_begins_at_the_beginning(small, tmp_path):
    image = nil_mitsuba.render(small, spp=16, checkpoint=tmp_path / "a.sums", resume=True)
    assert equal(image, nil_mitsuba.render(small, spp=16))


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


@pytest.mark.parametrize(
    "passes, count, gaps",
    [
        (((0, 4),), 4, []),
        (((1, 2), (3, 4)), 6, [(0, 1), (2, 3), (4, 6)]),
        ((), 2, [(0, 2)]),
        (((0, 8),), 4, []),
    ],
)
def test_missing_passes_are_named(small, passes, count, gaps):
    state = still_of(small).nothing()
    state.sums.passes, state.about = passes, {"count": count}
    assert stills.missing(state) == gaps


def test_settings_are_plain_values(small):
    settings = still_of(small).settings
    assert json.loads(json.dumps(settings)) == settings


def test_a_scene_made_in_python_has_the_same_hash_in_every_process(small, fresh_python):
    code = (
        "import nil_mitsuba, mitsuba as mi\nmi.set_variant('llvm_ad_rgb')\n"
        "import small_stills\nfrom nil_mitsuba import stills\n"
        "print(stills.hash_of(mi.load_dict(small_stills.description())))"
    )
    run = fresh_python(code, PYTHONPATH="tests")
    assert run.stdout.strip() == stills.hash_of(small), run.stderr


@pytest.mark.verify
def test_full_hd_stays_below_4_gibibytes(still_folder):
    code = (
        "import resource, sys\nfrom nil_mitsuba import cli\n"
        "try: cli.main()\nfinally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    sizes = []
    for spp in ("2", "6"):  # the second pass meets the sums of the first
        run = subprocess.run(
            alone(
                [
                    sys.executable,
                    "-c",
                    code,
                    "render",
                    str(ROOT / "scenes" / "cornell-box.xml"),
                    "-D",
                    "resx=1920",
                    "-D",
                    "resy=1080",
                    "-P",
                    "max_depth=2",
                    "--spp",
                    spp,
                    "-o",
                    str(still_folder / "a.exr"),
                    "--layers",
                    "distance,position,normal,albedo,cell,shape,samples",
                ]
            ),
            capture_output=True,
            text=True,
            timeout=600,
        )
        assert run.returncode == 0, run.stderr
        sizes.append(int(run.stdout.split()[-1]))  # KiB
    assert sizes[1] < 4 * 2**20
    assert sizes[1] < 1.1 * sizes[0]
