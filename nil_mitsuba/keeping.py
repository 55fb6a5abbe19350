"""What is kept of a walk: cameras as XML, copies of the scene, commands, the keys of a flight."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from . import jobs, keys
from .fog import ALBEDO, Fog
from .lens import LENS, lens_of
from .pose import Chart, Pose
from .registration import WORKING_VARIANT
from .scene_copy import SceneText, claim
from .scene_files import number_text
from .stills import film_settings


@dataclass(frozen=True)
class Shot:
    """A camera that was found, and what its picture depends on besides.

    ``lens``: the parameters `LENS` that it has. ``properties``: those of "nil" that differ from the
    scene's, as text. ``exposure``, ``filmic`` and ``denoise`` are those of the command.
    """

    pose: Pose
    chart: Chart
    lens: dict[str, float]
    properties: dict[str, str]
    fog: Fog
    exposure: float
    filmic: bool
    denoise: bool


@dataclass(frozen=True)
class Copy:
    """A scene file with a camera that was found, and the constants that it refers to."""

    path: Path
    defines: dict[str, str]


class Keeper:
    """Keeps shots of a scene, in files beside it that it never writes over.

    What it returns are events for the page. Raises what `SceneText` does.
    """

    def __init__(self, opened: jobs.Opened):
        self.job = opened.job
        self.scene = Path(self.job.path)
        self.text = SceneText(self.job.path, self.job.defines)
        own = opened.scene.sensors()[self.job.sensor]
        self.own_lens = lens_of(own)
        self.film_format = film_settings(own.film())["pixel_format"]
        self.in_passes = hasattr(opened.integrator, "view")  # what wraps it knows none
        self.saved: tuple[Shot, Copy] | None = None  # the last copy, and what it shows
        self.keys: list[keys.Key] = []
        self.key_path: Path | None = None
        self.key_copy: Copy | None = None  # which they need, if the scene's own sensor has no lens

    def camera(self, shot: Shot) -> dict:
        """The sensor's element, and the options that say the rest."""
        options = self.options(shot, self._edit(self.text.defines, shot))
        xml = self._edit(self.text.camera, shot)
        return {"is": "camera", "xml": xml, "options": shlex.join(options)}

    def save(self, shot: Shot) -> dict:
        """A copy of the scene with the camera."""
        return {"is": "saved", "path": str(self._copy(shot).path)}

    def command(self, shot: Shot) -> dict:
        """The command that renders the still, of such a copy."""
        copy = self._copy(shot)
        words = ["nil-mitsuba", "render", str(copy.path), *self.options(shot, copy.defines)]
        if self.film_format:  # as far as its film can tell it
            words += ["--png", str(copy.path.with_suffix(".png"))]
            if shot.exposure:
                words += ["--exposure", number_text(shot.exposure)]
            words += ["--filmic"] * shot.filmic
        if shot.denoise and self.in_passes and self.film_format in ("rgb", "rgba"):
            words.append("--denoise")
        return {"is": "command", "command": shlex.join(words), "path": str(copy.path)}

    def add_key(self, shot: Shot) -> dict:
        """Add the camera to those by which a flight leads; as of `flight`."""
        if self.key_path is None:
            self.key_path = claim(self.scene, "-keys", ".json")
        # A flight changes the parameters that its scene's sensor has: those of a lens need a copy
        if shot.lens.get("aperture_radius", 0) > 0 and "aperture_radius" not in self.own_lens:
            self.key_copy = self.key_copy or self._copy(shot)
        matrix = shot.pose.to_world(shot.chart).matrix
        entries = [float(matrix[i, j]) for i in range(4) for j in range(4)]
        added = [*self.keys, keys.Key(entries, shot.pose.cell, dict(shot.lens))]
        # All anew: keys from before the copy are to have the lens that they were seen by, too
        known = shot.lens if self.key_copy else self.own_lens
        written = (
            replace(key, parameters={name: key.parameters[name] for name in known}) for key in added
        )
        keys.save(self.key_path, list(written))
        self.keys = added
        return self.flight(shot)

    def flight(self, shot: Shot) -> dict:
        """How many keys there are, and the command that flies from one to the next."""
        flown = self.key_copy or Copy(self.scene, self.job.defines)
        words = ["nil-mitsuba", "fly", str(flown.path), *self.options(shot, flown.defines)]
        words += ["--keys", str(self.key_path), "--frames", "120"]
        words += ["-o", str(self.scene.with_name(f"{self.scene.stem}-frames"))]
        return {
            "is": "keys",
            "count": len(self.keys),
            "path": str(self.key_path),
            "command": shlex.join(words),
        }

    def options(self, shot: Shot, defines: dict[str, str]) -> list[str]:
        """The command's options that say which scene it is, and in which space."""
        words = [] if self.job.variant == WORKING_VARIANT else ["-m", self.job.variant]
        words += [word for item in defines.items() for word in ("-D", "=".join(item))]
        words += ["-s", str(self.job.sensor)] if self.job.sensor else []
        properties = self.job.properties | shot.properties
        properties.pop("aovs", None)
        words += [word for item in properties.items() for word in ("-P", "=".join(item))]
        if shot.fog.density:
            words += ["--fog", number_text(shot.fog.density)]
            if shot.fog.albedo != ALBEDO:
                words += ["--fog-albedo", number_text(shot.fog.albedo)]
        return words

    def _copy(self, shot: Shot) -> Copy:
        """A copy of the scene with a camera; that which there is already, if there is one."""
        if self.saved:
            last, copy = self.saved
            if last.pose is shot.pose and last.lens == shot.lens and copy.path.exists():
                return copy
        copy = Copy(self._edit(self.text.save, shot), self._edit(self.text.defines, shot))
        self.saved = shot, copy
        return copy

    def _edit(self, edit: Callable, shot: Shot):
        """A method of the scene's text, for a camera."""
        changed = self._changed(shot.lens)
        lens = {name: changed.get(name) for name in LENS}
        return edit(self.job.sensor, shot.pose.to_world(shot.chart), **lens)

    def _changed(self, lens: dict[str, float]) -> dict[str, float]:
        """The lens's parameters that the scene's own sensor has otherwise."""
        own = {"aperture_radius": 0.0} | self.own_lens
        changed = {name: value for name, value in lens.items() if value != own.get(name)}
        if lens.get("aperture_radius") == 0:
            changed.pop("focus_distance", None)  # a pinhole has none
        return changed
