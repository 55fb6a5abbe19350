"""Passes are traced in wavefronts, and the picture does not depend on where they are cut."""

import math
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import checkpoint, stills

# With a number of samples that they take as it is
SAMPLERS = {"multijitter": 16, "stratified": 16, "orthogonal": 25, "ldsampler": 16}


def description(size=16, sampler="independent", rfilter="box", film=(), **integrator):
    return {
        "type": "scene",
        "integrator": {"type": "nil", "max_depth": 3} | integrator,
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0.1, 0.1, 0.6], [0.7, 1, 0.4], [0, 0, 1]),
            "sampler": {"type": sampler},
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "component_format": "float32",
                "rfilter": {"type": rfilter},
            }
            | dict(film),
        },
        "sky": {"type": "constant", "radiance": 0.125},
        "lamp": {
            "type": "sphere",
            "center": [0.3, 0.4, 0.8],
            "radius": 0.1,
            "light": {"type": "area"},
        },
        "ball": {
            "type": "sphere",
            "center": [0.5, 0.5, 0.5],
            "radius": 0.2,
            "bsdf": {"type": "diffuse"},
        },
    }


@pytest.fixture
def module(rgb):
    from nil_mitsuba import passes  # of this variant

    return passes


@pytest.fixture
def cut(module, monkeypatch):
    """Gives all wavefronts one size, from here on; returns the list of those that are traced."""
    traced = []
    record = module.Passes._record

    def recorded(self, index, first):
        add, lanes = record(self, index, first)
        traced.append((first, lanes))
        return add, lanes

    monkeypatch.setattr(module.Passes, "_record", recorded)

    def cut(samples):
        monkeypatch.setattr(module, "FIRST_SAMPLES", samples)
        monkeypatch.setattr(module, "STEP_SAMPLES", samples)
        monkeypatch.setattr(module, "GROWTH", 1)
        monkeypatch.setattr(module, "_paces", WeakKeyDictionary())
        traced.clear()
        return traced

    return cut


BORDERED = {
    "sample_border": True,
    "crop_width": 9,
    "crop_height": 5,
    "crop_offset_x": 3,
    "crop_offset_y": 7,
}


@pytest.mark.parametrize(
    "scene",
    [
        {},
        {"rfilter": "gaussian", "film": BORDERED},
        {"aovs": "distance, position, cell, shape, samples"},
    ],
    ids=["box", "border", "layers"],
)
def test_the_picture_is_the_same_wherever_wavefronts_are_cut(rgb, cut, scene):
    loaded = mi.load_dict(description(**scene))
    cut(2**14)
    whole = mi.render(loaded, spp=12, seed=3)
    for samples in (600, 63):  # the last also cuts off a single sample
        traced = cut(samples)
        image = mi.render(loaded, spp=12, seed=3)
        assert len(traced) >= (2 if samples > 63 else 20)
        assert dr.allclose(image, whole, rtol=1e-5, atol=1e-6)


def test_a_single_pixel_is_cut(rgb, cut):
    loaded = mi.load_dict(description(1))
    cut(2**21)
    whole = mi.render(loaded, spp=2**14)
    traced = cut(3000)
    image = mi.render(loaded, spp=2**14)
    assert len(traced) == 5
    assert dr.allclose(image, whole, rtol=1e-4)  # 2^14 float32 numbers, added up


def test_two_million_samples_of_a_pixel_are_not_one_wavefront(rgb, cut, module, monkeypatch):
    monkeypatch.setattr(module, "WAVEFRONT_SECONDS", 0.02)
    sky = {key: value for key, value in description(1).items() if key not in ("lamp", "ball")}
    loaded, traced = mi.load_dict(sky), cut(2**16)
    image = mi.render(loaded, spp=2**21)
    assert len(traced) > 8 and sum(lanes for _, lanes in traced) == 2**21
    assert dr.allclose(image, 0.125)  # eighths add up exactly


