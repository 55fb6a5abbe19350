"""Sensors that see what no single picture plane shows: all around, a dome, with two eyes.

They are ordinary Mitsuba sensors, which `path` renders, too. A sensor's own axes are Mitsuba's: x
to the left, y up, z forward. "nil" knows them by their parameters, as any other sensor
(camera.py): it reads an eye's offset as a vector that the sensor is multiplied by.
"""

from __future__ import annotations

import abc
import math
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from .parameters import number

FLAG = mi.ParamFlags.NonDifferentiable
SIDES = {"left": -0.5, "right": 0.5}  # of interocular_distance, to the right


class Look(NamedTuple):
    """How a sensor looks through a place on its film, in the sensor's own axes.

    ``d``, ``d_x``, ``d_y``: directions of a pixel, and of those to its right and below it; ``eye``:
    where from (scene units); ``slant``: how far along the ray the unit of a clip distance is;
    ``inside``: whether that place is part of the picture.
    """

    d: mi.Vector3f
    d_x: mi.Vector3f
    d_y: mi.Vector3f
    eye: Any = 0
    slant: Any = 1
    inside: Any = True


class PythonSensor(mi.Sensor):
    """What the sensors of this module share: pose, clip distances, film, and eyes.

    Raises RuntimeError with a sentence, as Mitsuba's own do, for values that make no sense.
    """

    EYE = ""  # if a scene names none
    # Numbers that mi.traverse shows, besides to_world
    LISTED: tuple[str, ...] = ("near_clip", "far_clip")

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.m_needs_sample_3 = False
        self.near_clip = mi.Float(number(props, "near_clip", 1e-2))  # as in `perspective`
        endless = props.get("far_clip", 0) == math.inf  # "inf" in a scene file
        self.far_clip = mi.Float(math.inf if endless else number(props, "far_clip", 1e4))
        self.to_world = self.world_transform()

    def _set_eyes(self, props):
        self.eye = props.get("eye", self.EYE)
        if self.eye not in ("", "both", *SIDES):
            raise RuntimeError(f'"eye" must be left, right or both, and it is "{self.eye}"')
        if self.eye == "" and "interocular_distance" in props:
            raise RuntimeError(
                '"interocular_distance" goes with "eye": add <string name="eye" value="both"/>, or '
                "left or right"
            )
        if self.eye and "interocular_distance" not in props:
            raise RuntimeError(
                f'"eye" = {self.eye} needs "interocular_distance", which is in scene units'
            )
        self.interocular_distance = mi.Float(number(props, "interocular_distance", 0.0))
        if self.eye == "both" and not self.film().rfilter().is_box_filter():
            raise RuntimeError(
                "a filter wider than a pixel would mix the pictures of both eyes where they "
                'meet: put <rfilter type="box"/> into the film, or render each eye by itself'
            )

    def _size(self) -> tuple[int, int]:
        """Width and height (pixels) of one eye's whole picture."""
        width, height = self.film().size()
        return int(width), int(height) // (2 if self.eye == "both" else 1)

    @abc.abstractmethod
    def _look(self, place: mi.Point2f, side: mi.Float) -> Look:
        """How one looks through a place on the film (0 to 1), ``side`` scene units to the right."""

    # --------------------------------------------------------- what Mitsuba asks for

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        film = self.film()
        wavelengths, weight = self.sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), sample1, active
        )
        # The sample's place in the whole film, not in its crop
        scale = mi.ScalarVector2f(film.crop_size()) / mi.ScalarVector2f(film.size())
        start = mi.ScalarVector2f(film.crop_offset()) / mi.ScalarVector2f(film.size())
        place = mi.Point2f(sample2 * scale + start)
        side = mi.Float(0)
        if self.eye == "both":
            right = place.y >= 0.5
            place.y = 2 * place.y - dr.select(right, 1.0, 0.0)
            side = dr.select(right, SIDES["right"], SIDES["left"]) * self.interocular_distance
        elif self.eye:
            side = SIDES[self.eye] * self.interocular_distance
        look = self._look(place, side)

        ray = dr.zeros(mi.RayDifferential3f)
        ray.d = self.to_world @ look.d
        ray.d_x = self.to_world @ look.d_x
        ray.d_y = self.to_world @ look.d_y
        eye = self.to_world @ mi.Point3f(look.eye)
        ray.o = mi.Point3f(eye + self.near_clip * look.slant * ray.d)
        ray.o_x, ray.o_y = mi.Point3f(ray.o), mi.Point3f(ray.o)
        ray.has_differentials = True
        ray.maxt = (self.far_clip - self.near_clip) * look.slant
        ray.time = time
        ray.wavelengths = wavelengths
        return ray, weight * dr.select(look.inside, 1.0, 0.0)

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        full, weight = self.sample_ray_differential(time, sample1, sample2, sample3, active)
        ray = mi.Ray3f(full.o, full.d, full.time, full.wavelengths)
        ray.maxt = full.maxt
        return ray, weight

    def bbox(self):
        place = self.to_world @ mi.Point3f(0)
        point = mi.ScalarPoint3f(*(_host(c) for c in place))
        return mi.ScalarBoundingBox3f(point, point)

    def traverse(self, callback):
        super().traverse(callback)
        for name in ("to_world", *self.LISTED):
            callback.put(name, getattr(self, name), FLAG)

    def parameters_changed(self, keys=()):
        self._check()
        self.m_to_world = self.to_world
        dr.make_opaque(self.to_world, [getattr(self, name) for name in self.LISTED])

    def _check(self):
        near, far = _host(self.near_clip), _host(self.far_clip)
        if near <= 0:
            raise RuntimeError("The 'near_clip' parameter must be greater than zero!")
        if near >= far:
            raise RuntimeError("The 'near_clip' parameter must be smaller than 'far_clip'.")
        if dr.any(self.to_world.has_scale()):
            raise RuntimeError(
                "Scale factors in the camera-to-world transformation are not allowed!"
            )
        distance = _host(getattr(self, "interocular_distance", 0.0))
        if not 0 <= distance < math.inf:
            raise RuntimeError(f'"interocular_distance" must not be negative: it is {distance:g}')

        # Here, since a batch sets its sensors' sizes after they are made, as mi.traverse does
        if self.eye == "both" and self.film().size()[1] % 2:
            raise RuntimeError(
                "\"eye\" = both puts the left eye's picture above the right one's, so that the "
                f"film's height must be even, and it is {self.film().size()[1]}"
            )

    def to_string(self) -> str:
        """All that the picture depends on: checkpoints tell sensors apart by it."""
        lines = [f"  {name} = {getattr(self, name)}" for name in self.LISTED]
        lines += [f"  eye = {self.eye or 'none'}"]
        lines += [f"  film = {self.film()}", f"  sampler = {self.sampler()}"]
        lines += [f"  shutter_open = {self.shutter_open()}"]
        lines += [f"  shutter_open_time = {self.shutter_open_time()}"]
        lines += [f"  to_world = {self.to_world}"]
        text = ",\n".join(line.replace("\n", "\n  ") for line in lines)
        return f"{type(self).__name__}[\n{text}\n]"


