"""Write the meshes and bitmaps that the scenes beside this file use.

Run it from anywhere, after `pip install .`, to make them anew: ``python scenes/make_assets.py``.
"""

from __future__ import annotations

import cmath
import math
import random
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


# ---------------------------------------------------------------------------
#  Meshes in plain Python: lists of points and of triangles
# ---------------------------------------------------------------------------


def write_mesh(name, points, faces, normals=None, uv=None):
    mesh = mi.Mesh(
        name,
        len(points),
        len(faces),
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=uv is not None,
    )
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float([c for point in points for c in point])
    params["faces"] = mi.UInt32([i for face in faces for i in face])
    if normals is not None:
        params["vertex_normals"] = mi.Float([c for normal in normals for c in normal])
    if uv is not None:
        params["vertex_texcoords"] = mi.Float([c for pair in uv for c in pair])
    params.update()
    mesh.write_ply(str(FOLDER / "meshes" / name))


def tube(rings):
    """The surface through closed rings of points, counter-clockwise as seen from its end."""
    around = len(rings[0])
    faces = []
    for j in range(len(rings) - 1):
        for i in range(around):
            a, b = j * around + i, j * around + (i + 1) % around
            faces += [(a, b, b + around), (a, b + around, a + around)]
    return [point for ring in rings for point in ring], faces


def circle(radius, z, around, x=0.0, y=0.0):
    angles = [2 * math.pi * i / around for i in range(around)]
    return [(x + radius * math.cos(a), y + radius * math.sin(a), z) for a in angles]


def join(parts):
    """One mesh of several."""
    points, faces = [], []
    for more, triangles in parts:
        faces += [tuple(i + len(points) for i in triangle) for triangle in triangles]
        points += more
    return points, faces


def spline(knots, steps):
    """A Catmull-Rom curve through the points ``knots``, with ``steps`` pieces between two."""
    curve = []
    for i in range(len(knots) - 1):
        a, b, c, d = (knots[min(max(i + n, 0), len(knots) - 1)] for n in (-1, 0, 1, 2))
        for t in (step / steps for step in range(steps)):
            curve.append(
                tuple(
                    0.5
                    * (
                        2 * q
                        + t
                        * (r - p + t * (2 * p - 5 * q + 4 * r - s + t * (3 * q - p - 3 * r + s)))
                    )
                    for p, q, r, s in zip(a, b, c, d)
                )
            )
    return [*curve, knots[-1]]


def turned(name, *profiles, around=40, steps=4):
    """Write a surface of revolution of profiles (radius, z): each is smooth, edges lie between."""
    parts = []
    for profile in profiles:
        curve = spline(profile, steps) if len(profile) > 2 else profile
        # A ring of radius 0 would have triangles without area, and so no normals.
        parts.append(tube([circle(max(r, 1e-4), z, around) for r, z in curve]))
    write_mesh(name, *join(parts))


def chessmen():
    """Write four chessmen for a board whose squares have edge 1."""
    bottom = [(0, 0), (0.36, 0)]
    foot = [(0.36, 0), (0.40, 0.03), (0.38, 0.09), (0.31, 0.13), (0.27, 0.17)]
    turned(
        "pawn.ply",
        bottom,
        [*foot, (0.17, 0.27), (0.12, 0.42), (0.11, 0.56)],
        [(0.11, 0.56), (0.20, 0.585), (0.20, 0.61), (0.09, 0.64)],
        [(0.09, 0.64), (0.19, 0.72), (0.215, 0.82), (0.17, 0.93), (0.07, 1.0), (0, 1.015)],
    )
    turned(
        "king.ply",
        bottom,
        [*foot, (0.19, 0.30), (0.14, 0.6), (0.13, 1.0), (0.15, 1.12)],
        [(0.15, 1.12), (0.25, 1.15), (0.25, 1.18), (0.15, 1.22)],
        [(0.15, 1.22), (0.17, 1.3), (0.235, 1.55), (0.24, 1.6)],
        [(0.24, 1.6), (0.2, 1.66), (0.08, 1.71), (0.04, 1.75)],
        [(0.04, 1.75), (0.085, 1.8), (0.085, 1.86), (0.03, 1.91), (0, 1.915)],
    )
    turned(
        "bishop.ply",
        bottom,
        [*foot, (0.18, 0.28), (0.125, 0.55), (0.115, 0.85)],
        [(0.115, 0.85), (0.215, 0.88), (0.215, 0.91), (0.10, 0.94)],
        [(0.10, 0.94), (0.18, 1.03), (0.19, 1.13), (0.13, 1.28), (0.05, 1.38)],
        [(0.05, 1.38), (0.07, 1.42), (0.05, 1.46), (0, 1.475)],
    )
    turned(
        "rook.ply",
        bottom,
        [*foot, (0.21, 0.25), (0.175, 0.5), (0.18, 0.74), (0.2, 0.78)],
        [(0.2, 0.78), (0.27, 0.80)],
        [(0.27, 0.80), (0.27, 0.99)],
        [(0.27, 0.99), (0.19, 0.99)],
        [(0.19, 0.99), (0.19, 0.88)],
        [(0.19, 0.88), (0, 0.88)],
    )


