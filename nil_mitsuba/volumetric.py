"""The path tracing loop of scenes that hold participating media.

As in Mitsuba's ``volpath``, boundaries of the same index are no vertices: they count no bounce,
shadow rays go through them, and a geodesic goes on behind them as the one that it was.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import mis_weight

from . import geometry
from .interaction import offset, surface_interaction
from .lights import LightSample
from .media import NEAR
from .quotient import multiply_cells, seen_from
from .tracer import Cone, line_ray, random_of
from .view import to_rgb

if TYPE_CHECKING:
    from .integrator import NilIntegrator, View

# A shadow ray that can bring no more than this part of its light is traced so much more seldom,
# which saves a third of the time for the same error of a small lamp in fog
# (benchmarks/emitter_sampling.py), and more where the sky is the light.
DIM = 0.5


class VolumetricPaths:
    """Traces the paths of one view, in which there are media."""

    def __init__(self, integrator: NilIntegrator, view: View):
        self.integrator = integrator
        self.view = view
        self.media = view.media
        self.sampling = integrator.emitter_sampling and view.lights.exist

    @dr.syntax
    def trace(
        self,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        p: mi.Point3f,
        v: mi.Vector3f,
        cone: Cone,
        far: mi.Float,
        first: mi.Vector3f,
        active: mi.Bool,
    ):
        """As `NilIntegrator.trace`."""
        integrator, view, media = self.integrator, self.view, self.media
        scene, space, tracer, lights = view.scene, view.space, view.tracer, view.lights
        bsdf_ctx, phase_ctx = mi.BSDFContext(), mi.PhaseFunctionContext()
        depth_limit = dr.opaque(
            mi.UInt32, 0xFFFFFFFF if integrator.max_depth == -1 else integrator.max_depth
        )

        # --------------------- Configure loop state ----------------------

        # fmt: off
        p, v = mi.Point3f(p), mi.Vector3f(v)   # Start of the current piece, cells and frame
        cone = Cone(cone.width, cone.spread, cone.soft)   # How far off the piece may be
        medium = dr.zeros(mi.MediumPtr, dr.width(p))   # What it is in
        depth = mi.UInt32(0)                   # Depth of current vertex
        L = mi.Spectrum(0)                     # Radiance accumulator
        β = mi.Spectrum(1)                     # Path throughput weight
        η = mi.Float(1)                        # Index of refraction
        active = mi.Bool(active) & (depth_limit > 0)
        valid = mi.Bool(not integrator.hide_emitters and scene.environment() is not None)
        valid &= depth_limit > 0

        # Throughput is over the density of the channel that draws lengths; the others', over that
        channel = mi.UInt32(0)
        densities = mi.UnpolarizedSpectrum(1)

        # The last vertex that turned light, and the geodesic from there
        vertex_prev     = mi.Point3f(p)        # Its position (cells)
        start           = mi.Point3f(p)        # Of the geodesic, beside it
        pdf_prev        = mi.Float(1)
        delta_prev      = mi.Bool(True)        # No emitter was sampled there
        travelled       = mi.Float(0)          # Length (cells) of the geodesic before this piece
        cell            = mi.Vector3i(0)       # Deck element of this piece's start, seen from there
        far             = dr.minimum(far, tracer.max_distance)
        # fmt: on
        if dr.hint(media.filling is not None, mode="scalar"):
            medium = mi.MediumPtr(media.filling)
        seen = view.nothing_seen()
        if dr.hint(len(view.layers) > 0, mode="scalar"):
            seen = self._first_surface(seen, ray, p, v, cone, far, medium, active)
        if dr.hint(media.coloured, mode="scalar"):
            channels = len(densities)
            channel = dr.minimum(mi.UInt32(sampler.next_1d() * channels), channels - 1)

        while dr.hint(active, exclude=[ray, far, first, channel]):
            if dr.hint(space.quotient, mode="scalar"):
                p, home = geometry.wrap(p, space.twist)
                p = mi.Point3f(p)
                medium = self._behind_face(medium, p, home, active, ray.time)
                if dr.hint(self.sampling, mode="scalar"):
                    cell = multiply_cells(cell, home, space)

            # --------------------- The next vertex ---------------------

            limit = dr.select(depth == 0, far, tracer.max_distance) - travelled
            in_medium = active & (medium != None)  # noqa: E711 - an array of pointers
            left = media.interaction(medium, p, v, ray)
            free, seed = media.flight(left, p, limit, channel, sampler, in_medium)
            reach = tracer.reach(p, v, dr.minimum(free, limit))
            hit = tracer.intersect(p, v, cone, reach, active, ray.time, ends=True)
            length = dr.minimum(hit.distance, dr.minimum(free, limit))
            collided = in_medium & ~hit.valid & (free < limit)
            end = hit.end
            if dr.hint(not space.quotient, mode="scalar"):
                end = self._at(p, v, dr.select(collided, free, 0))
            arrival = dr.select(collided, self._turned(v, free), hit.arrival)
            mei = media.interaction(medium, end, arrival, ray)

            f, r = media.weights(left, p, length, mei, collided, channel, seed, in_medium)
            β *= dr.select(in_medium, f, 1)
            densities *= dr.select(in_medium, r, 1)
            w = self._over_all_channels(densities)
            depth[collided] += 1

            # --------------------- Direct emission ---------------------

            v_start = dr.select(depth == 0, first, self._turned(v, -travelled))
            si = surface_interaction(hit, v_start, space, ray.wavelengths)
            on_surface = active & si.is_valid()
            emitter = si.emitter(scene)
            glows = active & ~collided & (emitter != None)  # noqa: E711
            unseen = mi.Bool(False)
            if dr.hint(integrator.hide_emitters, mode="scalar"):
                unseen = glows & (depth == 0)
                glows &= ~unseen
            Le = emitter.eval(si, glows)
            if dr.hint(self.sampling, mode="scalar"):
                lit = glows & ~delta_prev
                image = multiply_cells(cell, hit.cell, space)
                whole = replace(hit, distance=hit.distance + travelled)
                beside = dr.select(travelled > 0, vertex_prev, start)
                if lit:
                    em_pdf = lights.pdf(
                        whole, si, emitter, vertex_prev, beside, v_start, image, lit
                    )
                    Le *= mis_weight(pdf_prev, em_pdf)
            L += dr.select(glows, β * Le * w, 0)

            # --------------------- Emitter sampling ---------------------

            more = depth + dr.select(collided, 0, 1) < depth_limit
            scatters = collided & more
            bsdf = si.bsdf()
            margin = view.margin(hit, si)
            width = view.widened(cone, length)
            phase = medium.phase_function()

            samples_light = scatters & medium.use_emitter_sampling()
            active_em = samples_light | (
                on_surface & ~unseen & more & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            )
            light = dr.zeros(LightSample)
            wo = mi.Vector3f(0, 0, 1)
            if dr.hint(self.sampling, mode="scalar"):
                vertex = dr.zeros(mi.Interaction3f)
                vertex.p = dr.select(collided, mei.p, si.p)
                vertex.time, vertex.wavelengths = ray.time, ray.wavelengths
                light = lights.sample(vertex, sampler, active_em)
                active_em &= dr.any(light.weight != 0)
                wo = si.to_local(light.direction)

            # ------------- Evaluate and sample BSDF and phase function -------------

            u1, u2 = sampler.next_1d(), sampler.next_2d()
            bsdf_val, bsdf_pdf, bsdf_sample, bsdf_weight = bsdf.eval_pdf_sample(
                bsdf_ctx, si, wo, u1, u2, on_surface
            )
            value, pdf = bsdf_val, bsdf_pdf
            if dr.hint(self.sampling, mode="scalar"):
                phase_val, phase_pdf = phase.eval_pdf(
                    phase_ctx, mei, light.direction, active_em & collided
                )
                value = dr.select(collided, phase_val, value)
                pdf = dr.select(collided, phase_pdf, pdf)
            phase_wo, phase_weight, phase_pdf = phase.sample(phase_ctx, mei, u1, u2, scatters)

            # --------------- Emitter sampling contribution ----------------

            if dr.hint(self.sampling, mode="scalar"):
                mis_em = dr.select(light.delta, 1, mis_weight(light.pdf, pdf))
                Lr_dir = β * value * light.weight * mis_em * w
                active_em &= dr.any(Lr_dir != 0)
                shadow = view.shadow_cone(cone, width, light)
                beside = offset(si.p, si.n, light.direction, margin, space)
                beside = dr.select(collided, end, beside)
                medium_em = self._beyond(medium, si, light.direction, active_em & on_surface)
                Lr_dir *= self._transmitted(
                    sampler, vertex, beside, light, shadow, medium_em, active_em
                )
                L += dr.select(active_em, Lr_dir, 0)

            # ----------------------- The next direction -----------------------

            v_surface = si.to_world(bsdf_sample.wo)
            null = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null)
            through = on_surface & (null | unseen)
            if dr.hint(integrator.hide_emitters, mode="scalar"):
                bsdf_weight = dr.select(unseen, 1, bsdf_weight)
                v_surface = dr.select(unseen, arrival, v_surface)
            weight = dr.select(collided, phase_weight, bsdf_weight)
            v = dr.select(collided, phase_wo, v_surface)
            p = dr.select(collided, end, offset(si.p, si.n, v, margin, space))
            β *= weight
            η[on_surface & ~unseen] *= bsdf_sample.eta
            turned = collided | (on_surface & ~through)
            valid |= turned
            medium = self._beyond(medium, si, v, on_surface)

            vertex_prev = dr.select(
                turned, space.to_cells(dr.select(collided, mei.p, si.p)), vertex_prev
            )
            start = dr.select(turned, p, start)
            pdf = dr.select(collided, phase_pdf, bsdf_sample.pdf)
            delta = dr.select(
                collided,
                ~samples_light,
                mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta),
            )
            pdf_prev = dr.select(turned, pdf, pdf_prev)
            delta_prev = dr.select(turned, delta, delta_prev)
            travelled = dr.select(turned, 0, travelled + length)
            cell = dr.select(turned, 0, multiply_cells(cell, hit.cell, space))

            cone = view.scattered(cone, width, pdf, turned & (collided | ~delta))

            # --------------------- Stopping criterion ---------------------

            depth[turned & on_surface] += 1
            active &= (scatters | on_surface) & (depth < depth_limit)
            β_max = dr.max(mi.unpolarized_spectrum(β * self._over_all_channels(densities)))
            rr_prob = dr.minimum(β_max * dr.square(η), 0.95)
            rr_active = turned & (depth >= integrator.rr_depth)
            rr_continue = sampler.next_1d() < rr_prob
            β[rr_active] *= dr.rcp(rr_prob)
            active &= (~rr_active | rr_continue) & (β_max != 0)

        return dr.select(valid, L, 0), valid, seen

    @dr.syntax
    def _first_surface(self, seen, ray, p, v, cone, far, medium, active):
        """The layers' channels of what a camera ray would meet if no medium met it before, behind
        boundaries of the same index. Draws nothing from the sampler: the picture stays as it is."""
        view, media = self.view, self.media
        space, tracer = view.space, view.tracer
        p, v, active, medium = mi.Point3f(p), mi.Vector3f(v), mi.Bool(active), mi.MediumPtr(medium)
        cone = Cone(cone.width, cone.spread)
        travelled, cell = mi.Float(0), mi.Vector3i(0)
        passed, seed = mi.UnpolarizedSpectrum(1), media.seed(random_of(p, v))
        while dr.hint(active, exclude=[ray, far]):
            if dr.hint(space.quotient, mode="scalar"):
                p, home = geometry.wrap(p, space.twist)
                p, cell = mi.Point3f(p), multiply_cells(cell, home, space)
                medium = self._behind_face(medium, p, home, active, ray.time)
            inside = active & (medium != None)  # noqa: E711 - an array of pointers
            mei = media.interaction(medium, p, v, ray)
            left = dr.minimum(far - travelled, media.deep(mei, inside))
            hit = tracer.intersect(p, v, cone, tracer.reach(p, v, left), active, ray.time)
            length = dr.minimum(hit.distance, left)
            part = media.transmittance(mei, p, length, seed, inside)
            passed *= dr.select(inside, part, 1)
            seed += 1

            si = surface_interaction(hit, v, space, ray.wavelengths)
            active &= hit.valid
            # Nothing but what light goes straight through
            kinds = si.bsdf().flags() & int(mi.BSDFFlags.All)
            through = kinds == int(mi.BSDFFlags.Null)
            if dr.hint(self.integrator.hide_emitters, mode="scalar"):
                through |= si.shape.emitter() != None  # noqa: E711
            seen = view.see(seen, hit, si, cell, travelled, active & ~through)
            active &= through
            p = offset(si.p, si.n, hit.arrival, view.margin(hit, si), space)
            medium = self._beyond(medium, si, hit.arrival, active)
            cone.width = dr.fma(cone.spread, length, cone.width)
            v = hit.arrival
            travelled += length
            cell = multiply_cells(cell, hit.cell, space)
        if dr.hint("transmittance" in view.layers, mode="scalar"):
            seen = seen | {"transmittance": to_rgb(passed, ray.wavelengths)}
        return seen

    @dr.syntax
    def _behind_face(self, medium, p, home, active, time):
        """The medium at the start ``p`` of a ray that has left its cell by the face on which it met
        a surface: what lies on the face behind it, in this cell, was passed, too."""
        if dr.hint(self.media.on_faces, mode="scalar"):
            passed = active & dr.any(home != 0)
            if passed:
                view, space = self.view, self.view.space
                ahead = _first_axis(home)
                start = space.to_scene(p - NEAR * ahead)
                length = 2 * NEAR * space.size
                ray = line_ray(start, space.to_scene_axes(ahead), time, length)
                found = view.scene.ray_intersect_preliminary(ray, coherent=False, active=passed)
                si = found.compute_surface_interaction(ray, mi.RayFlags.Minimal, passed)
                medium = self._beyond(medium, si, ray.d, passed & si.is_valid())
        return medium

    def _beyond(self, medium, si, v, active):
        """The medium behind a surface that is passed in direction ``v``."""
        crosses = active & si.is_medium_transition()
        return dr.select(crosses, si.target_medium(v), medium)

    def _over_all_channels(self, densities):
        """What weighs a path that any of the channels might have drawn."""
        if not self.media.coloured:
            return mi.Float(1)
        return dr.rcp(dr.mean(densities))

    def _at(self, p, v, length):
        """The point (cells) at a ``length`` (cells) of the geodesic from ``p``."""
        space = self.view.space
        return mi.Point3f(geometry.flow(p, space.to_cell_axes(v), length, space.twist)[0])

    def _turned(self, v, length):
        """The frame direction ``v`` of a geodesic at a ``length`` (cells) from there."""
        space = self.view.space
        if space.flat:
            return v
        d = space.to_cell_axes(v)
        return space.to_scene_axes(geometry.turned(d, space.twist * d.z * length))

    def _transmitted(self, sampler, vertex, start, light, cone, medium, active):
        """What part of a light that was drawn at a ``vertex`` arrives at it.

        The geodesic begins at ``start`` (cells), beside the vertex, in the ``medium``.
        """
        view, media = self.view, self.media
        space, tracer = view.space, view.tracer
        p, d = space.to_cells(vertex.p), light.direction
        if space.quotient:
            start, home = geometry.wrap(start, space.twist)
            start = mi.Point3f(start)
            p = seen_from(home, p, space)
        # Light from infinity comes from as far as rays reach
        length = dr.minimum(light.reach, tracer.max_distance)
        u = sampler.next_1d(active)
        if view.passable:
            return self._through_surfaces(
                vertex, p, start, d, length, cone, medium, media.seed(u), active
            )
        inside = active & (medium != None)  # noqa: E711 - an array of pointers
        mei = media.interaction(medium, start, d, vertex)
        passed = media.transmittance(mei, start, length, media.seed(u), inside)
        passed = dr.select(inside, passed, 1)
        chance = dr.minimum(dr.max(passed) / DIM, 1)
        traced = active & (u < chance)
        reach = light.reach
        if view.lights.has_infinite:
            reach = dr.minimum(reach, tracer.reach(start, d))
        blocked = tracer.occluded(p, start, d, cone, reach, traced, vertex.time)
        return dr.select(traced & ~blocked, passed / chance, 0)

    @dr.syntax
    def _through_surfaces(self, vertex, p, start, v, left, cone, medium, seed, active):
        """`_transmitted` where there may be surfaces that light goes straight through."""
        view, media = self.view, self.media
        space, tracer = view.space, view.tracer
        p, start, v = mi.Point3f(p), mi.Point3f(start), mi.Vector3f(v)
        left, active, medium = mi.Float(left), mi.Bool(active), mi.MediumPtr(medium)
        cone = Cone(cone.width, cone.spread)
        passed = mi.UnpolarizedSpectrum(1)
        while dr.hint(active, exclude=[vertex]):
            reach = dr.minimum(left, tracer.reach(start, v))
            hit = tracer.obstacle(p, start, v, cone, reach, active, vertex.time)
            length = dr.minimum(hit.distance, left)
            inside = active & (medium != None)  # noqa: E711 - an array of pointers
            mei = media.interaction(medium, p, v, vertex)
            part = media.transmittance(mei, p, length, seed, inside)
            passed *= dr.select(inside, part, 1)
            seed += 1

            active &= hit.valid
            si = surface_interaction(hit, v, space, vertex.wavelengths)
            part = mi.unpolarized_spectrum(si.bsdf().eval_null_transmission(si, active))
            passed *= dr.select(active, part, 1)
            # What is dim is followed more seldom
            most = dr.max(passed)
            chance = dr.minimum(most / DIM, 1)
            goes_on = mi.sample_tea_float32(seed, 0) < chance
            passed *= dr.select(active & (chance < 1), dr.select(goes_on, dr.rcp(chance), 0), 1)
            active &= goes_on & (most > 0)

            # To the side to which the chord went on, wherever the geodesic beside it goes
            side = -si.to_world(si.wi)
            start = offset(si.p, si.n, side, view.margin(hit, si), space)
            medium = self._beyond(medium, si, side, active)
            p, v, left = hit.end, hit.arrival, left - length
            cone.width = dr.fma(cone.spread, length, cone.width)
            if dr.hint(space.quotient, mode="scalar"):
                start, home = geometry.wrap(start, space.twist)
                start = mi.Point3f(start)
                p = seen_from(home, p, space)
                medium = self._behind_face(medium, start, home, active, vertex.time)
        return passed


def _first_axis(home):
    """The first axis along which ``home`` is another cell, and which way."""
    x, y, z = (dr.clip(mi.Float(step), -1, 1) for step in home)
    y = dr.select(x != 0, 0, y)
    return mi.Vector3f(x, y, dr.select((x != 0) | (y != 0), 0, z))
