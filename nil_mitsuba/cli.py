"""The command ``nil-mitsuba``."""

from __future__ import annotations

import abc
import contextlib
import functools
import json
import math
import os
import re
import shlex
import signal
import stat
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import click
import drjit as dr
import mitsuba as mi

from . import __version__, aiming, checkpoint, exr, jobs, keys, png, stills
from .denoise import can_denoise
from .errors import cause_of
from .fitting import FITS, cut_off
from .fog import ALBEDO, MOST, Fog
from .frames import Frames, Plan, is_there, path_of
from .layers import GUIDES, RENDERED
from .output import Output, metadata_of, software
from .parameters import nearest
from .registration import refusal
from .signals import Watch
from .sums import name_noise, name_passes

SUMS = ".sums"  # suffix of checkpoints and parts
MOST_FRAMES = 10**6  # eleven hours of film; seeds of passes are further apart

# A browser that has to be started shows a page within so many seconds.
COMING_SECONDS = 10.0


class Assignment(click.ParamType):
    """``key=value`` as a pair of strings."""

    name = "key=value"

    def convert(self, value, param, ctx):
        key, equals, text = value.partition("=")
        if not (key and equals):
            self.fail(f'expected key=value, and "{value}" is not.', param, ctx)
        return key, text


class Duration(click.ParamType):
    """Seconds, from a text such as ``90``, ``30m`` or ``1h30m``."""

    name = "time"
    UNITS = {"h": 3600, "m": 60, "s": 1}

    def convert(self, value, param, ctx):
        if isinstance(value, float):
            return value
        number = r"(\d+\.?\d*|\.\d+)"
        text = value.strip()
        if re.fullmatch(number, text):
            text += "s"
        match = re.fullmatch(rf"(?:{number}h)?(?:{number}m)?(?:{number}s)?", text)
        seconds = match and sum(
            float(part) * unit for part, unit in zip(match.groups(), self.UNITS.values()) if part
        )
        if not seconds:
            self.fail(
                f'expected a time such as 90s, 30m or 1h30m, and "{value}" is none.', param, ctx
            )
        return seconds


class Range(click.FloatRange):
    """A number in a range, which not-a-number is not."""

    def convert(self, value, param, ctx):
        number = super().convert(value, param, ctx)
        if number != number:
            self.fail(f'expected a number, and "{value}" is none.', param, ctx)
        return number


class PassRange(click.ParamType):
    """``a:b`` as a pair of whole numbers."""

    name = "a:b"

    def convert(self, value, param, ctx):
        match = re.fullmatch(r"(\d+):(\d+)", value)
        if match and int(match[1]) < int(match[2]):
            return int(match[1]), int(match[2])
        self.fail(f'expected a:b with a < b, such as 0:8, and "{value}" is not.', param, ctx)


class Triple(click.ParamType):
    """``x,y,z`` as three finite numbers, or whole numbers ``i,j,k``."""

    def __init__(self, kind: type = float):
        self.kind = kind
        self.name = "x,y,z" if kind is float else "i,j,k"

    def convert(self, value, param, ctx):
        with contextlib.suppress(ValueError):
            numbers = tuple(map(self.kind, value.split(",")))
            if len(numbers) == 3 and all(map(math.isfinite, numbers)):
                return numbers
        what = "numbers" if self.kind is float else "whole numbers"
        self.fail(f'expected three {what} {self.name}, and "{value}" is not.', param, ctx)


class Target(click.ParamType):
    """A point ``x,y,z``, or else the id of a shape."""

    name = "x,y,z|SHAPE-ID"

    def convert(self, value, param, ctx):
        parts = [part.strip() for part in value.split(",")]
        if len(parts) > 1 and any(parts) and all(not part or _is_number(part) for part in parts):
            return Triple().convert(value, param, ctx)  # meant as a point, if not written as one
        return value


def _is_number(text):
    with contextlib.suppress(ValueError):
        float(text)
        return True
    return False


class Stopped(click.ClickException):
    """A signal ended the command; the status says which."""

    def __init__(self, sentence: str, number: int):
        super().__init__(sentence)
        self.exit_code = 128 + number


class FittingCommand(click.Command):
    """A command whose option ``--fit`` may stand without a value, before an argument, too."""

    def parse_args(self, ctx, args):
        args = [
            "--fit=shapes" if arg == "--fit" and not self._means_a_fit(following) else arg
            for arg, following in zip(args, [*args[1:], ""], strict=False)
        ]
        return super().parse_args(ctx, args)

    @staticmethod
    def _means_a_fit(word):
        # Misspelt, too, so that the complaint names those that there are
        near = "." not in word and nearest(word, FITS)
        return word in FITS or (bool(near) and not os.path.exists(word))


class PassesOption(click.Option):
    """An option that has no meaning where a picture is rendered in one go."""


passes_option = functools.partial(click.option, cls=PassesOption)


@dataclass(frozen=True)
class PictureOptions:
    """How a picture is written: the options that ``render``, ``merge`` and ``fly`` share."""

    exposure: float
    filmic: bool
    denoise: bool
    compression: str

    def output_to(
        self, exr_path: Path | None, png_path: Path | None, layers: tuple[str, ...]
    ) -> Output:
        return Output(
            exr_path, png_path, self.exposure, self.filmic, self.compression, self.denoise, layers
        )