def test_wavefronts_follow_the_clock(rgb, cut, module, monkeypatch):
    traced = cut(64)
    loaded = mi.load_dict(description())
    monkeypatch.setattr(module, "GROWTH", 4)
    monkeypatch.setattr(module, "WAVEFRONT_SECONDS", 1e9)
    mi.render(loaded, spp=16)
    # The first may be compiled, and is no measure; each is cut before the last one is done
    assert [lanes for _, lanes in traced][:6] == [64, 64, 64, 256, 256, 1152]
    assert [first for first, _ in traced[1:]] == [first + lanes for first, lanes in traced[:-1]]

    cut(64)
    monkeypatch.setattr(module, "FIRST_SAMPLES", 1024)
    monkeypatch.setattr(module, "WAVEFRONT_SECONDS", 1e-9)
    mi.render(loaded, spp=16)
    assert [lanes for _, lanes in traced] == [1024, 1024, 1024, *16 * [64]]
    # The next render begins at the pace of the last
    traced.clear()
    mi.render(loaded, spp=16)
    assert [lanes for _, lanes in traced] == 64 * [64]


def test_no_size_of_a_wavefront_compiles_anything(rgb, cut):
    loaded = mi.load_dict(description(aovs="shape, position"))
    hashes = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for samples in (1000, 100, 77, 2**14):
            cut(samples)
            dr.kernel_history_clear()
            mi.render(loaded, spp=13)
            hashes.append({entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])})
    assert all(further <= hashes[0] for further in hashes[1:])


@pytest.mark.parametrize("quotient", [True, False])
def test_no_pass_compiles_anything_after_the_first(rgb, quotient):
    from nil_mitsuba.passes import Passes

    loaded = mi.load_dict(description(quotient=quotient))
    passes = Passes(loaded.integrator(), loaded, 0, pass_spp=16)
    hashes = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for index in range(3):
            dr.kernel_history_clear()
            passes.render(index)
            hashes.append({entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])})
    assert all(further <= hashes[0] for further in hashes[1:])


def test_layers_come_from_the_paths_of_the_picture(rgb, cut):
    loaded = mi.load_dict(description(aovs="cell, shape, position"))
    cut(100)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        mi.render(loaded, spp=1)
        history = dr.kernel_history([dr.KernelType.JIT])
    assert len([entry for entry in history if entry["operation_count"] > 500]) == 3


def test_parts_and_what_is_resumed_may_be_cut_otherwise(rgb, cut, tmp_path):
    loaded = mi.load_dict(description(aovs="cell"))
    rules = stills.Rules(spp=32)
    cut(2**14)
    still = stills.Still(loaded, seed=7, rules=rules, pass_spp=8)
    whole = still.nothing()
    for index in range(4):
        whole = whole.plus(still.render(index))

    cut(500)
    parts = stills.Still(loaded, seed=7, rules=rules, pass_spp=8)
    state = parts.render(2).plus(parts.render(0))
    checkpoint.save(tmp_path / "a.sums", state)
    cut(64)
    again = stills.Still(loaded, seed=7, rules=rules, pass_spp=8)
    state = again.start(tmp_path / "a.sums", resume=True)
    for index in list(again.todo(state, stop=4)):
        state = state.plus(again.render(index))
    assert state.sums.passes == ((0, 4),)
    assert dr.allclose(again.develop(state), still.develop(whole), rtol=1e-5, atol=1e-6)


def test_sums_with_other_random_numbers_are_refused(rgb, tmp_path):
    path = tmp_path / "a.sums"
    still = stills.Still(mi.load_dict(description(4)), rules=stills.Rules(spp=4))
    data = still.render(0).to_bytes()
    path.write_bytes(data.replace(b"sums 2", b"sums 1", 1))
    for read in (checkpoint.load, checkpoint.peek, checkpoint.describe):
        with pytest.raises(ValueError, match="a.sums.* other random numbers, by an earlier"):
            read(path)


