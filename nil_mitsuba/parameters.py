"""The parameters of the integrator ``nil``: what a scene or Python may set them to.

They are checked here, whether they come from a scene file, from a dictionary or are set on an
integrator that is there. Knows no variant.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping
from typing import Any

from .layers import RENDERED

# In the order in which a picture's metadata tell them; "aovs" is not among those.
NAMES = (
    "twist",
    "quotient",
    "fibres",
    "cell_origin",
    "cell_size",
    "tolerance",
    "max_distance",
    "max_depth",
    "rr_depth",
    "hide_emitters",
    "aovs",
)


def checked(given: Mapping[str, Any]) -> dict[str, Any]:
    """The values of all parameters, where those that are not ``given`` have their defaults.

    The layers that "aovs" names are "layers", besides. Raises RuntimeError, as Mitsuba's own
    plugins do, with a sentence on what is wrong.
    """
    for name in given:
        if name not in NAMES:
            raise RuntimeError(unknown(name))
    max_depth = _integer(given, "max_depth", -1)
    if max_depth < 0 and max_depth != -1:
        raise RuntimeError('"max_depth" must be set to -1 (infinite) or a value >= 0')
    rr_depth = _integer(given, "rr_depth", 5)
    if rr_depth <= 0:
        raise RuntimeError('"rr_depth" must be set to a value greater than zero!')
    quotient = _boolean(given, "quotient", True)
    twist = number(given, "twist", 1.0)
    if quotient and twist != round(twist):
        raise RuntimeError(
            f'"twist" = {twist:g} does not glue the faces of the cube: use an integer such as '
            f'{math.floor(twist)} or {math.ceil(twist)}, or set "quotient" to false'
        )
    limited = quotient or "max_distance" in given
    layers = _layers(given)
    return {
        "twist": twist,
        "quotient": quotient,
        "fibres": _axis(given, "fibres", "z"),
        "cell_origin": _point(given, "cell_origin"),
        "cell_size": _positive(given, "cell_size", 1.0),
        "tolerance": _positive(given, "tolerance", 0.25),
        "max_distance": _distance(given, "max_distance") if limited else math.inf,
        "max_depth": max_depth,
        "rr_depth": rr_depth,
        "hide_emitters": _boolean(given, "hide_emitters", False),
        "aovs": ",".join(layers),
        "layers": layers,
    }


def unknown(name: str) -> str:
    """One sentence on a property that "nil" does not have."""
    sentence = f'the integrator "nil" has no property "{name}"'
    near = nearest(name, NAMES)
    return (
        f'{sentence}: did you mean "{near}"?' if near else (f"{sentence}, but {', '.join(NAMES)}.")
    )


def nearest(name: str, names: Collection[str]) -> str | None:
    """The one of ``names`` that ``name`` most likely stands for, or None."""
    folded = {other.lower(): other for other in names}
    found = difflib.get_close_matches(name.lower().replace("-", "_"), folded, 1)
    return folded[found[0]] if found else None


def _integer(given, name, default):
    value = given.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int):
        raise RuntimeError(f'The property "{name}" has the wrong type (expected <integer>).')
    return value


def _boolean(given, name, default):
    value = given.get(name, default)
    if not isinstance(value, bool):
        raise RuntimeError(f'The property "{name}" has the wrong type (expected <boolean>).')
    return value


def number(given: Mapping[str, Any], name: str, default: float) -> float:
    """A finite number among properties; raises RuntimeError, with a sentence."""
    value = given.get(name, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise RuntimeError(f'The property "{name}" has the wrong type (expected <float>).')
    if not math.isfinite(value):
        raise RuntimeError(f'"{name}" must be a finite number, and it is {value}')
    return float(value)


def _positive(given, name, default):
    value = number(given, name, default)
    if value <= 0:
        raise RuntimeError(f'"{name}" must be greater than zero, and it is {value:g}')
    return value


def _distance(given, name):
    # "inf" in a scene file
    return math.inf if given.get(name) == math.inf else _positive(given, name, 12.0)


def _axis(given, name, default):
    value = given.get(name, default)
    if not isinstance(value, str) or value not in ("x", "y", "z"):
        raise RuntimeError(f'"{name}" must be an axis of the scene, x, y or z, and it is "{value}"')
    return value


def _point(given, name):
    value = given.get(name, [0.0, 0.0, 0.0])
    try:
        point = tuple(float(value[i]) for i in range(3))
    except (TypeError, IndexError, KeyError):
        raise RuntimeError(
            f'The property "{name}" has the wrong type (expected <point> or <vector>).'
        ) from None
    if not all(map(math.isfinite, point)):
        raise RuntimeError(f'"{name}" must be finite, and it is {list(point)}')
    return point


def _layers(given):
    """The chosen layers in the order of `RENDERED`, each once."""
    text = given.get("aovs", "")
    if not isinstance(text, str):
        raise RuntimeError('The property "aovs" has the wrong type (expected <string>).')
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in RENDERED:
            near = nearest(name, RENDERED)
            raise RuntimeError(
                f'"aovs" names the layer "{name}", which is none of '
                f"{', '.join(RENDERED)}" + (f': did you mean "{near}"?' if near else "")
            )
    return tuple(layer for layer in RENDERED if layer in names)
