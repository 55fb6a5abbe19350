"""Write the meshes and bitmaps that the scenes beside this file use.

Run it from anywhere, after `pip install .`, to make them anew: ``python scenes/make_assets.py``.
"""

from __future__ import annotations

from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import drjit as dr
import mitsuba as mi

FOLDER = Path(__file__).resolve().parent


def sky(name, zenith, horizon, nadir, glows, width=128):
    """Write an environment map: three colours blended by height, and soft lights.

    ``glows`` are triples of colour, direction (z is up) and sharpness: radiance
    colour · exp(sharpness (cos θ − 1)). All is smooth, so that little resolution does.
    """
    height = width // 2
    column, row = dr.meshgrid(dr.arange(mi.Float, width), dr.arange(mi.Float, height))
    sin_phi, cos_phi = dr.sincos((column + 0.5) / width * dr.two_pi)
    sin_theta, cos_theta = dr.sincos((row + 0.5) / height * dr.pi)
    # Mitsuba's maps have +y upwards: the scenes turn them by 90° about x.
    direction = mi.Vector3f(sin_theta * sin_phi, sin_theta * cos_phi, cos_theta)

    up = direction.z
    pole = dr.select(up > 0, mi.Color3f(*zenith), mi.Color3f(*nadir))
    color = dr.lerp(mi.Color3f(*horizon), pole, dr.minimum(1, 1.5 * dr.abs(up)))
    for radiance, towards, sharpness in glows:
        cosine = dr.dot(direction, dr.normalize(mi.Vector3f(*towards)))
        color += mi.Color3f(*radiance) * dr.exp(sharpness * (cosine - 1))

    image = mi.Bitmap(mi.TensorXf(dr.ravel(color), (height, width, 3)))
    image = image.convert(component_format=mi.Struct.Type.Float16)
    image.write(str(FOLDER / "textures" / name))


def stripes(name, size=128):
    """Write a bitmap of slanted stripes that repeats in both directions."""
    column, row = dr.meshgrid(dr.arange(mi.Float, size), dr.arange(mi.Float, size))
    phase = dr.two_pi / size * (column + row)
    # Edges a few pixels wide look sharp from afar and do not alias from near.
    wave = [dr.clip(0.5 + 4 * dr.cos(n * phase), 0, 1) for n in (1, 4)]
    color = dr.lerp(mi.Color3f(0.80, 0.20, 0.08), mi.Color3f(0.90, 0.84, 0.70), wave[0])
    color = dr.lerp(color, mi.Color3f(0.05, 0.14, 0.30), wave[1] * (1 - wave[0]))
    image = mi.Bitmap(mi.TensorXf(dr.ravel(color), (size, size, 3)))
    image.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(
        str(FOLDER / "textures" / name)
    )


def torus_knot(name, p=2, q=3, around=30, along=900):
    """Write a tube around the (p, q) torus knot: 2 · around · along triangles in [−1, 1]³.

    Vertices carry the colours of the rainbow in the order of the curve, and no normals: Mitsuba
    computes smooth ones.
    """
    # Radii of the torus that carries the curve, and of the tube: they add up to less than 1.
    ring, section, tube = 0.57, 0.27, 0.1
    i, j = dr.meshgrid(dr.arange(mi.Float, around), dr.arange(mi.Float, along))
    t, s = dr.two_pi / along * j, dr.two_pi / around * i

    def curve(t):
        r = ring + section * dr.cos(q * t)
        return mi.Point3f(r * dr.cos(p * t), r * dr.sin(p * t), section * dr.sin(q * t))

    # A frame along the curve from the torus' own axis circle: it never flips and closes up.
    tangent = dr.normalize(curve(t + 1e-2) - curve(t - 1e-2))
    outwards = curve(t) - ring * mi.Vector3f(dr.cos(p * t), dr.sin(p * t), 0)
    normal = dr.normalize(outwards - tangent * dr.dot(tangent, outwards))
    binormal = dr.cross(tangent, normal)
    position = curve(t) + tube * (normal * dr.cos(s) + binormal * dr.sin(s))
    hue = t + mi.Vector3f(0, 1, 2) * (dr.two_pi / 3)
    color = dr.square(0.5 + 0.42 * dr.cos(hue))

    i, j = mi.UInt32(i), mi.UInt32(j)
    here, right = j * around + i, j * around + (i + 1) % around
    ahead, diagonal = ((v + around) % (around * along) for v in (here, right))
    faces = [here, right, diagonal, here, diagonal, ahead]

    mesh = mi.Mesh(name, around * along, 2 * around * along)
    mesh.add_attribute("vertex_color", 3, dr.ravel(color))
    params = mi.traverse(mesh)
    params["vertex_positions"] = dr.ravel(position)
    indices = dr.empty(mi.UInt32, 6 * around * along)
    for n, index in enumerate(faces):
        dr.scatter(indices, index, here * 6 + n)
    params["faces"] = indices
    params.update()
    mesh.write_ply(str(FOLDER / "meshes" / name))


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    stripes("stripes.png")
    torus_knot("trefoil.ply")
    sky(
        "evening.exr",
        zenith=(0.10, 0.26, 0.60), horizon=(0.95, 0.50, 0.34), nadir=(0.10, 0.08, 0.22),
        glows=[((9.0, 5.4, 2.6), (0.5, -0.45, 0.75), 14), ((0.4, 0.7, 1.2), (-0.8, -0.3, 0.25), 4)],
    )  # fmt: skip
    sky(
        "day.exr",
        zenith=(0.45, 0.62, 0.95), horizon=(0.86, 0.88, 0.90), nadir=(0.30, 0.28, 0.27),
        glows=[((7.0, 6.3, 5.2), (-0.3, -0.6, 0.75), 10)],
    )  # fmt: skip
    sky(
        "night.exr",
        zenith=(0.02, 0.06, 0.16), horizon=(0.10, 0.34, 0.42), nadir=(0.03, 0.02, 0.08),
        glows=[((5, 5.6, 6.4), (-0.75, -0.45, 0.35), 12), ((1.6, 0.7, 0.3), (0.9, -0.3, -0.3), 5)],
    )  # fmt: skip
