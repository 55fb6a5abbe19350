"""The way of a camera by keys: where it is in each frame, how it is turned, and what it is set to.

From key to key it moves along the shortest geodesic. Its view is turned in the left-invariant
frame, with a level horizon if both keys have one, or else about one axis. Its parameters change
along with both.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import drjit.scalar as ds

from . import geometry
from .aiming import LEVEL
from .keys import MOST_CELLS, Key, UnfitError
from .pose import Chart, Pose, Vector, cross, dot, rotated, unit

# The last key is an image of the first if they are no further apart than this (cells, radians,
# parts of a length): their numbers may have been rounded, and nobody sees such a jump
CLOSED = 1e-4


class Flight:
    """A flight by two ``keys`` or more, in so many ``frames``.

    ``parameters`` are those of the sensor's that a key may set, as they are where it does not.
    ``loop``: the last key is a deck image of the first, and the frame after the last were the
    first; ``length`` (cells) is that of the way. Raises UnfitError for a key by which it cannot
    lead.
    """

    def __init__(
        self, keys: Sequence[Key], frames: int, chart: Chart, parameters: Mapping[str, float]
    ):
        self.chart = chart
        self.stops: list[_Stop] = []
        for number, key in enumerate(keys, start=1):
            name = f"key {number} of {len(keys)}"
            if any(key.cell) and not chart.quotient:
                raise UnfitError(
                    f'{name}: plain Nil has no other cells, and "cell" = {list(key.cell)} goes '
                    "with the quotient only."
                )
            for parameter in key.parameters.keys() - parameters.keys():
                raise UnfitError(f'{name}: the scene\'s sensor has no "{parameter}" to set.')
            place = chart.to_cells(key.to_world[3:12:4])
            if not max(map(abs, place)) <= MOST_CELLS:
                raise UnfitError(
                    f'{name}: its "to_world" is more than a million cells from the origin of the '
                    "cell, where places are too coarse for a way."
                )
            stop = _Stop.of(key, chart, {**parameters, **key.parameters})
            if self.stops and stop.mirrored != self.stops[0].mirrored:
                raise UnfitError(
                    f"{name}: it is a mirror image of the first as to left and right: negate the "
                    'first column of its "to_world".'
                )
            self.stops.append(stop)
        self.legs = [_Leg(a, b, chart) for a, b in zip(self.stops, self.stops[1:])]
        self.length = sum(leg.distance for leg in self.legs)
        # Where on the way each leg begins, and the last one ends
        self.marks = [0.0, *accumulate(leg.measure for leg in self.legs)]
        first, last = self.stops[0], self.stops[-1]
        self.loop = self.marks[-1] > 0 and last.is_image_of(first, chart)
        self.steps = frames if self.loop else frames - 1

    def at(self, frame: int) -> tuple[Pose, dict[str, float]]:
        """The camera's pose and parameters in a frame, counted from 0."""
        if frame and frame == self.steps:
            return self.stops[-1].pose, self.stops[-1].parameters  # whatever rounding makes of it
        here = self.marks[-1] * frame / max(self.steps, 1)
        index = min(bisect_right(self.marks, here), len(self.legs)) - 1
        leg = self.legs[index]
        part = (here - self.marks[index]) / leg.measure if leg.measure else 1.0
        return leg.at(min(part, 1.0))


