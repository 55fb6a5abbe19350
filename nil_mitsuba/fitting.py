"""Fitting the cell to a scene, and what that means for the camera."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from .aiming import columns_of, up_of
from .scene_files import number_text

MARGIN = 1e-3  # of the scene's largest extent: keeps walls and camera clear of the cube's faces

# What the cell may be fitted to, by the word behind --fit
FITS = {"shapes": "the shapes", "camera": "the shapes and the camera"}


@dataclass(frozen=True)
class Fit:
    """Properties of "nil", as text, and in sentences what they mean for the scene's camera."""

    properties: dict[str, str]
    notes: list[str]


def fit(scene: mi.Scene, sensor: mi.Sensor, nil: mi.Integrator, what: str) -> Fit:
    """The smallest cubic cell that holds ``what``, a key of `FITS`.

    Raises ValueError if the scene has no shapes of some extent.
    """
    from .camera import transforms  # needs a variant
    from .shapes import Shapes

    box = Shapes(scene).box
    if not box.valid() or max(box.extents()) == 0:
        raise ValueError("--fit needs a scene with shapes of some extent.")
    views = [transform for _, transform in transforms(sensor)]
    cameras = [columns_of(view)[3] for view in views]
    if what == "camera":
        for camera in cameras:
            box.expand(camera)
    size = max(box.extents()) * (1 + MARGIN)
    origin = box.center() - size / 2
    properties = {
        "cell_size": number_text(size),
        "cell_origin": ",".join(map(number_text, origin)),
    }
    notes = [
        f"--fit: the cell is the smallest cube around {FITS[what]}. It is kept by these lines in "
        f"the integrator, or by these options of the command:\n{_kept(properties)}"
    ]
    outside = [
        camera
        for camera in cameras
        if not all(c < x < c + size for c, x in zip(origin, camera, strict=True))
    ]
    if outside and getattr(nil, "quotient", True):
        place = ", ".join(f"{c:.4g}" for c in outside[0])
        notes.append(
            f"--fit: the camera at ({place}) lies outside of this cell: it is carried into it, and "
            "is likely to see walls; --fit camera takes the smallest cell that holds it, too."
        )
    fibres = getattr(nil, "fibres", "z")
    _, up = max(zip(map(abs, up_of(views[0])), "xyz", strict=True))
    if up != fibres:
        notes.append(
            f"--fit: the camera's up is {up}, and the fibres run along {fibres}; this lets the "
            f"fibres run upright:\n{_kept({'fibres': up})}"
        )
    return Fit(properties, notes)


TYPES = {"cell_size": "float", "cell_origin": "point", "fibres": "string"}


def _kept(properties):
    """Properties as lines for a scene file and for the command."""
    lines = [f'<{TYPES[name]} name="{name}" value="{text}"/>' for name, text in properties.items()]
    lines.append(" ".join(f"-P {name}={text}" for name, text in properties.items()))
    return "\n".join(f"    {line}" for line in lines)
