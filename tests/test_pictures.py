"""Picture files: what other programs read in them, and what becomes of them on a full disk."""

import contextlib
import datetime
import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import denoise, exr, exr_header, files, png
from nil_mitsuba.layers import LAYERS, channel_names

HEIGHT, WIDTH = 37, 53  # nothing divides them

METADATA = {
    "commandLine": 'nil-mitsuba render "my scene.xml" -D a=ü',
    "scene": "my scene.xml",
    "sceneHash": "9f86d081884c7d65",
    "spp": 64,
    "seed": 2**32 - 1,
    "passes": "0:16",
    "renderTime": 12.345678901,
    "twist": 1,
    "tolerance": 0.25,
    "quotient": True,
    "integrator": "NilIntegrator[\n  twist = 1\n]",
    "cell_origin": [-1, 0.1, 2],
}

pytestmark = pytest.mark.usefixtures("rgb")


def metadata_of(path):
    """Attributes of an EXR file other than those that say how its pixels are stored."""
    header = exr_header.read(path)[0]
    return {name: value for name, (_, value) in header.items() if name not in exr.STRUCTURE}


def random_image(channels, seed=0, height=HEIGHT, width=WIDTH):
    numbers = mi.PCG32(height * width * channels, initstate=seed).next_float32()
    return mi.TensorXf(numbers, (height, width, channels))


