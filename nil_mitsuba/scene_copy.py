"""A scene file's text with another camera in the place of one of its sensors."""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias
from xml.parsers import expat

import mitsuba as mi

from .aiming import columns_of, placing, scale_of, up_of
from .files import replacing
from .scene_files import SceneFiles, children, number_text

# Entries of a transform, in units of its scale, are the same up to so much: some 16 roundings
SAME = 2e-6
# What places a sensor: Mitsuba's own meters may have a direction instead of a transform
PLACES = ("to_world", "origin", "direction")
VIEWS = ("fov", "fov_axis", "focal_length")
OFFSETS = ("principal_point_offset_x", "principal_point_offset_y")
# Sensors that take them
FOV = ("perspective", "thinlens", "stereo_perspective")
FOCUS = ("perspective", "thinlens", "orthographic")
# A tag, in whose attributes a ">" may stand; an attribute in it, and its value with the quotes
TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")
ATTRIBUTE = re.compile(rb"""\s([^\s=]+)\s*=\s*("[^"]*"|'[^']*')""")
LATIN = re.compile(rb"""<\?xml\s[^>]*?encoding\s*=\s*["'](?:iso-8859-1|latin1)["']""", re.I)

# Names of properties, and the lines that take the place of all of these
Group: TypeAlias = tuple[Sequence[str], list[str]]


@dataclass(frozen=True)
class Lens:
    """A camera's lens; what is None stays as the file has it.

    ``x_fov``: the horizontal field of view (degrees). ``focus_distance``, ``aperture_radius``:
    scene units; a radius makes a "perspective" camera a "thinlens", and 0 makes that one again.
    """

    x_fov: float | None = None
    focus_distance: float | None = None
    aperture_radius: float | None = None


