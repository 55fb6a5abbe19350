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
from .layers import LAYERS, channel_names
from .lights import Lights, LightSample, lobe_angle
from .passes import Passes
from .quotient import Space, multiply_cells
from .shapes import ROUNDING, ROUNDINGS, Shapes, name_of
from .tracer import Cone, Tracer

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


class NilIntegrator(ADIntegrator):
    """Path tracer whose rays are geodesics of Nil, in plain Nil or in the quotient by Γ.

    Parameters: ``max_depth`` (−1), ``rr_depth`` (5) and ``hide_emitters`` (false) as in ``path``;
    ``twist`` (1); ``quotient`` (true); ``fibres`` ("z"), the scene's axis along which they run;
    ``cell_origin`` (0, 0, 0) and ``cell_size`` (1), in scene units; ``tolerance`` (0.25), in
    pixels; ``max_distance`` of one segment, in cells (12 in the quotient, unlimited in plain Nil);
    ``aovs``, layers to render beside the picture (none of them; a list such as "distance, normal").
    It offers no gradients and no participating media.
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
        _warn_of_what_is_ignored(scene, view.shapes, self)
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
        view = View(scene, self)
        camera = Camera(scene.sensors()[0], view.space, self.tolerance)
        p, v, cone, far = camera.start(ray, mi.Float(0))
        # Wrappers shrink the differentials with the sample count; the cone is a whole pixel's.
        scale = math.sqrt(sampler.sample_count())
        cone = Cone(cone.width * scale, cone.spread * scale)
        radiance, valid, seen = self.trace(view, sampler, ray, p, v, cone, far, mi.Bool(active))
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
        active: mi.Bool,
    ):
        """Radiance along the geodesics from ``p`` (cells) in frame direction ``v``.

        What lies beyond the length ``far`` (cells) is hidden from the camera. Returns the radiance,
        whether the path met anything that makes its pixel opaque, and the channels of each layer at
        the path's first vertex.
        """
        scene, space, tracer = view.scene, view.space, view.tracer
        lights = view.lights
        sampling = self.emitter_sampling and lights.exist
        bsdf_ctx = mi.BSDFContext()
        depth_limit = 0xFFFFFFFF if self.max_depth == -1 else self.max_depth

        # --------------------- Configure loop state ----------------------

        # fmt: off
        p, v = mi.Point3f(p), mi.Vector3f(v)   # Start of the current segment, cells and frame
        cone = Cone(cone.width, cone.spread, cone.soft)   # How far off the segment may be
        depth = mi.UInt32(0)                   # Depth of current vertex
        L = mi.Spectrum(0)                     # Radiance accumulator
        β = mi.Spectrum(1)                     # Path throughput weight
        η = mi.Float(1)                        # Index of refraction
        active = mi.Bool(active) & (depth_limit > 0)
        valid = mi.Bool(not self.hide_emitters and depth_limit > 0
                        and scene.environment() is not None)

        # Variables caching information from the previous bounce
        vertex_prev     = mi.Point3f(p)        # Its position (cells)
        bsdf_pdf_prev   = mi.Float(1)
        bsdf_delta_prev = mi.Bool(True)
        spent           = mi.Float(0)          # Length of the camera segment before hidden lights
        far             = dr.minimum(far, tracer.max_distance)
        seen            = view.nothing_seen()  # Layers
        # fmt: on

        if self.hide_emitters:
            p, v, cone, spent = self._beyond_lights(view, ray.time, p, v, cone, far, active)

        # What the loop leaves as it is need not be part of its state
        while dr.hint(active, exclude=[ray, far, spent]):
            # --------------------- The next vertex ---------------------

            start, home = mi.Point3f(p), mi.Vector3i(0)
            if space.quotient:
                p, home = geometry.wrap(p, space.twist)
            limit = dr.select(depth == 0, far - spent, tracer.max_distance)
            hit = tracer.intersect(p, v, cone, tracer.reach(p, v, limit), active, ray.time)
            si = surface_interaction(hit, v, space, ray.wavelengths)

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
            growth = dr.select(cone.soft, WIDENING, 1) * cone.spread
            width = dr.fma(growth, hit.distance, cone.width)

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
                penumbra = dr.minimum(PENUMBRA * light.angle, 1)
                spread = dr.select(
                    cone.soft,
                    view.rough_spread,
                    dr.maximum(cone.spread, view.rough_spread * penumbra),
                )
                active_em &= self._visible(view, si, margin, light, Cone(width, spread), active_em)
                L += dr.select(active_em, Lr_dir, 0)

            # ----------------------- BSDF sampling -----------------------

            v = si.to_world(bsdf_sample.wo)
            p = offset(si.p, si.n, v, margin, space)
            β *= bsdf_weight
            η *= bsdf_sample.eta
            valid |= (
                active & si.is_valid() & ~mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null)
            )

            # Information about the current vertex needed by the next iteration
            vertex_prev = space.to_cells(si.p)
            bsdf_pdf_prev = bsdf_sample.pdf
            bsdf_delta_prev = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)

            # The pixel's cone goes on growing behind mirrors and glass; a rough lobe widens it.
            lobe = dr.minimum(lobe_angle(bsdf_sample.pdf), 1)
            cone.width = width
            cone.soft |= active_next & ~bsdf_delta_prev & (lobe > SOFT_LOBE)
            cone.spread = dr.select(
                bsdf_delta_prev, cone.spread, dr.maximum(cone.spread, view.rough_spread * lobe)
            )

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
            p = geometry.multiply(
                mi.Point3f(geometry.inverse(home, space.integer_twist)), p, space.twist
            )
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


def _warn_of_what_is_ignored(scene, shapes, integrator):
    """Log a warning of the shapes outside the quotient's cube, and one each for what of a shape
    lies nowhere, and for media."""
    lower = list(integrator.cell_origin)
    upper = [c + integrator.cell_size for c in lower]
    margin = 1e-4 * integrator.cell_size  # a wall on a face is inside, whatever was rounded
    outside = []
    for shape, extent in zip(shapes.shapes, shapes.extents):
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
        if shape.is_medium_transition():
            mi.Log(mi.LogLevel.Warn, f"nil: the medium of the shape {name_of(shape)} is ignored.")
    if outside and not integrator.cell_is_known:
        reach, name = max(outside)
        others = f" (the farthest of {len(outside)})" if len(outside) > 1 else ""
        mi.Log(
            mi.LogLevel.Warn,
            f"nil: the shape {name} reaches {reach:.4g} scene units out of the cube {lower} to "
            f"{upper}{others}: what lies outside is never seen. Move it, or set cell_origin and "
            "cell_size.",
        )
    for kind, endpoints in (("sensor", scene.sensors()), ("emitter", scene.emitters())):
        for endpoint in endpoints:
            if endpoint.get_medium() is not None:
                name = f'"{endpoint.id()}"' if endpoint.id() else endpoint.class_name()
                mi.Log(mi.LogLevel.Warn, f"nil: the medium of the {kind} {name} is ignored.")


class View:
    """A scene seen through one integrator's parameters: what a pass needs besides its samples."""

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
        self.tracer = Tracer(scene, self.space, integrator.max_distance, self.shapes, focus)
        self.lights = Lights(scene, self.space, integrator.max_distance)
        self.rough_spread = dr.opaque(mi.Float, ROUGH_SPREAD * integrator.tolerance)
        self.layers = [layer for layer in integrator.layers if LAYERS[layer].rule != "count"]
        if "shape" in self.layers:
            self._number_shapes()

    def margin(self, hit, si) -> mi.Float:
        """How far (scene units) off a surface that was hit the next ray starts."""
        margin = self.shapes.margin(si, hit.preliminary.t)
        # Cells are counted from the origin
        return dr.maximum(margin, ROUNDINGS * ROUNDING * self.space.largest)

    def nothing_seen(self) -> dict[str, list]:
        """The channels of each layer where a path meets nothing."""

        def nothing(layer):
            mean = LAYERS[layer].rule == "mean"
            return mi.Float(0) if mean else mi.Int32(-(layer == "shape"))

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
                if mi.is_spectral:
                    # Under a light of equal energies. Single samples of a colour may be anything
                    albedo *= dr.rcp(mi.pdf_rgb_spectrum(si.wavelengths))
                    rgb = mi.spectrum_to_srgb(albedo, si.wavelengths)
                else:
                    rgb = dr.clip(albedo, 0, 1)
                found[layer] = [dr.select(smooth, rgb[i % len(rgb)], 1) for i in range(3)]
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
