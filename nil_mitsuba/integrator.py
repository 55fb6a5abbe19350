"""The integrator ``nil``: unidirectional path tracing along the geodesics of Nil."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator, mis_weight

from . import geometry, parameters
from .camera import Camera
from .errors import raising_causes
from .interaction import offset, surface_interaction
from .layers import channel_names
from .lights import LightSample
from .passes import Passes
from .quotient import Space, multiply_cells, seen_from
from .tracer import Cone
from .view import View, warn_of_what_is_ignored
from .volumetric import VolumetricPaths


class NilIntegrator(ADIntegrator):
    """Path tracer whose rays are geodesics of Nil, in plain Nil or in the quotient by Γ.

    Parameters: ``max_depth`` (−1), ``rr_depth`` (5) and ``hide_emitters`` (false) as in ``path``;
    ``twist`` (1); ``quotient`` (true); ``fibres`` ("z"), the scene's axis along which they run;
    ``cell_origin`` (0, 0, 0) and ``cell_size`` (1), in scene units; ``tolerance`` (0.25), in
    pixels; ``max_distance`` of one segment, in cells (12 in the quotient, unlimited in plain Nil);
    ``aovs``, layers to render beside the picture (none of them; a list such as "distance, normal").
    Media are those of ``volpath``; it offers no gradients.
    """

    _given: dict = {}  # Parameters that are not left to their defaults

    def __init__(self, props: mi.Properties):
        super().__init__(mi.Properties())
        # Tests switch emitter sampling off: estimates are then exact where furnaces are.
        self.emitter_sampling = True
        # Whoever has said more of shapes outside of the cell than the warning has it left out.
        self.cell_is_known = False
        self._set({name: props.get(name) for name in props.keys()})

    def __setattr__(self, name, value):
        # What is set on an integrator that is there is checked as what a scene file says
        if name in ("emitter_sampling", "cell_is_known"):
            super().__setattr__(name, value)
        else:
            self._set(self._given | {name: value})

    def _set(self, given: dict) -> None:
        for name, value in (parameters.checked(given) | {"_given": given}).items():
            super().__setattr__(name, value)

    def to_string(self) -> str:
        return (
            f"NilIntegrator[\n  twist = {self.twist:g},\n  quotient = {self.quotient},\n"
            f"  fibres = {self.fibres},\n"
            f"  cell_origin = {list(self.cell_origin)},\n  cell_size = {self.cell_size:g},\n"
            f"  tolerance = {self.tolerance:g},\n  max_distance = {self.max_distance:g},\n"
            f"  max_depth = {self.max_depth},\n  rr_depth = {self.rr_depth},\n"
            f"  hide_emitters = {self.hide_emitters}\n]"
        )

    # ---------------------------------------------------------------- rendering

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """Render an image (mi.TensorXf); Mitsuba's entry, see ``mi.render``."""
        seed = int(seed[0]) if dr.is_array_v(seed) else int(seed)
        passes = Passes(self, scene, sensor, seed, spp)
        sums = passes.nothing()
        for index in range(passes.count):
            sums = sums.plus(passes.render(index))
        image = passes.develop(sums)
        if not develop:
            return mi.TensorXf()
        if evaluate:
            dr.eval(image)
        return image

    def space(self, general: bool = False) -> Space:
        """The space that the parameters describe; ``general`` as of `Space`."""
        return Space(
            self.twist,
            self.quotient,
            list(self.cell_origin),
            self.cell_size,
            general,
            self.fibres,
        )

    def view(self, scene: mi.Scene, general: bool = False, sensor: mi.Sensor | None = None) -> View:
        """The scene as this integrator's parameters show it; ``general`` as of `Space`, ``sensor``
        the one around which empty space is known best."""
        view = View(scene, self, general, sensor)
        warn_of_what_is_ignored(view, self)
        return view

    def aov_names(self) -> list[str]:
        """Names of the channels that the layers add to the picture's."""
        return channel_names(self.layers)

    @raising_causes
    def sample(self, mode, scene, sampler, ray, active=True, **_):
        """One sample per ray, for integrators that wrap this one (``moment``, ``aov``).

        They do not say which sensor the ray is from: it is taken for a ray of the scene's first.
        """
        mi.Log(
            mi.LogLevel.Warn,
            "nil: inside another integrator; if that is aov, its own layers are traced straight.",
        )
        view = View(scene, self, sensor=scene.sensors()[0])
        camera = Camera(scene.sensors()[0], view.space, self.tolerance)
        p, v, cone, far, first = camera.start(ray, mi.Float(0))
        # Wrappers shrink the differentials with the sample count; the cone is a whole pixel's.
        scale = math.sqrt(sampler.sample_count())
        cone = Cone(cone.width * scale, cone.spread * scale)
        radiance, valid, seen = self.trace(
            view, sampler, ray, p, v, cone, far, first, mi.Bool(active)
        )
        # What is not seen in the scene is the number of samples: this one
        aovs = [mi.Float(channel) for layer in self.layers for channel in seen.get(layer, [1])]
        return radiance, valid, aovs, None

    def render_forward(self, *_, **__):
        raise RuntimeError(
            'the integrator "nil" offers no gradients: render_forward is not available.'
        )

    def render_backward(self, *_, **__):
        raise RuntimeError(
            'the integrator "nil" offers no gradients: render_backward is not available.'
        )

    # ------------------------------------------------------------- path tracing

    @dr.syntax
    def trace(
        self,
        view: View,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        p: mi.Point3f,
        v: mi.Vector3f,
        cone: Cone,
        far: mi.Float,
        first: mi.Vector3f,
        active: mi.Bool,
    ):
        """Radiance along the geodesics from ``p`` (cells) in frame direction ``v``.

        What lies beyond the length ``far`` (cells) is hidden from the camera, which sees the
        environment in the frame direction ``first``. Returns the radiance,
        whether the path met anything that makes its pixel opaque, and the channels of each layer at
        the path's first vertex.
        """
        if dr.hint(view.media.exist, mode="scalar"):
            return VolumetricPaths(self, view).trace(sampler, ray, p, v, cone, far, first, active)
        scene, space, tracer = view.scene, view.space, view.tracer
        lights = view.lights
        sampling = self.emitter_sampling and lights.exist
        bsdf_ctx = mi.BSDFContext()
        # Opaque: pictures of other depths need no other kernel
        depth_limit = dr.opaque(mi.UInt32, 0xFFFFFFFF if self.max_depth == -1 else self.max_depth)

        # --------------------- Configure loop state ----------------------

        # fmt: off
        p, v = mi.Point3f(p), mi.Vector3f(v)   # Start of the current segment, cells and frame
        cone = Cone(cone.width, cone.spread, cone.soft)   # How far off the segment may be
        depth = mi.UInt32(0)                   # Depth of current vertex
        L = mi.Spectrum(0)                     # Radiance accumulator
        β = mi.Spectrum(1)                     # Path throughput weight
        η = mi.Float(1)                        # Index of refraction
        active = mi.Bool(active) & (depth_limit > 0)
        valid = mi.Bool(not self.hide_emitters and scene.environment() is not None)
        valid &= depth_limit > 0

        # Variables caching information from the previous bounce
        vertex_prev     = mi.Point3f(p)        # Its position (cells)
        bsdf_pdf_prev   = mi.Float(1)
        bsdf_delta_prev = mi.Bool(True)
        sky             = mi.Vector3f(first)   # Direction before surfaces that turn no light
        spent           = mi.Float(0)          # Length of the camera segment before hidden lights
        far             = dr.minimum(far, tracer.max_distance)
        seen            = view.nothing_seen()  # Layers
        # fmt: on

        if self.hide_emitters:
            p, v, cone, spent = self._beyond_lights(view, ray.time, p, v, cone, far, active)

        # What the loop leaves as it is need not be part of its state
        while dr.hint(active, exclude=[ray, far, first, spent]):
            # --------------------- The next vertex ---------------------

            start, home = mi.Point3f(p), mi.Vector3i(0)
            if space.quotient:
                p, home = geometry.wrap(p, space.twist)
            limit = dr.select(depth == 0, far - spent, tracer.max_distance)
            hit = tracer.intersect(p, v, cone, tracer.reach(p, v, limit), active, ray.time)
            v_start = v
            if dr.hint(view.passable, mode="scalar"):
                v_start = sky
            elif dr.hint(not space.flat, mode="scalar"):
                v_start = dr.select(depth == 0, first, v)
            si = surface_interaction(hit, v_start, space, ray.wavelengths)

            seen = view.see(seen, hit, si, home, spent, active & (depth == 0))

            # --------------------- Direct emission ---------------------

            emitter = si.emitter(scene)
            Le = emitter.eval(si, active)
            if sampling:
                # A light that emitter sampling could have drawn is shared with it
                lit = active & ~bsdf_delta_prev & (emitter != None)  # noqa: E711
                image = multiply_cells(home, hit.cell, space)
                if lit:  # few are: most packets of rays need not compute the density
                    em_pdf = lights.pdf(hit, si, emitter, vertex_prev, start, v, image, lit)
                    Le *= mis_weight(bsdf_pdf_prev, em_pdf)
            L += β * Le

            # Continue tracing the path at this point?
            active_next = (depth + 1 < depth_limit) & si.is_valid()
            bsdf = si.bsdf()
            margin = view.margin(hit, si)
            width = view.widened(cone, hit.distance)

            # --------------------- Emitter sampling ---------------------

            wo = mi.Vector3f(0, 0, 1)
            active_em = active_next & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            light = dr.zeros(LightSample)
            if sampling:
                light = lights.sample(si, sampler, active_em)
                active_em &= dr.any(light.weight != 0)
                wo = si.to_local(light.direction)

            # ------ Evaluate BSDF * cos(theta) and sample direction -------

            bsdf_val, bsdf_pdf, bsdf_sample, bsdf_weight = bsdf.eval_pdf_sample(
                bsdf_ctx,
                si,
                wo,
                sampler.next_1d(),
                sampler.next_2d(),
                active & si.is_valid(),  # at the last vertex, whether it is seen through counts
            )

            # --------------- Emitter sampling contribution ----------------

            if sampling:
                mis_em = dr.select(light.delta, 1, mis_weight(light.pdf, bsdf_pdf))
                Lr_dir = β * bsdf_val * light.weight * mis_em
                active_em &= dr.any(Lr_dir != 0)
                shadow = view.shadow_cone(cone, width, light)
                active_em &= self._visible(view, si, margin, light, shadow, active_em)
                L += dr.select(active_em, Lr_dir, 0)

            # ----------------------- BSDF sampling -----------------------

            v = si.to_world(bsdf_sample.wo)
            p = offset(si.p, si.n, v, margin, space)
            β *= bsdf_weight
            η *= bsdf_sample.eta
            valid |= (
                active & si.is_valid() & ~mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null)
            )

            if dr.hint(view.passable, mode="scalar"):
                straight = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null)
                sky = dr.select(straight, sky, v)

            # Information about the current vertex needed by the next iteration
            vertex_prev = space.to_cells(si.p)
            bsdf_pdf_prev = bsdf_sample.pdf
            bsdf_delta_prev = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)

            cone = view.scattered(cone, width, bsdf_sample.pdf, ~bsdf_delta_prev)

            # --------------------- Stopping criterion ---------------------

            depth[si.is_valid()] += 1
            β_max = dr.max(mi.unpolarized_spectrum(β))

            # Russian roulette (η² cancels the radiance scaling inside a dielectric)
            rr_prob = dr.minimum(β_max * dr.square(η), 0.95)
            rr_active = depth >= self.rr_depth
            β[rr_active] *= dr.rcp(rr_prob)
            rr_continue = sampler.next_1d() < rr_prob
            active = active_next & (~rr_active | rr_continue) & (β_max != 0)

        return dr.select(valid, L, 0), valid, seen

    def _visible(self, view, si, margin, light, cone, active):
        """Whether nothing stands between a surface and the light drawn there."""
        space, tracer = view.space, view.tracer
        p = space.to_cells(si.p)
        start = offset(si.p, si.n, light.direction, margin, space)
        if space.quotient:
            start, home = geometry.wrap(start, space.twist)
            p = seen_from(home, p, space)
        reach = light.reach
        if view.lights.has_infinite:
            reach = dr.minimum(reach, tracer.reach(start, light.direction))
        return ~tracer.occluded(p, start, light.direction, cone, reach, active, si.time)

    @dr.syntax
    def _beyond_lights(self, view, time, p, v, cone, far, active):
        """Where a camera ray goes on behind the area lights that it meets first."""
        space, tracer = view.space, view.tracer
        spent = mi.Float(0)
        active = mi.Bool(active)
        while active:
            if space.quotient:
                p = mi.Point3f(geometry.wrap(p, space.twist)[0])
            hit = tracer.intersect(p, v, cone, tracer.reach(p, v, far - spent), active, time)
            si = surface_interaction(hit, v, space, mi.Color0f())
            active &= hit.valid & (si.shape.emitter() != None)  # noqa: E711
            start = offset(si.p, si.n, hit.arrival, view.margin(hit, si), space)
            p = dr.select(active, start, p)
            v = dr.select(active, hit.arrival, v)
            cone.width = dr.select(
                active, dr.fma(cone.spread, hit.distance, cone.width), cone.width
            )
            spent = dr.select(active, spent + hit.distance, spent)
        return p, v, cone, spent