def vase():
    turned(
        "vase.ply",
        [(0, 0), (0.2, 0)],
        [
            (0.2, 0),
            (0.34, 0.15),
            (0.42, 0.4),
            (0.33, 0.68),
            (0.14, 0.88),
            (0.11, 1.0),
            (0.17, 1.1),
            (0.16, 1.105),
            (0.095, 1.0),
            (0.1, 0.9),
        ],
    )


def shell(name, turns=5, along=500, around=28):
    """Write a whelk: a ribbed circle that grows as it turns. About [−1, 1] high, axis z."""
    growth, rings = 0.115, []
    for j in range(along):
        angle = 2 * math.pi * turns * (j / (along - 1) - 1)
        size = math.exp(growth * angle)
        ribs = 1 + 0.035 * math.cos(14 * angle)
        ring = []
        for a in (2 * math.pi * i / around for i in range(around)):
            # The heights are those of the largest whorl, centred.
            r, z = 0.54 + 0.46 * ribs * math.cos(a), -1.35 + 0.5 * ribs * math.sin(a)
            ring.append((size * r * math.cos(angle), size * r * math.sin(angle), size * z + 0.93))
        rings.append(ring[::-1])
    write_mesh(name, *tube(rings))


def arches(name, count=14):
    """Write ``count`` pointed arches across x, two wide, one apart along y: the ribs of a nave."""
    springing, radius, steps = 1.6, 1.7, 24
    centre = radius - 1
    apex = math.acos(centre / radius)
    # Points (x, z) of the left half with their outward normals.
    half = [((-1, 0), (-1, 0)), ((-1, springing), (-1, 0))]
    for a in (apex * i / steps for i in range(1, steps)):
        half.append(
            (
                (centre - radius * math.cos(a), springing + radius * math.sin(a)),
                (-math.cos(a), math.sin(a)),
            )
        )
    # The two halves meet in a mitre.
    top = [((0, springing + radius * math.sin(apex)), (0, 1 / math.sin(apex)))]
    line = half + top + [((-x, z), (-nx, nz)) for (x, z), (nx, nz) in half[::-1]]
    w, c = 0.10, 0.045  # half width of a rib, and how much of its edges is cut off
    section = [
        (w, c - w),
        (w - c, -w),
        (c - w, -w),
        (-w, c - w),
        (-w, w - c),
        (c - w, w),
        (w - c, w),
        (w, w - c),
    ]

    def block(x, y, z0, z1, w):
        square = [(x - w, y - w), (x + w, y - w), (x + w, y + w), (x - w, y + w)]
        points, faces = tube([[(x, y, z) for x, y in square] for z in (z0, z1)])
        return points, [*faces, (4, 5, 6), (4, 6, 7), (2, 1, 0), (3, 2, 0)]

    parts = []
    for y in range(count):
        parts.append(
            tube(
                [[(x + nx * a, y + b, z + nz * a) for a, b in section] for (x, z), (nx, nz) in line]
            )
        )
        for x in (-1, 1):
            parts += [block(x, y, 0, 0.18, 0.17), block(x, y, 1.5, 1.62, 0.16)]
    write_mesh(name, *join(parts))


