"""Pictures as OpenEXR files: layers, metadata, and what a file tells of itself."""

from __future__ import annotations

import json
import math
import os
import struct
import time
from collections.abc import Iterable, Mapping

import drjit as dr
import mitsuba as mi

from . import exr_header
from .files import replacing
from .layers import LAYERS, Layer

COMPONENT_FORMATS = ("float16", "float32", "uint32")

# Names of compressions, here and in the OpenEXR package.
COMPRESSIONS = {
    "none": "NO_COMPRESSION",
    "rle": "RLE_COMPRESSION",
    "zips": "ZIPS_COMPRESSION",
    "zip": "ZIP_COMPRESSION",
    "piz": "PIZ_COMPRESSION",
    "dwaa": "DWAA_COMPRESSION",
    "dwab": "DWAB_COMPRESSION",
}

# DWA is lossy in all channels R, G, B and Y, those of a vector included. Whatever is not a colour
# then has a part of the file to itself.
LOSSY = ("dwaa", "dwab")
COLOURS = ("picture", "noisy", "albedo")

PART_NAMES = ("rgba", "data")  # Nuke calls its own main part "rgba", too

HALF_MAX = 65504.0  # largest number of float16

# Attributes that say how pixels are stored.
STRUCTURE = frozenset(
    {
        "channels",
        "chunkCount",
        "compression",
        "dataWindow",
        "displayWindow",
        "lineOrder",
        "name",
        "pixelAspectRatio",
        "screenWindowCenter",
        "screenWindowWidth",
        "tiles",
        "type",
        "version",
    }
)

# Metadata in the order in which people ask for them; others follow by name.
FIRST = (
    "commandLine",
    "scene",
    "sceneHash",
    "spp",
    "seed",
    "passes",
    "noise",
    "renderTime",
    "capDate",
    "utcOffset",
    "software",
    "variant",
)


def write(
    path: str | os.PathLike,
    picture: tuple[list[str], mi.TensorXf],
    layers: Mapping[str, mi.TensorXf] | None = None,
    metadata: Mapping[str, object] | None = None,
    *,
    component_format: str = "float16",
    compression: str = "zip",
) -> None:
    """Write a picture and its layers as an OpenEXR file.

    `picture` holds the names of the channels and a tensor of shape (height, width, channels),
    `layers` maps keys of ``layers.LAYERS`` to tensors of the same height and width.
    `component_format` (one of ``COMPONENT_FORMATS``) is the picture's; what a half cannot hold
    becomes ±65504. `metadata` become attributes of the header: text, numbers without loss (whole
    numbers beyond 32 bits as text), truth values as "true" and "false", and everything else as
    JSON. The standard attributes ``capDate`` and ``utcOffset`` are added. The file has one part;
    with a lossy `compression`, layers that are not colours are in a second one, compressed by
    "zip". The OpenEXR package, and NumPy with it, is imported here and not before.

    Raises ValueError for what does not fit together and OSError if the file cannot be written; a
    file that `path` named before is then as it was.
    """
    _one_of(COMPRESSIONS, compression, "compression")
    _one_of(COMPONENT_FORMATS, component_format, "component format")
    names, image = picture
    images = {"picture": (Layer(tuple(names), None, None), image)}
    for key, tensor in (layers or {}).items():
        images[key] = LAYERS[_one_of(LAYERS, key, "layer")], tensor
    _check(images)

    data = [key for key in images if key not in COLOURS and compression in LOSSY]
    colours = [key for key in images if key not in data]
    attributes = _attributes(metadata or {})
    parts = [(attributes, compression, _planes(images, colours, component_format))]
    if data:
        parts.append(({}, "zip", _planes(images, data, component_format)))
    with replacing(path) as part:
        _write(part, parts)


def describe(path: str | os.PathLike) -> str:
    """Size, compression, layers with their types, and metadata of an OpenEXR file, as text.

    The file may be anyone's. Raises OSError and ValueError.
    """
    parts = exr_header.read(path)
    if len(parts) == 1:
        parts[0].pop("name", None)  # it tells parts from each other
    text = f"{path}: " + "\n\n".join(map(_describe, parts))
    # What a stranger's file says must not steer the terminal.
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


# ---------------------------------------------------------------------- writing


def _check(images: dict[str, tuple[Layer, mi.TensorXf]]) -> None:
    size = images["picture"][1].shape[:2]
    for what, (layer, tensor) in images.items():
        shape = (*size, len(layer.channels))
        if tensor.shape != shape:
            raise ValueError(
                f"{what}: the channels {', '.join(layer.channels)} need a tensor of the shape "
                f"{shape}, and this one has {tensor.shape}."
            )
    names = [name for layer, _ in images.values() for name in layer.channels]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'there are two channels "{name}".')


def _planes(images, keys: list[str], component_format: str) -> dict[str, mi.TensorXf]:
    """What to store by the names of the channels, in the types that store it."""
    return {
        name: _stored(images[key][1][:, :, i], images[key][0].storage or component_format)
        for key in keys
        for i, name in enumerate(images[key][0].channels)
    }


def _stored(plane: mi.TensorXf, storage: str):
    if storage == "float16":  # infinities spread when a picture is scaled or blurred
        plane = dr.select(dr.abs(plane) > HALF_MAX, HALF_MAX * dr.sign(plane), plane)
        return mi.TensorXf16(plane)
    return mi.TensorXf32(plane) if storage == "float32" else mi.TensorXu32(plane)


