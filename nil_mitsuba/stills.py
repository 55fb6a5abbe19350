"""Pictures of any sample count: pass after pass until a rule says stop, saved on the way.

A still is a sum of passes. Whoever renders them, here, after an interruption or on another machine,
gets the same image: each pass has a seed of its own, and sums are kept in double precision.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import numbers
import operator
import os
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import __version__, checkpoint, parameters
from .checkpoint import Checkpoint
from .fog import Fog
from .layers import LAYERS, channel_names
from .sums import Sums, develop, luminance, name_noise

# A checkpoint is never older than this, as long as no single pass and no writing takes longer.
CHECKPOINT_SECONDS = 60.0

# With a rule for time or noise, passes have so many samples in all, at least one per pixel: the
# rules are looked at between passes, each of which costs some hundredths of a second besides.
LOOK_SAMPLES = 2**19

# The variance between fewer passes says little about a picture of few pixels.
NOISE_PASSES = 4

# Mitsuba's names for the pixel formats of a film, in a scene and in the film's description.
PIXEL_FORMATS = {"y": "luminance", "ya": "luminance_alpha"}


@dataclass(frozen=True)
class Rules:
    """When to stop: samples per pixel, seconds of rendering, noise (see ``noise``).

    Whichever comes first counts, once there is a pass; at least one of them has to be given.
    """

    spp: int | None = None
    seconds: float | None = None
    noise: float | None = None

    def met(self, progress: Progress) -> bool:
        return progress.passes > 0 and (
            (self.spp is not None and progress.samples >= self.spp)
            or (self.seconds is not None and progress.seconds >= self.seconds)
            or (
                self.noise is not None
                and progress.noise is not None
                and progress.passes >= NOISE_PASSES
                and progress.noise <= self.noise
            )
        )


@dataclass(frozen=True)
class Progress:
    """How far a still is: passes, samples per pixel, seconds of rendering, and the noise so far
    (None before the second pass, unless one is all there will be); ``rules`` are those that will
    end it."""

    passes: int
    samples: int
    seconds: float
    noise: float | None
    rules: Rules

    @property
    def left(self) -> float | None:
        """Estimated seconds until the first rule is met; None if nothing can be said yet."""
        rules, estimates = self.rules, []
        if rules.seconds is not None:
            estimates.append(rules.seconds - self.seconds)
        if self.samples:
            if rules.spp is not None:
                estimates.append(self.seconds * (rules.spp / self.samples - 1))
            if rules.noise is not None and self.noise is not None:
                # Noise falls with the square root of the number of samples
                ratio = self.noise / rules.noise
                estimates.append(self.seconds * (ratio * ratio - 1))
        return max(0.0, min(estimates)) if estimates else None


class Interrupted(KeyboardInterrupt):
    """A still was stopped by Ctrl-C or SIGTERM; ``image`` is what there is of it."""

    def __init__(self, image: mi.TensorXf, sentence: str):
        super().__init__(sentence)
        self.image = image


class Still:
    """An image of a scene that is rendered in passes.

    ``settings`` is what has to be equal for sums of passes to belong together; ``fog`` is what of
    the scene a given ``scene_hash`` does not cover. Raises ValueError if the integrator is not
    "nil" itself, which renders passes.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        integrator: mi.Integrator | None = None,
        seed: int = 0,
        rules: Rules = Rules(),
        pass_spp: int | None = None,
        scene_hash: str | None = None,
        fog: Fog | None = None,
    ):
        from .passes import Passes  # of the current variant

        integrator = integrator or scene.integrator()
        if integrator is None:
            raise ValueError(
                'the scene has no integrator: give it one of the type "nil", or pass '
                'integrator=mi.load_dict({"type": "nil"}).'
            )
        if not hasattr(integrator, "view"):
            raise ValueError(
                f'the integrator "{type(integrator).__name__}" renders in one go: only "nil" '
                "itself, with no other integrator around it, renders in passes."
            )
        seed = operator.index(seed)  # it may be NumPy's
        if not 0 <= seed < 2**32:
            raise ValueError(f"seed is a whole number from 0 to 2^32 - 1, and it is {seed}.")
        sensor, name = _sensor(scene, sensor)
        self.film = sensor.film()
        if pass_spp is None and (rules.seconds or rules.noise):
            pass_spp = max(1, LOOK_SAMPLES // dr.prod(self.film.crop_size()))
            pass_spp = min(pass_spp, rules.spp or pass_spp)
        judged = rules.spp is not None or rules == Rules()  # no other rule makes more passes
        self.passes = Passes(
            integrator, scene, sensor, seed, rules.spp or 0, pass_spp, judged=judged
        )
        if rules == Rules():
            rules = Rules(spp=self.passes.count * self.passes.spp)
        self.rules = rules
        self.settings = {
            "scene": scene_hash or hash_of(scene),
            **(fog.settings if fog else {}),
            "sensor": name,
            "seed": seed,
            "pass_spp": self.passes.spp,
            "sampler": self.passes.sampler.class_name(),
            "film": film_settings(self.film),
            "layers": list(integrator.layers),
            "integrator": {
                name: _plain(getattr(integrator, name))
                for name in parameters.NAMES
                if name != "aovs"
            },
            "variant": mi.variant(),
            "versions": versions(),
        }

    @property
    def count(self) -> int | None:
        """Number of passes that hold the samples asked for; None if only time or noise end it."""
        return math.ceil(self.rules.spp / self.passes.spp) if self.rules.spp else None

    def nothing(self) -> Checkpoint:
        """The sums of no passes."""
        return Checkpoint(self.settings, self.passes.nothing())

    def render(self, index: int) -> Checkpoint:
        """Pass number ``index``."""
        start = time.perf_counter()
        sums = self.passes.render(index)
        own_noise = noise(self.film, sums) if sums.halves is not None else None
        return Checkpoint(self.settings, sums, time.perf_counter() - start, noise=own_noise)

    def start(self, path: str | os.PathLike | None, resume: bool) -> Checkpoint:
        """What there is to go on with: nothing, or with ``resume`` the checkpoint at `path`.

        Raises ValueError if that is of another still, and FileExistsError if it is there and not
        to be resumed.
        """
        if path is None or not os.path.lexists(path):
            return self.nothing()
        if not resume:
            raise FileExistsError(
                f'"{path}" holds the samples of an earlier render: resume it (--resume, '
                "resume=True), or remove the file."
            )
        state = checkpoint.load(path)
        try:
            state.require(self.settings)
        except ValueError as error:
            raise ValueError(f'cannot go on with "{path}": {error}') from None
        return state

    def todo(self, state: Checkpoint, first: int = 0, stop: int | None = None) -> Iterator[int]:
        """Numbers of the passes from ``first`` on, up to ``stop``, that are not in ``state``."""
        index = first
        endless = sys.maxsize
        for present, end in (*state.sums.passes, (endless, endless)):
            while index < min(present, endless if stop is None else stop):
                yield index
                index += 1
            index = max(index, end)

    def accumulate(
        self,
        state: Checkpoint,
        parts: Iterable[Checkpoint],
        progress: Callable[[Progress], None] | None = None,
        saver: Saver | None = None,
        interruptible: bool = True,
    ) -> tuple[Checkpoint, int | None]:
        """Add parts until there are no more, a rule is met, or a signal comes.

        ``parts`` yields checkpoints of passes as they are rendered, by whomever. Returns the sums
        and the number of the signal. In the main thread Ctrl-C and SIGTERM wait for the pass that
        is being rendered; a second one does not. If not ``interruptible``, they are for the caller.
        """
        parts = iter(parts)
        before, start = state.seconds, time.perf_counter()
        if state.noise is None:
            state.noise = noise(self.film, state.sums)
        catching: contextlib.AbstractContextManager[list[int]] = (
            interruption() if interruptible else contextlib.nullcontext([])
        )
        with catching as signals:
            while True:
                state.seconds = before + time.perf_counter() - start
                report = Progress(
                    state.sums.count,
                    state.sums.count * self.passes.spp,
                    state.seconds,
                    state.noise,
                    self.rules,
                )
                try:
                    if progress is not None:
                        progress(report)
                    if signals or self.rules.met(report):
                        break
                    part = next(parts, None)
                except BaseException:
                    # A second signal does not wait, an exception of the callback's does
                    if saver is not None and state.sums.count and len(signals) < 2:
                        saver.save(state)
                    raise
                if part is None:
                    break
                state = state.plus(part)
                if state.noise is None:
                    state.noise = noise(self.film, state.sums)
                state.seconds = before + time.perf_counter() - start  # As on a clock on the wall
                if saver is not None:
                    saver.after_pass(state)
        return state, signals[0] if signals else None

    def develop(self, state: Checkpoint) -> mi.TensorXf:
        """The image, as ``mi.render`` returns it: height × width × channels."""
        return self.passes.develop(state.sums)


class Saver:
    """Keeps a checkpoint of a growing still, never older than `CHECKPOINT_SECONDS`.

    What cannot be written is told to ``complain`` once, and rendering goes on: the last checkpoint
    that could be written stays.
    """

    def __init__(self, path: str | os.PathLike, complain: Callable[[str], None]):
        self.path = path
        self.complain = complain
        self.complained = False
        self.saved = self.passed = time.perf_counter()  # State of the last checkpoint, last pass
        self.pass_seconds = self.write_seconds = 0.0  # The longest so far

    def after_pass(self, state: Checkpoint) -> None:
        """Save, if the checkpoint were too old after one more pass."""
        now = time.perf_counter()
        self.pass_seconds = max(self.pass_seconds, now - self.passed)
        self.passed = now
        if now + self.pass_seconds + self.write_seconds >= self.saved + CHECKPOINT_SECONDS:
            self.save(state)
            self.passed = time.perf_counter()

    def save(self, state: Checkpoint) -> bool:
        """Save now; whether that went well."""
        start = time.perf_counter()
        try:
            checkpoint.save(self.path, state)
        except OSError as error:
            if not self.complained:
                self.complain(f"{error} The last checkpoint, if there was one, is as it was.")
            self.complained = True
            return False
        self.saved = start
        self.write_seconds = max(self.write_seconds, time.perf_counter() - start)
        return True


def render(
    scene: mi.Scene,
    sensor: int | mi.Sensor = 0,
    integrator: mi.Integrator | None = None,
    *,
    spp: int | None = None,
    seconds: float | None = None,
    noise: float | None = None,
    seed: int = 0,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> mi.TensorXf:
    """Render a still until it has `spp` samples per pixel, or `seconds` or `noise` are reached.

    Without any of the three the scene's sample count holds. `sensor` is a number or a sensor, as in
    ``mi.render``; `integrator` (the scene's, if None) has to be "nil". The image is a tensor,
    height × width × channels, those of the integrator's layers (`aovs`) behind the picture's.
    `noise` is the relative error that `nil_mitsuba.stills.noise` estimates. `progress` is called
    between passes with a ``stills.Progress``.

    At least once a minute and at the end the sums are written to the file `checkpoint`; with
    `resume` they are read from there first, if it exists, and `seconds` and `spp` count what was
    done before. The file stays, so that a larger `spp` can go on with it. Ctrl-C and SIGTERM, in
    the main thread, finish the pass, save the sums and raise ``stills.Interrupted``, a
    KeyboardInterrupt whose ``image`` is the image so far.

    Raises ValueError for arguments and checkpoints that do not fit and FileExistsError for a
    checkpoint that is not to be resumed; what cannot be written is a warning while rendering goes
    on.
    """
    rules = check_rules(spp, seconds, noise)
    still = Still(scene, sensor, integrator, seed, rules, pass_spp_of(checkpoint, resume))
    state = still.start(checkpoint, resume)
    saver = Saver(checkpoint, warnings.warn) if checkpoint is not None else None
    parts = (still.render(index) for index in still.todo(state, stop=still.count))
    state, signal_number = still.accumulate(state, parts, progress, saver)
    if saver is not None:
        saver.save(state)
    image = still.develop(state)
    dr.eval(image)
    if signal_number is not None:
        raise Interrupted(
            image,
            f"interrupted at {state.sums.count * still.passes.spp} samples per pixel, noise "
            f"{name_noise(state.noise, state.sums.count)}; the exception's image is what there is.",
        )
    return image


def noise(film: mi.Film, sums: Sums) -> float | None:
    """Root mean square, over all pixels, of the standard error of a pixel's luminance as a fraction
    of that luminance or of the image's mean luminance, whichever is larger: a number without a
    unit, 0.02 being two percent; None below two passes, or for one without ``halves``.

    It is estimated from what the passes differ by, or the halves of a single one, and is that of
    the image as rendered: denoised, an image has another error, of which this says nothing. A
    single pixel counts 1 at most, so that a few bright specks do not hide how far the rest is.
    Pixels that are infinite or not a number, which no further samples mend, are left out; the error
    of an image that has no others is infinite, and that of a black one, in which no sample has
    found light, 0.

    A pixel's luminance is the ratio R = ΣS/ΣW of sums over n passes; the variance of such a ratio
    is n/(n−1) Σ(S − R W)² / (ΣW)² to first order (Cochran, Sampling Techniques, eq. 6.13); with two
    halves, whose sums differ by D and V, it is (D − R V)² / (ΣW)².
    """
    total, weight = luminance(film, sums.values)
    pixels = len(weight)

    def plane_of(tensor, i):
        return dr.gather(mi.Float64, tensor.array, dr.arange(mi.UInt32, pixels) + i * pixels)

    ss, sw, ww = (plane_of(sums.moments, i) for i in range(3))
    n = dr.opaque(mi.Float64, sums.count)
    finite = dr.isfinite(total) & dr.isfinite(ss) & dr.isfinite(weight)
    seen = (weight > 0) & finite
    ratio = dr.select(seen, total / weight, 0)
    size = dr.abs(ratio)  # filters with negative lobes make pixels below black
    count = dr.maximum(dr.count(finite), 1)
    if sums.halves is not None:
        difference, unequal = (plane_of(sums.halves, i) for i in range(2))
        residuals = dr.square(difference - ratio * unequal)
    else:
        residuals = dr.fma(-2 * ratio, sw, ss) + dr.square(ratio) * ww
        residuals *= n / (n - 1)
    variance = dr.maximum(residuals, 0) / dr.square(weight)
    scale = dr.maximum(size, dr.sum(size) / count)
    squares = dr.select(seen & (scale > 0), variance / dr.square(scale), 0)
    # Of one pass, too, so that the second compiles nothing
    result = dr.select(dr.any(finite), dr.sqrt(dr.sum(squares) / count), dr.inf)[0]
    return result if sums.count > 1 or sums.halves is not None else None


@contextlib.contextmanager
def interruption(patience: int = 1) -> Iterator[list[int]]:
    """The signals SIGINT and SIGTERM that have come; one beyond `patience` of them raises
    KeyboardInterrupt.

    Outside of the main thread nothing is caught: Python allows no handlers there.
    """
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def catch(number, _frame):
        caught.append(number)
        if len(caught) > patience:
            raise KeyboardInterrupt(signal.Signals(number))

    before = {number: signal.signal(number, catch) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def check_rules(spp: int | None, seconds: float | None, noise: float | None) -> Rules:
    """The rules, checked; raises ValueError."""
    for name, value in (("spp", spp), ("seconds", seconds), ("noise", noise)):
        if value is not None and not isinstance(value, numbers.Real):
            raise ValueError(f"{name} has to be a number, and it is {value!r}.")
    if spp is not None and not (1 <= spp < math.inf and spp == int(spp)):
        raise ValueError(f"spp is a whole number from 1 on, and it is {spp}.")
    for name, value in (("seconds", seconds), ("noise", noise)):
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"{name} has to be a number greater than 0, and it is {value}.")
    return Rules(spp and int(spp), seconds, noise)


def pass_spp_of(path: str | os.PathLike | None, resume: bool) -> int | None:
    """Samples per pixel in a pass of the checkpoint to be resumed; None if there is none."""
    if path is None or not resume or not os.path.lexists(path):
        return None
    return checkpoint.peek(path)["pass_spp"]


def missing(state: Checkpoint) -> list[tuple[int, int]]:
    """Ranges of passes that are not in a still whose ``about`` says how many there should be."""
    gaps, index = [], 0
    count = state.about.get("count") or (state.sums.passes[-1][1] if state.sums.passes else 0)
    for first, stop in (*state.sums.passes, (count, count)):
        if index < min(first, count):
            gaps.append((index, min(first, count)))
        index = max(index, stop)
    return gaps


# --------------------------------------------------------------------- pictures


@dataclass
class Picture:
    """A developed still: names and tensor of the picture, layers by name, its component format."""

    names: list[str]
    image: mi.TensorXf
    layers: dict[str, mi.TensorXf]
    component_format: str


def picture_of(state: Checkpoint, film: mi.Film | None = None) -> Picture:
    """The picture and the layers of a still, developed by ``film`` or by one like its own."""
    settings = state.settings
    if film is None:
        film = film_of(settings["film"])
    image = develop(film, settings["layers"], state.sums, settings["pass_spp"])
    layers = settings["layers"]
    names = list(settings["film"]["pixel_format"].upper())
    if not names:  # a film with channels of its own
        total = len(channel_names(layers))
        names = [field.name for field in film.bitmap().struct_()][: image.shape[2] - total]
    planes, at = {}, len(names)
    for layer in layers:
        end = at + len(LAYERS[layer].channels)
        planes[layer] = image[:, :, at:end]
        at = end
    return Picture(names, image[:, :, : len(names)], planes, settings["film"]["component_format"])


def component_format(film: mi.Film) -> str:
    """The type in which a film wants its pixels stored: "float16", "float32" or "uint32"."""
    # A film tells it nowhere but in its description.
    match = re.search(r"component_format = (\w+)", str(film))
    return match[1] if match else "float32"


def film_settings(film: mi.Film) -> dict:
    """What it takes to make a film like this one, in plain values."""
    match = re.search(r"pixel_format = (\w+)", str(film))
    special = mi.has_flag(film.flags(), mi.FilmFlags.Special)  # with channels of its own
    pixel_format = match[1] if match and not special else ""
    return {
        "type": film.class_name(),
        "size": list(map(int, film.size())),
        "crop_size": list(map(int, film.crop_size())),
        "crop_offset": list(map(int, film.crop_offset())),
        "filter": str(film.rfilter()),
        "pixel_format": pixel_format,
        "component_format": component_format(film),
    }


def film_of(settings: dict) -> mi.Film:
    """A film that develops what one with these settings has summed up; raises ValueError."""
    if settings["type"] != "HDRFilm":
        raise ValueError(f'parts of the film "{settings["type"]}" cannot be merged: use hdrfilm.')
    return mi.load_dict(
        {
            "type": "hdrfilm",
            "width": settings["size"][0],
            "height": settings["size"][1],
            "crop_width": settings["crop_size"][0],
            "crop_height": settings["crop_size"][1],
            "crop_offset_x": settings["crop_offset"][0],
            "crop_offset_y": settings["crop_offset"][1],
            "pixel_format": PIXEL_FORMATS.get(settings["pixel_format"], settings["pixel_format"]),
            "component_format": settings["component_format"],
        }
    )


def hash_of(thing: mi.Scene | mi.Sensor) -> str:
    """SHA-256 of what is loaded: of its description and of all arrays that it lets one see.

    Numbers of samples are no part of it: each render in between sets them. Nor is an address, which
    is all that a batch says of itself: its sensors are asked.
    """
    traversed = mi.traverse(thing)
    # Sensors do not describe their media, nor media their phase functions
    kinds = (mi.Sensor, mi.Medium, mi.PhaseFunction)
    nodes = [node for node in traversed.hierarchy if isinstance(node, kinds)]
    text = re.sub(
        r"\b(base_seed|sample_count|samples_per_wavefront|wavefront_size) = \d+|\[0x[0-9a-f]+\]",
        "",
        "\n".join(map(str, (thing, *nodes))),
    )
    digest = hashlib.sha256(text.encode())
    for key in sorted(traversed.keys()):
        value = traversed[key]
        digest.update(key.encode())
        if dr.is_array_v(value) and dr.width(value):
            digest.update(dr.ravel(value).memview())
        else:
            digest.update(str(value).encode())
    return digest.hexdigest()


def _sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> tuple[mi.Sensor, int | str]:
    """A sensor, and what tells it from others: its number in the scene, or a hash if it has none.

    Raises ValueError for a number that no sensor has.
    """
    sensors = scene.sensors()
    if isinstance(sensor, mi.Sensor):
        return sensor, sensors.index(sensor) if sensor in sensors else hash_of(sensor)
    number = operator.index(sensor)  # it may be NumPy's
    if not 0 <= number < len(sensors):
        raise ValueError(
            f"the scene has {len(sensors)} sensors, numbered from 0, and sensor is {number}."
        )
    return sensors[number], number


def versions() -> dict[str, str]:
    """Versions of what renders."""
    return {"nil_mitsuba": __version__, "Mitsuba": mi.__version__, "Dr.Jit": dr.__version__}


def _plain(value):
    """A parameter as JSON gives it back."""
    if isinstance(value, float) and math.isinf(value):
        return "unlimited"
    return value if isinstance(value, (bool, int, float, str)) else list(map(float, value))
