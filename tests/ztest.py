"""Do two images have the same expectation? Statistics shared by the tests of whole renders."""

from __future__ import annotations

import math
from statistics import NormalDist

import drjit as dr
import mitsuba as mi

# Mitsuba's test_renders.py: significance of the test on all pixels together, and the share of the
# pixels that must pass it.
SIGNIFICANCE = 0.01
PASSING = 0.9975

# Pooled over an image, z is normal to a good approximation: one in 2,100 sound images exceeds this.
POOLED_Z = 3.5


class Estimate:
    """Mean XYZ of each pixel, and the variance of that mean; ``shape`` is (rows, columns).

    A variance is not believed below what float32 sums of squares resolve (1e-5 of the square of
    the mean, per sample).
    """

    def __init__(self, scene, integrator, spp, seed=0, sensor=0):
        moment = {"type": "moment", "of": integrator}
        image = mi.render(scene, sensor=sensor, integrator=mi.load_dict(moment), spp=spp, seed=seed)
        dr.eval(image)
        self.shape = image.shape[:2]
        first = image.shape[2] - 6
        pixels = dr.arange(mi.UInt32, self.shape[0] * self.shape[1])

        def channel(c):
            return dr.gather(mi.Float, image.array, pixels * image.shape[2] + c)

        self.mean = [channel(first + c) for c in range(3)]
        self.variance = [
            dr.maximum(channel(first + 3 + c) - dr.square(m), 1e-5 * dr.square(m) + 1e-8)
            / (spp - 1)
            for c, m in enumerate(self.mean)
        ]


def z_scores(first: Estimate, second: Estimate, block: int | None = None) -> list[mi.Float]:
    """z of the difference of two estimates, by channel and by square block of ``block`` pixels
    (the whole image if it is None), which must divide the image."""
    rows, columns = first.shape
    pixel = dr.arange(mi.UInt32, rows * columns)
    if block is None:
        index, count = dr.zeros(mi.UInt32, rows * columns), 1
    else:
        assert rows % block == 0 and columns % block == 0
        across = columns // block
        index, count = (
            (pixel // columns) // block * across + (pixel % columns) // block,
            rows // block * across,
        )
    scores = []
    for c in range(3):
        difference, variance = dr.zeros(mi.Float, count), dr.zeros(mi.Float, count)
        dr.scatter_add(difference, first.mean[c] - second.mean[c], index)
        dr.scatter_add(variance, first.variance[c] + second.variance[c], index)
        scores.append(difference * dr.rsqrt(variance))
    return scores


def sidak(count: int, significance: float = SIGNIFICANCE) -> float:
    """The |z| that the largest of ``count`` independent normal scores exceeds with probability
    ``significance``."""
    single = -math.expm1(math.log1p(-significance) / count)
    return -NormalDist().inv_cdf(single / 2)


def assert_same_expectation(first: Estimate, second: Estimate, block: int | None = None) -> None:
    """Fail if the two images differ by more than their noise, whole, by pixels, or by blocks.

    On equal expectations it fails with probability 0.0014 for the pooled scores of three channels
    (|z| > 3.5), less than that for the share of pixels that pass, and, with blocks, 0.001 more.
    """
    pooled = [float(z[0]) for z in z_scores(first, second)]
    assert max(map(abs, pooled)) <= POOLED_Z, f"pooled z of X, Y, Z: {pooled}"

    rows, columns = first.shape
    limit = sidak(rows * columns)
    for z in z_scores(first, second, block=1):
        failing = rows * columns - dr.count(dr.abs(z) <= limit)[0]  # NaN fails, too
        # One in 100 sound images of any size has one such pixel, one in 20,000 has two
        allowed = max(1, (1 - PASSING) * rows * columns)
        assert failing <= allowed, f"{failing} of {rows * columns} pixels fail the Z-test"

    if block is not None:
        scores = z_scores(first, second, block)
        limit = sidak(3 * len(scores[0]), 0.001)
        for channel, z in zip("XYZ", scores):
            beyond = [(i, round(float(x), 2)) for i, x in enumerate(z) if not abs(x) <= limit]
            assert not beyond, f"blocks whose {channel} differs by |z| > {limit:.2f}: {beyond}"