def ball(centre, radius, level, rough=0.0, rng=None, flat=1.0):
    """An icosahedron, refined ``level`` times, whose vertices are off by ``rough`` at random."""
    g = (1 + math.sqrt(5)) / 2
    points = [(0, s, t * g) for s in (-1, 1) for t in (-1, 1)]
    points = [(p[-i], p[1 - i], p[2 - i]) for i in range(3) for p in points]
    faces = [
        (a, b, c)
        for a in range(12)
        for b in range(a)
        for c in range(b)
        if all(math.dist(points[i], points[j]) < 2.1 for i, j in ((a, b), (b, c), (c, a)))
    ]
    for _ in range(level):
        middles, finer = {}, []

        def middle(i, j):
            key = min(i, j), max(i, j)
            if key not in middles:
                middles[key] = len(points)
                points.append(tuple((p + q) / 2 for p, q in zip(points[i], points[j])))
            return middles[key]

        for a, b, c in faces:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            finer += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = finer

    outwards = []
    for a, b, c in faces:
        p, q, r = points[a], points[b], points[c]
        volume = sum(p[i - 2] * (q[i - 1] * r[i] - q[i] * r[i - 1]) for i in range(3))
        outwards.append((a, b, c) if volume > 0 else (a, c, b))
    placed = []
    for p in points:
        r = radius / math.hypot(*p) * (1 + (rough * rng.uniform(-1, 1) if rng else 0))
        placed.append((centre[0] + r * p[0], centre[1] + r * p[1], centre[2] + flat * r * p[2]))
    return placed, outwards


def island():
    """Write the four parts of an island in the sky, of radius 1: rock, grass, trunk and leaves."""
    rng = random.Random(4)

    def noise(amount):
        return amount * rng.uniform(-1, 1)

    around, rock = 26, []
    for radius, z in (
        (0.0, -0.62),
        (0.16, -0.5),
        (0.34, -0.34),
        (0.62, -0.2),
        (0.9, -0.1),
        (1.0, -0.02),
    ):
        ring = []
        for i in range(around):
            a = 2 * math.pi * (i + 0.5 * rng.random()) / around
            r = radius * (1 + noise(0.16)) + 0.02
            ring.append((r * math.cos(a), r * math.sin(a), z + noise(0.05)))
        rock.append(ring)
    write_mesh("rock.ply", *tube(rock))

    grass = [rock[-1]]
    for scale, z in ((1.0, 0.05), (0.8, 0.07), (0.45, 0.1), (1e-3, 0.12)):
        grass.append([(scale * x, scale * y, z + scale * noise(0.02)) for x, y, _ in rock[-1]])
    write_mesh("grass.ply", *tube(grass))

    turned("trunk.ply", [(0.13, 0.05), (0.075, 0.2), (0.055, 0.45), (0.07, 0.75)], around=12)
    crown = [
        ((0.05, 0, 0.95), 0.36),
        ((-0.22, 0.1, 0.78), 0.26),
        ((0.25, -0.12, 0.75), 0.27),
        ((0.02, 0.25, 0.72), 0.24),
        ((0, -0.2, 0.7), 0.22),
    ]
    write_mesh("leaves.ply", *join(ball(c, r, 2, 0.09, rng, 0.85) for c, r in crown))


def lamps():
    """Write lamp posts, 1.3 apart on the plane z = 0, and their globes in two colours."""
    posts, warm, cold = [], [], []
    for i in range(-5, 6):
        for j in range(11):
            x, y = 1.3 * i, 1.3 * j
            posts += [
                tube([circle(r, z, 8, x, y) for z in (0, height)])
                for r, height in ((0.022, 0.93), (0.05, 0.1))
            ]
            (cold if (7 * i + 3 * j) % 5 == 4 else warm).append(ball((x, y, 1), 0.085, 2))
    for name, parts in (("posts", posts), ("lamps-warm", warm), ("lamps-cold", cold)):
        write_mesh(f"{name}.ply", *join(parts))