@dataclass(frozen=True)
class SceneOptions(PictureOptions):
    """What is rendered and by whom: the argument and options that ``render`` and ``fly`` share."""

    scene: str
    output: str | None
    layers: str | None
    spp: int | None
    seconds: float | None
    noise: float | None
    seed: int
    scheduler: str | None
    workers: int | None
    mode: str
    define: tuple[tuple[str, str], ...]
    sensor: int
    threads: int | None
    quiet: bool
    verbose: int
    properties: tuple[tuple[str, str], ...]
    fit: str | None
    fog: float | None
    fog_albedo: float | None

    def note(self, sentence: str) -> None:
        """Say something that is no error."""
        if not self.quiet:
            _note(sentence)

    def tell(self, path: Path) -> None:
        """Print the name of a file that is written."""
        if not self.quiet:
            _tell(path)

    @property
    def clustered(self) -> bool:
        return bool(self.scheduler or self.workers)

    def rules(self) -> stills.Rules:
        """When a picture is done; looks, too, whether all is there that the options need."""
        try:
            rules = stills.check_rules(self.spp, self.seconds, self.noise)
        except ValueError as error:
            raise click.UsageError(str(error)) from None
        if self.clustered:
            if self.scheduler and self.workers:
                raise click.UsageError(
                    "--workers starts a cluster here, --scheduler names another."
                )
            from . import cluster  # noqa: F401 - says what it needs before anything is rendered
        if self.denoise:
            _require_denoiser()
        return rules

    def job(self, **more) -> jobs.Job:
        """The job that these options describe, and ``more``."""
        properties = dict(self.properties)
        if self.layers is not None:
            properties["aovs"] = self.layers
        return jobs.Job(
            self.scene,
            self.mode,
            dict(self.define),
            properties,
            self.sensor,
            self.seed,
            denoise=self.denoise,
            fit=self.fit,
            fog=_fog(self.fog, self.fog_albedo),
            **more,
        )

    def open(self, job: jobs.Job) -> tuple[jobs.Opened, dict]:
        """A job's scene, loaded, and what the metadata of its pictures tell of it."""
        _set_variant(self.mode, self.verbose, self.quiet)
        dr.set_thread_count(self.threads or dr.thread_count())
        opened = jobs.open_scene(job, self.note)
        return opened, {
            "scene": self.scene,
            "integrator": str(opened.integrator),
            "commandLine": shlex.join(["nil-mitsuba", *sys.argv[1:]]),
        }


@dataclass(frozen=True)
class RenderOptions(SceneOptions):
    """The options of ``render``, and its argument, as click has checked them."""

    png: str | None
    pass_spp: int | None
    checkpoint: str | None
    resume: bool
    passes: tuple[int, int] | None


@dataclass(frozen=True)
class FlyOptions(SceneOptions):
    """The options of ``fly``, and its argument, as click has checked them."""

    keys: str
    frames: int
    format: str


@dataclass(frozen=True)
class Paths:
    """The files to write; a part of a picture is none yet."""

    exr: Path | None
    png: Path | None
    sums: Path

    @property
    def pictures(self) -> list[Path]:
        return [path for path in (self.exr, self.png) if path]

    def output(self, options: PictureOptions, layers: tuple[str, ...]) -> Output:
        assert self.exr, "a part has only sums"
        return options.output_to(self.exr, self.png, layers)


@click.group()
@click.version_option(__version__, message="%(prog)s %(version)s")
def cli():
    """Render Mitsuba scenes in Nil geometry."""


png_option = click.option("--png", metavar="OUT.png", help="Write an sRGB picture, too.")


def picture_options(command):
    """The options on how a picture is written."""
    for option in reversed(
        (
            click.option(
                "--exposure",
                type=Range(-png.MAX_EXPOSURE, png.MAX_EXPOSURE),
                default=0.0,
                metavar="STOPS",
                help="Brighten the PNG picture by so many stops.",
            ),
            click.option(
                "--filmic",
                is_flag=True,
                help="Let the PNG picture's highlights fade out as film does.",
            ),
            passes_option(
                "--denoise", is_flag=True, help="Remove noise; the noisy picture stays as a layer."
            ),
            click.option(
                "--compression",
                type=click.Choice(list(exr.COMPRESSIONS)),
                default="zip",
                show_default=True,
                help="Of the EXR file; dwaa and dwab are lossy.",
            ),
        )
    ):
        command = option(command)
    return command


def sample_options(command):
    """The options on what is rendered, until when."""
    for option in reversed(
        (
            passes_option(
                "--layers",
                metavar="A,B,…",
                help=f"Layers beside the picture: {', '.join(RENDERED)}.",
            ),
            click.option(
                "--spp",
                type=click.IntRange(1),
                help="Samples per pixel.  [default: the scene's, or with --time or --noise no "
                "limit]",
            ),
            passes_option(
                "--time", "seconds", type=Duration(), help="Stop after such a time as 90s or 1h30m."
            ),
            passes_option(
                "--noise",
                type=Range(0, min_open=True),
                metavar="ERROR",
                help="Stop at this relative error, such as 0.02; pixels that are infinite or not "
                "a number are left out.",
            ),
            click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True),
        )
    ):
        command = option(command)
    return command


def process_options(command):
    """The options on who renders, and what is said meanwhile."""
    for option in reversed(
        (
            passes_option(
                "--scheduler", metavar="tcp://HOST:PORT", help="Let a Dask cluster render."
            ),
            passes_option("--workers", type=click.IntRange(1), help="Render in so many processes."),
            click.option(
                "-t", "--threads", type=click.IntRange(1), help="Threads of each process."
            ),
            click.option("-q", "--quiet", is_flag=True, help="Print errors only."),
            click.option(
                "-v", "--verbose", count=True, help="Be more verbose (repeat for tracebacks)."
            ),
        )
    ):
        command = option(command)
    return command


