"""Writing OpenEXR files."""

from __future__ import annotations

import re

import mitsuba as mi


def write_film(path: str, film: mi.Film, metadata: dict[str, str | int | float]) -> None:
    """Write what a film has developed as an OpenEXR file with one named channel for each of its.

    Channels are named as the film names them (R, G, B, A, ...) and stored in the film's
    ``component_format``. `metadata` becomes attributes of the file's header. The OpenEXR package,
    and NumPy with it, is imported here and not before. Raises OSError or RuntimeError if the file
    cannot be written.
    """
    import OpenEXR

    image = film.develop()
    names = [field.name for field in film.bitmap().struct_()]
    tensor = _tensor_type(film)
    channels = {
        name: OpenEXR.Channel(tensor(image[:, :, i]).numpy())  # shares memory through DLPack
        for i, name in enumerate(names)
    }
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **metadata,
    }
    with OpenEXR.File(header, channels) as file:
        file.write(path)


def _tensor_type(film: mi.Film) -> type:
    # A film tells its component format nowhere but in its description.
    match = re.search(r"component_format = (\w+)", str(film))
    types = {"float16": mi.TensorXf16, "float32": mi.TensorXf32, "uint32": mi.TensorXu32}
    return types[match[1]] if match else mi.TensorXf32
