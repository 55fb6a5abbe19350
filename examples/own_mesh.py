"""Your own mesh in the cube: ``own_mesh.py MESH.obj`` (or .ply) puts it on a plinth, among copies.

It keeps the mesh's texture or the colours of its vertices. Without a file it takes the whelk that
scenes/make_assets.py makes.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import sys
from pathlib import Path

import nil_mitsuba  # before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import drjit as dr
import mitsuba as mi

ROOT = Path(__file__).resolve().parents[1]
SHELL = ROOT / "scenes" / "meshes" / "shell.ply"
# Where the mesh stands and how large it may be: other cells' copies leave the camera a clear view.
FOOT, EXTENT = (0.5, 0.6, 0.3), 0.4
EYE = (0.25, 0.02, 0.52)


def upward_axis(path):
    """OBJ files are y-up by custom; PLY files have none."""
    if path == SHELL:
        return "z"
    if path.suffix.lower() == ".obj":
        return "y"
    answer = input("Which axis is up in this mesh, y or z? ") if sys.stdin.isatty() else ""
    return "y" if answer.strip().lower() == "y" else "z"


def texture_of(path):
    """The first picture that an OBJ's materials or a PLY's header name, if it is there."""
    text = path.read_bytes()[: None if path.suffix.lower() == ".obj" else 4096].decode("latin-1")
    for library in re.findall(r"^mtllib (.+?)\s*$", text, re.M):
        if (path.parent / library).is_file():
            text += "\n" + (path.parent / library).read_text(encoding="latin-1")
    # Options such as "-s 1 1 1" may stand before a name
    names = re.findall(r"^\s*(?:map_Kd|comment TextureFile)\s(?:.*\s)?(\S+)\s*$", text, re.M)
    found = [path.parent / name.replace("\\", "/") for name in names]
    return next((picture for picture in found if picture.is_file()), None)


def load(path, up, texture=None):
    """The mesh with its colours, scaled to EXTENT, upright and standing on FOOT.

    Raises ValueError if the file holds no mesh.
    """
    T = mi.ScalarTransform4f
    description = {"type": path.suffix[1:].lower(), "filename": str(path)}
    turn = T().rotate([1, 0, 0], 90) if up == "y" else T()
    try:
        bare = mi.load_dict(description | {"to_world": turn})
    except RuntimeError as error:
        reason = str(error).rsplit("] ", 1)[-1]  # behind the places in Mitsuba's source
        raise ValueError(f'"{path}" holds no mesh that can be read: {reason}') from None
    if not bare.face_count() or dr.max(bare.faces_buffer())[0] >= bare.vertex_count():
        raise ValueError(f'"{path}" has no triangles, or some whose corners are not in it.')
    box = bare.bbox()
    if not 0 < max(box.extents()) < 1e15:  # what "nil" can place
        raise ValueError(f'"{path}" has no extent, or one that is no number up to 1e15.')
    middle = box.center()
    to_world = T().translate(FOOT).scale(EXTENT / max(box.extents()))
    to_world = to_world @ T().translate([-middle.x, -middle.y, -box.min.z]) @ turn

    stored = mi.traverse(bare).get("vertex_color")
    colour = {"type": "rgb", "value": [0.80, 0.50, 0.36]}
    if texture:
        colour = {"type": "bitmap", "filename": str(texture)}
    elif stored is not None:
        colour = {"type": "mesh_attribute", "name": "vertex_rgb"}
    paint = {"type": "principled", "base_color": colour, "roughness": 0.3}
    mesh = mi.load_dict(
        description | {"to_world": to_world, "bsdf": {"type": "twosided", "bsdf": paint}}
    )
    if stored is not None:
        count = mesh.vertex_count()
        shades = mi.TensorXf(stored, (count, len(stored) // count))[:, :3].array  # without alpha
        if dr.max(shades)[0] > 1:  # bytes, and not what Mitsuba itself writes
            shades = dr.srgb_to_linear(shades / 255)
        mesh.add_attribute("vertex_rgb", 3, shades)
    return mesh


def stage(mesh, width):
    T = mi.ScalarTransform4f
    x, y, z = FOOT
    stone = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.62, 0.60, 0.56]}}
    nil = mi.load_dict(
        {"type": "nil", "max_distance": 4.0, "max_depth": 6, "aovs": "albedo, normal"}
    )
    aim = nil_mitsuba.look_at(nil, EYE, mesh.bbox().center())
    return {
        "type": "scene",
        "integrator": nil,
        "sensor": {
            "type": "perspective",
            "fov": 65,
            "to_world": aim.to_world,
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": width * 9 // 16,
                "rfilter": {"type": "box"},  # noise that pixels share cannot be removed
            },
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


def show(progress):
    left = f", {progress.left:.0f} s left" if progress.left is not None else ""
    print(f"\r{progress.samples} samples per pixel{left}    ", end="", file=sys.stderr)


def developed(image):
    """The picture without its layers, and without its noise if the denoiser is installed."""
    picture, albedo, normal = (image[:, :, i : i + 3] for i in (0, 3, 6))
    if importlib.util.find_spec("mitsuba_oidn") is None:
        return picture
    from nil_mitsuba.denoise import denoise

    return denoise(picture, albedo, normal)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("mesh", nargs="?", type=Path, default=SHELL)
    parser.add_argument("--up", choices="yz", help="the mesh's upward axis, if not found or asked")
    parser.add_argument("--texture", type=Path, help="a picture for the mesh's uv")
    parser.add_argument("-o", "--output", default="own_mesh.png")
    parser.add_argument("--size", type=int, default=640, help="width in pixels")
    parser.add_argument("--spp", type=int, help="stop at so many samples per pixel")
    parser.add_argument("--seconds", type=float, default=15, help="stop after such a time")
    options = parser.parse_args()
    if options.mesh.suffix.lower() not in (".ply", ".obj"):
        parser.error(f'"{options.mesh}" is no mesh that this program reads: give a .ply or .obj.')
    for path in filter(None, (options.mesh, options.texture)):
        if not path.is_file():
            parser.error(f'"{path}" does not exist.')

    mi.set_variant("llvm_ad_rgb")
    up = options.up or upward_axis(options.mesh)
    try:
        mesh = load(options.mesh, up, options.texture or texture_of(options.mesh))
    except ValueError as error:
        sys.exit(f"own_mesh.py: {error}")
    scene = mi.load_dict(stage(mesh, options.size))
    image = nil_mitsuba.render(scene, spp=options.spp, seconds=options.seconds, progress=show)
    print(file=sys.stderr)
    mi.util.write_bitmap(options.output, developed(image), write_async=False)
    print(
        f"{options.output}: {options.mesh.name}, with {up} up, on a plinth in the quotient, and "
        "its copies (--up turns it, --seconds 300 shows more)"
    )


if __name__ == "__main__":
    main()