def scene_options(command):
    """The options on how a scene is read, and which space it is in."""
    for option in reversed(
        (
            click.option(
                "-m", "--mode", metavar="VARIANT", default="llvm_ad_rgb", show_default=True
            ),
            click.option(
                "-D",
                "--define",
                type=Assignment(),
                multiple=True,
                help='Define a constant that the scene refers to as "$key".',
            ),
            click.option(
                "-s",
                "--sensor",
                metavar="INDEX",
                type=click.IntRange(0),
                default=0,
                show_default=True,
                help="Sensor to take, in the scene's order.",
            ),
            click.option(
                "-P",
                "--property",
                "properties",
                metavar="NAME=VALUE",
                type=Assignment(),
                multiple=True,
                help='Set a property of the integrator "nil", such as twist=0 or '
                "cell_origin=-1,-1,-1.",
            ),
            click.option(
                "--fit",
                type=click.Choice(list(FITS)),
                metavar="[camera]",
                help="Fit the cell to the shapes, or to the shapes and the camera; in plain Nil "
                "with its origin halfway between those. Say what it is, and what else to do.",
            ),
            click.option(
                "--fog",
                type=Range(0, MOST),
                metavar="DENSITY",
                help="Fill the space of a scene without media with fog that light crosses for "
                "1/DENSITY cells in the mean, such as 0.15.",
            ),
            click.option(
                "--fog-albedo",
                type=Range(0, 1),
                metavar="ALBEDO",
                help="The part of that light that fog scatters; the rest it absorbs.  "
                f"[default: {ALBEDO:g}]",
            ),
        )
    ):
        command = option(command)
    return command


@cli.command(cls=FittingCommand)
@click.argument("scene", metavar="SCENE.xml")
@click.option(
    "-o", "--output", metavar="OUT.exr", help="Default: beside the scene, named after it."
)
@png_option
@picture_options
@sample_options
@passes_option(
    "--pass-spp",
    type=click.IntRange(1),
    help="Samples per pixel in each pass. This "
    "and --spp, as a file tells them, render its picture again.  [default: by size and "
    "rules]",
)
@passes_option(
    "--checkpoint",
    metavar="FILE" + SUMS,
    help="Keep the samples in this file, when "
    "the picture is done, too.  [default: one beside the picture until it is done]",
)
@passes_option("--resume", is_flag=True, help="Go on from the checkpoint, if there is one.")
@passes_option(
    "--passes",
    type=PassRange(),
    help='Render these passes only, into a file for "nil-mitsuba merge".',
)
@process_options
@scene_options
def render(**options):
    """Render a scene with the integrator "nil", whatever integrator it names.

    The letters are those of Mitsuba's own command. Ctrl-C and SIGTERM finish the pass that is being
    rendered, save the samples and write the picture so far.
    """
    _render(RenderOptions(**options))


@cli.command(cls=FittingCommand)
@click.argument("scene", metavar="SCENE.xml")
@click.option(
    "--at", type=Target(), required=True, help="Where to look: a point, or the middle of a shape."
)
@click.option(
    "--image", type=Triple(int), default="0,0,0", show_default=True, help="In which cell's copy."
)
@click.option("--from", "origin", type=Triple(), help="Where from, if not from the sensor.")
@click.option("--up", type=Triple(), help="What is to be upright, if not what the sensor holds so.")
@scene_options
def aim(scene, at, image, origin, up, mode, define, sensor, properties, fit, fog, fog_albedo):
    """Print the XML of a camera that looks at something, and how far that is.

    It takes the place of the sensor's to_world and focus_distance. Geodesics bend: the look_at of a
    target's coordinates misses it.
    """
    if origin and fit:
        raise click.UsageError(
            "--fit goes by where the scene has the sensor, and --from moves it: fit first, and "
            "give the -P that it prints."
        )
    _scene_path(scene)
    _set_variant(mode)
    job = jobs.Job(
        scene,
        mode,
        dict(define),
        dict(properties),
        sensor,
        fit=fit,
        fog=_fog(fog, fog_albedo),
    )
    opened = jobs.open_scene(job, _note, aiming=True)
    camera = opened.scene.sensors()[sensor]
    if camera.class_name() == "BatchSensor":
        raise click.ClickException(
            f"the sensor {sensor} is a batch of several: aim at a copy of the scene with one."
        )
    before = camera.world_transform()
    target = at
    if isinstance(at, str):
        target = aiming.middle_of(opened.scene, at)
        advice = cut_off(opened.nil, at, target)
        if advice:
            _note(advice)
    up = up or aiming.up_of(before)
    origin = origin or aiming.columns_of(before)[3]
    found = aiming.look_at(opened.nil, origin, target, up, image)
    click.echo(aiming.as_xml(found, up, camera))


@cli.command(cls=FittingCommand)
@click.argument("scene", metavar="SCENE.xml")
@scene_options
@click.option(
    "--port",
    type=click.IntRange(1024, 2**16 - 1),
    help="Of the page.  [default: one that is free]",
)
@click.option("--browser/--no-browser", default=True, help="Open the page.  [default: browser]")
@click.option("-t", "--threads", type=click.IntRange(1), help="Threads that render.")
@click.option("-v", "--verbose", count=True, help="Be more verbose (repeat for tracebacks).")
def view(
    scene, port, browser, threads, verbose, mode, define, sensor, properties, fit, fog, fog_albedo
):
    """Walk through a scene in the browser, and keep the cameras that are worth it.

    The page is for this computer only. It ends with its window, or with Ctrl-C.
    """
    from . import server  # says what it needs before anything is loaded

    _scene_path(scene)
    _set_variant(mode, verbose)
    dr.set_thread_count(threads or dr.thread_count())
    job = jobs.Job(
        scene, mode, dict(define), dict(properties), sensor, fit=fit, fog=_fog(fog, fog_albedo)
    )
    with server.serve(port or 0) as link, stills.interruption() as signals:
        click.echo(link.url)
        opened = browser and webbrowser.open(link.url)
        try:
            finder = _viewfinder(job, link)
        except Exception as error:
            sentence = tidy(str(cause_of(error)) or type(error).__name__)
            if opened:
                # Most errors are found before a browser has got the page
                _note(f"nil-mitsuba: {sentence}")
                link.await_viewer(COMING_SECONDS, lambda: bool(signals))
            link.send({"is": "end", "text": sentence})
            if opened and verbose < 2:  # the sentence has been said
                raise click.exceptions.Exit(1) from error
            raise
        finder.run(ended=lambda: bool(signals))
        link.send({"is": "end", "text": "The command has ended."})


