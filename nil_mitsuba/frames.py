"""The frames of a flight: a still each, through a sensor that is moved, and told apart in files."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from . import exr_header, png
from .checkpoint import Checkpoint, differences
from .flight import Flight
from .keys import Key, UnfitError
from .lens import lens_of
from .pose import Chart, Pose
from .stills import Progress, Rules, Still

if TYPE_CHECKING:
    from .jobs import Opened

# Digits of a frame's number in its file's name, at least
DIGITS = 4


@dataclass(frozen=True)
class Plan:
    """What frames to render, in plain values: keys, number of frames, and when each is done."""

    keys: tuple[Key, ...]
    count: int
    rules: Rules


class Frames:
    """The frames of a flight through a scene, which is loaded once.

    The job's sensor is moved from frame to frame. ``settings`` is what has to be equal for pictures
    to be frames of one flight. Raises UnfitError for a key that is of no use for that, and
    ValueError if the sensor or the integrator is.
    """

    def __init__(self, opened: Opened, plan: Plan):
        self.opened, self.plan = opened, plan
        self.in_work: Still | None = None
        self.progress: Progress | None = None  # of that
        self.chart = Chart.of(opened.nil)
        sensor = opened.scene.sensors()[opened.job.sensor]
        self.sensor = mi.traverse(sensor)
        if "to_world" not in self.sensor:
            what = "is a batch of several" if sensor.class_name() == "BatchSensor" else "has none"
            raise ValueError(
                f"a flight moves a sensor by its to_world, and the sensor {opened.job.sensor} "
                f"{what}: fly with a copy of the scene with another."
            )
        self.flight = Flight(plan.keys, plan.count, self.chart, lens_of(sensor))
        for number, stop in enumerate(self.flight.stops, start=1):
            try:
                self._move(stop.pose, stop.parameters)
            except RuntimeError as error:
                raise UnfitError(f"key {number} of {len(plan.keys)}: {error}") from None
        self.warned = False
        still = self.still(0)
        self.warned = True
        self.film = still.film
        rules = still.rules  # the scene's samples, if the plan names none
        keys = json.dumps([key.as_dict() for key in plan.keys])
        self.settings = {
            "frames": plan.count,
            # Thousands of keys in each file would be more than its picture
            "keys": hashlib.sha256(keys.encode()).hexdigest(),
            "spp": rules.spp,
            "time": rules.seconds,
            "noise": rules.noise,
            **still.settings,
            "seed": opened.job.seed,
        }

    def still(self, index: int) -> Still:
        """A frame's still; from then on the sensor stands where the frame is seen from."""
        job = self.opened.job
        self._move(*self.flight.at(index))
        # Noise that stood still while the picture moves would be seen as a dirty pane. Seeds of
        # passes are further apart than there are frames (see passes.pass_seed): each is used once
        seed = (job.seed + index) % 2**32
        opened = self.opened._replace(job=replace(job, seed=seed))
        level = mi.log_level()
        if self.warned and level == mi.LogLevel.Warn:
            mi.set_log_level(mi.LogLevel.Error)  # of what is wrong with the scene it warns once
        try:
            return opened.still(self.plan.rules)
        finally:
            mi.set_log_level(level)

    def render(self, index: int) -> Checkpoint:
        """A frame's sums; ``about`` says which it is, where the sensor stood and what it was set
        to."""
        still = self.in_work = self.still(index)
        passes = map(still.render, still.todo(still.nothing(), stop=still.count))
        state, _ = still.accumulate(still.nothing(), passes, self._follow, interruptible=False)
        self.in_work = self.progress = None
        pose, parameters = self.flight.at(index)
        matrix = pose.to_world(self.chart).matrix
        state.about = {
            "frame": index,
            "frames": self.plan.count,
            "toWorld": [matrix[i, j] for i in range(4) for j in range(4)],
            **parameters,
        }
        return state

    @property
    def left(self) -> float | None:
        """Estimated seconds until the frame that is being rendered is done; None if unknown."""
        progress, still = self.progress, self.in_work  # another thread may ask
        if progress and progress.left is not None:
            return progress.left
        return still.passes.left if still and still.count == 1 else None

    def _follow(self, progress: Progress) -> None:
        self.progress = progress

    def _move(self, pose: Pose, parameters: dict[str, float]) -> None:
        self.sensor["to_world"] = mi.Transform4f(pose.to_world(self.chart))
        for name, value in parameters.items():
            self.sensor[name] = dr.opaque(mi.Float, value)  # a literal would be another kernel
        self.sensor.update()


def path_of(folder: Path, index: int, count: int, suffix: str) -> Path:
    """The file of a frame among so many."""
    return folder / f"{index:0{max(DIGITS, len(str(count - 1)))}}{suffix}"


def is_there(path: str | os.PathLike, settings: dict) -> bool:
    """Whether the file `path` holds the frame with these settings; False if there is no file.

    Raises OSError if it cannot be read, and ValueError if it is another frame, or none.
    """
    if not os.path.lexists(path):
        return False
    advice = "remove it, or write to another folder (-o)."
    try:
        text = _mark_of(path)
    except ValueError as error:
        raise ValueError(f"{str(error).rstrip('.')}: {advice}") from None
    try:
        there = json.loads(text)
    except (TypeError, ValueError):  # no text, or another program's
        there = None
    if not isinstance(there, dict):
        raise ValueError(f'"{path}" is no frame of a flight: {advice}')
    found = list(differences(there, json.loads(json.dumps(settings))))
    if found:
        raise ValueError(f'"{path}" is a frame of another flight: {"; ".join(found)}; {advice}')
    return True


def _mark_of(path: str | os.PathLike):
    """What a file tells of its flight; None if nothing. Raises ValueError if it is damaged."""
    if Path(path).suffix == ".png":
        return png.texts_of(path).get("flight")
    attribute = exr_header.read(path)[0].get("flight")
    if not exr_header.is_complete(path):
        raise ValueError(f'"{path}" is damaged.')
    return attribute and attribute.value
