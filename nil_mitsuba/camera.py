"""Where a Mitsuba sensor's rays start in Nil, in which direction, and how exact they must be.

A sensor's rotation is read as frame components at its own position, so its rays' directions need
no change. What Mitsuba adds to the position (near clip, film plane, lens) is a coordinate vector δ
that is applied by the group product o·δ, which makes a camera's view the same wherever a left
translation takes it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import geometry
from .quotient import Space, opaque
from .tracer import Cone

SENSORS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic",
    "RadianceMeter": "radiancemeter",
    "BatchSensor": "batch",
}


class Camera:
    """A sensor's rays in Nil."""

    def __init__(self, sensor: mi.Sensor, space: Space, tolerance: float):
        name = sensor.class_name()
        if name not in SENSORS:
            raise RuntimeError(
                f'the integrator "nil" has no meaning for the sensor "{name}": use '
                f"{', '.join(SENSORS.values())}."
            )
        self.space = space
        self.tolerance = dr.opaque(mi.Float, tolerance)
        self.thinlens = name == "ThinLensCamera"
        film = sensor.film()
        self.first_column = film.crop_offset().x

        parameters = mi.traverse(sensor)
        if name == "BatchSensor":
            # A batch lists its children's parameters behind their names.
            children = [key[: -len(".shutter_open")] for key in parameters.keys()
                        if key.endswith(".shutter_open")]
            for child in children:
                turned = f"{child}.to_world" in parameters
                if not turned or f"{child}.aperture_radius" in parameters:
                    raise RuntimeError(
                        f'the integrator "nil" renders perspective and orthographic sensors inside '
                        f'a batch, and "{child}" is neither: render it as a sensor of its own.'
                    )
            transforms = [mi.Transform4f(parameters[f"{child}.to_world"]) for child in children]
            self.origins = [opaque(mi.Point3f(t @ mi.Point3f(0))) for t in transforms]
            self.columns = film.size().x // len(children)
        else:
            transform = sensor.world_transform()
            self.origins = [opaque(mi.Point3f(transform @ mi.ScalarPoint3f(0)))]
            self.axis = opaque(dr.normalize(mi.Vector3f(transform @ mi.Vector3f(0, 0, 1))))
        if self.thinlens:
            self.focus_distance = opaque(mi.Float(parameters["focus_distance"]))
            self.near_clip = opaque(mi.Float(parameters["near_clip"]))

    def start(self, ray: mi.RayDifferential3f, position: mi.Vector2f
              ) -> tuple[mi.Point3f, mi.Vector3f, Cone]:
        """Start (cells), frame direction and error cone of a sensor ray (scene).

        ``position`` is the sample's place on the film in pixels; a batch tells its sensors apart
        by it.
        """
        space = self.space
        origin = mi.Point3f(self.origins[0])
        for i, other in enumerate(self.origins[1:], start=1):
            origin = dr.select(position.x >= i * self.columns, other, origin)

        if ray.has_differentials:
            # The narrower side of a pixel bounds the error.
            cone = Cone(
                self.tolerance / space.size * dr.minimum(dr.norm(ray.o_x - ray.o),
                                                         dr.norm(ray.o_y - ray.o)),
                self.tolerance * dr.minimum(dr.norm(ray.d_x - ray.d), dr.norm(ray.d_y - ray.d)),
            )
        else:
            cone = Cone(0, self.tolerance * 1e-3)  # a single ray: as in an image 1,000 pixels wide

        p, v = space.to_cells(origin), mi.Vector3f(ray.d)
        if self.thinlens:
            p, v = self._through_lens(p, origin, ray)
        else:
            p = geometry.multiply(p, mi.Point3f((ray.o - origin) / space.size), space.twist)
        return p, v, cone

    def _through_lens(self, pinhole, origin, ray):
        """The ray from a point of the lens to where the pinhole's geodesic is in focus."""
        space, k = self.space, self.space.twist
        depth = dr.dot(ray.d, self.axis)
        near = self.near_clip / depth
        on_lens = (ray.o - near * ray.d) - origin
        to_focus = on_lens + (self.focus_distance / depth) * ray.d
        length = dr.norm(to_focus)
        focus, _ = geometry.flow(pinhole, mi.Vector3f(to_focus / length), length / space.size, k)
        lens = geometry.multiply(pinhole, mi.Point3f(on_lens / space.size), k)
        v = mi.Vector3f(geometry.connect(lens, focus, k).direction)
        return geometry.flow(lens, v, near / space.size, k)