def _viewfinder(job: jobs.Job, link):
    """What ``view`` shows."""
    from .viewfinder import Viewfinder

    notes: list[str] = []

    def note(sentence):
        _note(sentence)
        notes.append(sentence)

    opened = jobs.open_scene(job, note, aiming=True)
    return Viewfinder(opened, notes, link)


@cli.command(cls=FittingCommand)
@click.argument("scene", metavar="SCENE.xml")
@click.option(
    "--keys",
    required=True,
    metavar="CAMERAS.json",
    help="The cameras by which the flight leads.",
)
@click.option("--frames", required=True, type=click.IntRange(1, MOST_FRAMES), help="How many.")
@click.option(
    "-o",
    "--output",
    metavar="FOLDER",
    help="Where to write them, by their numbers.  [default: beside the scene, named after it]",
)
@click.option(
    "--format",
    type=click.Choice(["exr", "png"]),
    default="exr",
    show_default=True,
    help="Of the frames: EXR, or sRGB.",
)
@picture_options
@sample_options
@process_options
@scene_options
def fly(**options):
    """Render the frames of a flight, along geodesics from camera to camera.

    Frames that are there are kept, so that the same command goes on where one has ended. Ctrl-C and
    SIGTERM finish the frame that is being rendered. --spp, --time and --noise are those of a frame.
    """
    _fly(FlyOptions(**options))


@cli.command()
@click.argument("parts", metavar="PARTS...", nargs=-1, required=True)
@click.option(
    "-o",
    "--output",
    metavar="OUT.exr",
    required=True,
    help=f"With the suffix {SUMS}, the parts in one file.",
)
@png_option
@picture_options
def merge(parts, output, png, **picture):
    """Join parts that "nil-mitsuba render --passes" has rendered, to a picture."""
    options = PictureOptions(**picture)
    sums_only = Path(output).suffix == SUMS
    if sums_only and (png or options.denoise):
        raise click.UsageError(f"--png and --denoise go with a picture, not with {SUMS}.")
    exr_path = _output_path(output, SUMS if sums_only else ".exr", "-o")
    png_path = _output_path(png, ".png", "--png") if png else None
    if sums_only and exr_path.exists() and not any(map(exr_path.samefile, parts)):
        raise click.ClickException(
            f'"{exr_path}" holds samples and is none of the parts: remove it, or name another file.'
        )

    _set_variant(checkpoint.peek(parts[0])["variant"])
    state = checkpoint.load(parts[0])
    film = state.settings["film"]
    commands = [state.about.get("commandLine")]
    for part in parts[1:]:
        try:
            further = checkpoint.load(part)
            state = state.plus(further)
        except ValueError as error:
            raise click.ClickException(
                f'cannot merge "{part}" with "{parts[0]}": {error}'
            ) from None
        commands.append(further.about.get("commandLine"))
    missing = stills.missing(state)
    if missing:
        _note(f"the passes {name_passes(missing)} of 0:{state.about['count']} are missing.")
    # All that it took, line by line as in a script
    commands.append(shlex.join(["nil-mitsuba", *sys.argv[1:]]))
    state.about["commandLine"] = "\n".join(dict.fromkeys(filter(None, commands)))
    # As pictures have that parts can be merged to
    if film["pixel_format"] and state.noise is None:
        state.noise = stills.noise(stills.film_of(film), state.sums)
    if sums_only:
        checkpoint.save(exr_path, state)
    else:
        if options.denoise:
            _require_denoiser()
            _require_guides(state.settings)
        out = options.output_to(exr_path, png_path, tuple(state.settings["layers"]))
        out.write(stills.picture_of(state), metadata_of(state))
    _note(_ending(state, options.denoise))
    for path in filter(None, (exr_path, png_path)):
        _tell(path)


@cli.command()
@click.argument("file", metavar="FILE.exr")
def info(file):
    """Print what a picture holds, and how it was rendered."""
    if Path(file).suffix == SUMS:
        click.echo(checkpoint.describe(file))
    else:
        click.echo(exr.describe(file))


def main() -> None:
    """Run the command: one sentence on stderr and a status other than 0 if it cannot be done.

    The status is 2 for a wrong command line, 130 after Ctrl-C, 143 after SIGTERM and 1 otherwise.
    """
    with Watch("interrupted, no picture was written.") as watch:
        sentence, status = _run(watch)
        with contextlib.suppress(KeyboardInterrupt):
            dr.sync_thread()  # a kernel that is left would keep the process, and no one watch it
    if sentence:
        _note(sentence)
    sys.exit(status)


def _run(watch: Watch) -> tuple[str, int]:
    """What is to be said in the end, and the status."""
    try:
        return "", cli.main(prog_name="nil-mitsuba", standalone_mode=False, obj=watch) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        return error.format_message(), error.exit_code
    except click.ClickException as error:
        sentence, status = error.format_message(), error.exit_code
    except (click.Abort, KeyboardInterrupt) as error:
        numbers = (error.__cause__ or error).args  # click's error has what it is made of as cause
        sentence, status = watch.farewell(), 128 + next(iter(numbers), signal.SIGINT)
    except Exception as error:
        cause = cause_of(error)
        if mi.log_level() <= mi.LogLevel.Debug:  # -vv
            raise
        sentence, status = tidy(str(cause) or type(cause).__name__), 1
    return f"nil-mitsuba: {sentence}", status


