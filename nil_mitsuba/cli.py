"""The command ``nil-mitsuba``."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import sys
import tempfile
import time
from pathlib import Path

import click

from . import __version__

# The options that a scene's own integrator shares with "nil": they survive its replacement.
SHARED_PROPERTIES = ("max_depth", "rr_depth", "hide_emitters")

# Attributes of the integrator that a picture's metadata tell.
RECORDED = (
    "twist", "quotient", "cell_size", "tolerance", "max_distance",
    "max_depth", "rr_depth", "hide_emitters",
)  # fmt: skip

FIT_MARGIN = 1e-3  # of the scene's largest extent: keeps walls clear of the cube's faces


class Assignment(click.ParamType):
    """``key=value`` as a pair of strings."""

    name = "key=value"

    def convert(self, value, param, ctx):
        key, equals, text = value.partition("=")
        if not (key and equals):
            self.fail(f'expected key=value, and "{value}" is not.', param, ctx)
        return key, text


@click.group()
@click.version_option(__version__, message="%(prog)s %(version)s")
def cli():
    """Render Mitsuba scenes in Nil geometry."""


@cli.command()
@click.argument("scene", metavar="SCENE.xml")
@click.option(
    "-o", "--output", metavar="OUT.exr", help="Default: beside the scene, named after it."
)
@click.option("--png", metavar="OUT.png", help="Write an sRGB picture, too.")
@click.option("--spp", type=click.IntRange(1), help="Samples per pixel.  [default: the scene's]")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("-m", "--mode", metavar="VARIANT", default="llvm_ad_rgb", show_default=True)
@click.option(
    "-D", "--define", type=Assignment(), multiple=True,
    help='Define a constant that the scene refers to as "$key".',
)  # fmt: skip
@click.option(
    "-s", "--sensor", metavar="INDEX", type=click.IntRange(0), default=0, show_default=True,
    help="Sensor to render with, in the scene's order.",
)  # fmt: skip
@click.option("-t", "--threads", type=click.IntRange(1), help="Threads to render with.")
@click.option("-v", "--verbose", count=True, help="Be more verbose (repeat for tracebacks).")
@click.option(
    "-P", "--property", "properties", metavar="NAME=VALUE", type=Assignment(), multiple=True,
    help='Set a property of the integrator "nil", such as twist=0 or cell_origin=-1,-1,-1.',
)  # fmt: skip
@click.option("--fit", is_flag=True, help="Fit the cell to the scene's bounding box.")
def render(scene, output, png, spp, seed, mode, define, sensor, threads, verbose, properties, fit):
    """Render a scene with the integrator "nil", whatever integrator it names.

    The letters are those of Mitsuba's own command.
    """
    scene_path = Path(scene)
    if not scene_path.is_file():
        what = "is not a file" if scene_path.exists() else "does not exist"
        raise click.ClickException(f'the scene "{scene}" {what}.')
    exr_path = _output_path(output or scene_path.with_suffix(".exr"), ".exr", "-o")
    png_path = _output_path(png, ".png", "--png") if png else None

    mi, dr = _mitsuba(mode, verbose)
    # Mitsuba 3.9 waits for ever for an EXR texture if there is no worker thread to read it.
    threads = threads or dr.thread_count()
    dr.set_thread_count(max(threads, 2))
    mi.set_file_resolver(_resolver(mi, scene_path.parent))
    files = SceneFiles(mi, str(scene_path), dict(define), dict(properties))

    # Without --fit the integrator's parameters are checked before large meshes are loaded.
    integrator = None if fit else files.integrator()
    mi_scene = files.scene()
    if fit:
        integrator = files.integrator(**_fitted_cell(mi_scene.bbox()))
    if not mi_scene.sensors():
        raise click.ClickException(f'the scene "{scene}" has no sensor.')
    if sensor >= len(mi_scene.sensors()):
        raise click.ClickException(
            f'the scene "{scene}" has no sensor {sensor}: its sensors are numbered from 0 to '
            f"{len(mi_scene.sensors()) - 1}."
        )

    dr.set_thread_count(threads)
    start = time.perf_counter()
    spp = _render(integrator, mi_scene, sensor, seed, spp)
    seconds = time.perf_counter() - start

    film = mi_scene.sensors()[sensor].film()
    with contextlib.ExitStack() as stack:
        # Both files are complete before either takes its place.
        exr_part = stack.enter_context(_replacing(exr_path))
        png_part = stack.enter_context(_replacing(png_path)) if png_path else None
        if png_part:
            _write_png(film, png_part)
        from . import exr

        exr.write_film(exr_part, film, _metadata(mi, scene, integrator, spp, seed, seconds))
    for path in filter(None, (exr_path, png_path)):
        click.echo(path)


def main() -> None:
    """Run the command: one sentence on stderr and a status other than 0 if it cannot be done.

    The status is 2 for a wrong command line, 130 after Ctrl-C and 1 otherwise.
    """
    verbose = 0
    try:
        sys.exit(cli.main(prog_name="nil-mitsuba", standalone_mode=False))
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        sys.exit(error.exit_code)
    except click.ClickException as error:
        sentence, status = error.format_message(), error.exit_code
    except (click.Abort, KeyboardInterrupt):
        sentence, status = "interrupted, nothing was written.", 130
    except Exception as error:
        verbose = sum(arg.count("v") for arg in sys.argv if re.fullmatch("-v+", arg))
        if verbose > 1:
            raise
        sentence, status = tidy(str(error) or type(error).__name__), 1
    click.echo(f"nil-mitsuba: {sentence}", err=True)
    sys.exit(status)


def tidy(text: str) -> str:
    """One line out of a message of Mitsuba's, without source lines and nested tracebacks."""
    text = re.sub(r"\[(?:\w+\.(?:cpp|h|inl):\d+|PluginManager)\] ", "", text)
    # Frames are indented; the line behind them is the exception's type and sentence.
    text = re.sub(r"Traceback \(most recent call last\):\n(?: .*\n)*(?:[\w.]+: )?", "", text)
    text = re.sub(r"\s*\n\s*(?:- )?", " ", text.strip())
    return re.sub(r"^(?:Error while loading|While loading|At) (?=.+? \(line )", "", text)