@dataclass(frozen=True)
class _Stop:
    """A key: its pose, whose axes are at right angles; these as a rotation and their lengths."""

    pose: Pose
    axes: tuple[Vector, Vector, Vector]  # left, up and view, of length 1 and right-handed
    sizes: tuple[float, ...]
    mirrored: bool
    parameters: dict[str, float]

    @classmethod
    def of(cls, key: Key, chart: Chart, parameters: dict[str, float]) -> _Stop:
        rows = [key.to_world[i : i + 4] for i in range(0, 12, 4)]
        *columns, place = zip(*rows)
        left, up, view = map(chart.to_cell_axes, columns)
        sizes = tuple(math.hypot(*column) for column in columns)
        forward = unit(view)
        above = unit(up - dot(up, forward) * forward)
        aside = cross(above, forward)
        mirrored = dot(aside, left) < 0
        pose = _posed(
            chart.to_cells(place), (aside, above, forward), sizes, mirrored, key.cell
        ).within(chart)
        return cls(pose, (aside, above, forward), sizes, mirrored, parameters)

    def is_image_of(self, first: _Stop, chart: Chart) -> bool:
        """Whether a deck element takes the first to this, in all that it has."""
        k = chart.twist
        p, q = first.pose.place, self.pose.place
        # Both are in the first cell, but near a face one of them may be on its other side
        deck = [round(c) for c in geometry.multiply(q, geometry.inverse(p, k), k)]
        if not chart.quotient:
            deck = [0, 0, 0]
        off = geometry.multiply(ds.Array3f64(deck), p, k) - q
        _, angle = rotation(first.axes, self.axes)
        return (
            max(map(abs, off)) <= CLOSED
            and angle <= CLOSED
            and max(_changes(first, self), default=0) <= CLOSED
        )


class _Leg:
    """The way from one key to the next.

    ``measure`` is what it counts for when frames are spaced evenly: the length in cells, the angle
    in radians and the changes of parameters, as parts of the larger value, like sides at right
    angles. So a leg that is a turn or a zoom takes its time, too.
    """

    def __init__(self, start: _Stop, end: _Stop, chart: Chart):
        self.start, self.end, self.chart = start, end, chart
        k = chart.twist
        # From the start's own cell: however far that is, nothing is lost
        whole = round(k)
        back = geometry.inverse(ds.Array3i64(start.pose.cell), whole)
        step = geometry.multiply(back, ds.Array3i64(end.pose.cell), whole)
        target = geometry.multiply(ds.Array3f64(step), end.pose.place, k)
        way = geometry.connect(start.pose.place, target, k)
        self.direction, self.distance = way.direction, way.distance
        self.turn = _LevelTurn.between(start, end) or _Turn(start, end)
        self.measure = math.hypot(self.distance, self.turn.angle, *_changes(start, end))

    def at(self, part: float) -> tuple[Pose, dict[str, float]]:
        """Pose and parameters on a part of the way, from 0 to 1."""
        start, end = self.start, self.end
        place, _ = geometry.flow(
            start.pose.place, self.direction, part * self.distance, self.chart.twist
        )
        axes = self.turn.at(part)
        # In equal ratios, as a zoom is even
        sizes = tuple(a ** (1 - part) * b**part for a, b in zip(start.sizes, end.sizes))
        pose = _posed(place, axes, sizes, start.mirrored, start.pose.cell).within(self.chart)
        parameters = {}
        for name, value in start.parameters.items():
            a, b = _extent(name, value), _extent(name, end.parameters[name])
            parameters[name] = _of_extent(name, (1 - part) * a + part * b)
        return pose, parameters


class _Turn:
    """The turn of a view from one key to the next, about one axis; ``angle`` in radians."""

    def __init__(self, start: _Stop, end: _Stop):
        self.axes = start.axes
        self.axis, self.angle = rotation(start.axes, end.axes)

    def at(self, part: float) -> tuple[Vector, ...]:
        """Left, up and view after a part of it, from 0 to 1."""
        return tuple(rotated(v, self.axis, part * self.angle) for v in self.axes)


