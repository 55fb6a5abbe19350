"""Render from Python: a scene as a dictionary, the integrator ``nil``, a picture.

Twenty-four balls wind up around a fibre of the quotient, and meet their own copies; twist 1 above,
twist 0 below.
"""

from __future__ import annotations

import argparse
import math

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import mitsuba as mi

from sheet import contact_sheet


def scene(width, balls=24):
    T = mi.ScalarTransform4f()
    objects = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 75,
            "to_world": T.look_at(origin=[0.1, 0.05, 0.7], target=[0.5, 0.6, 0.45], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": width, "height": width // 2},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.9, 0.95, 1.0]}},
        "fibre": {
            "type": "cylinder",
            "p0": [0.5, 0.6, 0.001],
            "p1": [0.5, 0.6, 0.999],
            "radius": 0.04,
            "bsdf": {"type": "diffuse"},
        },
    }
    for i in range(balls):
        turn = (i + 0.5) / balls
        angle = 2 * math.pi * turn
        hue = [0.5 + 0.4 * math.cos(angle + third * 2 * math.pi / 3) for third in range(3)]
        objects[f"ball {i}"] = {
            "type": "sphere",
            "radius": 0.035,
            "center": [
                0.5 + 0.2 * math.cos(angle),
                0.6 + 0.2 * math.sin(angle),
                0.04 + 0.92 * turn,
            ],
            "bsdf": {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": hue}},
        }
    return objects


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--output", default="render_from_python.png")
    parser.add_argument("--size", type=int, default=640, help="width in pixels")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel")
    options = parser.parse_args()

    mi.set_variant("llvm_ad_rgb")
    balls = mi.load_dict(scene(options.size))
    pictures = []
    for twist in (1.0, 0.0):
        nil = mi.load_dict({"type": "nil", "twist": twist, "max_distance": 5.0})
        pictures.append(mi.render(balls, integrator=nil, spp=options.spp))
    mi.util.write_bitmap(options.output, contact_sheet(pictures, 1), write_async=False)
    print(f"{options.output}: a helix of balls in the quotient at twist 1, and at twist 0 below")


if __name__ == "__main__":
    main()
