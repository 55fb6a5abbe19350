"""Where a Mitsuba sensor's rays start in Nil, in which direction, and how exact they must be.

A sensor's rotation is read as frame components at its own position, so its rays' directions need
no change. What moves a ray's origin across its direction (film plane, lens) is a coordinate vector
δ that is applied by the group product o·δ, which makes a camera's view the same wherever a left
translation takes it. The clip planes are arc lengths along the ray's own geodesic: they hide, and
never move, what is seen.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import geometry
from .quotient import Space, opaque
from .tracer import Cone

SENSORS = (
    "perspective, thinlens, orthographic, radiancemeter, batch, spherical, fisheye, "
    "stereo_perspective"
)

OFFERED = {"near_clip", "to_world"}


class Camera:
    """A sensor's rays in Nil."""

    def __init__(self, sensor: mi.Sensor, space: Space, tolerance: float):
        self.space = space
        self.tolerance = dr.opaque(mi.Float, tolerance)
        parameters = mi.traverse(sensor)
        self.thinlens = "aperture_radius" in parameters
        self.views = [
            _Frustum(parameters, child, transform) for child, transform in transforms(sensor)
        ]
        if self.thinlens:
            self.focus_distance = opaque(mi.Float(parameters["focus_distance"]))

    def start(
        self, ray: mi.RayDifferential3f, across: mi.Float
    ) -> tuple[mi.Point3f, mi.Vector3f, Cone, mi.Float, mi.Vector3f]:
        """Start (cells), frame direction, error cone and length (cells) of a sensor ray (scene).

        The last one is its frame direction before it came to the near clip distance: in that the
        sensor sees an environment.
        ``across``: the sample's place on the film from its left (0) to its right (1); a batch tells
        its sensors apart by it.
        """
        space = self.space
        origin, near = self._view(ray, across)

        # Mitsuba's clip planes are across the axis, and both bound the way along the geodesic.
        on_plane = mi.Vector3f((ray.o - near * ray.d) - origin)
        near *= space.cells_per_unit
        far = ray.maxt * space.cells_per_unit
        if ray.has_differentials:
            # The narrower side of a pixel bounds the error.
            spread = self.tolerance * dr.minimum(dr.norm(ray.d_x - ray.d), dr.norm(ray.d_y - ray.d))
            width = (
                self.tolerance
                * space.cells_per_unit
                * dr.minimum(dr.norm(ray.o_x - ray.o), dr.norm(ray.o_y - ray.o))
            )
            cone = Cone(dr.fma(spread, near, width), spread)
        else:
            cone = Cone(0, self.tolerance * 1e-3)  # a single ray: as in an image 1,000 pixels wide

        p, v = space.to_cells(origin), space.to_cell_axes(mi.Vector3f(ray.d))
        if self.thinlens:
            p, v = self._through_lens(p, on_plane, ray)
        else:
            p = geometry.multiply(p, self._step(on_plane), space.twist)
        first = space.to_scene_axes(v)
        p, v = geometry.flow(p, v, near, space.twist)
        return p, space.to_scene_axes(v), cone, far, first

    def near(self, ray: mi.RayDifferential3f, across: mi.Float) -> mi.Float:
        """The length (scene) of the way to a ray's start, `across` as of `start`."""
        return self._view(ray, across)[1]

    def _step(self, v):
        """A vector (scene) as what a point (cells) is multiplied by."""
        return self.space.to_cell_axes(mi.Point3f(v * self.space.cells_per_unit))

    def _view(self, ray, across):
        """Origin of the sensor that a ray is from, and the way to its near clip plane (scene)."""
        origin, near = self.views[0].origin, self.views[0].near_of(ray)
        for i, view in enumerate(self.views[1:], start=1):
            mine = dr.minimum(mi.UInt32(across * len(self.views)), len(self.views) - 1) >= i
            origin = dr.select(mine, view.origin, origin)
            near = dr.select(mine, view.near_of(ray), near)
        return origin, near

    def _through_lens(self, pinhole, on_lens, ray):
        """Start (cells) of the ray from a point of the lens to where the pinhole's geodesic is in
        focus, and its direction in cell axes."""
        space, k = self.space, self.space.twist
        to_focus = on_lens + self.focus_distance / self.views[0].depth(ray) * ray.d
        length = dr.norm(to_focus)
        towards = space.to_cell_axes(mi.Vector3f(to_focus / length))
        focus, _ = geometry.flow(pinhole, towards, length * space.cells_per_unit, k)
        lens = geometry.multiply(pinhole, self._step(on_lens), k)
        return lens, mi.Vector3f(geometry.connect(lens, focus, k).direction)


def transforms(sensor: mi.Sensor) -> list[tuple[str, mi.Transform4f]]:
    """To the world from each sensor of a batch, or from a sensor that is none; with the prefix of
    its parameters. Raises RuntimeError for a sensor that "nil" does not render.

    What a sensor is is told by its parameters alone, since all that are written in Python have one
    class name: its rays start beyond a ``near_clip``, which is a plane if there is an ``x_fov``;
    what moves them from ``to_world`` otherwise acts by the group product; ``aperture_radius`` makes
    that a lens.
    """
    parameters = mi.traverse(sensor)
    # A batch lists its children's parameters behind their names.
    children = [
        key[: -len("shutter_open")] for key in parameters.keys() if key.endswith(".shutter_open")
    ]
    for child in children:
        offered = {name for name in OFFERED if f"{child}{name}" in parameters}
        if offered != OFFERED or f"{child}aperture_radius" in parameters:
            raise RuntimeError(
                f'the integrator "nil" renders sensors that have near_clip and to_world, and no '
                f'lens, inside a batch, which "{child[:-1]}" is not: render it as a sensor of its '
                "own."
            )
    if children:
        return [(child, mi.Transform4f(parameters[f"{child}to_world"])) for child in children]
    # A radiancemeter offers as little as sensors that are no camera
    if not all(name in parameters for name in OFFERED) and sensor.class_name() != "RadianceMeter":
        python = sensor.class_name() == "Sensor"  # all that are written in it
        name = type(sensor).__name__ if python else sensor.class_name()
        raise RuntimeError(
            f'the integrator "nil" has no meaning for the sensor "{name}": use {SENSORS}'
            + (", or show mi.traverse its near_clip and to_world." if python else ".")
        )
    return [("", sensor.world_transform())]


class _Frustum:
    """Where one sensor is, and how far from it its rays begin."""

    def __init__(self, parameters, prefix, transform):
        self.origin = opaque(mi.Point3f(transform @ mi.Point3f(0)))
        axis = mi.Vector3f(transform @ mi.Vector3f(0, 0, 1))
        self.axis = opaque(dr.normalize(axis))
        near = f"{prefix}near_clip"
        self.near = opaque(mi.Float(parameters[near] if near in parameters else 0))
        # All rays of an orthographic sensor, whose film may be scaled, have the same way to the
        # near clip plane, and so have those of a panorama, which has no plane.
        self.even = near in parameters and f"{prefix}x_fov" not in parameters
        self.scale = opaque(dr.norm(axis))

    def depth(self, ray):
        """How far a ray goes along the axis by a unit of its length."""
        return dr.dot(ray.d, self.axis)

    def near_of(self, ray):
        """How far along a ray it begins."""
        return self.near * self.scale if self.even else self.near / self.depth(ray)