def _attributes(metadata: Mapping[str, object]) -> dict[str, object]:
    now = time.localtime()
    attributes = {
        "capDate": time.strftime("%Y:%m:%d %H:%M:%S", now),
        "utcOffset": float(-now.tm_gmtoff),  # s; UTC = local time + offset
    }
    for name, value in metadata.items():
        if name in STRUCTURE:
            raise ValueError(f'"{name}" says how pixels are stored and cannot be metadata.')
        attributes[name] = _attribute(value)
    return attributes


def _attribute(value: object):
    """`value` as the OpenEXR package takes it, which cuts numbers to 32 bits."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):  # names of files may not be text
        return value.encode(errors="backslashreplace").decode()
    if isinstance(value, int):
        return value if -(2**31) <= value < 2**31 else str(value)
    if isinstance(value, float):
        return value if value == _to_float32(value) else mi.TensorXf64([value]).numpy()
    return json.dumps(value)


def _to_float32(value: float) -> float:
    try:
        return struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)


def _write(path: str, parts: list[tuple[dict, str, dict]]) -> None:
    """Write parts, each with its attributes, compression and planes."""
    import OpenEXR

    contents = []
    for attributes, compression, planes in parts:
        header = {
            **attributes,
            "compression": getattr(OpenEXR, COMPRESSIONS[compression]),
            "type": OpenEXR.scanlineimage,
        }
        # Channels share the memory of Dr.Jit's arrays.
        pixels = {name: OpenEXR.Channel(plane.numpy()) for name, plane in planes.items()}
        contents.append((header, pixels))
    if len(contents) == 1:
        file = OpenEXR.File(*contents[0])
    else:
        file = OpenEXR.File([OpenEXR.Part(*c, name) for c, name in zip(contents, PART_NAMES)])
    try:
        with file:
            file.write(path)
    except RuntimeError as error:
        # 'Failed to write pixel data to image file "...". File too large.'
        raise OSError(str(error).rpartition('". ')[2].rstrip(".")) from None
    if not exr_header.is_complete(path):
        raise OSError("its end could not be written; the disk may be full")


def _one_of(choices: Iterable[str], name: str, what: str) -> str:
    if name not in choices:
        raise ValueError(f'there is no {what} "{name}"; choose among {", ".join(choices)}.')
    return name


# ------------------------------------------------------------------- describing


def _describe(header: dict[str, exr_header.Attribute]) -> str:
    lines = [_size(header)]
    rows = _layer_rows(header["channels"].value)
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines += [""] + ["  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]

    header = _with_noise(header)
    names = sorted(header.keys() - STRUCTURE)
    names.sort(key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
    width = max(map(len, names), default=0)
    margin = "\n" + " " * (width + 4)
    lines += [""] if names else []
    for name in names:
        lines.append(f"  {name:{width}}  " + _text(header[name]).replace("\n", margin))
    return "\n".join(lines)


def _with_noise(header: dict[str, exr_header.Attribute]) -> dict[str, exr_header.Attribute]:
    """The header, in which the noise of a picture of ours is put into words."""
    ours = _text(header["software"]).startswith("nil_mitsuba") if "software" in header else False
    if not ours:
        return header
    noise = header.get("noise", exr_header.Attribute("string", "not stated"))  # by 0.1.0
    words = _text(noise)
    if noise.type != "string" and any(
        name.startswith("noisy.") for name in header["channels"].value
    ):
        words += " (before denoising)"
    return header | {"noise": exr_header.Attribute("string", words)}


def _size(header: dict[str, exr_header.Attribute]) -> str:
    left, top, right, bottom = header["dataWindow"].value
    number = header["compression"].value
    known = number < len(exr_header.COMPRESSION_NAMES)
    compression = exr_header.COMPRESSION_NAMES[number] if known else str(number)
    words = [f"{right - left + 1} x {bottom - top + 1} pixels", f"compression {compression}"]
    if "name" in header:
        words.insert(0, f'part "{header["name"].value}"')
    if "tiles" in header:
        words.append("in tiles")
    if header["displayWindow"] != header["dataWindow"]:
        words.append("data window {},{} to {},{}".format(*header["dataWindow"].value))
        words.append("display window {},{} to {},{}".format(*header["displayWindow"].value))
    return ", ".join(words)


def _layer_rows(channels: dict[str, str]) -> list[tuple[str, str, str]]:
    """Name, channels and types of each layer; channels without a layer come first."""
    layers: dict[str, list[str]] = {}
    for channel in channels:
        layer = channel.rpartition(".")[0]
        layers.setdefault(layer, []).append(channel)

    def rank(channel):  # files list channels by the alphabet
        letter = channel.rpartition(".")[2]
        return "RGBAXYZ".find(letter.upper()) if len(letter) == 1 else len("RGBAXYZ")

    rows = []
    for layer in sorted(layers):
        members = sorted(layers[layer], key=rank)
        letters = " ".join(channel.rpartition(".")[2] for channel in members)
        types = ", ".join(sorted({channels[channel] for channel in members}))
        rows.append((layer or "(picture)", letters, types))
    return rows


def _text(attribute: exr_header.Attribute) -> str:
    kind, value = attribute
    if isinstance(value, bytes):
        return f"({kind}, {len(value)} bytes)"
    if isinstance(value, float) and kind == "float":  # as few digits as tell it from others
        digits = (float(f"{value:.{n}g}") for n in range(1, 10))
        return next((f"{d:.9g}" for d in digits if _to_float32(d) == value), str(value))
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return str(value)
