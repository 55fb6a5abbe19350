"""Key files: cameras by which a flight leads, as JSON."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field

from .files import replacing
from .parameters import nearest

# What a key may set besides the place and the view, as `mi.traverse` names it, and its range
PARAMETERS = {
    "x_fov": (lambda x: 0 < x < 180, "degrees between 0 and 180"),
    "focus_distance": (lambda x: 0 < x < FAR, "a length greater than 0"),
    "aperture_radius": (lambda x: 0 <= x < FAR, "a length from 0 on"),
}
FAR = 1e15  # scene units, as of shapes
MOST_CELLS = 10**6  # so far along each axis: products of two such are exact in double precision

# The sides of a camera may be so far from a right angle (cosine): matrices are often written with
# four digits
SKEW = 1e-3


class UnfitError(ValueError):
    """A key that a scene cannot be seen from; the sentence begins with its number."""


@dataclass(frozen=True)
class Key:
    """A camera by which a flight leads.

    ``to_world``: the sensor's matrix, 16 numbers row by row. ``cell``: the deck element of the cell
    in which it stands, in the space that covers the quotient. ``parameters``: those of `PARAMETERS`
    that it sets, by name; others are as the scene has them.
    """

    to_world: list[float]
    cell: tuple[int, int, int] = (0, 0, 0)
    parameters: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict:
        """The key as it stands in a file."""
        cell = {"cell": list(self.cell)} if any(self.cell) else {}
        return {"to_world": list(self.to_world), **cell, **self.parameters}


def load(path: str | os.PathLike) -> list[Key]:
    """The keys in the file `path`.

    Raises OSError if it cannot be read, and ValueError, with a sentence that names the key, if it
    is no key file.
    """
    try:
        with open(path, encoding="utf-8-sig") as file:  # some editors put a mark before the text
            contents = json.load(file, object_pairs_hook=_once_each)
    except OSError as error:
        raise OSError(f'cannot read "{path}": {error.strerror or error}.') from None
    except (UnicodeDecodeError, RecursionError):
        raise ValueError(f'"{path}" is no key file: it is not text in JSON.') from None
    except json.JSONDecodeError as error:
        raise ValueError(
            f'"{path}" is not JSON: {error.msg} in line {error.lineno}, column {error.colno}.'
        ) from None
    except _WrongError as error:
        raise ValueError(f'"{path}" is no key file: {error}.') from None
    except ValueError:  # Python's, of thousands of digits
        raise ValueError(f'"{path}" is no key file: a number in it has too many digits.') from None
    listed = contents.get("keys") if isinstance(contents, dict) else None
    if not isinstance(listed, list) or contents.keys() != {"keys"}:
        raise ValueError(
            f'"{path}" is no key file: it must be one object {{"keys": [...]}} with nothing beside '
            "the list of keys."
        )
    keys = []
    for number, entry in enumerate(listed, start=1):
        try:
            keys.append(_key(entry))
        except _WrongError as error:
            raise ValueError(f'"{path}", key {number} of {len(listed)}: {error}.') from None
    return keys


def save(path: str | os.PathLike, keys: list[Key]) -> None:
    """Write a key file, whole or not at all; raises OSError."""
    # A number a line, as json indents, would be long: a row of the matrix a line is how one reads
    entries = []
    for key in keys:
        entry = key.as_dict()
        matrix = entry.pop("to_world")
        rows = [", ".join(map(repr, map(float, matrix[i : i + 4]))) for i in range(0, 16, 4)]
        lines = ['"to_world": [\n    ' + ",\n    ".join(rows) + "\n  ]"]
        lines += [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in entry.items()]
        entries.append("{\n  " + ",\n  ".join(lines) + "\n}")
    with replacing(path) as part, open(part, "w", encoding="utf-8") as file:
        file.write('{"keys": [' + ", ".join(entries) + "]}\n")


class _WrongError(Exception):
    """What is wrong with a key, and what would be right."""


def _once_each(pairs: list[tuple[str, object]]) -> dict:
    """An object of JSON, of which Python would take the last of two values with one name."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise _WrongError(f'"{twice}" stands twice in one object')
    return found


def _key(entry) -> Key:
    if not isinstance(entry, dict):
        raise _WrongError(
            f'a key is an object such as {{"to_world": [...]}}, and this is {_word(entry)}'
        )
    known = {"to_world", "cell", *PARAMETERS}
    for name in entry:
        if name not in known:
            near = nearest(name, known)
            raise _WrongError(
                f'there is no "{name}"'
                + (f': did you mean "{near}"?' if near else "")
                + f"; a key may have {', '.join(sorted(known))}"
            )
    parameters = {}
    for name, (fits, what) in PARAMETERS.items():
        if name in entry:
            value = entry[name]
            if not (_is_number(value) and fits(value)):
                raise _WrongError(f'"{name}" must be {what}, and it is {_word(value)}')
            parameters[name] = float(value)
    return Key(_matrix(entry.get("to_world")), _cell(entry.get("cell", [0, 0, 0])), parameters)


def _matrix(value) -> list[float]:
    if not (isinstance(value, list) and len(value) == 16 and all(map(_is_number, value))):
        raise _WrongError(
            '"to_world" must be a list of 16 numbers, row by row as in Mitsuba\'s <matrix>, and it '
            f"is {_word(value)}"
        )
    matrix = [float(c) for c in value]
    if not all(abs(c) < FAR for c in matrix):
        raise _WrongError('the numbers of "to_world" must be below 1e15')
    if any(abs(a - b) > SKEW for a, b in zip(matrix[12:], (0, 0, 0, 1))):
        raise _WrongError(
            '"to_world" must end in the row 0, 0, 0, 1 (the numbers go row by row), and it ends in '
            f"{', '.join(f'{c:g}' for c in matrix[12:])}"
        )
    columns = [matrix[i:12:4] for i in range(3)]
    sizes = [math.hypot(*column) for column in columns]
    if not all(size > 1 / FAR for size in sizes):
        raise _WrongError('the first three columns of "to_world" must be longer than 1e-15')
    for i in range(3):
        a, b = columns[i - 1], columns[i]
        cosine = sum(x * y for x, y in zip(a, b)) / (sizes[i - 1] * sizes[i])
        if not abs(cosine) <= SKEW:
            raise _WrongError(
                'the first three columns of "to_world" must be at right angles, as a camera\'s '
                "sides are"
            )
    return matrix


def _cell(value) -> tuple[int, int, int]:
    if (
        isinstance(value, list)
        and len(value) == 3
        and all(type(c) is int and abs(c) <= MOST_CELLS for c in value)
    ):
        return value[0], value[1], value[2]
    raise _WrongError(
        f'"cell" must be a list of three whole numbers up to a million, and it is {_word(value)}'
    )


def _is_number(value) -> bool:
    # json reads NaN and Infinity, too, and whole numbers that no float holds
    return type(value) in (int, float) and abs(value) < 1e300


def _word(value) -> str:
    if value is None:
        return "none"
    if isinstance(value, list):
        strange = [item for item in value if not _is_number(item)]
        return f"a list of {len(value)}" + (f" with {_word(strange[0])}" if strange else "")
    if isinstance(value, dict):
        return "an object"
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
