"""Fog: a homogeneous medium that the command puts around every sensor of a scene without media."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from .scene_files import number_text

# Where a sky stands at 12 cells, fog of 0.15 lets T = 17 % of its light through. Without objects,
# what it scatters makes T / (1 - albedo (1 - T)) of that: 28 % at 0.5, where pictures are dark and
# what is far is black; 66 % at 0.9, where it is pale; at 0.99 near colours fade, too, and paths are
# long.
ALBEDO = 0.9
MOST = 1e6  # per cell: nothing is seen through less, and float32 holds it in cells of any use


@dataclass(frozen=True)
class Fog:
    """Extinction ``density`` (per cell) and single-scattering ``albedo``, in plain values."""

    density: float
    albedo: float = ALBEDO

    @property
    def settings(self) -> dict[str, float]:
        """By the names of the command's options, as a still's settings and its header tell them."""
        return {"fog": self.density, "fog_albedo": self.albedo}

    def medium(self, nil: mi.Integrator) -> mi.Medium:
        """The fog as a medium; ``nil``: the integrator whose cells it is measured in."""
        sigma_t, albedo = self._numbers(nil)
        return mi.load_dict(
            {
                "type": "homogeneous",
                "id": "fog",  # as warnings call it
                "sigma_t": float(sigma_t),
                "albedo": float(albedo),
            }
        )

    def thicken(self, medium: mi.Medium, nil: mi.Integrator) -> None:
        """Make a `medium` of another fog's as dense as this one."""
        parameters = mi.traverse(medium)
        parameters["sigma_t.value.value"] = float(self._numbers(nil)[0])
        parameters.update()

    def _numbers(self, nil):
        # What the lines that are printed say, so that they give the same picture
        return number_text(self.density / nil.cell_size), number_text(self.albedo)

    def fill(self, scene: mi.Scene, nil: mi.Integrator) -> str:
        """Let all sensors of a loaded scene be in the fog; what is to be said of it.

        ``nil`` as of `medium`.
        """
        sigma_t, albedo = self._numbers(nil)
        medium = self.medium(nil)
        for sensor in scene.sensors():
            # A wrapper asks for the first one's, whichever renders; a batch's own is that of all
            sensor.set_medium(medium)
        return (
            "--fog: it is kept by these lines in every sensor:\n"
            '    <medium type="homogeneous">\n'
            f'        <float name="sigma_t" value="{sigma_t}"/>'
            f'<float name="albedo" value="{albedo}"/>\n'
            "    </medium>"
        )
