"""Small things to photograph: meshes in files, textures, films. No randomness, no numpy."""

from __future__ import annotations

import math
import struct
import zlib

import mitsuba as mi

ICOSAHEDRON = [(0, s, t * 1.618) for s in (-1, 1) for t in (-1, 1)]
ICOSAHEDRON = [(v[-i], v[1 - i], v[2 - i]) for i in range(3) for v in ICOSAHEDRON]


def faces(vertices):
    """The triangles of a convex polyhedron with edges of length 2, seen from outside in order."""
    triangles = []
    n = len(vertices)
    for i in range(n):
        for j in range(i + 1, n):
            for k in range(j + 1, n):
                a, b, c = (vertices[m] for m in (i, j, k))
                if all(abs(math.dist(p, q) - 2) < 0.01 for p, q in ((a, b), (b, c), (c, a))):
                    u, v = ([q[m] - a[m] for m in range(3)] for q in (b, c))
                    normal = [u[m - 2] * v[m - 1] - u[m - 1] * v[m - 2] for m in range(3)]
                    outward = sum(normal[m] * a[m] for m in range(3)) > 0
                    triangles.append((i, j, k) if outward else (i, k, j))
    assert len(triangles) == 20
    return triangles


def uv(vertex):
    x, y, z = vertex
    return (0.5 + math.atan2(y, x) / (2 * math.pi), 0.5 + z / 4)


def write_obj(path):
    lines = [f"v {x:f} {y:f} {z:f}" for x, y, z in ICOSAHEDRON]
    lines += ["vt {:f} {:f}".format(*uv(v)) for v in ICOSAHEDRON]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in f) for f in faces(ICOSAHEDRON)]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def write_ply(path, vertices=ICOSAHEDRON, triangles=None):
    """A mesh with a colour at each vertex (attribute vertex_color) and each face (face_color)."""

    def colour(i):
        return [0.5 + 0.4 * math.sin(7 * i + j) for j in range(3)]

    triangles = triangles or faces(vertices)
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in "xyzrgb"]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    header += [f"property float {name}" for name in "rgb"]
    lines = [" ".join(f"{c:.9g}" for c in (*v, *colour(i))) for i, v in enumerate(vertices)]
    lines += [
        f"3 {a} {b} {c} {(i + 1) / (len(triangles) + 1):f} 0.3 0.5"
        for i, (a, b, c) in enumerate(triangles)
    ]
    path.write_text("\n".join([*header, "end_header", *lines]) + "\n")
    return str(path)


def write_serialized(path):
    """Mitsuba's own format, version 4: one mesh with single-precision positions."""
    triangles = faces(ICOSAHEDRON)
    body = struct.pack("<I", 0x1000) + b"icosahedron\0"
    body += struct.pack("<QQ", len(ICOSAHEDRON), len(triangles))
    body += b"".join(struct.pack("<3f", *v) for v in ICOSAHEDRON)
    body += b"".join(struct.pack("<3I", *f) for f in triangles)
    path.write_bytes(struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1))
    return str(path)


def write_curve(path):
    points = [(math.sin(i), math.cos(i), 0.4 * i - 1.4, 0.15 + 0.02 * i) for i in range(8)]
    path.write_text("\n".join(" ".join(f"{c:f}" for c in p) for p in points) + "\n")
    return str(path)


def gradient(width, height, channels=3):
    """A smooth image that differs everywhere, with a bright spot."""
    values = []
    for y in range(height):
        for x in range(width):
            u, v = (x + 0.5) / width, (y + 0.5) / height
            spot = 3 if math.dist((u, v), (0.7, 0.3)) < 0.1 else 0
            values += [0.1 + u + spot, 0.2 + v + spot, 0.9 - 0.8 * u + spot][:channels]
    return mi.TensorXf(values, shape=(height, width, channels))


def texture(scale=0.5, **more):
    return {"type": "bitmap", "data": gradient(8, 8) * scale / 2, "raw": True, **more}


def place(x, y, z=0.0, size=0.38):
    return mi.ScalarTransform4f().translate([x, y, z]).scale(size)


def film(width, height, **more):
    # The box filter keeps pixels independent of each other.
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "component_format": "float32",
    } | more


def without_emitter_sampling(integrator):
    """The integrator, told to find lights by BSDF sampling alone."""
    integrator.emitter_sampling = False
    return integrator


# ---------------------------------------------------------------------------
#  Furnaces
# ---------------------------------------------------------------------------

ALBEDO, EMISSION = 0.8, 0.5
# Float32 sums of up to 20 terms.
ROUNDING = 1e-5


def nil(twist, quotient, max_depth, **more):
    integrator = {
        "type": "nil",
        "twist": float(twist),
        "quotient": quotient,
        "max_depth": max_depth,
        "rr_depth": 100_000,
    } | more
    return without_emitter_sampling(mi.load_dict(integrator))


def glowing(shape):
    """The shape, white as chalk that glows: every path through it has the same radiance."""
    return shape | {
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}},
        "light": {"type": "area", "radiance": {"type": "rgb", "value": EMISSION}},
    }


def sensor(origin, target, size=32, **more):
    return {
        "type": "perspective",
        "fov": 80,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1]),
        "film": film(size, size, **more),
    }


def cube_room():
    return {"room": glowing({"type": "cube", "flip_normals": True})}
