"""Render the gallery: every still by the command of its own that is printed, and a contact sheet.

Writes JPEG files into ``gallery/``, and prints the processor time of each still: where nothing else
runs, the seconds on the clock times the number of processors.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import mitsuba as mi

from sheet import contact_sheet

ROOT = Path(__file__).resolve().parents[1]

# In the order of the contact sheet, with the options that each wants
STILLS = {
    "winding-floor": ["--spp", "32", "--filmic", "--exposure", "0.8"],
    "nave": ["--spp", "16"],
    "knot": ["--spp", "24", "--filmic"],
    "chess": ["--spp", "24"],
    "islands": ["--spp", "16"],
    "quay": ["--spp", "24"],
    "shell": ["--spp", "24", "--filmic"],
    "window": ["--spp", "32", "--filmic"],
    "fibres": ["--spp", "24"],
    "materials": ["--spp", "24"],
    "lattice": ["--spp", "16"],
    "lantern": ["--spp", "144", "--filmic", "--exposure", "-0.5"],
    "dusk": ["--spp", "48", "--filmic"],
    "showcase": ["-D", "resx=1280", "-D", "resy=720", "--spp", "64"],
}

# JPEG: no artefacts to be seen, at a third of the bytes of 100
QUALITY = 90


def processor_time():
    """Seconds that finished child processes have spent, on all processors."""
    times = os.times()
    return times.children_user + times.children_system


def render(name, folder, options):
    """Render one still by the command line into a folder; the path of its PNG."""
    outputs = ["-o", f"{name}.exr", "--png", f"{name}.png"]
    start = processor_time()
    subprocess.run(
        [
            sys.executable,
            "-c",
            "from nil_mitsuba.cli import main; main()",
            "render",
            str(ROOT / "scenes" / f"{name}.xml"),
            *options,
            *outputs,
        ],
        cwd=folder,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    seconds = processor_time() - start
    print(
        f"{seconds:6.0f} s  nil-mitsuba render scenes/{name}.xml",
        shlex.join([*options, *outputs]),
        flush=True,
    )
    return folder / f"{name}.png"


def picture(path, width=None):
    """A picture file as linear RGB, scaled to a width in pixels if there is one."""
    bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    if width:
        height, full = bitmap.height(), bitmap.width()
        bitmap = bitmap.resample([width, round(height * width / full)])
    return bitmap


def write_jpeg(bitmap, path):
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
    bitmap.write(str(path), quality=QUALITY)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "names",
        nargs="*",
        default=list(STILLS),
        metavar="SCENE",
        help="default: all stills of the gallery",
    )
    parser.add_argument("--to", type=Path, default=ROOT / "gallery", metavar="FOLDER")
    parser.add_argument("--size", type=int, help="width in pixels; default: the scene's")
    parser.add_argument("--spp", type=int, help="samples per pixel, for all")
    parser.add_argument("--no-denoise", action="store_true", help="needs no mitsuba-oidn")
    options = parser.parse_args()

    common = [] if options.no_denoise else ["--denoise"]
    if options.size:
        common += ["-D", f"resx={options.size}", "-D", f"resy={options.size * 9 // 16}"]
    if options.spp:
        common += ["--spp", str(options.spp)]

    mi.set_variant("llvm_ad_rgb")
    options.to.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in options.names:
            png = render(name, Path(folder), [*STILLS.get(name, []), *common])
            write_jpeg(picture(png), options.to / f"{name}.jpg")
    width = min(options.size or 1280, 400)
    stills = [mi.TensorXf(picture(options.to / f"{name}.jpg", width)) for name in options.names]
    sheet = options.to / "contact-sheet.jpg"
    write_jpeg(mi.Bitmap(contact_sheet(stills, 3)), sheet)
    print(f"{sheet}: {len(stills)} stills")


if __name__ == "__main__":
    main()
