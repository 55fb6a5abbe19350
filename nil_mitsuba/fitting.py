"""Fitting the cell to a scene, and what that means for the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .aiming import columns_of, look_at, up_of
from .scene_files import number_text

MARGIN = 1e-3  # of the scene's largest extent: keeps walls and camera clear of the cube's faces
DIGITS = 5  # so that rounding takes less than a fiftieth of the margin on either side
# Of the cell: what is so far away leans by 3 degrees, a common field of view's twentieth
DWARFED = 0.1
NEAR = 5.0  # degrees, a tenth of a common field of view: a target so near the middle is seen well

# What the cell may be fitted to, by the word behind --fit
FITS = {"shapes": "the shapes", "camera": "the shapes and the camera"}


@dataclass(frozen=True)
class Fit:
    """Properties of "nil", as text; in sentences what they mean for the scene's camera; what
    options of the command follow from those; and how to aim the camera, if it has to be."""

    properties: dict[str, str]
    notes: list[str]
    options: str
    aim: str | None


def fit(scene: mi.Scene, sensor: mi.Sensor, nil: mi.Integrator, what: str) -> Fit:
    """A cell as large as the smallest cube around ``what``, a key of `FITS`.

    In the quotient the cell is that cube. In plain Nil, where nothing has to lie within a cell, the
    group's identity comes halfway from the camera to the middle of the shapes: between points with
    the cell coordinates (x, y) and (x', y') a picture leans by k (y' − y)(x + x')/2, which is
    nothing there. It does not depend on where the camera looks: an aimed one keeps it. Raises
    ValueError if the scene has no shapes of some extent.
    """
    from .camera import transforms  # needs a variant
    from .shapes import Shapes

    shapes = Shapes(scene)
    box = shapes.box
    if not box.valid() or max(box.extents()) == 0:
        raise ValueError("--fit needs a scene with shapes of some extent.")
    middle = box.center()
    views = [transform for _, transform in transforms(sensor)]
    cameras = [columns_of(view)[3] for view in views]
    if what == "camera":
        for camera in cameras:
            box.expand(camera)
    quotient = getattr(nil, "quotient", True)
    size, corner = _cube(box)
    halfway = _rounded([(a + b) / 2 for a, b in zip(cameras[0], middle, strict=True)], size)
    properties = _cell(size, corner if quotient else halfway)
    where = (
        f"the cell is the smallest cube around {FITS[what]}"
        if quotient
        else f"the cell is as wide as {FITS[what]}, and its origin is halfway from the camera to "
        "the middle of the shapes, where the picture leans least"
    )
    notes = [
        f"--fit: {where}. It is kept by these lines in the integrator, or by these options of the "
        f"command:\n{_kept(properties)}"
    ]
    huge, rest = _giants(shapes, cameras if quotient or what == "camera" else [], size)
    if huge:
        smaller, its_corner = _cube(rest)
        cell = _cell(smaller, its_corner if quotient else halfway)
        notes.append(
            f"--fit: all but {huge} would fit into a cell of {cell['cell_size']}, and in one so "
            "much larger next to nothing bends where they are; this lets it bend"
            + (f", and cuts off what of {huge} reaches out of the cell" if quotient else "")
            + f":\n{_kept(cell)}"
        )
    options = "--fit"
    outside = [camera for camera in cameras if not _holds(corner, size, camera)]
    way = math.dist(cameras[0], middle) / size
    if quotient and outside:
        options = "--fit camera"
        notes.append(
            f"--fit: the camera at {_text(outside[0])} lies outside of this cell: it is carried "
            "into it, and is likely to see walls; --fit camera takes the smallest cell that holds "
            "it, too."
        )
    elif way > 1 and what != "camera":  # light turns by a radian a cell at most, at twist 1
        options = "--fit camera"
        notes.append(
            f"--fit: the middle of the shapes is {way:.2g} cells away from the camera, and light "
            "bends strongly on so long a way; --fit camera takes a larger cell, in which it bends "
            "less."
        )
    fibres = getattr(nil, "fibres", "z")
    _, up = max(zip(map(abs, up_of(views[0])), "xyz", strict=True))
    if up != fibres:
        options += f" -P fibres={up}"
        notes.append(
            f"--fit: the camera's up is {up}, and the fibres run along {fibres}; this lets the "
            f"fibres run upright:\n{_kept({'fibres': up})}"
        )
    aim = None
    target = _looked_at(scene, views[0])
    if target and not (quotient and outside):
        space = {"cell_size": size, "cell_origin": corner if quotient else halfway, "fibres": up}
        angle = _miss(nil, space, views[0], target)
        if angle > NEAR:
            aim = (
                f"--fit: in flat space the camera looks at {_text(target)}, which is seen "
                f'{angle:.0f} degrees off the middle now: unless it is aimed, "nil-mitsuba aim" '
                f"with the -D, -P, -s and --fit of this command and --at "
                f"{_text(target, ',')[1:-1]} prints the to_world that looks there."
            )
    return Fit(properties, notes, options, aim)


def _cube(box):
    """Edge and corner of a cube around a box, with a margin, in few digits."""
    size = max(box.extents()) * (1 + MARGIN)
    (size,) = _rounded([size], size)
    return size, _rounded([c - size / 2 for c in box.center()], size)


def _rounded(numbers, size):
    """Numbers in so many digits that a cell of a size moves by less than its margin."""
    digits = DIGITS - math.floor(math.log10(size))
    return [round(number, digits) for number in numbers]


def _cell(size, origin):
    return {"cell_size": number_text(size), "cell_origin": ",".join(map(number_text, origin))}


def _giants(shapes, cameras, size):
    """The names of one or two shapes without which a cell for the others and for cameras would be
    as small as `DWARFED`, and a box around those; or None and anything."""
    known = [
        (max(extent.box.extents()), shape.id(), extent.box)
        for shape, extent in zip(shapes.shapes, shapes.extents, strict=True)
        if extent.box.valid()
    ]
    known.sort(key=lambda entry: entry[0], reverse=True)
    for count in (1, 2):  # such as the ground and a sky around it
        box = mi.ScalarBoundingBox3f()
        for _, _, other in known[count:]:
            box.expand(other)
        if not box.valid():
            break
        for camera in cameras:
            box.expand(camera)
        if 0 < max(box.extents()) < DWARFED * size:
            names = [f'"{name}"' if name else "a shape without id" for _, name, _ in known[:count]]
            return " and ".join(names), box
    return None, None


def _miss(nil, space, view, target):
    """By how many degrees a camera's central geodesic misses what it looks at in flat space."""
    bent = mi.load_dict(
        {
            "type": "nil",
            "twist": getattr(nil, "twist", 1.0),
            "quotient": getattr(nil, "quotient", True),
            "max_distance": 1e6,  # cells: any target is within reach
        }
        | space
    )
    _, up, forward, origin = columns_of(view)
    try:
        aimed = look_at(bent, origin, target, up)
    except ValueError:  # the camera stands on it, or looks along its up
        return 0.0
    cosine = sum(a * aimed.to_world.matrix[i, 2] for i, a in enumerate(forward))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine / math.hypot(*forward)))))