def tidy(text: str) -> str:
    """One line out of a message of Mitsuba's, without source lines and nested tracebacks."""
    text = re.sub(r"\[(?:\w+\.(?:cpp|h|inl):\d+|PluginManager)\] ", "", text)
    # Frames are indented; the line behind them is the exception's type and sentence.
    text = re.sub(r"Traceback \(most recent call last\):\n(?: .*\n)*(?:[\w.]+: )?", "", text)
    text = re.sub(r"\s*\n\s*(?:- )?", " ", text.strip())
    return re.sub(r"^(?:Error while loading|While loading|At) (?=.+? \(line )", "", text)


# -------------------------------------------------------------------- rendering


def _render(options: RenderOptions) -> None:
    scene = _scene_path(options.scene)
    paths = _paths(scene, options)
    rules = options.rules()
    pass_spp = options.pass_spp or stills.pass_spp_of(paths.sums, options.resume)
    opened, about = options.open(options.job(spp=rules.spp, pass_spp=pass_spp))
    if hasattr(opened.integrator, "view"):
        if options.resume and not paths.sums.exists():
            options.note(f'there is no checkpoint "{paths.sums}": beginning with the first pass.')
        still = _still(opened, rules, options)
        _render_still(still, opened, about, paths, options)
    else:
        _render_in_one_go(opened, about, paths, options)


def _still(opened: jobs.Opened, rules: stills.Rules, options: RenderOptions) -> stills.Still:
    """The still that is to be rendered, checked against what is to become of it."""
    still = opened.still(rules)
    if options.denoise:
        _require_guides(still.settings)
    if options.png and not still.settings["film"]["pixel_format"]:
        raise click.ClickException(_no_colours("--png", still.settings))
    if options.passes:
        stills.film_of(still.settings["film"])  # what "merge" will need
        first, stop = options.passes
        assert still.count is not None, "--passes goes with no other rule than --spp"
        if stop > still.count:
            raise click.ClickException(
                f"there are no passes {first}:{stop}: the picture consists of the passes "
                f"0:{still.count}, with {still.passes.spp} samples per pixel each."
            )
    return still


def _render_still(
    still: stills.Still, opened: jobs.Opened, about: dict, paths: Paths, options: RenderOptions
) -> None:
    """Render in passes, until all are done, a rule is met or a signal comes; write the files."""
    sums_path, count, note = paths.sums, still.count, options.note
    first, stop = options.passes or (0, count)
    state = still.start(sums_path, options.resume)
    if options.passes:
        # Passes that are there already may be others
        wanted = state.sums.count + len(list(still.todo(state, first, stop)))
        still.rules = stills.Rules(spp=wanted * still.passes.spp)
    state.about = about | ({"count": count} if count else {})

    parts = (still.render(index) for index in still.todo(state, first, stop))
    if options.clustered:
        from . import cluster

        job = replace(opened.job, path=os.path.abspath(options.scene), pass_spp=still.passes.spp)
        parts = cluster.render(
            still,
            job,
            still.todo(state, first, stop),
            options.scheduler,
            options.workers or 1,
            options.threads,
            lambda sentence: note(tidy(sentence)),
        )
    saver = stills.Saver(sums_path, _note)  # what it says is an error, though not the end
    watch = click.get_current_context().find_object(Watch)
    assert watch, "as main hands it over"
    watch.farewell = functools.partial(_farewell, sums_path)
    with contextlib.ExitStack() as stack:
        if not (options.clustered or options.quiet):  # a cluster is not waited for
            stack.enter_context(watch.explaining(functools.partial(_finishing, still)))
        stack.enter_context(contextlib.closing(parts))
        display = stack.enter_context(_Display(still, options.quiet))
        state, number = still.accumulate(state, parts, display, saver)
    if not state.sums.count:
        raise Stopped("interrupted before the first pass, nothing was written.", number or 0)

    # Whatever ends the writing of the picture, its samples are there
    with stills.interruption() as signals:
        kept = saver.save(state)
    number = next(iter(signals), number)
    if options.passes:
        written = [sums_path] if kept else []
    else:
        written = paths.pictures
        there = (
            f'The samples are in "{sums_path}": the same command with --resume writes the picture.'
            if kept
            else "The samples could not be saved."
        )
        try:
            with stills.interruption(patience=0) as signals:
                paths.output(options, opened.layers).write(
                    stills.picture_of(state, still.film), metadata_of(state)
                )
        except KeyboardInterrupt:
            raise Stopped(
                f"interrupted before the picture was written. {there}",
                next(iter(signals), signal.SIGINT),
            ) from None
        except Exception as error:
            raise click.ClickException(f"{tidy(str(cause_of(error)))} {there}") from error
    if not number:
        if not (options.checkpoint or options.passes):
            sums_path.unlink(missing_ok=True)  # whoever reads what is told may be gone
        note(_ending(state, options.denoise))
    for path in written:
        options.tell(path)
    if number:
        there = f'the same command with --resume goes on from "{sums_path}"'
        raise Stopped(
            f"interrupted at {_how_far(state, options.denoise)}; "
            f"{there if kept else 'the samples could not be saved'}.",
            number,
        )
    if options.passes and not kept:
        sys.exit(1)  # the saver has said why