# ------------------------------------------------------------------------ scene


class SceneFiles:
    """A scene description that has been read, with "nil" in the place of another integrator."""

    def __init__(self, mi, path: str, parameters: dict[str, str], properties: dict[str, str]):
        self.mi = mi
        self.config = mi.parser.ParserConfig(mi.variant())
        for name in ("config", "filename"):
            if name in parameters:  # the names of the parser's own arguments
                raise click.ClickException(f'-D cannot define "{name}": rename the parameter.')
        state = mi.parser.parse_file(self.config, path, **parameters)
        if state.root.type != mi.ObjectType.Scene:
            raise click.ClickException(f'the root element of "{path}" must be a <scene> tag.')
        mi.parser.transform_upgrade(self.config, state)
        mi.parser.transform_resolve(self.config, state)

        # Two scenes: one without the integrator, one with nothing else.
        self.rest, self.alone = state, mi.parser.ParserState(state)
        reference = self._take_integrator(path)
        self.alone.root.props = mi.Properties("scene")
        self.alone.root.props["integrator"] = reference
        self._nil = self._find_nil(reference.index()) or self._replace(reference.index(), path)
        for name, text in properties.items():
            self._nil.props[name] = parse_value(mi, text)

    def integrator(self, **properties):
        """The integrator by itself, with further properties of "nil" set."""
        for name, value in properties.items():
            self._nil.props[name] = value
        return self.mi.parser.instantiate(self.config, self.alone).integrator()

    def scene(self):
        """The scene without its integrator."""
        self.mi.parser.transform_merge_equivalent(self.config, self.rest)
        self.mi.parser.transform_merge_meshes(self.config, self.rest)
        return self.mi.parser.instantiate(self.config, self.rest)

    def _take_integrator(self, path: str):
        """Take the integrator out of the scene; a reference to its node among `alone`'s."""
        mi, nodes, root = self.mi, self.alone.nodes, self.rest.root.props
        own = [
            key
            for key, index in self._children(root)
            if nodes[index].type == mi.ObjectType.Integrator
        ]
        if len(own) > 1:
            raise click.ClickException(f'"{path}": only one integrator can be specified per scene.')
        if own:
            reference = root[own[0]]
            del root[own[0]]
            return reference

        click.echo(f'{path} has no integrator: rendering with "nil".', err=True)
        node = mi.parser.SceneNode()
        node.type = mi.ObjectType.Integrator
        node.props = mi.Properties("nil")
        nodes.append(node)
        return mi.Properties.ResolvedReference(len(nodes) - 1)

    def _find_nil(self, index: int):
        """The node of "nil" at or below an integrator's node: wrappers hold others."""
        node = self.alone.nodes[index]
        if node.props.plugin_name() == "nil":
            return node
        for _, child in self._children(node.props):
            found = self._find_nil(child)
            if found is not None:
                return found
        return None

    def _replace(self, index: int, path: str):
        node, props = self.alone.nodes[index], self.mi.Properties("nil")
        for name in SHARED_PROPERTIES:
            if name in node.props:
                props[name] = node.props[name]
        name = node.props.plugin_name()
        click.echo(f'{path}: the integrator "{name}" is replaced by "nil".', err=True)
        node.props = props
        return node

    def _children(self, props) -> list[tuple[str, int]]:
        """Names and node numbers of the objects below a node."""
        values = ((key, props[key]) for key in props.keys())
        return [
            (key, value.index())
            for key, value in values
            if isinstance(value, self.mi.Properties.ResolvedReference)
        ]