def unfitted(scene: mi.Scene, sensor: mi.Sensor, nil: mi.Integrator) -> str | None:
    """One sentence on what to do if the cell does not hold the shapes of a scene, or None."""
    from .shapes import Shapes  # needs a variant

    box = Shapes(scene).box
    size, corner = getattr(nil, "cell_size", 1.0), getattr(nil, "cell_origin", (0, 0, 0))
    if not box.valid() or not max(box.extents()):
        return None
    if all(_holds(corner, size, point) for point in (box.min, box.max)):
        return None
    options = fit(scene, sensor, nil, "shapes").options
    low, high = (_rounded(corner, max(box.extents())) for corner in (box.min, box.max))
    return (
        f"the shapes reach from {_text(low)} to {_text(high)}, and the cell from "
        f"{_text(corner)} to {_text([c + size for c in corner])}: "
        f"add {options} to fit it to them."
    )


def cut_off(nil: mi.Integrator, name: str, middle: Sequence[float]) -> str | None:
    """One sentence on a shape whose middle the quotient's cell does not hold, or None."""
    corner, size = nil.cell_origin, nil.cell_size
    if not nil.quotient or _holds(corner, size, middle):
        return None
    return (
        f'the middle of the shape "{name}", {_text(middle)}, lies outside of the cell, which '
        f"reaches from {_text(corner)} to {_text([c + size for c in corner])}, and is cut off: add "
        "--fit camera, or set cell_size and cell_origin."
    )


def _holds(corner, size, point):
    """Whether a cube in the scene holds a point within it, not on its faces."""
    return all(c < x < c + size for c, x in zip(corner, point, strict=True))


def _looked_at(scene, view):
    """The point that a camera looks at where space is flat, or None."""
    _, _, forward, origin = columns_of(view)
    ray = mi.Ray3f(mi.Point3f(origin), dr.normalize(mi.Vector3f(forward)))
    hit = scene.ray_intersect_preliminary(ray)
    return [c[0] for c in ray(hit.t)] if hit.is_valid()[0] else None


def _text(point, comma=", "):
    return f"({comma.join(f'{c + 0.0:.4g}' for c in point)})"  # + 0.0: a zero has no sign


TYPES = {"cell_size": "float", "cell_origin": "point", "fibres": "string"}


def _kept(properties):
    """Properties as lines for a scene file and for the command."""
    lines = [f'<{TYPES[name]} name="{name}" value="{text}"/>' for name, text in properties.items()]
    lines.append(" ".join(f"-P {name}={text}" for name, text in properties.items()))
    return "\n".join(f"    {line}" for line in lines)