class SceneText:
    """The text of a scene file, as it was when it was read.

    ``path`` is that of the file, and ``defines`` are the constants that the scene refers to. Raises
    OSError if it cannot be read, and ValueError or RuntimeError with a sentence if it is no scene.

    Sensors have the numbers of ``scene.sensors()``. Their methods raise ValueError with a sentence
    for a sensor that the file does not hold, or that cannot be such a camera.
    """

    def __init__(self, path: str | os.PathLike, defines: dict[str, str] | None = None):
        self.path = Path(path)
        raw = self.path.read_bytes()
        self._codec = _codec_of(raw)
        # In UTF-8, as Mitsuba counts; bytes that are none are kept
        self._text = _utf8(raw.decode(self._codec, "surrogateescape"))
        self._defines = defines or {}
        self._state = SceneFiles(str(path), self._defines, {}).rest

    def camera(self, sensor: int, to_world: mi.ScalarTransform4f, **lens: float | None) -> str:
        """The element of a sensor with another ``to_world`` and :class:`Lens`, to be pasted."""
        start, _, element = self._edited(sensor, to_world, Lens(**lens))
        margin = _margin(self._text, start)
        lines = element.replace(b"\r\n", b"\n").split(b"\n")
        return b"\n".join(line.removeprefix(margin) for line in lines).decode("utf-8", "replace")

    def with_camera(self, sensor: int, to_world: mi.ScalarTransform4f, **lens: float | None) -> str:
        """The text of the file with another ``to_world`` and :class:`Lens` of a sensor."""
        return self._with(sensor, to_world, Lens(**lens)).decode("utf-8", "replace")

    def save(self, sensor: int, to_world: mi.ScalarTransform4f, **lens: float | None) -> Path:
        """Write such a text beside the file, under a name that is not taken, and return its path.

        Names are scene-view.xml, scene-view-2.xml, ... Raises OSError with a sentence if the file
        cannot be written.
        """
        text = self._with(sensor, to_world, Lens(**lens)).decode("utf-8", "surrogateescape")
        path = claim(self.path, "-view", self.path.suffix)
        try:
            with replacing(path) as part:
                Path(part).write_bytes(text.encode(self._codec, "surrogateescape"))
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        return path

    def defines(
        self, sensor: int, to_world: mi.ScalarTransform4f, **lens: float | None
    ) -> dict[str, str]:
        """The constants that such a text still refers to: Mitsuba takes no others."""
        included = [Path(str(name)).read_bytes() for name in list(self._state.files)[1:]]
        text = b"\n".join([self._with(sensor, to_world, Lens(**lens)), *included])
        text = re.sub(b"<!--.*?-->", b"", text, flags=re.S)
        found = {}
        for name in sorted(self._defines, key=len, reverse=True):  # $x may begin as $xy does
            key = b"$" + _utf8(name)
            if key in text:
                found[name] = self._defines[name]
            text = text.replace(key, b"")
        return {name: found[name] for name in self._defines if name in found}

    def _with(self, sensor, to_world, lens):
        start, end, element = self._edited(sensor, to_world, lens)
        return self._text[:start] + element + self._text[end:]

    def _edited(self, sensor, to_world, lens):
        """Where a sensor's element begins and ends, and what takes its place."""
        node, name = self._node(sensor), self._name(sensor)
        kind, lines = _lens(node.props, lens, name)
        groups = [(PLACES, _transform(to_world)), *lines]
        element = _parse(self._text, node.offset - 1, name)
        edits = _edits(self._text, element, groups)
        if kind != node.props.plugin_name():
            edits.append((*element.kind, kind.encode()))
        return element.start, element.end, _replaced(self._text, element, edits)

    def _name(self, sensor):
        return f'the sensor {sensor} of "{self.path}"'

    def _node(self, sensor):
        """What Mitsuba's parser knows of a sensor that is written in the file itself."""
        nodes, kind = self._state.nodes, mi.ObjectType
        # The order of Mitsuba's scene; where a shape holds a sensor, None
        found = []
        for _, index in children(self._state.root.props):
            if nodes[index].type == kind.Sensor:
                found.append(nodes[index])
            elif nodes[index].type == kind.Shape:
                within = [nodes[child].type for _, child in children(nodes[index].props)]
                found += [None] * within.count(kind.Sensor)
        if not found:
            raise ValueError(f'the scene "{self.path}" has no sensor.')
        if not 0 <= sensor < len(found):
            raise ValueError(
                f'the scene "{self.path}" has no sensor {sensor}: its sensors are numbered from 0 '
                f"to {len(found) - 1}."
            )
        if any(there is None for there in found[: sensor + 1]):
            raise ValueError(
                f"{self._name(sensor)} is on a shape or behind one with a sensor, where numbers "
                "change as meshes are merged: write the cameras before the shapes."
            )
        node = found[sensor]
        if node.file_index:
            raise ValueError(
                f'{self._name(sensor)} is written in "{self._state.files[node.file_index]}", which '
                f'it includes: move the <sensor> into "{self.path.name}".'
            )
        if node.props.plugin_name() == "batch":
            raise ValueError(f"{self._name(sensor)} is a batch of several: take one of its own.")
        return node


class _Child(NamedTuple):
    """An element in a sensor: its property's name in Mitsuba 3, and its extent (bytes)."""

    name: str
    start: int
    end: int


class _Element(NamedTuple):
    """A sensor's element in a text: the extents (bytes) of its parts."""

    start: int
    head: int  # the end of its first tag
    end: int
    kind: tuple[int, int]  # the value of its "type", without quotes
    children: list[_Child]