class _LevelTurn:
    """A turn with a level horizon: about what is upright in both views, and up or down.

    About one axis the horizon would roll on the way between views of different heights.
    """

    def __init__(self, start: _Stop, end: _Stop, upright: Vector):
        self.axes, self.upright = start.axes, upright
        (left, _, view), (other, _, other_view) = start.axes, end.axes
        self.aside = math.atan2(dot(cross(left, other), upright), dot(left, other))
        below, above = (_height(v, upright) for v in (view, other_view))
        self.rise = above - below
        across = math.cos((below + above) / 2)
        self.angle = math.hypot(across * self.aside, self.rise)
        # Level is what is so but for rounding, which the last key keeps
        self.rest = rotation(self._level(1.0), end.axes)

    @classmethod
    def between(cls, start: _Stop, end: _Stop) -> _LevelTurn | None:
        """The turn between two views, if they have the same upright axis."""
        first, last = (_uprights(stop.axes) for stop in (start, end))
        both = first.keys() & last.keys()
        if not both:
            return None
        axis, sign = max(both, key=lambda upright: first[upright] + last[upright])
        return cls(start, end, ds.Array3f64([sign * (i == axis) for i in range(3)]))

    def at(self, part: float) -> tuple[Vector, ...]:
        """As of `_Turn`."""
        axis, angle = self.rest
        return tuple(rotated(v, axis, part * angle) for v in self._level(part))

    def _level(self, part):
        aside = [rotated(v, self.upright, part * self.aside) for v in self.axes]
        return tuple(rotated(v, -aside[0], part * self.rise) for v in aside)


def _uprights(axes: tuple[Vector, ...]) -> dict[tuple[int, float], float]:
    """The axes (of the cell's), with the sign of what is upwards, about which a view is level, and
    how far its up leads along each: two for a view up or down along an axis' plane, or none."""
    left, up, _ = axes
    return {
        (i, math.copysign(1.0, up[i])): abs(up[i])
        for i in range(3)
        if abs(left[i]) < LEVEL and abs(up[i]) > LEVEL
    }


def _height(view: Vector, upright: Vector) -> float:
    """Angle (radians) of a view above the horizon."""
    return math.asin(max(-1.0, min(1.0, dot(view, upright))))


def rotation(a: Sequence[Vector], b: Sequence[Vector]) -> tuple[Vector, float]:
    """Unit axis and angle (0 to π) of the rotation from one right-handed basis to another.

    By way of the quaternion, whose largest component is computed first (Shepperd 1978): at half a
    turn, and at none, nothing cancels.
    """
    m = [[sum(v[i] * u[j] for u, v in zip(a, b)) for j in range(3)] for i in range(3)]
    trace = m[0][0] + m[1][1] + m[2][2]
    largest = max(range(3), key=lambda i: m[i][i])
    if trace > m[largest][largest]:
        w = 1 + trace
        vector = [m[i - 1][i - 2] - m[i - 2][i - 1] for i in range(3)]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        vector = [0.0, 0.0, 0.0]
        vector[i] = 1 + m[i][i] - m[j][j] - m[k][k]
        vector[j] = m[i][j] + m[j][i]
        vector[k] = m[i][k] + m[k][i]
        w = m[k][j] - m[j][k]
    sign = -1.0 if w < 0 else 1.0
    size = math.hypot(*vector)
    if size == 0:
        return ds.Array3f64(0, 0, 1), 0.0
    return sign / size * ds.Array3f64(vector), 2 * math.atan2(size, abs(w))


def _posed(place, axes, sizes, mirrored, cell) -> Pose:
    left, up, view = (size * axis for size, axis in zip(sizes, axes))
    return Pose(place, -left if mirrored else left, up, view, axes[1], cell)


def _changes(a: _Stop, b: _Stop) -> list[float]:
    """Changes of parameters and scales from one key to another, as parts of the larger value."""
    pairs = [
        (_extent(name, a.parameters[name]), _extent(name, b.parameters[name]))
        for name in a.parameters
    ]
    pairs += zip(a.sizes, b.sizes)
    return [abs(x - y) / max(x, y) if x != y else 0.0 for x, y in pairs]


def _extent(name: str, value: float) -> float:
    """What a parameter is interpolated as: a length as it is, a field of view as the tangent of its
    half, which is how far the picture reaches, so that what is seen grows or shrinks evenly."""
    return math.tan(math.radians(value) / 2) if name == "x_fov" else value


def _of_extent(name: str, extent: float) -> float:
    return math.degrees(2 * math.atan(extent)) if name == "x_fov" else extent
