"""Denoising with Intel's Open Image Denoise."""

from __future__ import annotations

import importlib.util

import drjit as dr
import mitsuba as mi

# The network sees black beyond an image, which darkens and blotches the border. It shall see this
# many pixels of the mirror image instead; more of them gain little.
MARGIN = 16


def denoise(
    picture: mi.TensorXf,
    albedo: mi.TensorXf | None = None,
    normal: mi.TensorXf | None = None,
    quick: bool = False,
) -> mi.TensorXf:
    """`picture` without most of its noise.

    `picture` has the shape (height, width, 3), linear RGB, or (height, width, 4) with alpha, which
    is passed on as it is; `albedo` and `normal` have the shape (height, width, 3) and show it
    where edges and textures are. `normal` is in any orthonormal frame and needs `albedo`. Noise
    must differ from pixel to pixel: only a film with a "box" filter has such. Values that are not
    finite count as black. ``quick`` takes a lighter network and no care of the border, in a third
    of the time.

    Raises ValueError for other shapes and ImportError if the package ``mitsuba-oidn`` is missing.
    """
    oidn = _oidn()
    height, width, channels = _shape(picture)
    if channels not in (3, 4):
        raise ValueError(f"denoising needs RGB or RGBA, and this picture has {channels} channels.")
    if albedo is None and normal is not None:
        raise ValueError("denoising with normals needs the albedo, too.")
    for name, guide in (("albedo", albedo), ("normal", normal)):
        if guide is not None and _shape(guide) != (height, width, 3):
            raise ValueError(
                f"denoising needs {name} of the shape {(height, width, 3)}, "
                f"and this one has {guide.shape}."
            )

    if quick:
        return oidn.denoise(picture, albedo, normal, hdr=True, quality=oidn.Quality.Fast)
    guides = [None if guide is None else _framed(guide) for guide in (albedo, normal)]
    colour = oidn.denoise(_framed(picture[:, :, :3]), *guides, hdr=True)
    colour = colour[MARGIN : MARGIN + height, MARGIN : MARGIN + width]
    colour = type(picture)(colour)
    return dr.concat((colour, picture[:, :, 3:]), axis=2) if channels == 4 else colour


def through_media(
    albedo: mi.TensorXf, normal: mi.TensorXf, transmittance: mi.TensorXf
) -> tuple[mi.TensorXf, mi.TensorXf]:
    """The guides as they are seen through media: edges and textures fade as they do in the picture.

    All have the shape (height, width, 3). What media scatter has no edges, the albedo 1 and no
    normal, as what mirrors reflect.
    """
    seen = (transmittance[:, :, :1] + transmittance[:, :, 1:2] + transmittance[:, :, 2:]) / 3
    return 1 + (albedo - 1) * transmittance, normal * seen


def can_denoise() -> bool:
    """Whether the denoiser is installed."""
    return importlib.util.find_spec("mitsuba_oidn") is not None


def _oidn():
    try:
        import mitsuba_oidn
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "denoising needs the package mitsuba-oidn: pip install 'nil-mitsuba[denoise]'"
        ) from None
    return mitsuba_oidn


def _shape(image: mi.TensorXf) -> tuple[int, ...]:
    if image.ndim != 3:
        raise ValueError(
            f"denoising needs images of three dimensions, and this one has {image.ndim}."
        )
    return image.shape


def _framed(image: mi.TensorXf) -> mi.TensorXf32:
    """The image with its mirror image around it, in finite numbers."""
    height, width = image.shape[:2]
    image = mi.TensorXf32(dr.select(dr.isfinite(image), image, 0))
    return image[_mirrored(height)][:, _mirrored(width)]


def _mirrored(size: int) -> mi.UInt32:
    """Indices of the pixels of a row of `size`, continued by mirroring on both sides."""
    period = 2 * size
    start = period * -(-MARGIN // period) - MARGIN  # so that no index is negative
    index = (dr.arange(mi.UInt32, size + 2 * MARGIN) + start) % period
    return dr.select(index < size, index, period - 1 - index)