def lantern(name, windows=8, latitude=17, half=4.5):
    """Write a sphere of radius 1 that is pierced by a ring of windows at a latitude in degrees.

    A window reaches ``half`` degrees to each side of its middle, in latitude and in longitude.
    """
    window, wall = 2 * half, 360 / windows - 2 * half
    steps = [window, *[wall / 4] * 4] * windows
    longitudes = [sum(steps[:i]) - half for i in range(len(steps))]
    lower, upper = latitude - half, latitude + half
    latitudes = [-90 + (lower + 90) * i / 16 for i in range(16)]
    latitudes += [lower, *(upper + (90 - upper) * i / 12 for i in range(13))]
    rings = []
    for angle in map(math.radians, latitudes):
        # A ring of radius 0 would have triangles without area, and so no normals.
        r, z = max(math.cos(angle), 1e-4), math.sin(angle)
        rings.append([(r * math.cos(a), r * math.sin(a), z) for a in map(math.radians, longitudes)])
    points, faces = tube(rings)
    # A quad is two triangles in a row; every fifth one of the ring from `lower` is a window.
    pierced = range(2 * 16 * len(steps), 2 * 17 * len(steps))
    faces = [f for i, f in enumerate(faces) if i not in pierced or i // 2 % 5]
    write_mesh(name, points, faces)


def winding_floor(name, size=56):
    """Write a floor that the glued cube carries on without a seam, but for one axis.

    A floor z = f(x, y) over the whole quotient (twist 1) does not exist: f(x + 1, y) = f(x, y) + y
    and f(x, y + 1) = f(x, y) disagree by 1 after one round of the cell. The argument of the theta
    function θ(x, y) = Σ exp(−π (x − n)² + 2π i n y) obeys both, up to whole floors, and winds once
    round the zero of θ at the centre of the cell: f = arg θ / 2π is a ramp there.
    """
    # The gap between two cells is too narrow to be seen.
    margin, height, hole = 5e-5, 0.1, 0.05

    def vertex(x, y):
        θ = θx = θy = 0
        for n in range(-3, 5):
            term = cmath.exp(-math.pi * (x - n) ** 2 + 2j * math.pi * n * y)
            θ, θx, θy = θ + term, θx - 2 * math.pi * (x - n) * term, θy + 2j * math.pi * n * term
        θ = θ or 1e-9  # at the zero itself, in the hole
        slope = [(derivative / θ).imag / (2 * math.pi) for derivative in (θx, θy)]
        length = math.hypot(*slope, 1)
        normal = -slope[0] / length, -slope[1] / length, 1 / length
        return (x, y, cmath.phase(θ) / (2 * math.pi) + height, *normal)

    def clip(polygon, sign, z):
        """The part of a polygon where sign · (its height − z) ≥ 0."""
        result = []
        for p, q in zip(polygon, polygon[1:] + polygon[:1]):
            above, next_above = sign * (p[2] - z), sign * (q[2] - z)
            if above >= 0:
                result.append(p)
            if (above >= 0) != (next_above >= 0):
                t = above / (above - next_above)
                result.append(tuple(a + t * (b - a) for a, b in zip(p, q)))
        return result

    coordinates = [margin + (1 - 2 * margin) * i / size for i in range(size + 1)]
    grid = [[vertex(x, y) for y in coordinates] for x in coordinates]
    index, faces = {}, []
    for i in range(size):
        for j in range(size):
            a, b, c, d = grid[i][j], grid[i + 1][j], grid[i + 1][j + 1], grid[i][j + 1]
            for triangle in ((a, b, c), (a, c, d)):
                if min(math.dist(p[:2], (0.5, 0.5)) for p in triangle) < hole:
                    continue
                # The branch of the argument that is continuous on this triangle, on every floor
                # that it reaches in the cube
                level = triangle[0][2]
                for floor in (-1, 0, 1, 2):
                    polygon = [(x, y, z - round(z - level) + floor, *n) for x, y, z, *n in triangle]
                    polygon = clip(clip(polygon, 1, margin), -1, 1 - margin)
                    # Neighbours agree on a vertex but for rounding.
                    ids = [
                        index.setdefault(tuple(round(c, 6) for c in p), len(index)) for p in polygon
                    ]
                    faces += [
                        (ids[0], m, n) for m, n in zip(ids[1:], ids[2:]) if len({ids[0], m, n}) == 3
                    ]
    vertices = list(index)
    write_mesh(
        name, [v[:3] for v in vertices], faces, [v[3:] for v in vertices], [v[:2] for v in vertices]
    )


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    torus_knot("trefoil.ply")
    chessmen()
    vase()
    shell("shell.ply")
    arches("arches.ply")
    island()
    lamps()
    lantern("lantern.ply")
    winding_floor("winding-floor.ply")
    sky(
        "evening.exr",
        zenith=(0.10, 0.26, 0.60),
        horizon=(0.95, 0.50, 0.34),
        nadir=(0.10, 0.08, 0.22),
        glows=[((9.0, 5.4, 2.6), (0.5, -0.45, 0.75), 14), ((0.4, 0.7, 1.2), (-0.8, -0.3, 0.25), 4)],
    )
    sky(
        "day.exr",
        zenith=(0.45, 0.62, 0.95),
        horizon=(0.86, 0.88, 0.90),
        nadir=(0.30, 0.28, 0.27),
        glows=[((7.0, 6.3, 5.2), (-0.3, -0.6, 0.75), 10)],
    )
    sky(
        "night.exr",
        zenith=(0.02, 0.06, 0.16),
        horizon=(0.10, 0.34, 0.42),
        nadir=(0.03, 0.02, 0.08),
        glows=[((5, 5.6, 6.4), (-0.75, -0.45, 0.35), 12), ((1.6, 0.7, 0.3), (0.9, -0.3, -0.3), 5)],
    )