def _render_in_one_go(
    opened: jobs.Opened, about: dict, paths: Paths, options: RenderOptions
) -> None:
    """Render with a wrapper of Mitsuba's around "nil", which knows no passes."""
    given = [
        parameter.opts[0]
        for parameter in click.get_current_context().command.params
        if isinstance(parameter, PassesOption) and getattr(options, str(parameter.name))
    ]
    if given:
        raise click.ClickException(
            f'{given[0]} is for the integrator "nil" itself: one around it renders in one go.'
        )
    job, scene = opened.job, opened.scene
    film = scene.sensors()[job.sensor].film()
    start = time.perf_counter()
    image = opened.integrator.render(scene, job.sensor, seed=job.seed, spp=job.spp or 0)
    dr.eval(image)
    dr.sync_thread()
    spp = job.spp or scene.sensors()[job.sensor].sampler().sample_count()
    metadata = about | {
        "sceneHash": job.scene_hash,
        **(job.fog.settings if job.fog else {}),
        "spp": spp,
        "seed": job.seed,
        "sensor": job.sensor,
        "noise": "not estimated: rendered in one go",
        "renderTime": time.perf_counter() - start,
        "variant": mi.variant(),
        "software": software(stills.versions()),
    }
    channels = [field.name for field in film.bitmap().struct_()]
    picture = stills.Picture(channels, image, {}, stills.component_format(film))
    paths.output(options, ()).write(picture, metadata)
    options.note(f"{_samples(spp)}, noise {metadata['noise']}.")
    for path in paths.pictures:
        options.tell(path)


# ----------------------------------------------------------------------- flights


def _fly(options: FlyOptions) -> None:
    scene = _scene_path(options.scene)
    folder = _folder(options.output or scene.with_suffix(""))
    _refuse_of_another_format(options)
    rules = options.rules()
    plan = Plan(tuple(keys.load(options.keys)), options.frames, rules)
    if len(plan.keys) < 2:
        count = "one key" if plan.keys else "no keys"
        raise click.ClickException(
            f'"{options.keys}" has {count}, and a flight leads from one to another: give two or '
            "more."
        )
    opened, about = options.open(options.job(flight=plan))
    try:
        frames = Frames(opened, plan)
    except keys.UnfitError as error:
        raise click.ClickException(f'"{options.keys}", {tidy(str(error))}') from None
    settings = frames.settings
    if options.denoise:
        _require_guides(settings)
    png_only = options.format == "png"
    if png_only and not settings["film"]["pixel_format"]:
        raise click.ClickException(_no_colours("--format png", settings))
    # How it is written is part of what a frame is
    settings |= {"layers": list(opened.layers), "denoise": options.denoise} | (
        {"exposure": options.exposure, "filmic": options.filmic}
        if png_only
        else {"compression": options.compression}
    )

    paths = [
        path_of(folder, index, plan.count, f".{options.format}") for index in range(plan.count)
    ]
    todo = [i for i, path in enumerate(paths) if not is_there(path, settings | {"frame": i})]
    kept = plan.count - len(todo)
    if kept:
        options.note(f"kept {_count(kept)}.")
    if not todo:
        return
    _make(folder)
    flight = frames.flight
    options.note(
        f"{'a loop' if flight.loop else 'a flight'} of {flight.length:.3g} cells"
        + (": behind its last frame comes its first." if flight.loop else ".")
    )
    rendered: Iterator[checkpoint.Checkpoint | None]
    display = _FramesDisplay(frames, kept, options.quiet)
    if options.clustered:
        from . import cluster

        job = replace(
            opened.job, path=os.path.abspath(options.scene), pass_spp=settings["pass_spp"]
        )
        rendered = cluster.render_frames(
            job,
            todo,
            options.scheduler,
            options.workers or 1,
            options.threads,
            lambda sentence: options.note(tidy(sentence)),
        )
    else:
        rendered = (frames.render(index) for index in todo)
    watch = click.get_current_context().find_object(Watch)
    assert watch, "as main hands it over"
    goes_on = "the same command goes on"
    watch.farewell = lambda: f"interrupted at {_count(display.done)} of {plan.count}; {goes_on}."
    noisiest = -1.0, ""
    with contextlib.ExitStack() as stack:
        if not (options.clustered or options.quiet):  # a cluster is not waited for
            stack.enter_context(watch.explaining(display.finishing))
        signals = stack.enter_context(stills.interruption())
        stack.enter_context(contextlib.closing(rendered))
        stack.enter_context(display)
        for state in rendered:
            if state is not None:
                index = state.about["frame"]
                mark = json.dumps(settings | {"frame": index})
                state.about = about | state.about | {"flight": mark}
                exr_path, png_path = (None, paths[index]) if png_only else (paths[index], None)
                out = options.output_to(exr_path, png_path, opened.layers)
                out.write(stills.picture_of(state, frames.film), metadata_of(state))
                display.frame_is_done()
                with display.aside():
                    options.tell(paths[index])
                noisiest = max(noisiest, (state.noise or 0.0, _how_far(state, options.denoise)))
            if signals:
                break
    if display.done == plan.count:
        options.note(f"{_count(len(todo))}; the noisiest: {noisiest[1]}.")
    else:
        raise Stopped(watch.farewell(), signals[0])


def _refuse_of_another_format(options: FlyOptions) -> None:
    """Refuse options that would do nothing."""
    of_exr = {"--layers": options.layers, "--compression": options.compression != "zip"}
    of_png = {"--exposure": options.exposure, "--filmic": options.filmic}
    wrong, right = (of_exr, "exr") if options.format == "png" else (of_png, "png")
    for name, given in wrong.items():
        if given:
            raise click.UsageError(f"{name} goes with --format {right}.")


def _folder(name: str | Path) -> Path:
    """A folder that is there and can be written to, or can be made."""
    folder = Path(name)
    if os.path.lexists(folder):
        if not folder.is_dir():
            raise click.ClickException(f'cannot write to "{folder}": it is not a folder.')
        _require_writable(folder)
    return folder


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise click.ClickException(
            f'cannot make the folder "{folder}": {error.strerror}.'
        ) from None


