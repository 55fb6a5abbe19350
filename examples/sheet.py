"""Several pictures as one, for the programs beside this file."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

GAP = 8  # pixels between two pictures


def contact_sheet(pictures: list[mi.TensorXf], columns: int) -> mi.TensorXf:
    """Pictures of one size (height, width, 3) in rows of ``columns``, on white."""
    height, width, channels = pictures[0].shape
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    shape = (rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, channels)
    sheet = dr.full(mi.TensorXf, 1, shape=shape)
    for i, picture in enumerate(pictures):
        row, column = divmod(i, columns)
        y, x = row * (height + GAP), column * (width + GAP)
        sheet[y : y + height, x : x + width, :] = picture.array
    return sheet
