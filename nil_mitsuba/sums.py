"""What passes of an image add up to, and the image that it is."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .layers import channel_names

LUMINANCE = (0.212671, 0.715160, 0.072169)  # of linear sRGB, as Mitsuba weighs it


@dataclass
class Sums:
    """What passes add up to, in double precision: 2³² samples and more lose nothing.

    ``values``: TensorXd, height × width × channels of the film, weights included; ``moments``:
    TensorXd, 3 × height × width, sums over passes of S², S·W and W², where S is the sum of weighted
    luminances in a pixel of one pass and W that of the weights; ``points``: TensorXi, height ×
    width × channels of the layers that show a pixel's first sample; ``passes``: ranges (first,
    stop) of the passes that are in, sorted. ``halves``: of a single pass alone, and only if asked
    for, TensorXd, 2 × height × width: by how much S and W differ between its two halves, enlarged
    as far as those are not of one size.
    """

    values: mi.TensorXd
    moments: mi.TensorXd
    points: mi.TensorXi
    passes: tuple[tuple[int, int], ...]
    halves: mi.TensorXd | None = None

    @property
    def count(self) -> int:
        """Number of passes that are in."""
        return sum(stop - first for first, stop in self.passes)

    def plus(self, other: Sums) -> Sums:
        """The sums of both; the first samples are those of the lowest pass.

        Raises ValueError if a pass is in both.
        """
        passes = joined(self.passes, other.passes)
        first = min(
            (sums for sums in (self, other) if sums.passes),
            default=self,
            key=lambda sums: sums.passes[0],
        )
        sums = Sums(self.values + other.values, self.moments + other.moments, first.points, passes)
        dr.eval(sums.values, sums.moments)
        return sums


def joined(*ranges: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
    """Sets of passes put together; raises ValueError if a pass is in two of them."""
    together: list[tuple[int, int]] = []
    for first, stop in sorted(part for several in ranges for part in several):
        if together and first < together[-1][1]:
            twice = first, min(stop, together[-1][1])
            raise ValueError(f"the passes {name_passes([twice])} are there twice.")
        if together and first == together[-1][1]:
            first = together.pop()[0]
        together.append((first, stop))
    return tuple(together)


def name_passes(ranges: Iterable[tuple[int, int]]) -> str:
    """Ranges of passes as they are written on a command line, such as "0:8, 12:16"."""
    return ", ".join(f"{first}:{stop}" for first, stop in ranges)


def name_noise(noise: float | None, passes: int) -> str:
    """What ``stills.noise`` says of so many passes, or why it says nothing."""
    if noise is None and passes < 2:
        return f"not estimated: {'one pass' if passes else 'no passes'}"
    if noise is None:
        return "not stated"
    if noise == 0:  # A black picture, too, of which one can say no more
        return f"0: {'all passes' if passes > 1 else 'both halves of the pass'} are equal"
    return "infinite: no pixel is finite" if noise == math.inf else f"{noise:.3g}"


def develop(film: mi.Film, layers: Iterable[str], sums: Sums, pass_spp: int) -> mi.TensorXf:
    """The image in ``film`` of passes of ``pass_spp`` samples that rendered ``layers``, too.

    A tensor, height × width × channels, those of the layers behind the picture's.
    """
    film.prepare(channel_names(layers, "mean"))
    film.put_block(mi.ImageBlock(mi.TensorXf(sums.values), film.crop_offset()))
    image = film.develop()
    shape = image.shape[:2]
    further = [mi.TensorXf(sums.points)] if sums.points.shape[2] else []
    if "samples" in layers:
        further.append(dr.full(mi.TensorXf, sums.count * pass_spp, (*shape, 1)))
    return dr.concat([image, *further], axis=2) if further else image


def luminance(film: mi.Film, values: mi.TensorXf | mi.TensorXd) -> tuple[mi.Float64, mi.Float64]:
    """Sums of luminances and of weights by pixel, out of the channels that a film sums up."""
    channels = values.shape[2]

    def channel(i):
        return plane(values, i)

    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        # Bands of its own, none more important than another; the last channel is the weight
        weight = channels - 1
        colours: tuple[float, ...] = (1 / weight,) * weight
    else:
        weight = 4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3
        colours = LUMINANCE
    return sum(c * channel(i) for i, c in enumerate(colours)), channel(weight)


def plane(values: mi.TensorXf | mi.TensorXd, channel: int) -> mi.Float64:
    """A channel of an image, height × width × channels, by pixel."""
    height, width, channels = values.shape
    pixel = dr.arange(mi.UInt32, height * width) * channels
    return mi.Float64(dr.gather(type(values.array), values.array, pixel + channel))
