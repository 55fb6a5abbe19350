"""Walk straight ahead through the quotient, and look: a contact sheet, and frames for a film.

From x = 1/4 straight ahead along y, four cells lead back to the start, one storey higher: by
(x, y, z + k x y) the walk is closed at twist 1, and so the film is a loop. With ffmpeg:
``ffmpeg -i frames/%03d.png walk.mp4``. Where the fibres run along another axis of the scene than
z, the walk's x, y and z are the cell's: z along the fibres.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import drjit as dr
import mitsuba as mi

from nil_mitsuba import geometry
from sheet import contact_sheet

SHOWCASE = Path(__file__).resolve().parents[1] / "scenes" / "showcase.xml"


def point(text):
    return [float(part) for part in text.split(",")]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("scene", nargs="?", default=SHOWCASE, help="default: scenes/showcase.xml")
    parser.add_argument("-o", "--output", default="walk.png")
    parser.add_argument("--frames-to", metavar="FOLDER", help="write each frame, too")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--start", type=point, default=[0.25, 0, 0.655], help="x,y,z in cells")
    parser.add_argument("--direction", type=point, default=[0, 1, 0], help="frame components")
    parser.add_argument("--length", type=float, default=4, help="in cells")
    parser.add_argument("--twist", type=int, default=1)
    parser.add_argument("--size", type=int, default=320, help="width of a frame in pixels")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel")
    options = parser.parse_args()

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(
        str(options.scene),
        twist=str(options.twist),
        spp=str(options.spp),
        resx=str(options.size),
        resy=str(options.size * 9 // 16),
    )
    camera = mi.traverse(scene.sensors()[0])
    integrator = scene.integrator()
    origin, cell = mi.Point3f(integrator.cell_origin), integrator.cell_size
    start, direction = mi.Point3f(options.start), dr.normalize(mi.Vector3f(options.direction))
    first = "xyz".index(integrator.fibres) + 1  # the scene's axis that is the cell's x, modulo 3

    def in_scene(v):
        return type(v)(*(v[(axis - first) % 3] for axis in range(3)))

    frames = []
    for i in range(options.frames):
        t = mi.Float(options.length * i / options.frames)
        p, v = geometry.flow(start, direction, t, integrator.twist)
        # A camera's rotation is read in frame components: E3 stays upright, whatever the place.
        eye = origin + cell * in_scene(p)
        camera["to_world"] = mi.Transform4f().look_at(
            eye, eye + in_scene(v), in_scene(mi.Vector3f(0, 0, 1))
        )
        camera.update()
        frames.append(mi.render(scene, seed=i))
        if options.frames_to:
            folder = Path(options.frames_to)
            folder.mkdir(parents=True, exist_ok=True)
            mi.util.write_bitmap(str(folder / f"{i:03}.png"), frames[-1], write_async=False)
    sheet = contact_sheet(frames, options.columns)
    mi.util.write_bitmap(options.output, sheet, write_async=False)
    print(f"{options.output}: {options.frames} views from a walk of {options.length:g} cells")


if __name__ == "__main__":
    main()
