"""OpenEXR files: what other programs read in them, layers and metadata, a description."""

import datetime
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from images import (
    HEIGHT,
    METADATA,
    WIDTH,
    all_layers,
    as_half,
    equal,
    metadata_of,
    random_image,
    smooth_image,
)
from nil_mitsuba import exr
from nil_mitsuba.layers import LAYERS, channel_names
from nil_mitsuba.stills import component_format

pytestmark = pytest.mark.usefixtures("rgb")


def read_channels(path):
    """Pixel types and pixels of all parts, through the OpenEXR package."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        pixels = [channel.pixels for part in file.parts for channel in part.channels.values()]
        names = [name for part in file.parts for name in part.channels]
    types = {name: array.dtype.name for name, array in zip(names, pixels)}
    return types, {name: mi.TensorXf(array.astype("float32")) for name, array in zip(names, pixels)}


@pytest.mark.parametrize("compression", exr.COMPRESSIONS)
@pytest.mark.parametrize("component_format", ["float16", "float32"])
def test_layers_keep_their_values_whatever_the_compression(tmp_path, compression, component_format):
    picture, layers = smooth_image(4), all_layers() | {"noisy": smooth_image(3)}
    exr.write(
        tmp_path / "a.exr",
        ("RGBA", picture),
        layers,
        component_format=component_format,
        compression=compression,
    )
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
        assert component_format(film) == name
    exr.write(tmp_path / "a.exr", ("Y", 10 * random_image(1)), component_format="uint32")
    types, channels = read_channels(tmp_path / "a.exr")
    assert types == {"Y": "uint32"} and dr.max(channels["Y"].array) == 9


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"layers": {"depth": (1,)}}, ['"depth"', "distance", "position"]),
        ({"layers": {"cell": (1,)}}, ["cell.X, cell.Y, cell.Z", str((HEIGHT, WIDTH, 3))]),
        ({"compression": "jpeg"}, ['"jpeg"', "zip", "dwaa"]),
        ({"component_format": "float64"}, ['"float64"', "float16"]),
        ({"picture": "RGBA"}, ["R, G, B, A", str((HEIGHT, WIDTH, 4)), str((HEIGHT, WIDTH, 3))]),
        ({"picture": "RGR"}, ['two channels "R"']),
    ],
)
def test_what_does_not_fit_together_is_named(tmp_path, arguments, words):
    picture = arguments.pop("picture", "RGB"), random_image(3)
    layers = {key: random_image(*n) for key, n in arguments.pop("layers", {}).items()}
    with pytest.raises(ValueError) as error:
        exr.write(tmp_path / "a.exr", picture, layers, **arguments)
    assert all(word in str(error.value) for word in words), error.value
    assert not list(tmp_path.iterdir())


def test_the_description_tells_size_layers_and_metadata(tmp_path):
    exr.write(tmp_path / "a.exr", ("RGBA", random_image(4)), all_layers(), METADATA)
    text = exr.describe(tmp_path / "a.exr")
    lines = text.splitlines()
    assert lines[0] == f"{tmp_path / 'a.exr'}: {WIDTH} x {HEIGHT} pixels, compression zip"
    words = [line.split() for line in lines]
    for row in (
        "(picture) R G B A float16",
        "albedo R G B float16",
        "cell X Y Z float32",
        "depth Z float32",
        "samples X float32",
        "spp 64",
        "seed 4294967295",
        "tolerance 0.25",
        "renderTime 12.345678901",
        "x_fov 80",
        "quotient true",
    ):
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
        {
            "type": OpenEXR.tiledimage,
            "compression": OpenEXR.PIZ_COMPRESSION,
            "owner": "Ada",
            "tiles": OpenEXR.TileDescription(),
            "focus": 0.1,
            "tags": ["a", "b"],
            "preview": OpenEXR.PreviewImage(1, 1),
            "whitePoint": (0.3127, 0.3290),
        },
        {"R": plane, "other.long": plane},
        "left",
    )
    right = OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Z": plane}, "right")
    with OpenEXR.File([left, right]) as file:
        file.write(str(tmp_path / "a.exr"))
    text = exr.describe(tmp_path / "a.exr")
    for words in (
        'part "left", 53 x 37 pixels, compression piz, in tiles',
        'part "right"',
        "owner",
        "Ada",
        "0.1\n",
        "a, b",
        "(preview, ",
        "0.3127",
    ):
        assert words in text, words
    assert metadata_of(tmp_path / "a.exr")["owner"] == "Ada"

    mi.Bitmap(random_image(3)).write(str(tmp_path / "b.exr"))
    assert "R G B" in exr.describe(tmp_path / "b.exr")


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
