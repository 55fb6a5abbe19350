"""A scene seen through one integrator's parameters: what a pass needs besides its samples."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from .layers import LAYERS
from .lights import Lights, LightSample, lobe_angle
from .media import Media, is_passable
from .quotient import multiply_cells
from .shapes import ROUNDING, ROUNDINGS, Shapes, name_of
from .tracer import Cone, Tracer

if TYPE_CHECKING:
    from .integrator import NilIntegrator

# After a bounce that scatters into a lobe of one radian, a ray may be off by this angle per pixel
# of tolerance; its lobe blurs what lies behind it. On the bent Cornell box halving it moves the
# mean by less than 0.1 % and costs a tenth more time.
ROUGH_SPREAD = 0.8
# A lobe narrower than this (radians) is a mirror's for the tracer: hits stay exact behind it.
SOFT_LOBE = 0.1
# Behind a rough bounce, the part of a ray's spread by which the next ray's error grows: lobes blur
# what lies behind them, not the contact that the next ray starts from.
WIDENING = 0.25
# Towards a light a ray may be off by the angle that a rough bounce would allow it, times so many
# half angles of the light: the shadow's edge is as wide as the light.
PENUMBRA = 3


class View:
    """A scene seen through one integrator's parameters: what a pass needs besides its samples.

    ``passable``: whether light goes straight through any of its surfaces.
    """

    def __init__(
        self,
        scene: mi.Scene,
        integrator: NilIntegrator,
        general: bool = False,
        sensor: mi.Sensor | None = None,
    ):
        if dr.flag(dr.JitFlag.FreezingScope):
            raise RuntimeError(
                'the integrator "nil" takes numbers from the scene that a frozen function would '
                "keep when the scene changes: render without dr.freeze."
            )
        self.scene = scene
        self.space = integrator.space(general)
        self.shapes = Shapes(scene)
        focus = None
        if sensor is not None:
            to_world = sensor.world_transform().matrix
            focus = mi.ScalarPoint3f([to_world[i, 3][0] for i in range(3)])
        self.media = Media(scene, sensor, self.space, self.shapes)
        self.passable = is_passable(scene)
        reach = self.media.reach(integrator.max_distance)
        # A set distance is that of the sky, however dense the air before it
        ends = self.space.quotient and math.isinf(integrator.max_distance)
        horizon = reach if ends else integrator.max_distance
        self.tracer = Tracer(scene, self.space, horizon, self.shapes, focus)
        self.lights = Lights(scene, self.space, reach)
        self.rough_spread = dr.opaque(mi.Float, ROUGH_SPREAD * integrator.tolerance)
        self.layers = [layer for layer in integrator.layers if LAYERS[layer].rule != "count"]
        if "shape" in self.layers:
            self._number_shapes()

    def margin(self, hit, si) -> mi.Float:
        """How far (scene units) off a surface that was hit the next ray starts."""
        margin = self.shapes.margin(si, hit.preliminary.t)
        # Cells are counted from the origin
        return dr.maximum(margin, ROUNDINGS * ROUNDING * self.space.largest)

    def widened(self, cone: Cone, length: mi.Float) -> mi.Float:
        """Width of a ray's cone after a ``length`` (cells)."""
        growth = dr.select(cone.soft, WIDENING, 1) * cone.spread
        return dr.fma(growth, length, cone.width)

    def shadow_cone(self, cone: Cone, width: mi.Float, light: LightSample) -> Cone:
        """How far a ray towards a light may be off, from the end of another ray's cone."""
        penumbra = dr.minimum(PENUMBRA * light.angle, 1)
        spread = dr.maximum(cone.spread, self.rough_spread * penumbra)
        return Cone(width, dr.select(cone.soft, self.rough_spread, spread))

    def scattered(self, cone: Cone, width: mi.Float, pdf: mi.Float, rough: mi.Bool) -> Cone:
        """The cone behind a vertex that was reached by another, and has the density ``pdf`` over
        directions if it is ``rough``.

        The pixel's cone goes on growing behind mirrors and glass; a rough lobe widens it.
        """
        lobe = dr.minimum(lobe_angle(pdf), 1)
        soft = cone.soft | (rough & (lobe > SOFT_LOBE))
        spread = dr.maximum(cone.spread, self.rough_spread * lobe)
        return Cone(width, dr.select(rough, spread, cone.spread), soft)

    def nothing_seen(self) -> dict[str, list]:
        """The channels of each layer where a path meets nothing."""

        def nothing(layer):
            if LAYERS[layer].rule == "mean":
                return mi.Float(layer == "transmittance")
            return mi.Int32(-(layer == "shape"))

        return {layer: [nothing(layer) for _ in LAYERS[layer].channels] for layer in self.layers}

    @dr.syntax
    def see(self, seen, hit, si, home, spent, first):
        """The channels of each layer after a vertex, which counts where ``first``."""
        if dr.hint(len(self.layers) > 0, mode="scalar"):
            first = first & si.is_valid()
            if first:  # a branch: later vertices need not compute them
                seen = self._channels_of(hit, si, home, spent, first)
        return seen

    def _channels_of(self, hit, si, home, spent, first):
        found = {}
        for layer in self.layers:
            if layer == "distance":
                found[layer] = [(spent + hit.distance) * self.space.size]
            elif layer == "position":
                found[layer] = list(si.p)
            elif layer == "normal":
                found[layer] = list(si.sh_frame.n)
            elif layer == "albedo":
                bsdf = si.bsdf()
                albedo = bsdf.eval_diffuse_reflectance(si, first)
                # What only reflects and refracts shows other things' colours: white, for denoisers
                smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                rgb = to_rgb(albedo, si.wavelengths)
                found[layer] = [dr.select(smooth, c, 1) for c in rgb]
            elif layer == "transmittance":  # of a vacuum; that of media is found on the way
                found[layer] = [mi.Float(1)] * 3
            elif layer == "cell":
                found[layer] = list(multiply_cells(home, hit.cell, self.space))
            elif layer == "shape":
                shape = dr.select(si.instance == None, si.shape, si.instance)  # noqa: E711
                number = dr.reinterpret_array(mi.UInt32, shape)
                found[layer] = [dr.gather(mi.Int32, self.shape_numbers, number, first)]
        return found

    def _number_shapes(self):
        pointers = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s))[0] for s in self.scene.shapes()]
        numbers = [-1] * (max(pointers, default=0) + 1)
        for number, pointer in enumerate(pointers):
            numbers[pointer] = number
        self.shape_numbers = mi.Int32(numbers)


