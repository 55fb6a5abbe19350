"""The viewfinder: what who looks at a scene asks for, and the pictures that he sees meanwhile.

It knows neither browser nor network: messages come from a `Link` and events go to it, as they are
described there. Everything runs in one thread.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import mitsuba as mi

from . import jobs
from .denoise import can_denoise
from .errors import cause_of
from .fog import Fog
from .keeping import Keeper, Shot
from .lens import viewing_sensor
from .pose import Chart, Pose
from .scene_files import number_text

if TYPE_CHECKING:
    from .preview import Canvas, Preview, Sight

# While something moves, a picture should take about so long: eight a second. Its size grows and
# shrinks by this factor where it takes much less or more.
FRAME_SECONDS, STEP = 0.125, math.sqrt(2)
SMALLEST = 160  # pixels wide; a coarser picture shows nothing

# Paths are so long while something moves. Longer ones change little but inside glass.
MOVING_DEPTH = 4

DEEPEST = 64  # the end of the slider, which stands for no limit

# Nothing that is asked for waits longer than for one piece of a picture, of so many samples.
PIECE_SECONDS = 0.1
FIRST_PIECE, LEAST_PIECE = 2**15, 2**12

# The denoiser's better network takes three times as long: it has to be worth it.
FEW_PASSES = 16

# A picture that refines is shown whenever it has twice as many samples, and after each pass by
# when so many seconds have gone.
SHOW_SECONDS = 5.0

# However long a picture takes, the next one is no farther away than so many seconds of walking.
LONGEST_STEP = 0.25
TURN = math.radians(60)  # a second, by the arrows
SPEED = 0.4  # cells a second
NOTCH = 1.25  # of the wheel, to the speed

WAIT_SECONDS = 0.2  # for messages, if there is nothing to do; signals are looked at between

# A page that is loaded again is back within so many seconds; then it was closed.
LEAVING_SECONDS = 3.0


class Link(Protocol):
    """What a viewfinder sees of who looks through it."""

    viewer: bool  # whether there is anybody
    ready: bool  # whether a picture would be shown at once

    def messages(self, wait: float) -> list[dict]:
        """What has been asked for; waits so many seconds if there is nothing."""

    def send(self, event: dict) -> None:
        """Tell something."""

    def show(self, header: dict, jpeg: bytes) -> bool:
        """Show a picture; whether it was taken."""


@dataclass
class Slider:
    """A number that who looks may change, and what is done about it."""

    name: str
    label: str
    value: float
    least: float
    most: float
    step: float
    take: Callable[[float], None]
    unit: str = ""
    log: bool = False

    def __post_init__(self):
        self.first = self.value

    def event(self) -> dict:
        return {
            "name": self.name,
            "label": self.label,
            "min": self.least,
            "max": self.most,
            "step": self.step,
            "value": self.value,
            "first": self.first,
            "log": self.log,
            "unit": self.unit,
        }

    def fitting(self, value: float) -> float:
        """The value that it can have next to one."""
        value = max(self.least, min(self.most, value))
        return float(round(value)) if self.step == 1 else value


class Viewfinder:
    """A loaded scene with a camera that moves.

    ``opened`` is the scene, with ids of shapes; ``notes`` are sentences on it. Raises RuntimeError
    or ValueError if it cannot be walked through.
    """

    def __init__(self, opened: jobs.Opened, notes: list[str], link: Link):
        self.job, self.scene, self.nil = opened.job, opened.scene, opened.nil
        self.notes, self.link = notes, link
        own = self.scene.sensors()[self.job.sensor]
        self.sensor, self.lens = viewing_sensor(own, self.nil)
        self.keeper = Keeper(opened)
        self.depth = self.nil.max_depth
        self.chart = Chart.of(self.nil)
        self.home = self.pose = Pose.of(own.world_transform(), self.chart)
        self.first = {name: getattr(self.nil, name) for name in ("twist", "tolerance", "max_depth")}
        fog = self.job.fog or Fog(0.0)
        self.fog, self.fog_albedo = fog.density, fog.albedo
        self.fog_medium = self.sensor.get_medium() if self.job.fog else None
        self.guided = can_denoise()
        self.denoises, self.filmic, self.exposure = self.guided, False, 0.0
        self.preview: Preview
        self.sliders = {slider.name: slider for slider in self._sliders()}
        size = self.sensor.film().crop_size()
        self.aspect = size[0] / size[1]

        self.room = (1280, 720)  # pixels that the page has for the picture
        self.width = 320  # of the picture while something moves
        self.speed = SPEED
        self.move, self.turn = (0.0, 0.0, 0.0), (0.0, 0.0)
        self.kick = False  # whether a key was pressed since the last step
        self.advanced = 0.0  # when that was
        self.compiled = False
        self.stale = True  # whether the camera or the scene differ from what is shown
        self.placed = self.known = False  # whether the preview has the camera, and the parameters
        self.canvas: Canvas | None = None  # the picture that refines
        self.shown, self.shown_at = 0, 0.0  # its passes when it was shown last, and when
        self.piece = FIRST_PIECE
        self.broken = False  # whether there can be no picture until something changes
        self.seconds = FRAME_SECONDS  # that a moving picture takes
        self.frames = 0  # shown so far
        self.picture: mi.TensorXf | None = None  # developed last, and what is told of it
        self.header: dict = {}
        self.untold = False  # whether it could not be shown
        self.pointed: list[float] | None = None
        self._prepare()

    # ------------------------------------------------------------------ the loop

    def run(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Answer and show, until ``ended`` or until nobody looks any more."""
        seen: float | None = None  # when somebody looked
        while not ended():
            for message in self.link.messages(0 if self._works() else WAIT_SECONDS):
                self.answer(message)
            now = time.perf_counter()
            if self.link.viewer:
                self._advance(min(now - self.advanced, LONGEST_STEP))
                self.advanced = seen = now
                self._work()
            elif seen is not None and now - seen > LEAVING_SECONDS:
                return

    def _works(self) -> bool:
        """Whether there is something to do besides waiting for messages."""
        if not self.link.viewer or self.broken:
            return False
        return self.link.ready or not (self.stale or self._is_due())

    def _work(self) -> None:
        """The next picture or piece of one, if one is wanted; what goes wrong with it is said."""
        try:
            if self.stale:
                if self.link.ready:
                    self.broken = False
                    self.glance()
            elif self.untold and self.link.ready:
                self.untold = False
                self._tell_picture()
            elif self.pointed is not None:
                self._point()
            elif self._works():
                self.refine()
        except (RuntimeError, ValueError, OSError) as error:
            # Once: until something changes, the next picture would not go better
            self.stale, self.canvas, self.broken = False, None, True
            self.say(str(cause_of(error)), "error")

    def say(self, text: str, kind: str = "note") -> None:
        """One sentence for who looks."""
        self.link.send({"is": "says", "text": text, "kind": kind})

    # ---------------------------------------------------------------- what is seen

    def look(self) -> None:
        """Have the sensor placed where the camera is."""
        self.placed, self.stale = False, True

    def change(self) -> None:
        """Have the preview take over what has changed of the integrator or the media."""
        self.known, self.stale = False, True

    def _catch_up(self) -> None:
        """Let the preview have the camera and the parameters that there are now.

        Not before they are needed: what is dragged changes more often than there are pictures, and
        a twist takes as long as one.
        """
        if not self.placed:
            self.preview.look(self.pose.to_world(self.chart), **self.lens)
            self.placed = True
        if not self.known:
            self.preview.change()
            self.known = True

    def sight(self, at: Sequence[float]) -> Sight:
        """What is seen at a place, in parts of the picture."""
        self._catch_up()
        return self.preview.sight(*at)

    def glance(self) -> None:
        """Show a picture at once, as large as there is time for."""
        start = time.perf_counter()
        self._catch_up()
        width, height = self._size(self.width)
        canvas = self.preview.canvas(width, height)
        self.nil.max_depth = MOVING_DEPTH if self.depth < 0 else min(MOVING_DEPTH, self.depth)
        try:
            self.preview.render(canvas, width * height)
        finally:
            self.nil.max_depth = self.depth
        self.stale, self.canvas = False, None
        self._show(canvas, quick=True, moving=self.moving)
        if self.compiled:
            self._adapt(time.perf_counter() - start)
        self.compiled = True

    def _adapt(self, seconds: float) -> None:
        """Choose the size of moving pictures by the time that the last one took."""
        self.seconds += (seconds - self.seconds) / 4
        if self.seconds > FRAME_SECONDS * STEP and self.width > SMALLEST:
            self.width = max(SMALLEST, round(self.width / STEP))
        elif self.seconds * STEP**2 < FRAME_SECONDS and self._size(self.width)[0] == self.width:
            self.width = round(self.width * STEP)
        else:
            return
        self.seconds = FRAME_SECONDS  # nothing is known of that size

    def refine(self) -> None:
        """Trace a piece of the picture at rest, and show that from time to time.

        Its size doubles with the first passes until there is no room for more: who waits sees
        something better at once.
        """
        if self.canvas is None:
            self._start(2 * self.width)
        canvas = self.canvas
        assert canvas is not None
        if not self._is_due():
            start = time.perf_counter()
            count = min(self.piece, canvas.left)
            self.preview.render(canvas, count)
            if count == self.piece:
                ratio = PIECE_SECONDS / (time.perf_counter() - start)
                self.piece = int(max(LEAST_PIECE, count * max(0.5, min(2, ratio))))
        if self._is_due() and self.link.ready:
            self._show(canvas, quick=canvas.passes < FEW_PASSES, moving=False)
            self.shown, self.shown_at = canvas.passes, time.perf_counter()
            if canvas.width < self._size(self.room[0])[0]:
                self._start(2 * canvas.width)

    def _start(self, width: int) -> None:
        """Begin with a picture of about a width, or as wide as there is room for."""
        self.canvas = self.preview.canvas(*self._size(width))
        self.shown, self.shown_at = 0, time.perf_counter()

    def _is_due(self) -> bool:
        """Whether the picture that refines has come so far that it is to be shown."""
        canvas = self.canvas
        if canvas is None or canvas.begun or canvas.passes == self.shown:
            return False
        late = time.perf_counter() - self.shown_at > SHOW_SECONDS
        return canvas.passes >= 2 * self.shown or late or not self.denoises

    def _size(self, width: int) -> tuple[int, int]:
        """A picture's size of about a width, that fits into the page's room."""
        width = min(width, self.room[0], round(self.room[1] * self.aspect))
        return max(2, width), max(1, round(width / self.aspect))

    def _show(self, canvas: Canvas, quick: bool, moving: bool) -> None:
        """Develop a canvas and show it."""
        self.picture = self.preview.picture(canvas, self.denoises, quick)
        self.header = {
            "spp": canvas.passes,
            "moving": moving,
            "denoised": self.denoises,
            "place": self.chart.to_scene(self.pose.place),
            "cell": list(self.pose.cell) if self.chart.quotient else None,
        }
        self._tell_picture()

    def _tell_picture(self) -> None:
        """Show what was developed last, with the exposure that there is now."""
        from .preview import as_jpeg  # of the current variant

        if self.picture is None:
            return
        height, width, _ = self.picture.shape
        self.frames += 1
        header = self.header | {
            "frame": self.frames,
            "size": [width, height],
            "fps": 1 / self.seconds,
            "speed": self.speed * self.chart.size,
        }
        if not self.link.show(header, as_jpeg(self.picture, self.exposure, self.filmic)):
            self.untold = True

    # ------------------------------------------------------------------ answers

    def answer(self, message: dict) -> None:
        """Do what a message asks for; what is wrong with it is said."""
        try:
            getattr(self, f"_do_{message['do']}")(message)
        except (RuntimeError, ValueError, OSError) as error:
            self.say(str(cause_of(error)), "error")

    def _do_hello(self, message: dict) -> None:
        self._do_size(message)
        self.move, self.turn = (0.0, 0.0, 0.0), (0.0, 0.0)
        self._tell_scene()
        if self.notes:
            self.say(" ".join(self.notes))  # there is room for one message
        if self.keeper.keys:
            self.link.send(self.keeper.flight(self.shot))
        if not self.compiled:
            self.say("Compiling the kernel of this scene.", "busy")

    def _tell_scene(self) -> None:
        self.link.send(
            {
                "is": "scene",
                "title": Path(self.job.path).name,
                "aspect": self.aspect,
                "sliders": [slider.event() for slider in self.sliders.values()],
            }
        )

    def _do_bye(self, _message: dict) -> None:
        self.move, self.turn = (0.0, 0.0, 0.0), (0.0, 0.0)
        self.canvas, self.stale, self.pointed = None, True, None
        self.picture = None

    def _do_size(self, message: dict) -> None:
        width, height = message["size"]
        room = max(SMALLEST, int(width)), max(1, int(height))
        if room != self.room:
            self.room, self.canvas = room, None
        self.stale |= self.picture is None

    def _do_look(self, message: dict) -> None:
        dx, dy = message["by"]
        # The point under the pointer follows it
        angle = 2 * math.atan(math.tan(math.radians(self.fov) / 2) / self.aspect)
        self.pose = self.pose.turned(dx * angle, dy * angle)
        self.look()

    def _do_go(self, message: dict) -> None:
        move, turn = tuple(message["move"]), tuple(message["turn"])
        if any(move) or any(turn):
            if not self.moving:
                self.advanced = time.perf_counter() - FRAME_SECONDS
                self.kick = True
        elif self.kick:  # let go before there was a step
            self._advance(FRAME_SECONDS)
        self.move, self.turn = move, turn

    def _advance(self, seconds: float) -> None:
        """Move and turn as the keys say that are held, for a time."""
        if any(self.turn):
            self.pose = self.pose.turned(*(TURN * seconds * c for c in self.turn))
        if any(self.move):
            # Two keys at once are no faster than one
            length = self.speed * seconds * min(1, math.hypot(*self.move))
            self.pose = self.pose.moved(self.move, length, self.chart)
        if self.moving:
            self.kick = False
            self.look()

    @property
    def moving(self) -> bool:
        """Whether keys are held that move or turn the camera."""
        return any(self.move) or any(self.turn)

    def _do_speed(self, message: dict) -> None:
        self.speed = max(1e-4, min(1e3, self.speed * NOTCH ** message["by"]))
        self.say(f"{self.speed:.2g} cells a second.")

    def _do_home(self, _message: dict) -> None:
        self.pose = self.home.within(self.chart)
        self.look()

    def _do_point(self, message: dict) -> None:
        self.pointed = message["at"]
        if self.pointed is None:
            self._tell_sight(None, None)

    def _point(self) -> None:
        if self.pointed is not None:
            at, self.pointed = self.pointed, None
            self._tell_sight(at, self.sight(at))

    def _tell_sight(self, at, sight) -> None:
        names = ("shape", "cell", "position", "distance")
        self.link.send(
            {"is": "under", "at": at} | {name: getattr(sight, name, None) for name in names}
        )

    def _do_aim(self, message: dict) -> None:
        if self.sensor.class_name() == "OrthographicCamera":
            raise ValueError(
                "an orthographic camera sees all in one direction, and aims at nothing."
            )
        sight = self.sight(message["at"])
        self.pose = self.pose.looking(self.chart.to_cell_axes(sight.direction))
        if sight.distance is not None and "focus" in self.sliders:
            self._set(self.sliders["focus"], sight.distance)
            self.link.send({"is": "value", "name": "focus", "value": self.sliders["focus"].value})
        self.look()
        self._tell_sight([0.5, 0.5], sight)

    def _do_set(self, message: dict) -> None:
        slider = self.sliders.get(message["name"])
        if slider is None:
            raise ValueError(f'there is no slider "{message["name"]}" here.')
        self._set(slider, message["value"])
        if slider.value != message["value"]:
            self.link.send({"is": "value", "name": slider.name, "value": slider.value})

    def _set(self, slider: Slider, value: float) -> None:
        slider.value = slider.fitting(value)
        slider.take(slider.value)

    # -------------------------------------------------------------------- sliders

    def _sliders(self) -> list[Slider]:
        nil, size = self.nil, self.nil.cell_size
        most = max(3.0, math.ceil(abs(nil.twist)))
        step = 1 if nil.quotient else 0.01
        sliders = [
            Slider("twist", "Twist", nil.twist, -most, most, step, self._twist),
            Slider("exposure", "Exposure", 0.0, -8, 8, 0.1, self._exposure, "stops"),
            Slider("filmic", "Filmic", 0, 0, 1, 1, self._filmic),
        ]
        if "x_fov" in self.lens:
            sliders.append(
                Slider("fov", "Field of view", self.lens["x_fov"], 5, 150, 0.5, self._fov, "°")
            )
        if "focus_distance" in self.lens:
            focus = self.lens["focus_distance"]
            least, far = min(0.05 * size, focus), max(50 * size, focus)
            sliders += [
                Slider("focus", "Focus", focus, least, far, 0.01, self._focus, log=True),
                Slider(
                    "aperture",
                    "Aperture",
                    self.lens["aperture_radius"],
                    0,
                    max(0.1 * size, self.lens["aperture_radius"]),
                    0.001 * size,
                    self._aperture,
                ),
            ]
        depth = DEEPEST if self.depth < 0 else self.depth
        sliders += [
            Slider("depth", "Depth", depth, 1, max(DEEPEST, depth), 1, self._depth),
            Slider(
                "tolerance",
                "Tolerance",
                nil.tolerance,
                min(0.02, nil.tolerance),
                max(4.0, nil.tolerance),
                0.01,
                self._tolerance,
                "pixels",
                log=True,
            ),
        ]
        if self.fog or not self._has_media():
            sliders.append(
                Slider("fog", "Fog", self.fog, 0, max(2.0, self.fog), 0.01, self._fog, "per cell")
            )
        if self.guided:
            sliders.append(Slider("denoise", "Denoise", 1, 0, 1, 1, self._denoise))
        return sliders

    def _twist(self, value: float) -> None:
        self.nil.twist = value
        self.chart = Chart.of(self.nil)
        self.pose = self.pose.within(self.chart)
        self.change()
        self.look()

    def _exposure(self, value: float) -> None:
        self.exposure = value
        self._tell_picture()

    def _filmic(self, value: float) -> None:
        self.filmic = bool(value)
        self._tell_picture()

    def _fov(self, value: float) -> None:
        self.lens["x_fov"] = value
        self.look()

    def _focus(self, value: float) -> None:
        self.lens["focus_distance"] = value
        self.look()

    def _aperture(self, value: float) -> None:
        self.lens["aperture_radius"] = value
        self.look()

    def _depth(self, value: float) -> None:
        self.depth = self.nil.max_depth = -1 if value == DEEPEST else int(value)
        self.stale = True

    def _tolerance(self, value: float) -> None:
        self.nil.tolerance = value
        self.change()

    def _denoise(self, value: float) -> None:
        self.denoises = bool(value)
        if self.canvas is None:
            self.stale = True
        self.shown = 0  # what there is is shown after the pass in work

    def _fog(self, value: float) -> None:
        if not (value or self.fog_medium):
            return
        self.fog = value
        fog = Fog(value, self.fog_albedo)
        # A sensor keeps the medium that it has been given once: one of nothing is no fog
        if self.fog_medium is None:
            self.say("Compiling the kernel with fog.", "busy")
            self.fog_medium = fog.medium(self.nil)
            self.sensor.set_medium(self.fog_medium)
            self._prepare()
        else:
            fog.thicken(self.fog_medium, self.nil)
            self.change()

    def _prepare(self) -> None:
        """Make anew what renders."""
        from .preview import Preview  # of the current variant

        self.compiled = False
        self.preview = Preview(self.scene, self.nil, self.sensor, self.guided)
        self.placed = self.known = False
        self.stale = True
        self._catch_up()

    def _has_media(self) -> bool:
        from .media import has_media  # of the current variant

        return has_media(self.scene, self.sensor)

    @property
    def fov(self) -> float:
        """Horizontal, in degrees; of a sensor that has none, about that of a screen."""
        return self.lens.get("x_fov", 60.0)

    # ------------------------------------------------------------------ what is kept

    @property
    def shot(self) -> Shot:
        """What there is to see now, as it can be kept."""
        now = {"twist": self.nil.twist, "tolerance": self.nil.tolerance, "max_depth": self.depth}
        properties = {
            name: number_text(value) for name, value in now.items() if value != self.first[name]
        }
        return Shot(
            self.pose,
            self.chart,
            dict(self.lens),
            properties,
            Fog(self.fog, self.fog_albedo),
            self.exposure,
            self.filmic,
            self.denoises,
        )

    def _do_copy(self, _message: dict) -> None:
        self.link.send(self.keeper.camera(self.shot))

    def _do_save(self, _message: dict) -> None:
        self.link.send(self.keeper.save(self.shot))

    def _do_render(self, _message: dict) -> None:
        self.link.send(self.keeper.command(self.shot))

    def _do_key(self, _message: dict) -> None:
        self.link.send(self.keeper.add_key(self.shot))
