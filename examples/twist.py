"""The same room at twist 0, 1 and 2, side by side: what the parameter ``twist`` does."""

from __future__ import annotations

import argparse
from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import mitsuba as mi

from sheet import contact_sheet

ROOM = Path(__file__).resolve().parents[1] / "scenes" / "cornell-box.xml"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", nargs="?", default=ROOM, help="default: scenes/cornell-box.xml")
    parser.add_argument("-o", "--output", default="twist.png")
    parser.add_argument("--twists", type=float, nargs="+", default=[0, 1, 2], metavar="K")
    parser.add_argument("--size", type=int, default=360, help="width of each picture in pixels")
    parser.add_argument("--spp", type=int, default=128, help="samples per pixel")
    options = parser.parse_args()

    mi.set_variant("llvm_ad_rgb")
    pictures = [
        mi.render(
            mi.load_file(
                str(options.scene),
                twist=f"{twist:g}",
                spp=str(options.spp),
                resx=str(options.size),
                resy=str(options.size),
            )
        )
        for twist in options.twists
    ]
    sheet = contact_sheet(pictures, len(pictures))
    mi.util.write_bitmap(options.output, sheet, write_async=False)
    twists = ", ".join(f"{twist:g}" for twist in options.twists)
    print(f"{options.output}: {Path(options.scene).name} at twist {twists}")


if __name__ == "__main__":
    main()
