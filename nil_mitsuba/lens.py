"""The lens of a sensor: its parameters, and a sensor with a lens in the place of a pinhole."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .keys import PARAMETERS

LENS = tuple(PARAMETERS)  # what keys may set


def lens_of(sensor: mi.Sensor) -> dict[str, float]:
    """The parameters `LENS` that a sensor has."""
    parameters = mi.traverse(sensor)
    return {name: one(parameters[name]) for name in LENS if name in parameters}


def one(value) -> float:
    """A parameter as a number, whether Mitsuba keeps it as one or as an array."""
    return float(value[0] if dr.is_array_v(value) else value)


def viewing_sensor(own: mi.Sensor, nil: mi.Integrator) -> tuple[mi.Sensor, dict[str, float]]:
    """A sensor that sees what a scene's own sees, and its lens's parameters.

    A pinhole becomes a lens with an aperture of nothing, so that an aperture needs no other kernel.
    Raises RuntimeError for a sensor that cannot be moved.
    """
    parameters = mi.traverse(own)
    kind = own.class_name()
    if kind in ("BatchSensor", "RadianceMeter") or "to_world" not in parameters:
        raise RuntimeError(
            f'the viewfinder cannot walk with the sensor "{kind}": name another by -s, or look '
            "through a copy of the scene with a perspective one."
        )
    lens = lens_of(own)
    shifted = any(
        one(parameters[name])
        for name in ("principal_point_offset_x", "principal_point_offset_y")
        if name in parameters
    )
    if kind != "PerspectiveCamera" or shifted:
        return own, lens
    film = own.film()
    (width, height), (crop_width, crop_height) = film.size(), film.crop_size()
    crop_x, crop_y = film.crop_offset()
    lens |= {"focus_distance": 2.0 * nil.cell_size, "aperture_radius": 0.0}
    description = {
        "type": "thinlens",
        "fov": lens["x_fov"],
        "fov_axis": "x",
        "focus_distance": lens["focus_distance"],
        "aperture_radius": 1.0,  # of 0 Mitsuba would warn
        "near_clip": own.near_clip(),
        "far_clip": own.far_clip(),
        "shutter_open": own.shutter_open(),
        "shutter_close": own.shutter_open() + own.shutter_open_time(),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "crop_width": crop_width,
            "crop_height": crop_height,
            "crop_offset_x": crop_x,
            "crop_offset_y": crop_y,
        },
    }
    if own.get_medium() is not None:
        description["medium"] = own.get_medium()
    return mi.load_dict(description), lens