def _codec_of(raw: bytes) -> str:
    """The encoding that Mitsuba's parser takes a file to be in, by its first bytes."""
    for mark, codec in ((codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be")):
        if raw.startswith(mark):
            return codec
    return "latin-1" if LATIN.match(raw) else "utf-8"


def _utf8(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")


def _lens(props: mi.Properties, lens: Lens, name: str) -> tuple[str, list[Group]]:
    """The type of a sensor with a lens, and the lines for it; ``name`` is what errors call it."""
    kind = props.plugin_name()

    def only(kinds, what):
        if kind not in kinds:
            raise ValueError(f'{name} is of the type "{kind}", which has no {what}.')

    groups: list[Group] = []
    if lens.x_fov is not None:
        only(FOV, "fov")
        lines = [_float("fov", lens.x_fov), '<string name="fov_axis" value="x"/>']
        groups.append((VIEWS, lines))
    if lens.focus_distance is not None:
        only(FOCUS, "focus_distance")
        groups.append((("focus_distance",), [_float("focus_distance", lens.focus_distance)]))
    if lens.aperture_radius is None:
        return kind, groups

    if lens.aperture_radius == 0:
        if kind != "thinlens":
            return kind, groups
        groups.append((("aperture_radius",), []))
        return "perspective", groups
    only(("perspective", "thinlens"), "aperture_radius")
    groups.append((("aperture_radius",), [_float("aperture_radius", lens.aperture_radius)]))
    if any(props.get(offset, 0) for offset in OFFSETS):
        raise ValueError(
            f"{name} has a {OFFSETS[0][:-2]}, which no thinlens has: remove it, or close the "
            "aperture."
        )
    groups.append((OFFSETS, []))  # exporters write zeros
    return "thinlens", groups


def _float(name, value):
    return f'<float name="{name}" value="{number_text(value)}"/>'


def _transform(to_world: mi.ScalarTransform4f) -> list[str]:
    """A camera's transform, line by line: as one would write it, or else as a matrix.

    A tab stands for a step to the right.
    """
    to_world = mi.Transform4f(to_world)
    *axes, origin = columns_of(to_world)
    scale = scale_of(to_world)
    view = [c / scale[2] for c in axes[2]]
    T = mi.ScalarTransform4f
    for up in (up_of(to_world), [c / scale[1] for c in axes[1]]):
        lines = placing(view, up, origin, scale)
        found = T().look_at([0, 0, 0], view, up)
        if len(lines) > 2:
            found = found @ T().scale(scale)
        if _same(axes, columns_of(mi.Transform4f(found))):
            break
    else:  # sheared, or rounded to few digits
        numbers = [to_world.matrix[i, j][0] for i in range(4) for j in range(4)]
        lines = [f'<matrix value="{" ".join(map(number_text, numbers))}"/>']
    return ['<transform name="to_world">', *(f"\t{line}" for line in lines), "</transform>"]


def _same(axes: Sequence[Sequence[float]], others: Sequence[Sequence[float]]) -> bool:
    return all(
        abs(a - b) <= SAME * max(map(abs, axis))
        for axis, other in zip(axes, others)
        for a, b in zip(axis, other)
    )


def _parse(text: bytes, start: int, name: str) -> _Element:
    """The sensor that begins somewhere in a text; ``name`` is what errors call it."""
    if not text.startswith(b"<sensor", start):
        raise ValueError(f"{name} is not where Mitsuba found it: save the file in UTF-8.")
    found: list[_Child] = []
    opened: list[tuple[str, int]] = []
    end = None
    parser = expat.ParserCreate("utf-8")

    def begin(_, attributes):
        opened.append((_current(attributes.get("name", "")), start + parser.CurrentByteIndex))

    def close(_):
        nonlocal end
        child, first = opened.pop()
        last = _tag(text, first).end()
        if not _closes_itself(text, first):
            last = _tag(text, start + parser.CurrentByteIndex).end()
        if len(opened) == 1:
            found.append(_Child(child, first, last))
        elif not opened:
            end = last

    parser.StartElementHandler, parser.EndElementHandler = begin, close
    try:
        parser.Parse(text[start:], True)
    except expat.ExpatError as error:
        if end is None:  # what follows the sensor is no part of it
            line = text.count(b"\n", 0, start) + error.lineno
            what = expat.ErrorString(error.code)
            raise ValueError(f"{name} is not well-formed XML: {what} in line {line}.") from None
    assert end is not None
    head = _tag(text, start).end()
    kind = next(m for m in ATTRIBUTE.finditer(text, start, head) if m[1] == b"type")
    return _Element(start, head, end, (kind.start(2) + 1, kind.end(2) - 1), found)


def _current(name: str) -> str:
    """The name in Mitsuba 3 of a property, which older versions wrote as toWorld."""
    return re.sub("(?<=[a-z])[A-Z]+", lambda capitals: f"_{capitals[0].lower()}", name)


def _tag(text, start):
    found = TAG.match(text, start)
    assert found is not None  # since it has been parsed
    return found


def _closes_itself(text, start):
    return _tag(text, start)[0].endswith(b"/>")


def _edits(text: bytes, element: _Element, groups: list[Group]) -> list[tuple[int, int, bytes]]:
    """Extents (bytes) in a sensor's element, and what takes their place."""
    base = _margin(text, element.start)
    margins = [_margin(text, child.start) for child in element.children if _leads(text, child)]
    unit = b"\t" if base.startswith(b"\t") else b"    "
    margin = next((m for m in margins if m.startswith(base) and m != base), base + unit)
    unit = margin.removeprefix(base)
    line = text[element.start :].partition(b"\n")[0]
    newline = b"\r\n" if line.endswith(b"\r") else b"\n"

    def block(lines, indent=margin):
        return (newline + indent).join(line.encode().replace(b"\t", unit) for line in lines)

    def instead(child, lines):
        indent = _margin(text, child.start) if _leads(text, child) else margin
        return child.start, child.end, block(lines, indent)

    put: list[tuple[_Child, list[str]]] = []
    new: list[str] = []
    gone: list[_Child] = []
    for names, lines in groups:
        there = [child for child in element.children if child.name in names]
        if there and lines:
            first, *there = there
            put.append((first, lines))
        else:
            new += lines
        gone += there
    edits = [(*_extent(text, child), b"") for child in gone]
    if put:
        (first, lines), *put = put
        put.append((first, [*lines, *new]))
        return edits + [instead(child, lines) for child, lines in put]

    added = newline + margin + block(new)
    head = element.head
    if _closes_itself(text, element.start):
        bare = len(text[: head - 2].rstrip())
        return [*edits, (bare, head, b">" + added + newline + base + b"</sensor>")]
    rest = text[head:].lstrip(b" \t")
    if not rest.startswith((b"\n", b"\r\n")):
        added += newline + (base if rest.startswith(b"</sensor") else margin)
    return [*edits, (head, head, added)]


def _margin(text: bytes, start: int) -> bytes:
    """The blanks with which the line of a byte begins."""
    line = text[text.rfind(b"\n", 0, start) + 1 : start]
    return line[: len(line) - len(line.lstrip(b" \t"))]


def _leads(text: bytes, child: _Child) -> bool:
    """Whether an element begins the line that it is in."""
    line = text[text.rfind(b"\n", 0, child.start) + 1 : child.start]
    return not line.strip(b" \t")


def _extent(text: bytes, child: _Child) -> tuple[int, int]:
    """What goes with an element: its line, if that holds nothing else, or the blanks before it."""
    before, after = text[: child.start].rstrip(b" \t"), text[child.end :].lstrip(b" \t")
    if not _leads(text, child):
        return len(before), child.end
    if not after.startswith((b"\n", b"\r\n")):
        return child.start, child.end
    return len(before.removesuffix(b"\n").removesuffix(b"\r")), len(text) - len(after)


def _replaced(text: bytes, element: _Element, edits: list[tuple[int, int, bytes]]) -> bytes:
    """A sensor's element after edits."""
    parts, at = [], element.start
    for start, end, new in sorted(edits):
        parts += [text[at:start], new]
        at = end
    return b"".join([*parts, text[at : element.end]])


def claim(scene: Path, ending: str, suffix: str) -> Path:
    """An empty file beside a scene, of a name that nothing had: "scene" and the ending, numbered
    from the second on. Raises OSError with a sentence."""
    number = 1
    while True:
        path = scene.with_name(f"{scene.stem}{ending}{f'-{number}' if number > 1 else ''}{suffix}")
        try:
            path.open("xb").close()
        except FileExistsError:
            number += 1
        except OSError as error:
            raise OSError(f'cannot write "{path}": {error.strerror}.') from error
        else:
            return path
