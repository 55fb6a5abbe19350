"""Take the picture of the viewfinder: needs the extra ``test``, and Chromium with its driver."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from pathlib import Path

import nil_mitsuba  # noqa: F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import mitsuba as mi

DOCS = Path(__file__).resolve().parent
SCENE = DOCS.parent / "scenes" / "showcase.xml"

sys.path.append(str(DOCS.parent / "tests"))
from browser import chromium  # noqa: E402


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=DOCS / "viewfinder.jpg")
    parser.add_argument("--seconds", type=float, default=40, help="to wait for a better picture")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    code = "from nil_mitsuba.cli import main; main()"
    command = [sys.executable, "-c", code, "view", str(SCENE), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            with chromium(1280, 800) as page:
                page.open(process.stdout.readline().strip())
                page.wait(lambda: page.frame is not None, 60)
                page.to(0.62, 0.3).perform()
                time.sleep(options.seconds)
                png = page.browser.get_screenshot_as_png()
        finally:
            process.send_signal(signal.SIGINT)
    stream = mi.MemoryStream()
    stream.write(png)
    stream.seek(0)
    picture = mi.Bitmap(stream).convert(mi.Bitmap.PixelFormat.RGB)
    picture.write(str(options.output), quality=88)
    print(options.output)


if __name__ == "__main__":
    main()
