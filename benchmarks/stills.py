"""Prints what a still costs beside its samples: memory over spp, passes, layers, checkpoints.

Shares of time are processor time of all threads, each measured against its counterpart in turns
within one run, because machines are noisy; writing a checkpoint is time on a clock.
"""

import argparse
import math
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

import drjit as dr
import mitsuba as mi

from nil_mitsuba import checkpoint, stills
from nil_mitsuba.layers import RENDERED

from .worker import alone

SCENE = str(pathlib.Path(__file__).parents[1] / "scenes" / "cornell-box.xml")
ALL_LAYERS = ", ".join(RENDERED)


def load(width, height, layers=""):
    """The scene and its integrator with layers."""
    scene = mi.load_file(SCENE, resx=width, resy=height)
    own = scene.integrator()
    return scene, mi.load_dict(
        {
            "type": "nil",
            "aovs": layers,
            "twist": own.twist,
            "quotient": own.quotient,
            "cell_origin": own.cell_origin,
            "cell_size": own.cell_size,
            "max_depth": 4,
        }
    )


def processor_seconds(work):
    start = time.process_time()
    work()
    dr.sync_thread()
    return time.process_time() - start


def overhead(plain, costly, repeats):
    """Median of (costly − plain) / plain over turns, after one turn that compiles."""
    ratios = []
    for turn in range(repeats + 1):
        works = [plain, costly] if turn % 2 else [costly, plain]
        seconds = {work: processor_seconds(work) for work in works}
        if turn:
            ratios.append(seconds[costly] / seconds[plain] - 1)
    return statistics.median(ratios), min(ratios), max(ratios)


def passes(repeats, size, total, samples):
    """A still of so many samples in passes of fewer, against one pass of all."""
    from nil_mitsuba import passes as module

    scene, integrator = load(*size)
    pixels = math.prod(size)
    spp = total // pixels

    def render(still):
        state = still.nothing()
        still.accumulate(state, (still.render(index) for index in range(still.count)))

    def still_of(wavefront):
        usual, module.WAVEFRONT_SAMPLES = module.WAVEFRONT_SAMPLES, wavefront
        still = stills.Still(scene, 0, integrator, 0, stills.Rules(spp), scene_hash="")
        module.WAVEFRONT_SAMPLES = usual
        return still

    one, many = still_of(spp * pixels), still_of(samples)
    assert one.count == 1 and many.count * samples == spp * pixels
    return overhead(lambda: render(one), lambda: render(many), repeats)


def layers(repeats, size):
    """A pass with all layers against one with none."""

    def work(names):
        scene, integrator = load(*size, names)
        still = stills.Still(scene, 0, integrator, 0, stills.Rules(16), scene_hash="")
        state = still.nothing()
        return lambda: state.plus(still.render(0))

    return overhead(work(""), work(ALL_LAYERS), repeats)


def checkpoints(width, height, names):
    """Seconds to write a checkpoint, and its size in MiB."""
    scene, integrator = load(width, height, names)
    still = stills.Still(scene, 0, integrator, 0, stills.Rules(1), scene_hash="")
    state = still.nothing()
    with tempfile.TemporaryDirectory(dir=".") as folder:
        path = pathlib.Path(folder) / "a.sums"
        seconds = []
        for _ in range(5):
            start = time.perf_counter()
            checkpoint.save(path, state)
            seconds.append(time.perf_counter() - start)
        return statistics.median(seconds), path.stat().st_size / 2**20


def peak_memory(spp):
    """Most memory that the command ever holds, in MiB, in a process of its own."""
    code = (
        "import resource\nfrom nil_mitsuba import cli\n"
        "try: cli.main()\n"
        "finally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.run(
            alone(
                [
                    sys.executable,
                    "-c",
                    code,
                    "render",
                    SCENE,
                    "-D",
                    "resx=480",
                    "-D",
                    "resy=270",
                    "-P",
                    "max_depth=4",
                    "--spp",
                    str(spp),
                    "-o",
                    os.path.join(folder, "a.exr"),
                ]
            ),
            capture_output=True,
            text=True,
            check=True,
        )
    return float(run.stdout.split()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--samples",
        type=int,
        nargs="+",
        default=[16, 64, 256],
        help="samples per pixel at which memory is measured",
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.repeats, arguments.samples = 1, [1]
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)

    print("peak memory, 480 x 270 pixels")
    for spp in arguments.samples:
        print(f"  {spp:5d} spp: {peak_memory(spp):.0f} MiB")
    from nil_mitsuba.passes import WAVEFRONT_SAMPLES

    shrink, size, film = (
        (1024, (64, 32), (192, 108)) if arguments.quick else (1, (512, 256), (1920, 1080))
    )
    total = 4 * WAVEFRONT_SAMPLES // shrink
    for name, function, *of in (
        ("passes against a single one", passes, total, WAVEFRONT_SAMPLES // shrink),
        (
            "passes for --time and --noise against a single one",
            passes,
            total,
            max(stills.LOOK_SAMPLES // shrink, math.prod(size)),
        ),
        ("all layers against none", layers),
    ):
        median, low, high = function(arguments.repeats, size, *of)
        print(f"{name}: {median:+.1%} (from {low:+.1%} to {high:+.1%})")
    for what, names in (("no layers", ""), ("all layers", ALL_LAYERS)):
        seconds, size = checkpoints(*film, names)
        print(
            f"a checkpoint a minute, {film[0]} x {film[1]} pixels, {what}: "
            f"{seconds / stills.CHECKPOINT_SECONDS:.1%} ({seconds:.2f} s, {size:.0f} MiB)"
        )


if __name__ == "__main__":
    main()
