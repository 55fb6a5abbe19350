"""What passes have added up to so far, in a file: a checkpoint of a render, or a part of one."""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from .files import replacing
from .sums import Sums, name_noise, name_passes

# The number is that of the format. JSON text follows, with its length before it, then the arrays
# in the order in which it lists them, and the SHA-256 of all that.
MAGIC = b"nil-mitsuba sums 2\n\0\0\0\0\0"
# Version 1 seeded wavefronts, not samples: its passes and ours do not add up to one picture.
OTHER_NUMBERS = b"nil-mitsuba sums 1\n"
ALIGNMENT = 64  # bytes; arrays are read where they lie
ARRAYS = {"values": "d", "moments": "d", "points": "i"}  # fields of Sums and their item types

# Settings whose values would be of no use to anyone: hashes, or many numbers.
CHANGED = {
    "scene": "the scene or a file that it names has changed",
    "keys": "the keys have changed",
}
# What others are called in sentences, where their own names would not do.
NAMES = {
    "pass_spp": "samples per pixel in a pass",
    "channels": "the film's channels",
}


@dataclass
class Checkpoint:
    """Sums of passes, and what it takes to add more of them.

    ``settings`` is what has to be equal for sums to be added up (names, texts, numbers, and lists
    and dictionaries of them); ``seconds`` the time that rendering took;
    ``about`` what a picture's metadata tell besides; ``noise`` the estimate of ``stills.noise``,
    None where there is none or no one has made it, as after an addition to other passes.
    """

    settings: dict
    sums: Sums
    seconds: float = 0.0
    about: dict = field(default_factory=dict)
    noise: float | None = None

    def plus(self, other: Checkpoint) -> Checkpoint:
        """Both together; raises ValueError if they do not belong together or overlap."""
        self.require(other.settings)
        return Checkpoint(
            self.settings,
            self.sums.plus(other.sums),
            self.seconds + other.seconds,
            self.about,
            None if self.sums.passes else other.noise,
        )

    def require(self, settings: dict) -> None:
        """Raise ValueError, with one sentence, unless the settings are these."""
        found = list(differences(self.settings, settings))
        if found:
            raise ValueError("; ".join(found) + ".")

    def to_bytes(self) -> bytes:
        """The file's contents."""
        return b"".join(self._blocks())

    @staticmethod
    def from_bytes(data: bytes, name: str = "this") -> Checkpoint:
        """What `to_bytes` made; raises ValueError if it is something else or damaged.

        The variant that it was made with has to be set: see ``peek``.
        """
        header, start = _header(data, name)

        arrays = {}
        for key, shape in header["arrays"].items():
            kind = ARRAYS[key]
            flat, tensor = {"d": (mi.Float64, mi.TensorXd), "i": (mi.Int32, mi.TensorXi)}[kind]
            stop = start + struct.calcsize(kind) * math.prod(shape)
            items = memoryview(data)[start:stop].cast(kind)  # type: ignore[call-overload]
            # A copy, in memory as sums in the making are: the same kernels go on with it
            values = dr.zeros(flat, 0) if 0 in shape else flat(items) + dr.opaque(flat, 0)
            arrays[key] = tensor(values, tuple(shape))
            start = stop
        dr.eval(arrays)
        sums = Sums(passes=tuple(map(tuple, header["passes"])), **arrays)
        return Checkpoint(
            header["settings"], sums, header["seconds"], header["about"], header.get("noise")
        )

    def _blocks(self) -> Iterator[bytes | memoryview]:
        if sys.byteorder != "little":
            raise OSError("checkpoints are written on little-endian machines only.")
        tensors = {key: getattr(self.sums, key) for key in ARRAYS}
        text = json.dumps(
            {
                "settings": self.settings,
                "about": self.about,
                "seconds": self.seconds,
                "noise": self.noise,
                "passes": self.sums.passes,
                "arrays": {key: tensor.shape for key, tensor in tensors.items()},
            }
        ).encode()
        text += b" " * (-(len(MAGIC) + 8 + len(text)) % ALIGNMENT)
        digest = hashlib.sha256()
        head = MAGIC + struct.pack("<Q", len(text)) + text
        for block in (head, *(t.array.memview() for t in tensors.values() if len(t.array))):
            digest.update(block)
            yield block
        yield digest.digest()


def save(path: str | os.PathLike, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; raises OSError if that fails, and leaves an earlier one as it was."""
    with replacing(path) as part, open(part, "wb") as file:
        for block in checkpoint._blocks():
            file.write(block)


def load(path: str | os.PathLike) -> Checkpoint:
    """Read a checkpoint; raises OSError if it cannot be read and ValueError if it is none."""
    return Checkpoint.from_bytes(_read(path), f'"{path}"')


def peek(path: str | os.PathLike) -> dict:
    """The settings of a checkpoint, without its sums; needs no variant."""
    return _header(_read(path), f'"{path}"')[0]["settings"]


def describe(path: str | os.PathLike) -> str:
    """What a checkpoint holds, as text; raises OSError and ValueError as ``load`` does."""
    header = _header(_read(path), f'"{path}"')[0]
    passes = header["passes"]
    lines = {
        "passes": name_passes(passes),
        # Those of earlier versions hold no estimate
        "noise": name_noise(header.get("noise"), sum(stop - first for first, stop in passes)),
        "renderTime": header["seconds"],
    }
    lines |= header["about"]
    for key, value in header["settings"].items():
        lines |= value if isinstance(value, dict) else {key: value}
    width = max(map(len, lines))
    return f"{path}: sums of passes\n\n" + "\n".join(
        f"  {key:{width}}  " + _word(value).replace("\n", "\n" + " " * (width + 4))
        for key, value in lines.items()
    )


def _read(path) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read()
    except OSError as error:
        raise OSError(f'cannot read "{path}": {error.strerror}.') from None


def _header(data: bytes, name: str) -> tuple[dict, int]:
    """The JSON text of a file, and where its arrays start."""
    if data.startswith(OTHER_NUMBERS):
        raise ValueError(
            f"{name} was rendered with other random numbers, by an earlier version of "
            "nil-mitsuba: only that version can go on with it."
        )
    if not data.startswith(MAGIC):
        raise ValueError(f"{name} is no checkpoint of this version of nil-mitsuba.")
    if len(data) > len(MAGIC) + 8 + 32:
        start = len(MAGIC) + 8
        stop = start + struct.unpack_from("<Q", data, len(MAGIC))[0]
        # The checksum comes first: what is whole was written by this code
        if hashlib.sha256(memoryview(data)[:-32]).digest() == data[-32:]:
            return json.loads(data[start:stop]), stop
    raise ValueError(f"{name} is damaged: its checksum is wrong.")


def differences(ours: dict, theirs: dict) -> Iterator[str]:
    """Sentences on what differs: "twist is 1 there and 2 here"."""
    for key in sorted(ours.keys() | theirs.keys(), key=list(ours | theirs).index):
        there, here = ours.get(key), theirs.get(key)
        if isinstance(there, dict) and isinstance(here, dict):
            yield from differences(there, here)
        elif there != here:
            name = NAMES.get(key, key)
            yield CHANGED.get(key, f"{name} is {_word(there)} there and {_word(here)} here")


def _word(value) -> str:
    if isinstance(value, list):
        return ",".join(map(str, value)) or "none"
    return "none" if value is None else str(value)