def _count(frames: int) -> str:
    return f"{frames} frame{'' if frames == 1 else 's'}"


def _finishing(still: stills.Still) -> str:
    left, about = still.passes.left, ""
    if left is not None:
        about = f", in about {left:.0f} s" if left < 120 else f", in about {left / 60:.0f} min"
    return f"finishing the pass that is being rendered{about}; a second signal ends this at once."


def _farewell(sums_path: Path) -> str:
    there = f'; the same command with --resume goes on from "{sums_path}"'
    return f"interrupted, no picture was written{there if sums_path.exists() else ''}."


def _samples(spp: int) -> str:
    return f"{spp} sample{'' if spp == 1 else 's'} per pixel"


def _how_far(state: checkpoint.Checkpoint, denoised: bool) -> str:
    """Samples and noise of a still, in words."""
    count = state.sums.count
    noise = name_noise(state.noise, count)
    if denoised and state.noise is not None:
        noise += " before denoising"
    return f"{_samples(count * state.settings['pass_spp'])}, noise {noise}"


def _ending(state: checkpoint.Checkpoint, denoised: bool) -> str:
    """What is said of a still that is done."""
    spp = state.settings["pass_spp"]
    advice = ""
    whole = state.sums.count == 1 == state.about.get("count", 1)
    if whole and state.noise is None and spp > 1:
        advice = f" (--pass-spp {math.ceil(spp / stills.NOISE_PASSES)} makes more)"
    return f"{_how_far(state, denoised)}{advice}."


class _Bar(abc.ABC):
    """Tells on stderr how far something is: a bar on a terminal; elsewhere, if it has ``lines``, a
    line now and then.

    A thread tells the time, whatever goes on.
    """

    FORM = "{percentage:3.0f}% |{bar}| {desc}"  # tqdm puts a comma before "postfix"
    BAR_SECONDS, LINE_SECONDS = 1.0, 10.0

    def __init__(self, quiet: bool, lines: bool):
        from tqdm import tqdm

        self.quiet = quiet or sys.stderr is None  # closed from the start
        self.bar = tqdm(
            total=1.0,
            bar_format=self.FORM,
            disable=self.quiet or None,  # None: where no terminal is
            leave=False,
            dynamic_ncols=True,
        )
        self.quiet = self.quiet or bool(self.bar.disable and not lines)
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        if not self.quiet:
            self.thread.start()
        return self

    def __exit__(self, *_):
        self.over.set()
        if not self.quiet:
            self.thread.join()
        self.bar.close()

    def _run(self) -> None:
        while not self.over.wait(self.LINE_SECONDS if self.bar.disable else self.BAR_SECONDS):
            self._show()

    def _show(self) -> None:
        part, text = self._state()
        if not text:
            return
        if self.bar.disable:
            _note(text)
            return
        self.bar.n = min(1.0, part)
        with contextlib.suppress(OSError):  # as in _note
            self.bar.set_description_str(text, refresh=True)

    @abc.abstractmethod
    def _state(self) -> tuple[float, str]:
        """The part that is done, and words; none before there is something to say."""

    def _clock(self, seconds: float) -> str:
        # Beyond thirty years no one waits, and the estimate means nothing
        return self.bar.format_interval(seconds) if seconds < 1e9 else "?"


class _Display(_Bar):
    """Tells how far a still is; called with each ``stills.Progress``."""

    def __init__(self, still: stills.Still, quiet: bool):
        super().__init__(quiet, lines=True)
        self.still = still
        self.pixels = float(dr.prod(still.film.crop_size()))
        self.latest: tuple[stills.Progress, float] | None = None  # and when it came

    def __call__(self, progress: stills.Progress) -> None:
        self.latest = progress, time.perf_counter()
        if not self.bar.disable:
            self._show()

    def _state(self) -> tuple[float, str]:
        if self.latest is None:
            return 0.0, ""
        progress, then = self.latest
        since = time.perf_counter() - then
        left = self._left(progress, since)
        seconds = progress.seconds + since
        whole = seconds + left if left is not None else 0
        return seconds / whole if whole else 0.0, self._words(progress, seconds, left)

    def _left(self, progress: stills.Progress, since: float) -> float | None:
        """Seconds that are left, so long after the passes that are done."""
        passes = self.still.passes
        if not progress.samples and 0 < passes.done < passes.samples:  # the first is in work
            part = passes.spp * passes.done / passes.samples
            return replace(progress, samples=part, seconds=progress.seconds + since).left
        left = progress.left
        return None if left is None else max(0.0, left - since)

    def _words(self, progress: stills.Progress, seconds: float, left: float | None) -> str:
        # What matters most comes first: a narrow terminal cuts the rest off
        count = self.still.count
        passes, samples = str(progress.passes), str(progress.samples)
        if count is not None:
            passes, samples = f"{passes}/{count}", f"{samples}/{count * self.still.passes.spp}"
        words = [f"{samples} spp"]
        if progress.noise is not None:
            words.append(f"noise {progress.noise:.2g}")
        if left is not None:
            words.append(f"{self._clock(left)} left")
        words.append(f"{self._clock(seconds)} elapsed")
        words.append("1 pass" if passes == "1" else f"{passes} passes")
        if progress.samples and progress.seconds:
            rate = progress.samples * self.pixels / progress.seconds
            words.append(f"{rate / 1e6:.2f} M/s")
        return ", ".join(words)


