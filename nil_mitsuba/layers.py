"""The layers beside a picture: their channels, how a pixel's samples make them, how files store
them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

# How a pixel's samples become its value in a layer: averaged as the picture is; the first of them,
# where whole numbers are names, which no average could be; or their number.
Rule = Literal["mean", "first", "count"]


class Layer(NamedTuple):
    """Names of a layer's channels, how samples combine, and the type that stores them in a file."""

    channels: tuple[str, ...]
    rule: Rule | None  # None: not rendered, but made of the picture
    storage: str | None  # None: as the picture is stored


# A layer's name in a file is what precedes the last dot. What follows it has one letter, since
# Blender leaves channels with longer ones out; vectors have X, Y and Z in capitals, since Mitsuba
# cannot split a file with others. Nuke's own layer of depths has the channel depth.Z. What is
# counted or measured stays float32: whole numbers up to 2^24 are exact in it, signs and all, and
# programs that know no integers read it.
# Rendered ones come in the order of their rules: an image holds them as they are listed here.
LAYERS: Mapping[str, Layer] = {
    "distance": Layer(("depth.Z",), "mean", "float32"),
    "position": Layer(("position.X", "position.Y", "position.Z"), "mean", "float32"),
    "normal": Layer(("normal.X", "normal.Y", "normal.Z"), "mean", "float16"),
    "albedo": Layer(("albedo.R", "albedo.G", "albedo.B"), "mean", "float16"),
    "transmittance": Layer(
        ("transmittance.R", "transmittance.G", "transmittance.B"), "mean", "float16"
    ),
    "cell": Layer(("cell.X", "cell.Y", "cell.Z"), "first", "float32"),
    "shape": Layer(("shape.X",), "first", "float32"),
    "samples": Layer(("samples.X",), "count", "float32"),
    "noisy": Layer(("noisy.R", "noisy.G", "noisy.B"), None, None),
}

# Those that can be asked for.
RENDERED = tuple(name for name, layer in LAYERS.items() if layer.rule)

# Those that guide a denoiser.
GUIDES = ("albedo", "normal")


def channel_names(layers: Iterable[str], rule: Rule | None = None) -> list[str]:
    """Names of the channels of ``layers``, or of those among them with one rule."""
    return [
        channel
        for name in layers
        if rule in (None, LAYERS[name].rule)
        for channel in LAYERS[name].channels
    ]