def to_rgb(spectrum: mi.UnpolarizedSpectrum, wavelengths: mi.Color0f) -> list[mi.Float]:
    """What a surface or a medium leaves of a light of equal energies, as red, green and blue."""
    if mi.is_spectral:
        # Single samples of a colour may be anything
        spectrum = spectrum * dr.rcp(mi.pdf_rgb_spectrum(wavelengths))
        return list(mi.spectrum_to_srgb(spectrum, wavelengths))
    spectrum = dr.clip(spectrum, 0, 1)
    return [spectrum[i % len(spectrum)] for i in range(3)]


def warn_of_what_is_ignored(view, integrator):
    """Log a warning of the shapes outside the quotient's cube, and one each for what of a shape
    lies nowhere, and of what media do not do."""
    lower = list(integrator.cell_origin)
    upper = [c + integrator.cell_size for c in lower]
    margin = 1e-4 * integrator.cell_size  # a wall on a face is inside, whatever was rounded
    outside = []
    for shape, extent in zip(view.shapes.shapes, view.shapes.extents):
        if extent.lost:
            mi.Log(
                mi.LogLevel.Warn,
                f"nil: of the shape {name_of(shape)}, {extent.lost}: they are never seen.",
            )
        reach = 0
        if integrator.quotient and extent.box.valid():
            box = extent.box
            reach = max(max(lower[i] - box.min[i], box.max[i] - upper[i]) for i in range(3))
        if reach > margin:
            outside.append((reach, name_of(shape)))
    if outside and not integrator.cell_is_known:
        reach, name = max(outside)
        others = f" (the farthest of {len(outside)})" if len(outside) > 1 else ""
        mi.Log(
            mi.LogLevel.Warn,
            f"nil: the shape {name} reaches {reach:.4g} scene units out of the cube {lower} to "
            f"{upper}{others}: what lies outside is never seen. Move it, or set cell_origin and "
            "cell_size.",
        )
    for sentence in view.media.warnings(integrator.max_distance):
        mi.Log(mi.LogLevel.Warn, f"nil: {sentence}")
