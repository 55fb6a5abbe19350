"""Your own mesh in the cube: ``own_mesh.py MESH.ply`` (or .obj) puts it on a plinth, among copies.

Without a file it takes the whelk that scenes/make_assets.py makes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import mitsuba as mi

ROOT = Path(__file__).resolve().parents[1]
# Where the mesh stands and how large it may be: other cells' copies leave the camera a clear view.
FOOT, EXTENT = (0.5, 0.6, 0.3), 0.4


def fitted(path, up):
    """The mesh's description, scaled to EXTENT, upright and standing on FOOT."""
    T = mi.ScalarTransform4f
    description = {"type": path.suffix[1:].lower(), "filename": str(path)}
    turn = T().rotate([1, 0, 0], 90) if up == "y" else T()
    box = mi.load_dict(description | {"to_world": turn}).bbox()
    middle = box.center()
    to_world = T().translate(FOOT).scale(EXTENT / max(box.extents()))
    to_world = to_world @ T().translate([-middle.x, -middle.y, -box.min.z]) @ turn
    return description | {
        "to_world": to_world,
        "bsdf": {
            "type": "twosided",
            "bsdf": {
                "type": "plastic",
                "diffuse_reflectance": {"type": "rgb", "value": [0.80, 0.50, 0.36]},
            },
        },
    }


def stage(mesh, width):
    T = mi.ScalarTransform4f
    x, y, z = FOOT
    stone = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.62, 0.60, 0.56]}}
    return {
        "type": "scene",
        "integrator": {"type": "nil", "max_distance": 4.0, "max_depth": 6},
        "sensor": {
            "type": "perspective",
            "fov": 65,
            "to_world": T().look_at(
                origin=[0.25, 0.02, 0.52], target=[0.48, 0.6, 0.38], up=[0, 0, 1]
            ),
            "film": {"type": "hdrfilm", "width": width, "height": width * 9 // 16},
        },
        "sky": {
            "type": "envmap",
            "filename": str(ROOT / "scenes" / "textures" / "evening.exr"),
            "scale": 1.4,
            "to_world": T().rotate([0, 0, 1], 110).rotate([1, 0, 0], 90),
        },
        "mesh": mesh,
        "plinth": {
            "type": "cylinder",
            "p0": [x, y, 0.1],
            "p1": [x, y, z - 1e-3],
            "radius": 0.16,
            "bsdf": {"type": "twosided", "bsdf": stone},
        },
        "top": {
            "type": "disk",
            "bsdf": stone,
            "to_world": T().translate([x, y, z - 1e-3]).scale(0.16),
        },
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "mesh", nargs="?", type=Path, default=ROOT / "scenes" / "meshes" / "shell.ply"
    )
    parser.add_argument("--up", choices="yz", default="z", help="the mesh's upward axis")
    parser.add_argument("-o", "--output", default="own_mesh.png")
    parser.add_argument("--size", type=int, default=640, help="width in pixels")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel")
    options = parser.parse_args()
    if options.mesh.suffix.lower() not in (".ply", ".obj"):
        parser.error(f'"{options.mesh}" is no mesh that this program reads: give a .ply or .obj.')
    if not options.mesh.is_file():
        parser.error(f'the mesh "{options.mesh}" does not exist.')

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_dict(stage(fitted(options.mesh, options.up), options.size))
    picture = mi.render(scene, spp=options.spp)
    mi.util.write_bitmap(options.output, picture, write_async=False)
    print(f"{options.output}: {options.mesh.name} on a plinth in the quotient, and its copies")


if __name__ == "__main__":
    main()