def parse_value(mi, text: str):
    """The value of a property from the command line: boolean, number, vector "x,y,z" or string."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(text)
    with contextlib.suppress(ValueError):
        x, y, z = map(float, text.split(","))
        return mi.ScalarVector3d(x, y, z)
    return text


def _fitted_cell(bbox) -> dict:
    if not bbox.valid() or max(bbox.extents()) == 0:
        raise click.ClickException("--fit needs a scene with shapes of some extent.")
    size = max(bbox.extents()) * (1 + FIT_MARGIN)
    origin = bbox.center() - size / 2
    corner = ",".join(f"{c:.9g}" for c in origin)  # 9 digits give a float32 back
    click.echo(f"--fit: cell_origin={corner} cell_size={size:.9g}", err=True)
    return {"cell_origin": origin, "cell_size": size}


# -------------------------------------------------------------------- rendering


def _mitsuba(variant: str, verbose: int):
    """Mitsuba, with `variant` set if that can run "nil", and Dr.Jit."""
    import drjit as dr
    import mitsuba as mi

    from .registration import refusal

    mi.set_log_level(
        (mi.LogLevel.Warn, mi.LogLevel.Info, mi.LogLevel.Debug, mi.LogLevel.Trace)[min(verbose, 3)]
    )
    if variant in mi.variants():
        sentence = refusal(variant)
        if sentence:
            raise click.ClickException(sentence)
    mi.set_variant(variant)
    return mi, dr


def _resolver(mi, folder: Path):
    resolver = mi.FileResolver(mi.file_resolver())
    resolver.prepend(str(folder))
    return resolver


def _render(integrator, scene, sensor: int, seed: int, spp: int | None) -> int:
    """Fill the sensor's film, with a progress bar if stderr is a terminal; samples per pixel."""
    if not hasattr(integrator, "view"):  # a wrapper of Mitsuba's renders in one go
        integrator.render(scene, sensor, seed=seed, spp=spp or 0, develop=False)
        return spp or scene.sensors()[sensor].sampler().sample_count()

    from tqdm import tqdm

    from .passes import Passes

    passes = Passes(integrator, scene, sensor, seed, spp or 0)
    form = "{percentage:3.0f}% |{bar}| {n_fmt}/{total_fmt} samples per pixel, {remaining} left"
    with tqdm(total=passes.count * passes.spp, bar_format=form, disable=None) as progress:
        sums = passes.render(0)
        progress.update(passes.spp)
        for index in range(1, passes.count):
            sums = sums.plus(passes.render(index))
            progress.update(passes.spp)
    passes.develop(sums)
    return passes.count * passes.spp


# ----------------------------------------------------------------------- output


def _output_path(name: str | Path, suffix: str, option: str) -> Path:
    """Path of a file to write, whose folder is writable and whose suffix says what it holds."""
    path = Path(name)
    if not path.suffix:
        path = path.with_suffix(suffix)
    if path.suffix.lower() != suffix:
        raise click.UsageError(f'{option} writes a {suffix} file, and "{path}" is named otherwise.')
    if path.is_dir():
        raise click.ClickException(f'cannot write "{path}": it is a folder.')
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise click.ClickException(
            f'cannot write to the folder "{path.parent}": {error.strerror}.'
        ) from None
    return path


@contextlib.contextmanager
def _replacing(path: Path):
    """A file to write in the same folder, which takes the place of `path` if all goes well."""
    part = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield str(part)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _write_png(film, path: str) -> None:
    import mitsuba as mi

    pixel = mi.Bitmap.PixelFormat
    bitmap = film.bitmap()
    if bitmap.pixel_format() == pixel.MultiChannel:
        bitmap = dict(bitmap.split())["<root>"]
    formats = {pixel.XYZ: pixel.RGB, pixel.XYZA: pixel.RGBA}
    bitmap.convert(
        formats.get(bitmap.pixel_format(), bitmap.pixel_format()), mi.Struct.Type.UInt8, True
    ).write(path)


def _metadata(mi, scene: str, integrator, spp: int, seed: int, seconds: float) -> dict:
    import drjit as dr

    metadata = {
        "scene": scene,
        "spp": spp,
        "seed": seed,
        "integrator": str(integrator),
        "renderTime": float(seconds),
        "variant": mi.variant(),
        "software": f"nil_mitsuba {__version__}, Mitsuba {mi.__version__}, Dr.Jit {dr.__version__}",
        "commandLine": shlex.join(["nil-mitsuba", *sys.argv[1:]]),
    }
    for name in RECORDED:
        if hasattr(integrator, name):  # a wrapper of Mitsuba's does not pass them on
            value = getattr(integrator, name)
            metadata[name] = str(value).lower() if isinstance(value, bool) else value
    if hasattr(integrator, "cell_origin"):
        metadata["cell_origin"] = "{:.9g},{:.9g},{:.9g}".format(*integrator.cell_origin)
    return metadata
