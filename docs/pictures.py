"""Make the pictures of "How to look at Nil" and "A scene of your own".

Needs altair and vl-convert-python for its diagrams, and the denoiser.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import altair as alt
import drjit as dr
import mitsuba as mi

from nil_mitsuba import geometry

DOCS = Path(__file__).resolve().parent
EXAMPLES = DOCS.parent / "examples"

sys.path.append(str(EXAMPLES))
from sheet import contact_sheet  # noqa: E402


def glued_faces(path, size):
    """The face x = 0 with level lines, and where twist 1 and 2 glue them onto the face x = 1."""
    panels = []
    for title, twist in (("face x = 0", 0), ("face x = 1, twist 1", 1), ("face x = 1, twist 2", 2)):
        rows = []
        for line in range(6):
            for i in range(201):
                y = i / 200
                z = (line + 0.5) / 6 + twist * y
                # A line that leaves through the top comes in from below: a new piece
                rows.append(
                    {
                        "y": y,
                        "z": z - math.floor(z),
                        "height": (line + 0.5) / 6,
                        "piece": f"{line}/{math.floor(z)}",
                    }
                )
        panels.append(
            alt.Chart(alt.Data(values=rows))
            .mark_line(strokeWidth=5)
            .encode(
                x=alt.X("y:Q", scale=alt.Scale(domain=[0, 1])),
                y=alt.Y("z:Q", scale=alt.Scale(domain=[0, 1])),
                detail="piece:N",
                color=alt.Color("height:Q", legend=None, scale=alt.Scale(scheme="plasma")),
            )
            .properties(width=size, height=size, title=title)
        )
    alt.hconcat(*panels).save(str(path), scale_factor=2)


def level_looks(path, size):
    """Height of geodesics that start level from the identity, by where they are heading."""
    rows = []
    for azimuth in range(0, 181, 15):
        a, b = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        p, _ = geometry.flow(
            mi.Point3f(0), mi.Vector3f(a, b, 0), dr.linspace(mi.Float, 0, 3, 61), 1
        )
        rows += [{"length": 3 * i / 60, "z": z, "azimuth": azimuth} for i, z in enumerate(p.z)]
    alt.Chart(alt.Data(values=rows)).mark_line().encode(
        x=alt.X("length:Q", title="length (cells)"),
        y=alt.Y("z:Q", title="height z (cells)"),
        detail="azimuth:N",
        color=alt.Color(
            "azimuth:Q",
            title="azimuth from x (degrees)",
            scale=alt.Scale(scheme="blueorange", domain=[0, 180]),
            legend=alt.Legend(values=[0, 45, 90, 135, 180]),
        ),
    ).properties(width=1.4 * size, height=size, title="Level looks from the origin").save(
        str(path), scale_factor=2
    )


def leaning_fibres(path, size, spp):
    """A fan: vertical rods one behind another on the y axis, seen along it, each leaning more."""
    T = mi.ScalarTransform4f()
    scene = {
        "type": "scene",
        "integrator": {"type": "nil", "quotient": False, "max_depth": 3},
        "sensor": {
            "type": "perspective",
            "fov": 60,
            "to_world": T.look_at([0, 0, 0], [0, 1, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size, "height": size * 9 // 16},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.95, 0.96, 1.0]}},
    }
    for i, y in enumerate((0.5, 1, 2, 4, 8)):
        color = [0.75 - 0.16 * i, 0.12 + 0.06 * i, 0.10 + 0.14 * i]
        scene[f"rod {i}"] = {
            # As thick as its distance makes it look thin
            "type": "cylinder",
            "p0": [0, y, -20],
            "p1": [0, y, 20],
            "radius": 0.02 * y,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}},
        }
    picture = mi.render(mi.load_dict(scene), spp=spp)
    mi.util.write_bitmap(str(path), picture, write_async=False, quality=90)


# The room of "A scene of your own": straight, bent in plain Nil, and in the quotient
PLAIN = "-P quotient=false -P fibres=y "
ROOMS = (
    PLAIN + "-P twist=0",
    PLAIN + "-P cell_size=10 -P cell_origin=0,1,0",
    PLAIN + "-P cell_size=5 -P cell_origin=0,1,0",
    PLAIN + "-P cell_size=5 -P cell_origin=0,1,-5",
    "-P fibres=y -P cell_size=5.005 -P cell_origin=-2.5025,-1.5025,-1.0025",
)


def own_scene(path, size, spp):
    """The room as the command renders it, with other options side by side."""
    pictures = []
    with tempfile.TemporaryDirectory() as folder:
        for number, options in enumerate(ROOMS):
            png = Path(folder) / f"{number}.png"
            words = f"-D resx={size} -D resy={size} --spp {spp} --denoise -q {options}".split()
            room = ["render", str(DOCS / "room.xml"), "-o", str(png.with_suffix(".exr"))]
            command = "from nil_mitsuba.cli import main; main()"
            subprocess.run(
                [sys.executable, "-c", command, *room, "--png", str(png), *words], check=True
            )
            picture = mi.Bitmap(str(png)).convert(component_format=mi.Struct.Type.Float32)
            pictures.append(mi.TensorXf(picture.convert(srgb_gamma=False)))
    sheet = contact_sheet(pictures, len(pictures))
    mi.util.write_bitmap(str(path), sheet, write_async=False, quality=90)


def example(program, output, *arguments):
    """Run a program of examples/; a JPEG is made from its PNG, for Mitsuba's default is large."""
    png = output.with_suffix(".png")
    subprocess.run(
        [sys.executable, str(EXAMPLES / program), "-o", str(png), *arguments], check=True
    )
    if output != png:
        mi.Bitmap(str(png)).write(str(output), quality=90)
        png.unlink()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--to", type=Path, default=DOCS, metavar="FOLDER")
    parser.add_argument("--size", type=int, default=960, help="width of the widest, in pixels")
    parser.add_argument("--spp", type=int, default=256, help="samples per pixel")
    options = parser.parse_args()
    size, spp = options.size, options.spp

    mi.set_variant("llvm_ad_rgb")
    options.to.mkdir(parents=True, exist_ok=True)
    glued_faces(options.to / "glued-faces.png", size // 6)
    level_looks(options.to / "level-looks.png", size // 3)
    # An even sky makes little noise.
    leaning_fibres(options.to / "leaning-fibres.jpg", size, max(1, spp // 4))
    example("light_images.py", options.to / "light-images.png", "--size", str(size // 3))
    example(
        "twist.py",
        options.to / "twist.jpg",
        "--size",
        str(size // 3),
        "--spp",
        str(max(1, spp // 2)),
    )
    own_scene(options.to / "own-scene.jpg", size // 4, max(1, spp // 2))
    print(f"{options.to}: five pictures for looking-at-nil.md, one for your-own-scene.md")


if __name__ == "__main__":
    main()
