"""Measures all methods, and writes the tables and charts."""

import argparse
import pathlib
import sys
import time

import drjit as dr

from . import __doc__ as about
from .charts import draw
from .end_points import end_points, heyoka_rows
from .images import IMAGE_KNOBS, images
from .methods import measure
from .rays import LENGTHS, Rays
from .scenes import MAIN, setups
from .tables import chosen, ratio_lines, table, write

ROOT = pathlib.Path(__file__).resolve().parents[2]


def main():
    began = time.perf_counter()
    parser = argparse.ArgumentParser(description=about.split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    parser.add_argument(
        "-o",
        "--output",
        type=pathlib.Path,
        default=ROOT / "charts",
        help="folder of the charts and tables (default: charts)",
    )
    arguments = parser.parse_args()
    quick, folder = arguments.quick, arguments.output
    folder.mkdir(parents=True, exist_ok=True)

    # Two threads on any machine: what is launched is large enough for so many
    dr.set_thread_count(min(2, dr.thread_count()))
    rows = []
    for setup in setups():
        main = setup.kind == MAIN["scene"] and setup.space == MAIN["space"]
        if quick and not main:
            continue
        # Four blocks of rays, eight for the first chart; two where all are traced twice
        rays = Rays(setup, 64 if quick else 368 if main else 256)
        for length in (MAIN["length"],) if quick else LENGTHS:
            if main and length == MAIN["length"]:
                rows += measure(rays, length, 1 if quick else 2, 2000)
            else:
                rows += measure(rays, length, 1, 300)
        report(f"traced: {setup.kind}, {setup.space}", began)
    lengths = (5,) if quick else (5, 1, 20)
    end_rows = end_points(lengths, 1 if quick else 2, quick)
    if not quick:
        end_rows += heyoka_rows(lengths)
    report("end points: done", began)
    image_rows, differences = [], []
    for setup in setups():
        if quick and (setup.kind, setup.space) != ("sparse", "plain"):
            continue
        found = (
            images(setup, IMAGE_KNOBS[-2:], 32, 24, 1, (1, 2, 4), 4)
            if quick
            else images(setup, IMAGE_KNOBS, 80, 60, 8, (1, 2, 4), 128)
        )
        image_rows += found[0]
        differences += found[1]
        report(f"rendered: {setup.kind}, {setup.space}", began)

    write(folder, rows, end_rows, image_rows, differences)
    print("\n".join(["", table(chosen(rows, **MAIN)), "", *ratio_lines(end_rows)]))
    draw(folder, rows, image_rows)
    report("done", began)


def report(what, began):
    print(f"{time.perf_counter() - began:4.0f} s  {what}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
