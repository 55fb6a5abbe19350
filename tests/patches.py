"""Patches of a surface, and samples of the light that the package finds for them."""

import drjit as dr
import mitsuba as mi


def lights(twist, quotient, max_distance, **scene):
    from nil_mitsuba.lights import Lights
    from nil_mitsuba.quotient import Space

    scene = mi.load_dict({"type": "scene", **scene})
    return Lights(scene, Space(float(twist), quotient, [0, 0, 0], 1.0), max_distance)


class Strata:
    """A sampler whose number pairs run through equal steps, so that means are quadratures."""

    def __init__(self, count, copies=1):
        self.u = (mi.Float(dr.arange(mi.UInt32, count * copies) % count) + 0.5) / count

    def next_1d(self):
        return mi.Float(0.5)

    def next_2d(self):
        return mi.Point2f(self.u, 0.5)


def independent(count, seed=0):
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    return sampler


def surface(points, normals):
    """Surface interactions at points (scene) with unit frame normals."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(points))
    si.p, si.n = mi.Point3f(points), mi.Normal3f(normals)
    si.sh_frame = mi.Frame3f(si.n)
    si.t = 1.0
    return si


def received(found, n):
    """Irradiance that each light sample brings to a surface with unit normal n (first channel)."""
    return found.weight[0] * dr.maximum(dr.dot(n, found.direction), 0)


def point_light(position, intensity=1.0):
    return {
        "type": "point",
        "position": list(position),
        "intensity": {"type": "rgb", "value": intensity},
    }


UP = (0.0, 0.0, 1.0)
TILTED = (0.36, -0.48, 0.8)

# Beyond length 2π/|k|, and away from caustics: several geodesics arrive.
FAR_PATCHES = {
    1: [
        ((0.0, 0.0, 0.0), UP, (0.5, -0.3, 8.925)),
        ((0.0, 0.0, 0.0), TILTED, (-0.7, 0.5, 15.0)),
        ((0.4, -0.3, 0.5), (0.0, 0.0, -1.0), (1.1, 0.2, -20.0)),
        ((0.0, 0.0, 0.0), (-0.6, 0.0, 0.8), (1.5, -0.4, 27.0)),
    ],
    2: [((0.0, 0.0, 0.0), UP, (0.2, 0.1, 4.96)), ((0.0, 0.0, 0.0), TILTED, (-0.5, 0.4, -9.0))],
    3: [((0.1, 0.2, 0.0), UP, (0.5, -0.3, 5.0)), ((0.0, 0.0, 0.0), TILTED, (-0.3, 0.4, 8.0))],
    -1: [
        ((0.1, 0.2, 0.0), UP, (1.0, 1.0, 10.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (1.5, -0.4, -20.0)),
    ],
}
REACH = {1: 32.0, 2: 15.0, 3: 12.0, -1: 32.0}
