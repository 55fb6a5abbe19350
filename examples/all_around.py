"""A scene seen from where its camera stands: all around, as a dome, or with two eyes.

Sensors take the place of the scene's own: "spherical", with one eye or with two of which the left
one's picture is above the right one's, "fisheye", and "stereo_perspective", whose two pictures
stand side by side here, the left eye's on the left.
"""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

import nil_mitsuba  # before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import drjit as dr
import mitsuba as mi

from nil_mitsuba.aiming import columns_of, up_of
from sheet import contact_sheet

SHOWCASE = Path(__file__).resolve().parents[1] / "scenes" / "showcase.xml"
WRAP = 32  # columns: more than the denoiser looks to the side


def pose(to_world, level):
    """That of a camera; if it is to be ``level``, without what its look rises or falls by."""
    _, _, forward, origin = columns_of(to_world)
    up, ahead = mi.ScalarVector3f(up_of(to_world)), mi.ScalarVector3f(forward)
    if level:
        ahead -= dr.dot(ahead, up) * up
    T = mi.ScalarTransform4f
    return T().translate(origin) @ T().look_at([0, 0, 0], ahead, up)


def sensor(kind, camera, size, distance):
    own = mi.traverse(camera)
    eyes = {"eye": "both", "interocular_distance": distance}
    described, height = {
        "panorama": ({"type": "spherical"}, size // 2),
        "stereo-panorama": ({"type": "spherical"} | eyes, 2 * (size // 2)),
        "dome": ({"type": "fisheye", "fov": 180.0}, size),
        "pair": ({"type": "stereo_perspective", "fov": 75.0} | eyes, 2 * (size * 3 // 4)),
    }[kind]
    film = {"type": "hdrfilm", "width": size, "height": height, "rfilter": {"type": "box"}}
    return described | {
        "to_world": pose(camera.world_transform(), level=kind != "pair"),
        "near_clip": own["near_clip"] if "near_clip" in own else 1e-3,
        "film": film,
    }


def denoised(image, around):
    """A picture and its layers without noise, and across the seam, too, if it goes all around."""
    if importlib.util.find_spec("mitsuba_oidn") is None:
        return image[:, :, :3]
    from nil_mitsuba.denoise import denoise

    width = image.shape[1]
    if around:
        image = dr.concat((image[:, width - WRAP :], image, image[:, :WRAP]), axis=1)
    picture = denoise(*(image[:, :, i : i + 3] for i in (0, 3, 6)))
    return picture[:, WRAP : WRAP + width] if around else picture


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("scene", nargs="?", default=SHOWCASE, help="default: scenes/showcase.xml")
    parser.add_argument(
        "--kind", choices=("panorama", "stereo-panorama", "dome", "pair"), default="panorama"
    )
    parser.add_argument("--eyes", type=float, default=0.02, help="their distance in scene units")
    parser.add_argument("-o", "--output", default="all_around.png")
    parser.add_argument("--size", type=int, default=1280, help="width in pixels, of each eye's")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel")
    options = parser.parse_args()

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(str(options.scene))
    camera = sensor(options.kind, scene.sensors()[0], options.size, options.eyes)
    scene.integrator().aovs = "albedo, normal"
    image = nil_mitsuba.render(scene, mi.load_dict(camera), spp=options.spp)

    two = options.kind in ("stereo-panorama", "pair")
    height = image.shape[0] // (2 if two else 1)
    eyes = [
        denoised(image[i * height : (i + 1) * height], "panorama" in options.kind)
        for i in range(2 if two else 1)
    ]
    picture = contact_sheet(eyes, 2) if options.kind == "pair" else dr.concat(eyes, axis=0)
    mi.util.write_bitmap(options.output, picture, write_async=False)
    print(f"{options.output}: {Path(options.scene).name}, {options.kind}")


if __name__ == "__main__":
    main()
