"""The denoiser takes noise and nothing else."""

import sys

import drjit as dr
import mitsuba as mi
import pytest

from images import equal, random_image
from nil_mitsuba import denoise

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.fixture
def oidn():
    return pytest.importorskip("mitsuba_oidn")


def edge(height, width, samples, seed=0):
    """A bright half beside a dark one: as it is, and with the noise of `samples` per pixel."""
    index = dr.arange(mi.UInt32, height * width * 3)
    truth = dr.select((index // 3) % width < width // 2, mi.Float(0.1), 2)
    light = dr.zeros(mi.Float, dr.width(index))
    rng = mi.PCG32(dr.width(index), initstate=seed)
    for _ in range(samples):
        light -= dr.log(1 - rng.next_float32())  # mean 1, variance 1
    shape = (height, width, 3)
    return mi.TensorXf(truth, shape), mi.TensorXf(truth * light / samples, shape)


def relative_mse(image, truth):
    return dr.mean((dr.square(image - truth) / (dr.square(truth) + 0.01)).array)[0]


@pytest.mark.parametrize("height, width", [(64, 96), (37, 53)])
def test_denoising_takes_the_noise_and_leaves_mean_and_alpha(oidn, height, width):
    truth, noisy = edge(height, width, samples=8)
    alpha = random_image(1, 5, height, width)
    clean = denoise.denoise(dr.concat((noisy, alpha), axis=2))
    assert clean.shape == (height, width, 4) and type(clean) is type(noisy)
    assert equal(clean[:, :, 3:], alpha)
    assert relative_mse(clean[:, :, :3], truth) < relative_mse(noisy, truth) / 15
    half = width // 2
    for side in (slice(0, half - 2), slice(half + 2, width)):
        means = [dr.mean(image[:, side, :3].array)[0] for image in (clean, truth)]
        assert means[0] == pytest.approx(means[1], rel=0.03)


def test_albedo_and_normals_keep_what_noise_would_hide(oidn):
    height, width = 64, 96
    _, noisy = edge(height, width, samples=4)
    index = dr.arange(mi.UInt32, height * width)
    checks = dr.select(((index % width) // 4 + (index // width) // 4) % 2 == 0, mi.Float(0.4), 0.6)
    albedo = mi.TensorXf(dr.repeat(checks, 3), (height, width, 3))
    normal = mi.TensorXf(dr.tile(mi.Float(0, 0, 1), height * width), albedo.shape)
    truth, noise = edge(height, width, samples=4)
    truth, noisy = albedo, albedo * noise / truth
    plain = relative_mse(denoise.denoise(noisy), truth)
    guided = relative_mse(denoise.denoise(noisy, albedo, normal), truth)
    assert guided < plain / 3


@pytest.mark.verify
def test_denoising_a_render_needs_the_box_filter(oidn):
    """Other filters spread a sample over several pixels, and their noise looks like texture."""
    gains = {}
    for name in ("box", "gaussian"):
        description = mi.cornell_box()
        film = {"type": "hdrfilm", "width": 128, "height": 128}
        description["sensor"]["film"] = film | {"rfilter": {"type": name}}
        scene = mi.load_dict(description)
        layers = {"type": "aov", "aovs": "a:albedo,n:sh_normal", "image": {"type": "path"}}
        truth = mi.render(scene, spp=1024, seed=1)
        noisy = mi.render(scene, integrator=mi.load_dict(layers), spp=16)
        image, albedo, normal = (noisy[:, :, i : i + 3] for i in (0, 3, 6))
        clean = denoise.denoise(image, albedo, normal)
        gains[name] = relative_mse(image, truth) / relative_mse(clean, truth)
        means = [dr.mean(x.array)[0] for x in (clean, truth)]
        assert means[0] == pytest.approx(means[1], rel=0.02)
    print("relative squared error falls by", gains)
    assert gains["box"] > 5 and gains["gaussian"] < 2


def test_denoising_does_not_darken_the_border(oidn):
    for size in ((1, 1, 3), (5, 40, 3), (37, 53, 3)):
        clean = denoise.denoise(dr.full(mi.TensorXf, 0.5, size))
        assert clean.shape == size
        assert dr.all(dr.abs(clean - 0.5).array < 0.01)


def test_pixels_that_are_not_finite_do_not_spread(oidn):
    image = dr.full(mi.TensorXf, 0.5, (40, 50, 3))
    image[10, 20, 0] = float("nan")
    image[30, 20, 1] = float("inf")
    clean = denoise.denoise(image)
    assert dr.all(dr.isfinite(clean.array)) and dr.max(clean.array) < 0.6


def test_denoising_loads_no_numpy(oidn, fresh_python):
    done = fresh_python(
        "import sys, nil_mitsuba, mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "from nil_mitsuba.denoise import denoise\n"
        "image = mi.TensorXf([0.5] * 300, (10, 10, 3))\n"
        "denoise(image, image, image)\n"
        "assert 'numpy' not in sys.modules\n"
    )
    assert done.returncode == 0, done.stderr


def test_a_missing_denoiser_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(ImportError, match=r"pip install 'nil-mitsuba\[denoise\]'"):
        denoise.denoise(random_image(3))


def test_pictures_that_cannot_be_denoised_are_named(oidn):
    image = random_image(3)
    with pytest.raises(ValueError, match="this picture has 2 channels"):
        denoise.denoise(random_image(2))
    with pytest.raises(ValueError, match="needs the albedo, too"):
        denoise.denoise(image, normal=image)
    with pytest.raises(ValueError, match=r"albedo of the shape \(37, 53, 3\)"):
        denoise.denoise(image, random_image(1), image)
