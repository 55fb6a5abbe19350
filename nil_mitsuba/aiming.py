"""Pointing a camera: where it has to look first, so that its central geodesic meets a target."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from textwrap import shorten
from typing import NamedTuple

import drjit as dr
import drjit.scalar as ds
import mitsuba as mi

from . import geometry
from .parameters import nearest
from .scene_files import number_text

# Sine of the angle between view and up below which rounding would turn a picture by a milliradian,
# a pixel in a thousand.
PARALLEL = 1e-4
# An axis counts as upright if the camera's sides are so nearly level to it (radians): transforms
# are often written with four digits.
LEVEL = 1e-3
FAR = 1e15  # scene units, as of shapes


class Aim(NamedTuple):
    """Where a camera looks: its ``to_world``, and the way to the target (scene units)."""

    to_world: mi.ScalarTransform4f
    focus_distance: float


def look_at(
    integrator_or_scene: mi.Integrator | mi.Scene,
    origin: Sequence[float],
    target: Sequence[float],
    up: Sequence[float] | None = None,
    image: Sequence[int] = (0, 0, 0),
) -> Aim:
    """The transform of a camera whose central geodesic meets a target, and how far that is.

    ``integrator_or_scene``: an integrator "nil", one that holds it ("moment", "aov"), or a scene
    that has such a one; it says how space bends.
    ``origin``, ``target``: points in scene coordinates. ``up``: the direction that is to be upright
    in the picture, along the fibres if None. ``image``: in the quotient, the cell in which the
    target's image is meant, a deck element in the order of the layer "cell"; (0, 0, 0) is the
    target itself.

    Returns ``to_world`` (for any sensor) and ``focus_distance``, the length of the shortest
    geodesic in scene units (for the sensor "thinlens"). The rotation is read, as Mitsuba's own
    `look_at` is at twist 0, along the axes of the scene: they stand for the left-invariant frame at
    the camera, in which ``up`` is given, too. Raises ValueError if the target is at the camera or
    beyond ``max_distance``, if ``up`` is parallel to the view, or if there are no images.
    """
    nil = _nil_of(integrator_or_scene)
    origin, target = _triple("origin", origin), _triple("target", target)
    image = _cell(image)
    if any(image) and not nil.quotient:
        raise ValueError(
            f"plain Nil has no images in other cells: image = {image} goes with the quotient only."
        )

    space = nil.space()
    twist = space.twist_number
    p = _exact(space.to_cells(mi.Point3f(origin)))
    q = _exact(space.to_cells(mi.Point3f(target)))
    deck = ds.Array3f64([i * edge for i, edge in zip(image, space.EDGES)])
    way = geometry.connect(p, geometry.multiply(deck, q, twist), twist)
    # Closer than a few roundings of their coordinates, points tell no direction
    if way.distance < 2**-21 * max(*map(abs, p), *map(abs, q)):
        raise ValueError(f"the target is where the camera is, at {_text(origin)}.")
    if not way.distance <= nil.max_distance:  # nor if it is no number
        what = f"the target's image in the cell {image}" if any(image) else "the target"
        raise ValueError(
            f"{what} is {way.distance:.4g} cells away, and rays end at max_distance = "
            f"{nil.max_distance:g}: raise it, or aim at something nearer."
        )
    view = mi.ScalarVector3f(*space.to_scene_axes(way.direction))
    fibres = tuple(space.to_scene_axes(ds.Array3f64(0, 0, 1)))
    up = _upright(view, fibres if up is None else _triple("up", up))
    T = mi.ScalarTransform4f
    return Aim(
        T().translate(origin) @ T().look_at([0, 0, 0], view, up),
        way.distance * space.size_number,
    )


def up_of(to_world: mi.Transform4f) -> tuple[float, ...]:
    """What a camera holds upright (scene axes): an axis if its sides are level, or its own up."""
    left, up, _, _ = columns_of(to_world)
    upright = [i for i in range(3) if abs(left[i]) < LEVEL * math.hypot(*left)]
    if not upright:
        return tuple(up)
    axis = max(upright, key=lambda i: abs(up[i]))
    return tuple(math.copysign(1, up[i]) if i == axis else 0.0 for i in range(3))


def columns_of(to_world: mi.Transform4f) -> list[list[float]]:
    """A camera's sides (to the left in Mitsuba), up and view, and its place, in scene axes."""
    matrix = to_world.matrix
    return [[matrix[i, j][0] for i in range(3)] for j in range(4)]