# ---------------------------------------------------------------- other samplers


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_tiles_of_other_samplers_follow_from_the_settings_alone(
    rgb, cut, module, monkeypatch, sampler
):
    loaded = mi.load_dict(description(sampler=sampler))
    spp = SAMPLERS[sampler]
    monkeypatch.setattr(module, "TILE_SAMPLES", spp * 60)  # 256 pixels: five tiles of 52
    images, sizes = [], []
    for samples, seconds in ((64, 1e9), (1024, 1e-9)):
        traced = cut(samples)
        monkeypatch.setattr(module, "WAVEFRONT_SECONDS", seconds)
        images.append(mi.render(loaded, spp=spp, seed=1))
        sizes.append(list(traced))
    assert sizes[0] == sizes[1] == [(i * 52 * spp, 52 * spp) for i in range(5)]
    assert dr.allclose(images[0], images[1], rtol=1e-5)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_tiles_are_images_of_the_same_scene(rgb, module, monkeypatch, sampler):
    # Under the sky alone all samples are equal: a pixel that a tile left out, or drew twice, shows
    sky = {
        key: value
        for key, value in description(sampler=sampler).items()
        if key not in ("lamp", "ball")
    }
    spp = SAMPLERS[sampler]
    monkeypatch.setattr(module, "TILE_SAMPLES", spp * 60)
    loaded = mi.load_dict(sky)
    passes = module.Passes(loaded.integrator(), loaded, spp=spp)
    values = passes.render(0).values.array
    channels = len(values) // 256
    weights = dr.gather(mi.Float64, values, dr.arange(mi.UInt32, 256) * channels + channels - 1)
    assert dr.all(weights == spp)
    assert dr.allclose(mi.render(loaded, spp=spp), 0.125)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_many_samples_of_a_pixel_are_several_passes_of_a_tile(rgb, module, monkeypatch, sampler):
    spp = SAMPLERS[sampler]
    monkeypatch.setattr(module, "TILE_SAMPLES", spp)
    loaded = mi.load_dict(description(1, sampler))
    passes = module.Passes(loaded.integrator(), loaded, spp=4 * spp)
    assert (passes.spp, passes.count) == (spp, 4)


# ------------------------------------------------------------------------ seeds


def streams(module, seed, index, samples, first=0):
    """Two random numbers of each of a pass's samples."""
    sampler = mi.load_dict({"type": "independent"})
    number = dr.arange(mi.UInt32, samples) + first
    sampler.seed(module.sample_seeds(seed, index, number), 1)
    return sampler.next_1d(), sampler.next_1d()


def test_numbers_of_neighbours_are_not_correlated(module):
    # 47 scores of mean products; sound streams exceed 4.5 once in 3,100 runs
    count = 2**20
    here, then = (x - 0.5 for x in streams(module, 5, 0, count))

    def score(other):
        return dr.sum(here * other)[0] * 12 / math.sqrt(count)  # 1/12: the variance of both

    scores = [score(then)]
    for lag in (1, 2, 3, 4, 7, 8, 16, 31, 64, 100, 256, 512, 1000, 1024, 2**14, 2**16, 2**19):
        for other in streams(module, 5, 0, count, lag):
            scores.append(score(other - 0.5))
    for seed, index in ((5, 1), (5, 2), (6, 0), (4, 0), (5 + 2**16, 0), (0, 0)):
        for other in streams(module, seed, index, count):
            scores.append(score(other - 0.5))
    assert max(map(abs, scores)) < 4.5, scores


def test_hardly_any_samples_have_the_same_numbers(module):
    # 2^18 of 2^32 seeds: 8 pairs are expected, more than 24 once in 400,000 runs
    for index in (0, 1):
        seeds = module.sample_seeds(0, index, dr.arange(mi.UInt32, 2**18))
        assert 2**18 - len(set(seeds)) <= 24


def test_pixels_and_passes_are_independent(rgb, module):
    """Errors of the mean of all pixels and of single ones are as large as independent ones.

    Over 64 passes a variance is known to 18 %; sound ones fail once in 1,000 runs.
    """
    loaded = mi.load_dict(description(16))
    passes = module.Passes(loaded.integrator(), loaded, seed=1, spp=64 * 4, pass_spp=4)
    totals, squares, sums = [], mi.Float64(0), mi.Float64(0)
    for index in range(64):
        values, weight = module.luminance(passes.film, passes.render(index).values)
        pixel = values / weight
        totals.append(dr.mean(pixel)[0])
        sums += pixel
        squares += dr.square(pixel)
        dr.eval(sums, squares)
    pixel_variance = dr.sum((squares - dr.square(sums) / 64) / 63)[0] / 256**2
    mean = sum(totals) / 64
    variance = sum((total - mean) ** 2 for total in totals) / 63
    assert 0.5 < variance / pixel_variance < 1.75
