"""Where a camera stands and how it is turned, in double precision: steps, turns and views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import drjit.scalar as ds
import mitsuba as mi

from . import geometry
from .aiming import columns_of, up_of

# How far a turn leads above the level (radians): beyond it one to the side is a roll
STEEPEST = math.radians(89)

# Steps that cancel each other, as up and back do at the zenith, leave no more than rounding
STILL = 1e-6

Vector: TypeAlias = Any  # ds.Array3f64


@dataclass(frozen=True)
class Chart:
    """What scene coordinates mean in the space of an integrator "nil".

    ``twist``; ``quotient``; the cell's ``origin`` and ``size`` (scene units); ``axes``, the scene's
    axis (0 to 2) along which each of the cell's runs.
    """

    twist: float
    quotient: bool
    origin: tuple[float, float, float]
    size: float
    axes: tuple[int, int, int]

    @classmethod
    def of(cls, nil: mi.Integrator) -> Chart:
        """That of an integrator."""
        first = "xyz".index(nil.fibres) + 1
        axes = (first % 3, (first + 1) % 3, (first + 2) % 3)
        return cls(nil.twist, nil.quotient, tuple(nil.cell_origin), nil.cell_size, axes)

    def to_cell_axes(self, v: Sequence[float]) -> Vector:
        """Components along the scene's axes to those along the cell's."""
        return ds.Array3f64([float(v[axis]) for axis in self.axes])

    def to_scene_axes(self, v: Vector) -> list[float]:
        """Components along the cell's axes to those along the scene's."""
        return [v[self.axes.index(axis)] for axis in range(3)]

    def to_cells(self, p: Sequence[float]) -> Vector:
        """Scene coordinates to cell coordinates."""
        return self.to_cell_axes([(a - b) / self.size for a, b in zip(p, self.origin)])

    def to_scene(self, p: Vector) -> list[float]:
        """Cell coordinates to scene coordinates."""
        return [a * self.size + b for a, b in zip(self.to_scene_axes(p), self.origin)]


@dataclass(frozen=True)
class Pose:
    """A camera's place and rotation.

    ``place`` is in cells, and in the quotient within the first one; the camera has come there by
    way of ``cell``, a deck element: it stands at ``cell``·``place`` in the space that covers the
    quotient. ``left``, ``up`` and ``view`` are the columns of its to_world, frame components along
    the cell's axes, scaled and mirrored as those are. ``upright`` is the unit direction about which
    it turns to the side.
    """

    place: Vector
    left: Vector
    up: Vector
    view: Vector
    upright: Vector
    cell: tuple[int, int, int] = (0, 0, 0)

    @classmethod
    def of(
        cls, to_world: mi.Transform4f, chart: Chart, cell: tuple[int, int, int] = (0, 0, 0)
    ) -> Pose:
        """That of a sensor's ``to_world``."""
        *columns, place = columns_of(to_world)
        above = up_of(to_world)
        size = math.hypot(*above)
        left, up, view = map(chart.to_cell_axes, columns)
        upright = chart.to_cell_axes([c / size for c in above])
        pose = cls(chart.to_cells(place), left, up, view, upright, cell)
        return pose.within(chart)

    def to_world(self, chart: Chart) -> mi.ScalarTransform4f:
        """The camera's transform, from its place in the first cell."""
        columns = [chart.to_scene_axes(column) for column in (self.left, self.up, self.view)]
        columns.append(chart.to_scene(self.place))
        rows = [list(row) for row in zip(*columns)]
        return mi.ScalarTransform4f([*rows, [0, 0, 0, 1]])

    def within(self, chart: Chart) -> Pose:
        """The same pose as it is seen from the quotient's cell; in plain Nil as it is."""
        if not chart.quotient:
            return self
        place, step = geometry.wrap(self.place, chart.twist)
        i, j, k = geometry.multiply(ds.Array3i64(self.cell), step, round(chart.twist))
        return replace(self, place=place, cell=(int(i), int(j), int(k)))

    def covering(self, chart: Chart) -> Vector:
        """Its place (cells) in the space that covers the quotient."""
        return geometry.multiply(ds.Array3i64(self.cell), self.place, chart.twist)

    def moved(self, to: Sequence[float], length: float, chart: Chart) -> Pose:
        """A step of a ``length`` (cells) along the geodesic ``to`` a direction.

        That is so far to the left, along `upright` and along the view. The camera turns with the
        geodesic's frame direction, about the fibres: whoever walks straight ahead looks ahead.
        """
        left, view = unit(self.left), unit(self.view)
        ahead = to[0] * left + to[1] * self.upright + to[2] * view
        if math.hypot(*ahead) < STILL:
            return self
        towards = unit(ahead)
        place, _ = geometry.flow(self.place, towards, length, chart.twist)
        angle = chart.twist * towards.z * length
        left, up, view, upright = (
            geometry.turned(v, angle) for v in (self.left, self.up, self.view, self.upright)
        )
        return Pose(place, left, up, view, upright, self.cell).within(chart)

    def turned(self, aside: float, above: float) -> Pose:
        """The pose after a turn to the picture's left about `upright`, and one up (radians).

        Upwards and downwards it ends a degree before `upright`.
        """
        mirrored = dot(cross(self.up, self.view), self.left) < 0
        pose = self._rotated(self.upright, -aside if mirrored else aside)
        view = unit(pose.view)
        height = math.atan2(dot(pose.upright, view), math.hypot(*cross(pose.upright, view)))
        above = max(-STEEPEST, min(STEEPEST, height + above)) - height
        # About the camera's own side: where `looking` has led to the very zenith, no other is known
        return pose._rotated(unit(cross(view, pose.up)), above)

    def looking(self, towards: Vector) -> Pose:
        """The pose that looks along a unit frame direction (cell axes), as upright as before.

        Straight up or down it keeps its sides, as far as they are across the view.
        """
        view = unit(self.view)
        aside = math.atan2(
            dot(cross(view, towards), self.upright),
            dot(view, towards) - dot(view, self.upright) * dot(towards, self.upright),
        )
        pose = self._rotated(self.upright, aside)
        # The rest is a turn up or down, about the axis across both
        view = unit(pose.view)
        axis = cross(view, towards)
        sine = math.hypot(*axis)
        if sine == 0:
            return pose
        return pose._rotated(1 / sine * axis, math.atan2(sine, dot(view, towards)))

    def _rotated(self, axis: Vector, angle: float) -> Pose:
        """Rotated about a unit axis, but for `upright`."""
        left, up, view = (rotated(v, axis, angle) for v in (self.left, self.up, self.view))
        return replace(self, left=left, up=up, view=view)


def rotated(v: Vector, axis: Vector, angle: float) -> Vector:
    """``v`` rotated about a unit axis (Rodrigues' formula)."""
    s, c = math.sin(angle), math.cos(angle)
    return c * v + s * cross(axis, v) + (1 - c) * dot(axis, v) * axis


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return ds.Array3f64([a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)])


def dot(a: Vector, b: Vector) -> float:
    """The scalar product."""
    return sum(x * y for x, y in zip(a, b))


def unit(v: Vector) -> Vector:
    """``v`` divided by its length."""
    return 1 / math.hypot(*v) * v
