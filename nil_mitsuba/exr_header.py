"""Headers of OpenEXR files.

Read as "OpenEXR File Layout" (https://openexr.com/en/latest/OpenEXRFileLayout.html) describes
them, of any kind: scan lines or tiles, flat or deep, one part or several. Neither the OpenEXR
package nor NumPy is needed.
"""

from __future__ import annotations

import os
import struct
from typing import Any, BinaryIO, NamedTuple

MAGIC = b"\x76\x2f\x31\x01"
MULTIPART = 1 << 12  # bit of the version field
LONGEST_NAME = 255

# Attributes that each header must have, and their types.
REQUIRED = {
    "channels": "chlist",
    "compression": "compression",
    "dataWindow": "box2i",
    "displayWindow": "box2i",
}

COMPRESSION_NAMES = (  # by their number in a file
    "none",
    "rle",
    "zips",
    "zip",
    "piz",
    "pxr24",
    "b44",
    "b44a",
    "dwaa",
    "dwab",
)
PIXEL_TYPES = ("uint32", "float16", "float32")

# Types of attributes that are a number or a few.
_NUMBERS = {
    "box2f": "<4f",
    "box2i": "<4i",
    "chromaticities": "<8f",
    "compression": "<B",
    "double": "<d",
    "envmap": "<B",
    "float": "<f",
    "int": "<i",
    "lineOrder": "<B",
    "m33d": "<9d",
    "m33f": "<9f",
    "m44d": "<16d",
    "m44f": "<16f",
    "rational": "<iI",
    "tiledesc": "<IIB",
    "v2d": "<2d",
    "v2f": "<2f",
    "v2i": "<2i",
    "v3d": "<3d",
    "v3f": "<3f",
    "v3i": "<3i",
}


class Attribute(NamedTuple):
    """Type, by its name in the file, and value: a str, int, float, tuple, or bytes if the type
    is unknown; a "chlist" is a dict of channels' names and pixel types."""

    type: str
    value: Any


def read(path: str | os.PathLike) -> list[dict[str, Attribute]]:
    """The header of each part of the OpenEXR file `path`.

    Raises OSError if `path` cannot be opened and ValueError if it is no OpenEXR file or its
    headers are incomplete.
    """
    try:
        with open(path, "rb") as file:
            headers = _read(file)
    except OSError as error:
        raise OSError(f'cannot read "{path}": {error.strerror or error}.') from None
    except _NotEXRError:
        raise ValueError(f'"{path}" is not an OpenEXR file.') from None
    except (EOFError, struct.error):
        headers = []
    if not headers or not all(map(_is_usable, headers)):
        raise ValueError(f'"{path}" is damaged: its header is incomplete.')
    return headers


def is_complete(path: str | os.PathLike) -> bool:
    """Whether a file of flat scan lines ends where its last chunk of pixels ends.

    The OpenEXR library does not report that closing a file has failed.
    """
    with open(path, "rb") as file:
        try:
            headers = _read(file)
            # Chunks follow a table of their offsets.
            start = file.tell()
            if "chunkCount" in headers[0]:
                count = sum(header["chunkCount"].value for header in headers)
            else:  # files of one part may leave it out, and begin with the first chunk
                count = (struct.unpack("<Q", _take(file, 8))[0] - start) // 8
            file.seek(start)
            offsets = struct.unpack(f"<{count}Q", _take(file, 8 * count))
            if not offsets or min(offsets) < file.tell():
                return False
            # In files of several parts, a chunk tells its part first.
            file.seek(max(offsets) + (4 if len(headers) > 1 else 0))
            _, size = struct.unpack("<iI", _take(file, 8))
            return file.tell() + size == file.seek(0, os.SEEK_END)
        except (_NotEXRError, EOFError, struct.error):
            return False


def _is_usable(header: dict[str, Attribute]) -> bool:
    return all(name in header and header[name].type == kind for name, kind in REQUIRED.items())


class _NotEXRError(Exception):
    pass


def _read(file: BinaryIO) -> list[dict[str, Attribute]]:
    """The headers, with `file` left behind them."""
    if file.read(len(MAGIC)) != MAGIC:
        raise _NotEXRError
    (version,) = struct.unpack("<I", _take(file, 4))
    headers = [_header(file)]
    while version & MULTIPART:
        header = _header(file)
        if not header:  # an empty one ends the list
            break
        headers.append(header)
    return headers


def _header(file: BinaryIO) -> dict[str, Attribute]:
    attributes = {}
    while name := _text(file):
        kind = _text(file)
        (size,) = struct.unpack("<I", _take(file, 4))
        attributes[name] = Attribute(kind, _decode(kind, _take(file, size)))
    return attributes


def _take(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError
    return data


def _text(file: BinaryIO) -> str:
    """A name, which a zero byte ends."""
    name = b""
    while (byte := _take(file, 1)) != b"\0":
        name += byte
        if len(name) > LONGEST_NAME:
            raise EOFError
    return name.decode(errors="replace")


def _decode(kind: str, data: bytes):
    if kind in _NUMBERS:
        values = struct.unpack(_NUMBERS[kind], data)
        return values[0] if len(values) == 1 else values
    if kind == "string":
        return data.decode(errors="replace")
    if kind == "floatvector":
        return struct.unpack(f"<{len(data) // 4}f", data)
    if kind == "stringvector":
        return tuple(_strings(data))
    if kind == "chlist":
        return dict(_channels(data))
    return data


def _strings(data: bytes):
    while data:
        (size,) = struct.unpack_from("<I", data)
        yield data[4 : 4 + size].decode(errors="replace")
        data = data[4 + size :]


def _channels(data: bytes):
    while data[:1] not in (b"", b"\0"):
        name, _, data = data.partition(b"\0")
        # pixel type, "perceptually linear" in four bytes, sampling in x and y
        (pixel_type,) = struct.unpack_from("<i12x", data)
        known = 0 <= pixel_type < len(PIXEL_TYPES)
        yield name.decode(errors="replace"), PIXEL_TYPES[pixel_type] if known else str(pixel_type)
        data = data[16:]
