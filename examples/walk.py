"""Walk straight ahead through the quotient, and look: a film without an end, as a contact sheet.

From x = 1/4 straight ahead along y, four cells lead back to the start, one storey higher: by
(x, y, z + k x y) the walk is closed at twist 1. So two cameras tell the whole of it, of which the
second is the first, in another cell: scenes/showcase-walk.json.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import mitsuba as mi

from sheet import contact_sheet

SHOWCASE = Path(__file__).resolve().parents[1] / "scenes" / "showcase.xml"
WALK = SHOWCASE.with_name("showcase-walk.json")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--output", default="walk.png")
    parser.add_argument("--frames-to", metavar="FOLDER", help="keep the frames, too")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--size", type=int, default=320, help="width of a frame in pixels")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel")
    options = parser.parse_args()

    mi.set_variant("llvm_ad_rgb")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(options.frames_to or Path(scratch) / "frames")
        command = [sys.executable, "-c", "from nil_mitsuba.cli import main; main()"]
        command += ["fly", str(SHOWCASE), "--keys", str(WALK), "--frames", str(options.frames)]
        command += ["-o", str(folder), "--format", "png", "--spp", str(options.spp)]
        command += ["-D", f"resx={options.size}", "-D", f"resy={options.size * 9 // 16}"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        frames = [mi.Bitmap(str(path)) for path in sorted(folder.glob("*.png"))]
    linear = (mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    sheet = contact_sheet(
        [mi.TensorXf(frame.convert(*linear)) for frame in frames], options.columns
    )
    mi.util.write_bitmap(options.output, sheet, write_async=False)
    print(f"{options.output}: {len(frames)} views from a walk of four cells")


if __name__ == "__main__":
    main()
