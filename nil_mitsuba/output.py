"""A still's picture in files, with what it takes to render it again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from . import exr, png
from .checkpoint import Checkpoint
from .layers import GUIDES
from .stills import Picture
from .sums import name_noise, name_passes

# Of the metadata, what a PNG file tells, too: which frame of which flight it is.
IN_PNG = ("flight",)


@dataclass(frozen=True)
class Output:
    """Where a picture goes: ``exr``, ``png`` or both (paths), and how it is written.

    ``denoise`` removes noise, guided by the layers `GUIDES`; of the layers, those in ``layers`` are
    written.
    """

    exr: Path | None = None
    png: Path | None = None
    exposure: float = 0.0
    filmic: bool = False
    compression: str = "zip"
    denoise: bool = False
    layers: tuple[str, ...] = ()

    def write(self, picture: Picture, metadata: dict) -> None:
        """Write the files; raises OSError if one cannot be written, and ValueError."""
        image = picture.image
        layers = {name: picture.layers[name] for name in self.layers}
        if self.denoise:
            from . import denoise

            albedo, normal = (picture.layers[name] for name in GUIDES)
            passed = picture.layers.get("transmittance")
            if passed is not None:
                albedo, normal = denoise.through_media(albedo, normal, passed)
            image = denoise.denoise(image, albedo, normal)
            layers["noisy"] = picture.image[:, :, :3]
        if self.exr:
            exr.write(
                self.exr,
                (picture.names, image),
                layers,
                metadata,
                component_format=picture.component_format,
                compression=self.compression,
            )
        if self.png:
            png.write(
                self.png,
                png.linear_rgb(picture.names, image),
                exposure=self.exposure,
                filmic=self.filmic,
                texts={name: metadata[name] for name in IN_PNG if name in metadata},
            )


def metadata_of(state: Checkpoint) -> dict:
    """What an EXR file tells of a still: how to render it again, and how it was rendered."""
    settings, passes = state.settings, state.sums.passes
    integrator = dict(settings["integrator"])
    integrator["cell_origin"] = ",".join(f"{c:.9g}" for c in integrator["cell_origin"])
    about = {key: value for key, value in state.about.items() if key != "count"}
    noise: float | str = name_noise(state.noise, state.sums.count)
    if state.noise is not None and math.isfinite(state.noise):
        noise = float(f"{state.noise:.3g}")  # what it is good for, and what "info" then prints
    return {
        **about,
        "sceneHash": settings["scene"],
        **{key: settings[key] for key in ("fog", "fog_albedo") if key in settings},
        "sensor": settings["sensor"],
        "seed": settings["seed"],
        "spp": state.sums.count * settings["pass_spp"],
        "passes": f"{name_passes(passes)} of {settings['pass_spp']} samples per pixel",
        "noise": noise,
        "layers": ",".join(settings["layers"]),
        "renderTime": state.seconds,
        "variant": settings["variant"],
        "software": software(settings["versions"]),
        **integrator,
    }


def software(versions: dict[str, str]) -> str:
    """Names and versions of programs as one text."""
    return ", ".join(f"{name} {version}" for name, version in versions.items())
