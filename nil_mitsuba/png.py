"""Pictures for the screen: exposure, tone curve, sRGB, dithering, PNG files."""

from __future__ import annotations

import os
from collections.abc import Mapping

import drjit as dr
import mitsuba as mi

from .files import replacing

MAX_EXPOSURE = 100  # stops; float32 has 127 on either side

SIGNATURE = b"\x89PNG\r\n\x1a\n"
WHITE = 255

# Narkowicz' fit of ACES' curve for screens: x (a x + b) / (x (c x + d) + e).
CURVE = (2.51, 0.03, 2.43, 0.59, 0.14)
CURVE_END = 8.0  # the fit reaches 1 at 7.2

# A grey of 18 % is what exposure is measured for. The curve takes 0.1302 to 0.18; scaled by the
# quotient it leaves that grey alone, and changes contrast and highlights only.
MID_GREY = 0.18
CURVE_SCALE = 0.1301707 / MID_GREY

# The numbers of Roberts' sequence R2, 1/ρ and 1/ρ² with ρ³ = ρ + 1, as fractions of 2^32: its
# points fill each small block of pixels evenly.
R2 = (3242174889, 2447445414)

# Thresholds are the middles of 2^10 intervals from 0 to 1. They so keep a distance from either end
# that is far above rounding errors: what lies on a level stays on it.
THRESHOLD_BITS = 10


def write(
    path: str | os.PathLike,
    image: mi.TensorXf,
    *,
    exposure: float = 0.0,
    filmic: bool = False,
    dither: bool = True,
    texts: Mapping[str, str] | None = None,
) -> None:
    """Write an image as a PNG file with 8 bits in sRGB.

    `image` has the shape (height, width, channels): linear RGB with the primaries of sRGB, or one
    channel of luminance, and after them alpha, by which they are multiplied, if there is one more.
    `exposure` is in stops. `texts`, in ASCII, become the file's, by keyword: ``texts_of`` reads
    them. The other parameters are those of ``levels``. Raises ValueError for another shape or
    exposure and OSError if the file cannot be written; a file that `path` named before is then as
    it was.
    """
    pixels = levels(image, exposure=exposure, filmic=filmic, dither=dither)
    formats = mi.Bitmap.PixelFormat
    pixel_format = (formats.Y, formats.YA, formats.RGB, formats.RGBA)[image.shape[2] - 1]
    stream = mi.MemoryStream()
    bitmap = mi.Bitmap(pixels, pixel_format)
    for keyword, text in (texts or {}).items():
        bitmap.metadata()[keyword] = text
    bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    with replacing(path) as part, open(part, "wb") as file:
        file.write(stream.raw_buffer())


def texts_of(path: str | os.PathLike) -> dict[str, str]:
    """The texts in a PNG file, by keyword.

    Raises OSError if it cannot be read and ValueError if it is no PNG file or not whole.
    """
    try:
        with open(path, "rb") as file:
            start = file.read(len(SIGNATURE))
    except OSError as error:
        raise OSError(f'cannot read "{path}": {error.strerror or error}.') from None
    if start != SIGNATURE:
        raise ValueError(f'"{path}" is not a PNG file.')
    try:
        metadata = mi.Bitmap(str(path)).metadata()
    except RuntimeError:
        raise ValueError(f'"{path}" is damaged.') from None
    # Mitsuba writes texts in quotation marks, and reads these, too
    return {
        keyword: metadata[keyword].removeprefix('"').removesuffix('"')
        for keyword in metadata.keys()
        if isinstance(metadata[keyword], str)
    }


def levels(
    image: mi.TensorXf, *, exposure: float = 0.0, filmic: bool = False, dither: bool = True
) -> mi.TensorXu8:
    """What ``write`` puts into a file: sRGB in whole numbers from 0 to 255, of `image`'s shape.

    With `filmic`, colours go through ``filmic_curve`` first. With `dither`, a value between two
    levels becomes one or the other such that the mean over a few pixels is kept; values on a
    level, black and white among them, stay on it. Colours are divided by alpha, as the format
    asks for. Not-a-number is black.
    """
    if image.ndim != 3 or not 1 <= image.shape[2] <= 4:
        raise ValueError(
            "a PNG file needs an image of the shape (height, width, 1 to 4 channels), and this "
            f"one has {image.shape}."
        )
    if not abs(exposure) <= MAX_EXPOSURE:
        raise ValueError(
            f"the exposure must be between -{MAX_EXPOSURE} and {MAX_EXPOSURE} stops, "
            f"and {exposure} is not."
        )
    height, width, channels = image.shape
    colours = channels if channels % 2 else channels - 1
    image = mi.TensorXf32(image)

    colour, alpha = image[:, :, :colours], image[:, :, colours:]
    if colours < channels:
        alpha = dr.select(alpha > 0, dr.minimum(alpha, 1), 0)
        colour = dr.select(alpha > 0, colour / alpha, 0)
    colour = colour * dr.opaque(mi.Float32, 2.0**exposure)  # one kernel for all exposures
    colour = dr.select(colour > 0, colour, 0)
    if filmic:
        colour = filmic_curve(colour)
    colour = dr.select(colour < 1, WHITE * dr.linear_to_srgb(colour), WHITE)
    colour = dr.floor(colour + (_thresholds(height, width) if dither else 0.5))
    if colours < channels:
        alpha = dr.round(WHITE * alpha)
        colour = dr.concat((colour, alpha), axis=2)
    return mi.TensorXu8(dr.minimum(colour, WHITE))


def filmic_curve(x):
    """A film's response: more contrast in dark tones, highlights that fade out, 1 beyond 10.

    K. Narkowicz, "ACES Filmic Tone Mapping Curve" (2016),
    https://knarkowicz.wordpress.com/2016/01/06/aces-filmic-tone-mapping-curve/, scaled such that
    it leaves a grey of 18 % as it is. `x` is linear and not negative.
    """
    a, b, c, d, e = CURVE
    x = dr.minimum(CURVE_SCALE * x, CURVE_END)
    return dr.minimum(x * (a * x + b) / (x * (c * x + d) + e), 1)


def linear_rgb(names: list[str], image: mi.TensorXf) -> mi.TensorXf:
    """The colours of a film, and its alpha if there is one, as ``write`` takes them.

    `names` are those of the film's channels; "X", "Y", "Z" become RGB, others than colours and
    alpha are left out. Raises ValueError if there are no colours.
    """
    for colours in ("RGB", "XYZ", "Y"):
        if set(colours) <= set(names):
            break
    else:
        raise ValueError(f"there are no colours among the channels {', '.join(names)}.")
    planes = [image[:, :, names.index(name)] for name in colours]
    if colours == "XYZ":
        xyz = mi.Color3f(*(plane.array for plane in planes))
        planes = [mi.TensorXf(c, image.shape[:2]) for c in mi.xyz_to_srgb(xyz)]
    if "A" in names:
        planes.append(image[:, :, names.index("A")])
    return dr.concat([plane[:, :, None] for plane in planes], axis=2)


def _thresholds(height: int, width: int) -> mi.TensorXf32:
    """A number between 0 and 1 for each pixel, always the same."""
    pixel = dr.arange(mi.UInt32, height * width)
    number = (pixel % width) * R2[0] + (pixel // width) * R2[1]  # modulo 2^32
    number >>= 32 - THRESHOLD_BITS
    return mi.TensorXf32((mi.Float32(number) + 0.5) * 2.0**-THRESHOLD_BITS, (height, width, 1))