def middle_of(scene: mi.Scene, name: str) -> tuple[float, ...]:
    """The middle of the bounding box of the shape with an id; a scene whose meshes are merged has
    lost theirs. Raises ValueError, with the ids there are, if it is none of them."""
    from .shapes import extent_of  # needs a variant

    named = {shape.id(): shape for shape in scene.shapes() if shape.id()}
    if name not in named:
        _refuse_parts_of_groups(scene, name)
        near = nearest(name, named)
        there = f"there are {shorten(', '.join(named), 1000, placeholder=' ...')}"
        raise ValueError(
            f'no shape has the id "{name}": '
            + (f'did you mean "{near}"? ' if near else "")
            + (f"{there}." if named else "none has one, so give a point.")
        )
    box = extent_of(named[name]).box
    if not box.valid():
        raise ValueError(f'the shape "{name}" has no extent to aim at.')
    return tuple(box.center())


def _refuse_parts_of_groups(scene, name):
    nodes = mi.traverse(scene).hierarchy
    if not any(isinstance(node, mi.Shape) and node.id() == name for node in nodes):
        return
    instances = [s.id() for s in scene.shapes() if s.class_name() == "Instance" and s.id()]
    such = shorten(", ".join(instances), 300, placeholder=" ...")
    raise ValueError(
        f'"{name}" belongs to a shapegroup, which is nowhere by itself: name an instance of it'
        + (f", such as {such}." if instances else ", which needs an id, or give a point.")
    )


def as_xml(aim: Aim, up: Sequence[float], sensor: mi.Sensor) -> str:
    """An aim as elements of a scene file, for the place of those that a sensor has now.

    A mirrored camera stays so, and an orthographic one, whose scale is its film's size.
    """
    *_, view, origin = columns_of(mi.Transform4f(aim.to_world))
    lines = placing(view, up, origin, scale_of(sensor.world_transform()))
    text = "\n    ".join(('<transform name="to_world">', *lines)) + "\n</transform>"
    if isinstance(sensor, mi.ProjectiveCamera):  # other sensors refuse a focus
        text += f'\n<float name="focus_distance" value="{number_text(aim.focus_distance)}"/>'
    return text


def scale_of(to_world: mi.Transform4f) -> list[float]:
    """By what a camera's axes are scaled; the first is negative if it is mirrored."""
    left, above, forward, _ = columns_of(to_world)
    scale = [math.hypot(*column) for column in (left, above, forward)]
    if _dot(_cross(left, above), forward) < 0:
        scale[0] = -scale[0]
    return scale


def placing(
    view: Sequence[float], up: Sequence[float], origin: Sequence[float], scale: Sequence[float]
) -> list[str]:
    """What stands in a scene file's <transform> of a camera, line by line."""
    # A look from the origin, and then a move: far away, a difference of points would lose digits
    lines = [
        f'<lookat origin="0, 0, 0" target="{_numbers(view)}" up="{_numbers(up)}"/>',
        f'<translate value="{_numbers(origin)}"/>',
    ]
    if any(abs(s - 1) > LEVEL for s in scale):
        lines.insert(0, f'<scale value="{_numbers(scale)}"/>')
    return lines


def _nil_of(holder):
    """The integrator "nil" in a scene, or that which an integrator is or wraps."""
    outer = holder.integrator() if isinstance(holder, mi.Scene) else holder
    within = mi.traverse(outer).hierarchy if isinstance(outer, mi.Integrator) else ()
    found = next((node for node in within if hasattr(node, "view")), None)
    if found is None:
        raise ValueError(
            f'look_at needs an integrator "nil", or a scene that has one, and this is '
            f'{type(outer).__name__}: pass one such as mi.load_dict({{"type": "nil"}}).'
        )
    return found


def _upright(view, up):
    """``up``, if it tells where up is in a picture of what lies along ``view``."""
    if math.hypot(*_cross(view, up)) <= PARALLEL * math.hypot(*up):  # view has the length 1
        across = min(range(3), key=lambda i: abs(view[i]))
        other = tuple(int(i == across) for i in range(3))
        raise ValueError(
            f"up = {_text(up)} does not say where up is in a view along {_text(view)}: give "
            f"another, such as {other}."
        )
    return up


def _cross(a, b):
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]


def _dot(a, b):
    return sum(map(operator.mul, a, b))


def _triple(name, value):
    try:
        if dr.is_jit_v(value) and dr.width(value) == 1:
            value = [c[0] for c in value]
        numbers = tuple(float(c) for c in value)
        if len(numbers) == 3 and all(abs(c) < FAR for c in numbers):
            return numbers
    except (TypeError, ValueError):
        pass
    raise ValueError(f'"{name}" must be three numbers below 1e15, and it is {value}.')


def _cell(value):
    try:
        i, j, k = map(operator.index, value)
    except (TypeError, ValueError):
        raise ValueError(
            f'"image" must be three whole numbers, such as (1, 0, 0), and it is {value}.'
        ) from None
    return i, j, k


def _exact(p):
    """A point or direction of one lane in float64, as a scalar."""
    return ds.Array3f64(*(c[0] for c in p))


def _numbers(values):
    return ", ".join(map(number_text, values))


def _text(values):
    return f"({', '.join(f'{c + 0.0:.4g}' for c in values)})"