class Spherical(PythonSensor):
    """All that is seen from one point: 360° × 180°, equirectangular.

    A pixel's azimuth and elevation are those of an `envmap` with the same ``to_world``; the middle
    of the picture looks along z. ``to_world``; ``near_clip`` (0.01) and ``far_clip`` (10000),
    lengths along each ray (scene units); ``eye`` (none): ``left``, ``right`` or ``both``, the left
    one's picture above the right one's, with ``interocular_distance`` (scene units). The eyes of a
    column stand beside each other as they do for one who turns towards it, and come together
    towards the poles by the cosine of the elevation: omnidirectional stereo. The film's filter is
    the box filter, or `sample_border` is on: then any filter goes on across the seam and the poles.
    """

    LISTED = (*PythonSensor.LISTED, "interocular_distance")

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self._set_eyes(props)
        film = self.film()
        if not (film.rfilter().is_box_filter() or film.sample_border()):
            raise RuntimeError(
                "a filter wider than a pixel would leave a seam in a panorama: put "
                '<rfilter type="box"/> into the film, or <boolean name="sample_border" '
                'value="true"/>, with which it goes on beyond the edges'
            )
        self.parameters_changed()

    def _look(self, place, side):
        width, height = self._size()
        # Beyond the film's edges both angles go on, over the poles, too
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * place.x)
        sin_theta, cos_theta = dr.sincos(dr.pi * place.y)
        d = mi.Vector3f(sin_phi * sin_theta, cos_theta, -cos_phi * sin_theta)
        right = mi.Vector3f(cos_phi, 0, sin_phi)
        below = mi.Vector3f(sin_phi * cos_theta, -sin_theta, -cos_phi * cos_theta)
        # Columns crowd together at the poles, where a pixel is as large as anywhere else to the eye
        # that looks there: its angles are those at the horizon, the narrower one both ways.
        sine, cosine = _sincos(min(2 * math.pi / width, math.pi / height))
        return Look(
            d,
            cosine * d + sine * right,
            cosine * d + sine * below,
            side * sin_theta * right,
        )


