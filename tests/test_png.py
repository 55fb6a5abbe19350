"""PNG files: levels, dithering, the filmic curve."""

import drjit as dr
import mitsuba as mi
import pytest

from images import equal, random_image
from nil_mitsuba import png

pytestmark = pytest.mark.usefixtures("rgb")


def linear(level):
    return dr.srgb_to_linear(level / 255)


def test_dithering_keeps_the_mean_between_two_levels():
    """Steps of a tenth of a level, each 16 pixels square; without dithering they are lost."""
    steps, side = 30, 16
    index = dr.arange(mi.UInt32, steps * side * side)
    level = 100 + mi.Float((index % (steps * side)) // side) / 10
    image = mi.TensorXf(linear(level), (side, steps * side, 1))

    def worst(dither, block):
        pixels = mi.TensorXf(png.levels(image, dither=dither))
        error = (pixels - mi.TensorXf(level, image.shape)).array
        x, y = index % (steps * side) // block, index // (steps * side) // block
        sums = dr.zeros(mi.Float, steps * side * side // block**2)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, error, y * (steps * side // block) + x)
        return dr.max(dr.abs(sums))[0] / block**2

    assert worst(False, 16) > 0.45
    assert worst(True, 16) < 0.03
    assert worst(True, 4) < 0.15


def test_what_lies_on_a_level_stays_on_it():
    level = mi.Float(dr.arange(mi.UInt32, 256))
    image = mi.TensorXf(dr.repeat(linear(level), 1000), (256, 1000, 1))
    expected = mi.TensorXf(dr.repeat(level, 1000), image.shape)
    assert equal(mi.TensorXf(png.levels(image)), expected)


def test_one_stop_more_doubles_the_light():
    image = random_image(3)
    for filmic in (False, True):
        brighter = png.levels(image, exposure=1, filmic=filmic)
        assert equal(brighter, png.levels(2 * image, filmic=filmic))
        assert not equal(brighter, png.levels(image, filmic=filmic))
    assert equal(png.levels(image, exposure=-2), png.levels(image / 4))


def test_the_filmic_curve_is_the_published_one_and_leaves_mid_grey_alone():
    x = mi.Float(1, 0.5) / png.CURVE_SCALE
    published = (2.51 + 0.03) / (2.43 + 0.59 + 0.14), (0.6275 + 0.015) / (0.6075 + 0.295 + 0.14)
    assert dr.allclose(png.filmic_curve(x), mi.Float(published))
    assert dr.allclose(png.filmic_curve(mi.Float(0.18)), 0.18, rtol=1e-5)


def test_the_filmic_curve_rises_from_black_to_white():
    x = dr.linspace(mi.Float, 0, 20, 100001)
    y = png.filmic_curve(x)
    index = dr.arange(mi.UInt32, 100000)
    assert dr.all(dr.gather(mi.Float, y, index) <= dr.gather(mi.Float, y, index + 1))
    assert y[0] == 0 and y[100000] == 1
    assert y[50000] > 0.99 and y[2500] < 0.8


def test_values_without_a_colour_are_black_or_white():
    inf, nan = float("inf"), float("nan")
    image = mi.TensorXf([nan, -1, -inf, 0, 1, 1.5, 1e30, inf], (1, 8, 1))
    for filmic in (False, True):
        pixels = list(mi.Float(png.levels(image, filmic=filmic).array))
        assert pixels[:4] == [0] * 4 and pixels[6:] == [255] * 2
    assert list(mi.Float(png.levels(image).array)) == [0] * 4 + [255] * 4


def test_alpha_is_taken_out_of_the_colours():
    image = mi.TensorXf([0.25, 0.25, 0.1, 0.5, 0, 0, 0, 0, 0.3, 0.2, 0.1, 1], (1, 3, 4))
    pixels = list(mi.Float(png.levels(image, dither=False).array))
    half = round(255 * 0.7353569)  # sRGB of 0.5
    assert pixels[:2] == [half, half] and pixels[3] == 128
    assert pixels[4:8] == [0] * 4
    assert pixels[8:] == [*mi.Float(png.levels(image[:, 2:, :3], dither=False).array), 255]


@pytest.mark.parametrize("channels, pixel_format", [(1, "Y"), (2, "YA"), (3, "RGB"), (4, "RGBA")])
def test_the_file_holds_the_levels(tmp_path, channels, pixel_format):
    image = random_image(channels)
    png.write(tmp_path / "a.png", image, exposure=0.5, filmic=True)
    bitmap = mi.Bitmap(str(tmp_path / "a.png"))
    assert bitmap.pixel_format() == getattr(mi.Bitmap.PixelFormat, pixel_format)
    assert bitmap.srgb_gamma()
    pixels = mi.TensorXf(mi.TensorXu8(bitmap))
    assert equal(pixels, mi.TensorXf(png.levels(image, exposure=0.5, filmic=True)))


def test_texts_in_a_file_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "a.png"
    texts = {"flight": '{"key": [1.5, "a \\"word\\"", null], "x": ""}', "long": "abc " * 10_000}
    png.write(path, random_image(3), texts=texts)
    found = png.texts_of(path)
    assert {name: found[name] for name in texts} == texts
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(ValueError, match='a.png" is damaged'):
        png.texts_of(path)
    path.write_bytes(b"\x76\x2f\x31\x01")
    with pytest.raises(ValueError, match='a.png" is not a PNG file'):
        png.texts_of(path)
    with pytest.raises(OSError, match="cannot read .*none.png.*No such file"):
        png.texts_of(tmp_path / "none.png")


def test_bad_exposures_and_shapes_are_named():
    for exposure in (1e9, float("nan")):
        with pytest.raises(ValueError, match="between -100 and 100 stops"):
            png.levels(random_image(3), exposure=exposure)
    with pytest.raises(ValueError, match=r"\(37, 53, 5\)"):
        png.levels(random_image(5))


def test_films_of_every_kind_have_colours():
    image = random_image(4)
    assert equal(png.linear_rgb(list("RGBA"), image), image)
    assert equal(png.linear_rgb(["n.X", "B", "G", "R"], image), image[:, :, mi.UInt32(3, 2, 1)])
    assert equal(png.linear_rgb(["Y", "A", "n.X", "n.Y"], image), image[:, :, :2])
    white = mi.TensorXf([0.950456, 1, 1.089058, 0.5], (1, 1, 4))  # D65
    rgb = png.linear_rgb(list("XYZA"), white)
    assert dr.allclose(rgb.array, mi.Float(1, 1, 1, 0.5), atol=1e-3)
    with pytest.raises(ValueError, match=r"no colours among the channels n\.X"):
        png.linear_rgb(["n.X", "n.Y", "n.Z", "A"], image)
