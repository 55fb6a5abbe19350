"""Write the meshes and bitmaps that the scenes beside this file use.

Run it from anywhere, after `pip install .`, to make them anew: ``python scenes/make_assets.py``.
"""

from __future__ import annotations

import math
from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import drjit as dr
import mitsuba as mi

FOLDER = Path(__file__).resolve().parent


def sky(width=128):
    """A soft evening sky as an environment map: z is up, the sun's side is +y.

    Every colour is a smooth function of direction, so that little resolution does.
    """
    height = width // 2
    i, j = dr.meshgrid(dr.arange(mi.Float, width), dr.arange(mi.Float, height))
    sin_phi, cos_phi = dr.sincos((i + 0.5) / width * 2 * dr.pi)
    sin_theta, cos_theta = dr.sincos((j + 0.5) / height * dr.pi)
    # Mitsuba's convention for latitude-longitude maps whose axis is +y, then turned to +z
    d = mi.Vector3f(sin_theta * sin_phi, cos_theta, -sin_theta * cos_phi)
    d = mi.Vector3f(d.x, -d.z, d.y)

    def blend(a, b, t):
        return dr.lerp(mi.Color3f(*a), mi.Color3f(*b), dr.clip(t, 0, 1))

    def glow(color, direction, sharpness):
        axis = dr.normalize(mi.Vector3f(*direction))
        return mi.Color3f(*color) * dr.exp(sharpness * (dr.dot(d, axis) - 1))

    horizon = (0.95, 0.50, 0.34)
    color = dr.select(
        d.z > 0,
        blend(horizon, (0.10, 0.26, 0.60), 1.4 * d.z),
        blend(horizon, (0.10, 0.08, 0.22), -1.8 * d.z),
    )
    color += glow((9.0, 5.4, 2.6), (0.5, -0.45, 0.75), 14)
    color += glow((0.4, 0.7, 1.2), (-0.8, -0.3, 0.25), 4)
    image = mi.TensorXf(dr.ravel(color), (height, width, 3))
    mi.Bitmap(image).convert(component_format=mi.Struct.Type.Float16).write(
        str(FOLDER / "textures" / "sky.exr")
    )


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    sky()