class Fisheye(PythonSensor):
    """A dome's picture, equidistant: the angle from the axis grows evenly from the middle.

    ``fov`` (180): the angle that the largest circle in the film spans, up to 360 degrees; outside
    of the circle the picture is black. ``to_world``; ``near_clip`` (0.01) and ``far_clip`` (10000),
    lengths along each ray (scene units).
    """

    LISTED = (*PythonSensor.LISTED, "fov")
    eye = ""

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.fov = mi.Float(number(props, "fov", 180.0))
        self.parameters_changed()

    def _check(self):
        super()._check()
        if not 0 < _host(self.fov) <= 360:
            raise RuntimeError(
                f'"fov" must be above 0 and at most 360 degrees, and it is {_host(self.fov):g}'
            )

    def _look(self, place, side):
        width, height = self._size()
        pixel = dr.deg2rad(self.fov) / min(width, height)
        x, y = (place.x - 0.5) * width * pixel, (place.y - 0.5) * height * pixel
        theta = dr.sqrt(dr.square(x) + dr.square(y))
        middle = theta == 0
        x = dr.select(middle, 1, x / dr.select(middle, 1, theta))
        y = dr.select(middle, 0, y / dr.select(middle, 1, theta))
        sine, cosine = dr.sincos(theta)
        d = mi.Vector3f(-x * sine, -y * sine, cosine)
        outwards = mi.Vector3f(-x * cosine, -y * cosine, -sine)
        around = mi.Vector3f(y, -x, 0)
        # Farther out a pixel is narrower around the axis than outwards, and at 360 degrees the rim
        # is one direction: as in a panorama, the angle that does not shrink goes both ways.
        right, below = x * outwards - y * around, y * outwards + x * around
        sine, cosine = dr.sincos(pixel)
        return Look(
            d,
            cosine * d + sine * right,
            cosine * d + sine * below,
            inside=theta <= 0.5 * dr.deg2rad(self.fov),
        )


class StereoPerspective(PythonSensor):
    """A pair of `perspective` cameras with parallel frames, beside each other.

    All parameters of `perspective`; ``eye`` (both): ``left``, ``right`` or ``both``, the left one's
    picture above the right one's; ``interocular_distance`` (scene units). Each eye's picture is
    that of a `perspective` half the distance to its side.
    """

    EYE = "both"
    LENS = ("principal_point_offset_x", "principal_point_offset_y")
    LISTED = (*PythonSensor.LISTED, "interocular_distance", "x_fov", *LENS)

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self._set_eyes(props)
        lens = {name: props[name] for name in ("fov", "fov_axis", "focal_length") if name in props}
        self.principal_point_offset_x, self.principal_point_offset_y = (
            mi.Float(number(props, name, 0.0)) for name in self.LENS
        )
        self.x_fov = mi.Float(mi.traverse(self._camera(lens))["x_fov"])
        self.parameters_changed()

    def parameters_changed(self, keys=()):
        super().parameters_changed(keys)
        self.camera = self._camera({"fov": _host(self.x_fov)})

    def _camera(self, lens):
        """Mitsuba's own camera with one eye's film, at the origin."""
        width, height = self._size()
        film = {"type": "hdrfilm", "width": width, "height": height}
        offsets = {name: _host(getattr(self, name)) for name in self.LENS}
        return mi.load_dict({"type": "perspective", "film": film} | lens | offsets)

    def _look(self, place, side):
        ray, _ = self.camera.sample_ray_differential(0, 0.5, place, mi.Point2f(0))
        # The clip planes are across the axis
        return Look(ray.d, ray.d_x, ray.d_y, mi.Vector3f(-side, 0, 0), dr.rcp(ray.d.z))


SENSORS = {
    "spherical": Spherical,
    "fisheye": Fisheye,
    "stereo_perspective": StereoPerspective,
}


def _host(value) -> float:
    """A number of one lane, or of a scalar variant."""
    return float(value[0] if dr.is_array_v(value) else value)


def _sincos(angle):
    return math.sin(angle), math.cos(angle)