class _FramesDisplay(_Bar):
    """Tells how many frames of a flight are done, ``done`` of them from the start."""

    def __init__(self, frames: Frames, done: int, quiet: bool):
        super().__init__(quiet, lines=False)
        self.frames, self.count = frames, frames.plan.count
        self.kept = self.done = done
        self.start = self.start_of_frame = time.perf_counter()

    def frame_is_done(self) -> None:
        self.done += 1
        self.start_of_frame = time.perf_counter()

    def aside(self) -> contextlib.AbstractContextManager:
        """A context in which lines can be printed, without the bar in their way."""
        return self.bar.external_write_mode()

    def finishing(self) -> str:
        """What is said when the frame in work is waited for."""
        left = self.frames.left
        about = "" if left is None else f", in about {left:.0f} s"
        return (
            f"finishing the frame that is being rendered{about}; a second signal ends this at once."
        )

    def _state(self) -> tuple[float, str]:
        now = time.perf_counter()
        left, since, seconds = self.frames.left, now - self.start_of_frame, now - self.start
        done = float(self.done - self.kept)
        if left is not None:
            done += since / max(since + left, 1e-9)
        words = [f"{self.done}/{self.count} frames"]
        if done:
            words.append(f"{self._clock((self.count - self.kept - done) * seconds / done)} left")
        words.append(f"{self._clock(seconds)} elapsed")
        return (self.kept + done) / self.count, ", ".join(words)


# ----------------------------------------------------------------------- output


def _paths(scene: Path, options: RenderOptions) -> Paths:
    if options.passes:
        if options.png or options.denoise or options.checkpoint or options.noise or options.seconds:
            raise click.UsageError(
                "--passes renders a part of --spp samples: it goes with none of --png, "
                "--denoise, --checkpoint, --noise and --time."
            )
        first, stop = options.passes
        part = options.output or scene.with_suffix(f".{first}-{stop}{SUMS}")
        return Paths(None, None, _output_path(part, SUMS, "--passes"))
    exr_path = _output_path(options.output or scene.with_suffix(".exr"), ".exr", "-o")
    return Paths(
        exr_path,
        _output_path(options.png, ".png", "--png") if options.png else None,
        _output_path(options.checkpoint or exr_path.with_suffix(SUMS), SUMS, "--checkpoint"),
    )


def _fog(density: float | None, albedo: float | None) -> Fog | None:
    """The fog of two options, of which the second needs the first."""
    if density is None:
        if albedo is not None:
            raise click.UsageError("--fog-albedo goes with --fog, which says how dense the fog is.")
        return None
    return Fog(density) if albedo is None else Fog(density, albedo)


def _scene_path(name: str) -> Path:
    scene = Path(name)
    if not scene.is_file():
        what = "is not a file" if scene.exists() else "does not exist"
        raise click.ClickException(f'the scene "{scene}" {what}.')
    return scene


def _require_denoiser() -> None:
    if not can_denoise():
        raise click.ClickException(
            "--denoise needs the package mitsuba-oidn: pip install 'nil-mitsuba[denoise]'"
        )


def _require_guides(settings: dict) -> None:
    """Refuse what cannot be denoised."""
    film = settings["film"]
    if film["pixel_format"] not in ("rgb", "rgba"):
        raise click.ClickException('--denoise needs a film with the pixel format "rgb" or "rgba".')
    if not film["filter"].startswith("BoxFilter") or not set(GUIDES) <= set(settings["layers"]):
        raise click.ClickException(
            f'--denoise needs the layers {" and ".join(GUIDES)} and the film\'s filter "box": '
            "render the parts so."
        )


def _no_colours(option: str, settings: dict) -> str:
    return f'{option} needs a film with colours, and "{settings["film"]["type"]}" has none.'


def _output_path(name: str | Path, suffix: str, option: str) -> Path:
    """Path of a file that can be written, whose suffix says what it holds."""
    path = Path(name)
    if not path.suffix:
        path = path.with_suffix(suffix)
    if path.suffix.lower() != suffix:
        raise click.UsageError(f'{option} writes a {suffix} file, and "{path}" is named otherwise.')
    real = Path(os.path.realpath(path))  # what a link points at
    try:
        str(real).encode()
    except UnicodeEncodeError:
        raise click.ClickException(
            f'cannot write "{click.format_filename(path)}": its name is not text in UTF-8.'
        ) from None
    try:
        with contextlib.suppress(FileNotFoundError):
            mode = os.stat(real).st_mode
            if not stat.S_ISREG(mode):
                what = "a folder" if stat.S_ISDIR(mode) else "not an ordinary file"
                raise click.ClickException(f'cannot write "{path}": it is {what}.')
    except OSError as error:  # such as a name that is too long
        raise click.ClickException(f'cannot write "{path}": {error.strerror}.') from None
    _require_writable(real.parent, path.parent)
    return path


def _require_writable(folder: Path, name: Path | None = None) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise click.ClickException(
            f'cannot write to the folder "{name or folder}": {error.strerror}.'
        ) from None


def _tell(path: Path) -> None:
    try:
        click.echo(path)
    except BrokenPipeError:
        raise  # click ends quietly
    except OSError as error:
        raise click.ClickException(
            f'"{path}" is written, but its name cannot be printed: {error.strerror}.'
        ) from None


def _note(sentence: str) -> None:
    with contextlib.suppress(OSError):  # a terminal or a pipe that is gone ends no render
        click.echo(sentence, err=True)


# ---------------------------------------------------------------------- Mitsuba


def _set_variant(variant: str, verbose: int = 0, quiet: bool = False) -> None:
    """Set a variant, if it can run "nil", and what Mitsuba tells besides errors."""
    level = (mi.LogLevel.Warn, mi.LogLevel.Info, mi.LogLevel.Debug, mi.LogLevel.Trace)
    mi.set_log_level(mi.LogLevel.Error if quiet else level[min(verbose, 3)])
    if variant in mi.variants():
        sentence = refusal(variant)
        if sentence:
            raise click.ClickException(sentence)
    mi.set_variant(variant)
