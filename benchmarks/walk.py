"""How many pictures a second the viewfinder shows while somebody walks.

Each scene is walked through at 57,600 pixels, those of 320 × 180, and its twist dragged; then the
camera rests until a picture of 1280 × 720 has been shown. Prints a table, which is true while
nothing else runs.
"""

from __future__ import annotations

import argparse
import pathlib
import time

from nil_mitsuba import jobs
from nil_mitsuba.viewfinder import Viewfinder

SCENES = pathlib.Path(__file__).resolve().parents[1] / "scenes"
SIZES = {"showcase": [320, 180], "cornell-box": [240, 240]}  # in the shapes of their films
FULL = [1280, 720]


class Window:
    """Somebody who looks, and whose browser is never late."""

    viewer = ready = True

    def __init__(self):
        self.shown: list[tuple[float, list[int]]] = []

    def messages(self, _wait):
        return []

    def send(self, event):
        if event["is"] == "says":
            print(f"  {event['text']}")

    def show(self, header, _jpeg):
        self.shown.append((time.perf_counter(), header["size"]))
        return True

    def rate(self, finder, frames):
        """Pictures a second, of so many."""
        start, count = time.perf_counter(), len(self.shown) + frames
        last = start
        while len(self.shown) < count:
            now = time.perf_counter()
            finder._advance(now - last)
            last = now
            finder._work()
        return frames / (time.perf_counter() - start)


def measure(name, frames, denoised):
    """Pictures a second of a walk and of a dragged twist, and seconds until a large one."""
    window = Window()
    opened = jobs.open_scene(jobs.Job(str(SCENES / f"{name}.xml")), aiming=True)
    finder = Viewfinder(opened, [], window)
    finder.answer({"do": "hello", "size": SIZES[name]})
    if not denoised:
        finder.answer({"do": "set", "name": "denoise", "value": 0})
    finder._adapt = lambda _seconds: None  # at this size, whatever it takes
    finder.width = SIZES[name][0]
    window.rate(finder, 2)  # the kernel is compiled
    finder.answer({"do": "go", "move": [0, 0, 1], "turn": [0.3, 0]})
    window.rate(finder, 2)
    walk = window.rate(finder, frames)
    finder.answer({"do": "go", "move": [0, 0, 0], "turn": [0, 0]})

    start = time.perf_counter()
    for number in range(frames):
        finder.answer({"do": "set", "name": "twist", "value": number % 3})
        window.rate(finder, 1)
    drag = frames / (time.perf_counter() - start)

    finder.answer({"do": "home"})
    finder.answer({"do": "size", "size": FULL})
    start = time.perf_counter()
    while window.shown[-1][1][0] < FULL[0] and window.shown[-1][1][1] < FULL[1]:
        finder._work()
    return walk, drag, time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--frames", type=int, default=40, help="pictures of each measurement")
    options = parser.parse_args()
    print("scene            denoised  walk/s  twist/s  seconds to 1280 x 720")
    for name in SIZES:
        for denoised in (True, False):
            walk, drag, seconds = measure(name, options.frames, denoised)
            word = "yes" if denoised else "no"
            print(f"{name:16} {word:8} {walk:7.1f} {drag:8.1f} {seconds:9.1f}", flush=True)


if __name__ == "__main__":
    main()