def smooth_image(channels):
    """An image that a lossy compression changes little."""
    index = dr.arange(mi.UInt32, HEIGHT * WIDTH * channels) // channels
    x, y = mi.Float(index % WIDTH) / WIDTH, mi.Float(index // WIDTH) / HEIGHT
    return mi.TensorXf(0.5 + 0.4 * dr.sin(4 * x) * dr.cos(3 * y), (HEIGHT, WIDTH, channels))


def all_layers():
    images = {key: random_image(len(layer.channels), seed)
              for seed, (key, layer) in enumerate(LAYERS.items())}
    return images | {
        "position": 100 * images["position"] - 50,
        "normal": 2 * images["normal"] - 1,
        "cell": dr.floor(2**25 * images["cell"]) - 2**24,
        "shape": dr.floor(1000 * images["shape"]) - 1,
        "samples": dr.floor(2**24 * images["samples"]),
    }


def read_channels(path):
    """Pixel types and pixels of all parts, through the OpenEXR package."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        pixels = [channel.pixels for part in file.parts for channel in part.channels.values()]
        names = [name for part in file.parts for name in part.channels]
    types = {name: array.dtype.name for name, array in zip(names, pixels)}
    return types, {name: mi.TensorXf(array.astype("float32")) for name, array in zip(names, pixels)}


def equal(first, second):
    return first.shape == second.shape and dr.all(first.array == second.array)


def as_half(tensor):
    return mi.TensorXf(mi.TensorXf16(tensor))


# ------------------------------------------------------------------------- EXR


@pytest.mark.parametrize("compression", exr.COMPRESSIONS)
@pytest.mark.parametrize("component_format", ["float16", "float32"])
def test_layers_keep_their_values_whatever_the_compression(
    tmp_path, compression, component_format
):
    picture, layers = smooth_image(4), all_layers() | {"noisy": smooth_image(3)}
    exr.write(
        tmp_path / "a.exr", ("RGBA", picture), layers,
        component_format=component_format, compression=compression,
    )  # fmt: skip
    types, channels = read_channels(tmp_path / "a.exr")

    assert set(channels) == {*"RGBA", *channel_names(LAYERS)}
    for i, name in enumerate("RGBA"):
        assert types[name] == component_format
        error = dr.max(dr.abs(channels[name] - picture[:, :, i]).array)
        assert error < (0.02 if compression in exr.LOSSY else 1e-3)
    for key, layer in LAYERS.items():
        for i, name in enumerate(layer.channels):
            assert types[name] == (layer.storage or component_format)
            written = layers[key][:, :, i]
            expected = as_half(written) if types[name] == "float16" else written
            if compression not in exr.LOSSY or key not in exr.COLOURS:
                assert equal(channels[name], expected), name


def test_a_lossy_picture_is_a_smaller_file(tmp_path):
    for compression in ("none", "dwaa"):
        picture = "RGB", smooth_image(3)
        exr.write(tmp_path / f"{compression}.exr", picture, compression=compression)
    sizes = [(tmp_path / f"{c}.exr").stat().st_size for c in ("none", "dwaa")]
    assert sizes[1] < sizes[0] / 2


def test_mitsuba_splits_a_file_into_the_picture_and_its_layers(tmp_path):
    picture, layers = random_image(4), all_layers()
    exr.write(tmp_path / "a.exr", ("RGBA", picture), layers, component_format="float32")
    bitmaps = dict(mi.Bitmap(str(tmp_path / "a.exr")).split())

    names = {"distance": "depth"} | {key: key for key in LAYERS if key != "distance"}
    assert set(bitmaps) == {"<root>", *names.values()}
    assert equal(mi.TensorXf(bitmaps["<root>"]), picture)
    for key, name in names.items():
        stored = LAYERS[key].storage == "float16"
        expected = as_half(layers[key]) if stored else layers[key]
        assert equal(mi.TensorXf(bitmaps[name]), expected), key


def test_mitsuba_reads_the_picture_of_a_lossy_file(tmp_path):
    picture = smooth_image(3)
    exr.write(tmp_path / "a.exr", ("RGB", picture), all_layers(), compression="dwaa")
    root = dict(mi.Bitmap(str(tmp_path / "a.exr")).split())["<root>"]
    assert root.pixel_format() == mi.Bitmap.PixelFormat.RGB
    assert dr.max(dr.abs(mi.TensorXf(mi.TensorXf16(root)) - picture).array) < 0.02


@pytest.mark.parametrize("compression", ["zip", "dwaa"])
def test_openimageio_reads_layers_and_metadata(tmp_path, compression):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    oiiotool = shutil.which("oiiotool", path=path)
    if not oiiotool:
        pytest.skip("oiiotool is not there")
    layers = all_layers()
    exr.write(
        tmp_path / "a.exr", ("RGBA", smooth_image(4)), layers, METADATA, compression=compression
    )

    command = [oiiotool, "-a", "--info", "-v", str(tmp_path / "a.exr")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    lists = re.findall("channel list: (.*)", done.stdout)
    listed = [name.partition(" ")[0] for line in lists for name in line.split(", ")]
    assert sorted(listed) == sorted([*"RGBA", *channel_names(LAYERS)])
    for name in ("cell.Y (float)", "normal.Y (half)", "spp: 64", "tolerance: 0.25"):
        assert name in done.stdout


def test_metadata_come_back_without_loss(tmp_path):
    values = METADATA | {
        "third": 1 / 3,
        "huge": 1e300,
        "tiny": 5e-324,
        "many": 2**63 + 1,
        "negative": -(2**31),
        "empty": "",
        "a name of more than thirty-one characters": "x" * 70000,
        "not text": os.fsdecode(b"caf\xe9.xml"),
        "nested": {"a": [1, None]},
    }
    exr.write(tmp_path / "a.exr", ("RGB", random_image(3)), metadata=values)
    read = metadata_of(tmp_path / "a.exr")

    assert set(read) == {*values, "capDate", "utcOffset"}
    for name, value in values.items():
        if isinstance(value, bool):
            assert read[name] == str(value).lower()
        elif isinstance(value, int) and abs(value) > 2**31:
            assert int(read[name]) == value
        elif isinstance(value, list | dict):
            assert json.loads(read[name]) == value
        elif name == "not text":
            assert read[name] == "caf\\udce9.xml"
        else:
            assert read[name] == value and type(read[name]) is type(value), name


def test_the_openexr_package_reads_the_same_metadata(tmp_path):
    import OpenEXR

    exr.write(tmp_path / "a.exr", ("RGB", random_image(3)), metadata=METADATA)
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        header = dict(file.header())  # closing the file empties it
    ours = metadata_of(tmp_path / "a.exr")
    for name in ours:
        assert header[name] == ours[name], name
    assert set(header) - set(ours) <= exr.STRUCTURE


@pytest.mark.parametrize("zone", ["UTC0", "IST-5:30", "EST5EDT,M1.1.0,M12.5.0"])
def test_the_date_is_that_of_writing_in_local_time(tmp_path, monkeypatch, zone):
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        exr.write(tmp_path / "a.exr", ("RGB", random_image(3)))
    finally:
        monkeypatch.undo()
        time.tzset()
    header = metadata_of(tmp_path / "a.exr")
    local = datetime.datetime.strptime(header["capDate"], "%Y:%m:%d %H:%M:%S")
    utc = local + datetime.timedelta(seconds=header["utcOffset"])
    age = datetime.datetime.now(datetime.timezone.utc).replace(tzinfo=None) - utc
    assert 0 <= age.total_seconds() < 60
    assert ("IST" in zone) == (header["utcOffset"] == -5.5 * 3600)


def test_metadata_cannot_replace_what_makes_the_file_readable(tmp_path):
    for name in ("channels", "dataWindow", "compression"):
        with pytest.raises(ValueError, match=f'"{name}".*cannot be metadata'):
            exr.write(tmp_path / "a.exr", ("RGB", random_image(3)), metadata={name: 1})
    assert not list(tmp_path.iterdir())


def test_a_half_holds_no_infinities_and_keeps_what_is_not_a_number(tmp_path):
    inf, nan = float("inf"), float("nan")
    values = mi.TensorXf([1, 65504, 65519, 65521, 1e30, inf, -1e30, -inf, nan], (1, 9, 1))
    exr.write(tmp_path / "a.exr", ("Y", values))
    _, channels = read_channels(tmp_path / "a.exr")
    array = channels["Y"].array
    assert list(array)[:8] == [1, 65504, 65504, 65504, 65504, 65504, -65504, -65504]
    assert dr.isnan(array)[8]


def test_a_film_is_written_in_its_own_format(tmp_path):
    for name in exr.COMPONENT_FORMATS:
        film = mi.load_dict({"type": "hdrfilm", "component_format": name})
        assert exr.component_format(film) == name
    exr.write(tmp_path / "a.exr", ("Y", 10 * random_image(1)), component_format="uint32")
    types, channels = read_channels(tmp_path / "a.exr")
    assert types == {"Y": "uint32"} and dr.max(channels["Y"].array) == 9


@pytest.mark.parametrize("arguments, words", [
    ({"layers": {"depth": (1,)}}, ['"depth"', "distance", "position"]),
    ({"layers": {"cell": (1,)}}, ["cell.X, cell.Y, cell.Z", str((HEIGHT, WIDTH, 3))]),
    ({"compression": "jpeg"}, ['"jpeg"', "zip", "dwaa"]),
    ({"component_format": "float64"}, ['"float64"', "float16"]),
    ({"picture": "RGBA"}, ["R, G, B, A", str((HEIGHT, WIDTH, 4)), str((HEIGHT, WIDTH, 3))]),
    ({"picture": "RGR"}, ['two channels "R"']),
])  # fmt: skip
def test_what_does_not_fit_together_is_named(tmp_path, arguments, words):
    picture = arguments.pop("picture", "RGB"), random_image(3)
    layers = {key: random_image(*n) for key, n in arguments.pop("layers", {}).items()}
    with pytest.raises(ValueError) as error:
        exr.write(tmp_path / "a.exr", picture, layers, **arguments)
    assert all(word in str(error.value) for word in words), error.value
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------ description


def test_the_description_tells_size_layers_and_metadata(tmp_path):
    exr.write(tmp_path / "a.exr", ("RGBA", random_image(4)), all_layers(), METADATA)
    text = exr.describe(tmp_path / "a.exr")
    lines = text.splitlines()
    assert lines[0] == f"{tmp_path / 'a.exr'}: {WIDTH} x {HEIGHT} pixels, compression zip"
    words = [line.split() for line in lines]
    for row in (
        "(picture) R G B A float16", "albedo R G B float16", "cell X Y Z float32",
        "depth Z float32", "samples X float32", "spp 64", "seed 4294967295", "tolerance 0.25",
        "renderTime 12.345678901", "quotient true",
    ):  # fmt: skip
        assert row.split() in words, row
    # A value of several lines stays in its column.
    start = next(i for i, line in enumerate(lines) if line.startswith("  integrator"))
    column = lines[start].index("NilIntegrator")
    assert lines[start + 1] == " " * column + "  twist = 1"
    assert text.index("  spp ") < text.index("  capDate ") < text.index("  integrator ")


def test_files_of_others_are_described_too(tmp_path):
    import OpenEXR

    plane = mi.TensorXf(random_image(1)[:, :, 0]).numpy()
    left = OpenEXR.Part(
        {"type": OpenEXR.tiledimage, "compression": OpenEXR.PIZ_COMPRESSION, "owner": "Ada",
         "tiles": OpenEXR.TileDescription(), "focus": 0.1, "tags": ["a", "b"],
         "preview": OpenEXR.PreviewImage(1, 1), "whitePoint": (0.3127, 0.3290)},
        {"R": plane, "other.long": plane}, "left",
    )  # fmt: skip
    right = OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Z": plane}, "right")
    with OpenEXR.File([left, right]) as file:
        file.write(str(tmp_path / "a.exr"))
    text = exr.describe(tmp_path / "a.exr")
    for words in (
        'part "left", 53 x 37 pixels, compression piz, in tiles', 'part "right"', "owner",
        "Ada", "0.1\n", "a, b", "(preview, ", "0.3127",
    ):  # fmt: skip
        assert words in text, words
    assert metadata_of(tmp_path / "a.exr")["owner"] == "Ada"

    mi.Bitmap(random_image(3)).write(str(tmp_path / "b.exr"))
    assert "R G B" in exr.describe(tmp_path / "b.exr")


def test_a_damaged_header_gets_one_sentence_or_a_description(tmp_path):
    exr.write(tmp_path / "a.exr", ("RGB", random_image(3, height=2, width=2)), metadata=METADATA)
    data, rng = (tmp_path / "a.exr").read_bytes(), random.Random(1)
    sentences = 0
    for _ in range(1000):
        damaged = bytearray(data)
        damaged[rng.randrange(4, 700)] = rng.randrange(256)
        (tmp_path / "b.exr").write_bytes(damaged)
        try:
            assert "pixels" in exr.describe(tmp_path / "b.exr")
        except ValueError as error:
            sentences += "is damaged" in str(error)
    assert sentences > 10


def test_a_description_does_not_steer_the_terminal(tmp_path):
    picture = "RGB", random_image(3)
    exr.write(tmp_path / "a.exr", picture, metadata={"owner": "\x1b[2J\rA\x9b", "big": 3.4e38})
    text = exr.describe(tmp_path / "a.exr")
    assert "[2J" in text and not set("\x1b\r\x9b") & set(text)


def test_what_is_not_an_exr_file_gets_one_sentence(tmp_path):
    (tmp_path / "a.exr").write_text("hello")
    (tmp_path / "empty.exr").touch()
    for name, words in {
        "a.exr": "is not an OpenEXR file", "empty.exr": "is not an OpenEXR file",
        "none.exr": "No such file", ".": "directory",
    }.items():  # fmt: skip
        for function in (exr.describe, exr_header.read):
            with pytest.raises((OSError, ValueError)) as error:
                function(tmp_path / name)
            assert words in str(error.value) and str(tmp_path / name) in str(error.value)
            assert "\n" not in str(error.value)


@pytest.mark.parametrize("compression", ["zip", "dwaa", "none"])
def test_a_file_cut_anywhere_is_known_to_be_incomplete(tmp_path, compression):
    path, cut = tmp_path / "a.exr", tmp_path / "cut.exr"
    picture = "RGB", random_image(3, height=20, width=4)
    distance = random_image(1, height=20, width=4)
    exr.write(path, picture, {"distance": distance}, METADATA, compression=compression)
    data = path.read_bytes()
    assert exr_header.is_complete(path)
    for size in range(len(data) - 1, -1, -3):
        cut.write_bytes(data[:size])
        assert not exr_header.is_complete(cut), size
        # Either the header is there or there is a sentence.
        try:
            assert metadata_of(cut)["spp"] == 64
        except ValueError as error:
            assert "is damaged" in str(error) or size < 4
    cut.write_bytes(data + b"\0")
    assert not exr_header.is_complete(cut)


def test_describing_needs_no_numpy(tmp_path, fresh_python):
    exr.write(tmp_path / "a.exr", ("RGB", random_image(3)), metadata=METADATA)
    done = fresh_python(
        "import sys, nil_mitsuba, mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "from nil_mitsuba import exr, png\n"
        f"print(exr.describe({str(tmp_path / 'a.exr')!r}))\n"
        f"png.write({str(tmp_path / 'a.png')!r}, mi.TensorXf([0.5] * 12, (2, 2, 3)))\n"
        "assert 'numpy' not in sys.modules and 'OpenEXR' not in sys.modules\n"
    )
    assert done.returncode == 0 and "spp" in done.stdout, done.stderr


# ------------------------------------------------------- full disks, bad targets


def test_a_full_disk_leaves_the_last_good_file(tmp_path):
    """A limit on the size of files, wherever it falls, does what a full disk does."""
    code = (
        "import resource, sys, nil_mitsuba, mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "from nil_mitsuba import exr, png\n"
        "numbers = mi.PCG32(100 * 90 * 3).next_float32()\n"
        "image = mi.TensorXf(numbers, (100, 90, 3))\n"
        "import OpenEXR\n"
        "writers = {'a.exr': lambda path: exr.write(path, ('RGB', image)),\n"
        "           'a.png': lambda path: png.write(path, image)}\n"
        "for name, write in writers.items():\n"
        "    path = sys.argv[1] + '/' + name\n"
        "    write(path)\n"
        "    data = open(path, 'rb').read()\n"
        "    for limit in (0, 100, 5000, len(data) - 1):\n"
        "        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))\n"
        "        try:\n"
        "            write(path)\n"
        "        except OSError as error:\n"
        "            message = str(error)\n"
        "        else:\n"
        "            message = 'written'\n"
        "        finally:\n"
        "            unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)\n"
        "            resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)\n"
        "        print(message)\n"
        "        assert open(path, 'rb').read() == data\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    expected = [
        f'cannot write "{tmp_path}/{name}": File too large.'
        for name in ("a.exr", "a.png")
        for _ in range(4)
    ]
    assert done.stdout.splitlines() == expected
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "a.png"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
def test_a_disk_that_fills_with_the_last_bytes_is_noticed(monkeypatch):
    # A picture this small is written when the file is closed, where OpenEXR ignores errors.
    monkeypatch.setattr(exr, "replacing", lambda path: contextlib.nullcontext("/dev/full"))
    with pytest.raises(OSError, match="the disk may be full"):
        exr.write("a.exr", ("RGB", random_image(3, height=2, width=2)))


@pytest.mark.parametrize("suffix", ["exr", "png"])
def test_targets_that_cannot_be_written_get_a_sentence(tmp_path, suffix):
    def write(path):
        image = random_image(3)
        exr.write(path, ("RGB", image)) if suffix == "exr" else png.write(path, image)

    (tmp_path / f"folder.{suffix}").mkdir()
    os.mkfifo(tmp_path / f"pipe.{suffix}")
    for name, reason in {
        f"nowhere/a.{suffix}": "No such file or directory",
        f"folder.{suffix}": "it is a folder",
        f"pipe.{suffix}": "it is not an ordinary file",
    }.items():
        with pytest.raises(OSError) as error:
            write(tmp_path / name)
        assert str(error.value) == f'cannot write "{tmp_path / name}": {reason}.'
    if os.geteuid() == 0:  # to whom no folder is read-only
        return
    (tmp_path / "locked").mkdir(mode=0o500)
    with pytest.raises(OSError, match="Permission denied"):
        write(tmp_path / "locked" / f"a.{suffix}")


def test_an_interrupted_write_leaves_no_trace(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("before")
    with pytest.raises(KeyboardInterrupt), files.replacing(path) as part:
        Path(part).write_text("half of")
        raise KeyboardInterrupt
    assert path.read_text() == "before" and os.listdir(tmp_path) == ["a.txt"]


def test_who_reads_the_old_file_is_not_disturbed(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("before")
    with open(path) as reader:
        with files.replacing(path) as part:
            Path(part).write_text("after")
        assert reader.read() == "before"
    assert path.read_text() == "after"


def test_a_link_goes_on_pointing_at_the_file(tmp_path):
    (tmp_path / "disk").mkdir()
    path, link = tmp_path / "disk" / "a.txt", tmp_path / "a.txt"
    path.write_text("before")
    link.symlink_to(path)
    with files.replacing(link) as part:
        assert Path(part).parent == path.parent  # a file can only be moved within a disk
        Path(part).write_text("after")
    assert link.is_symlink() and path.read_text() == "after"


# ------------------------------------------------------------------------- PNG


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


# -------------------------------------------------------------------- denoising


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
