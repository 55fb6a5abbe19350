"""Emitter sampling along geodesics: which light, which of its images, which connecting geodesic.

A point on an area light is joined by the minimising geodesic and weighted against BSDF sampling. A
point-like light is reached by every geodesic that joins it. In the quotient every light has an
image in every cell; one is chosen with a probability that follows the light it can bring.
Environments and directional lights are direction fields in the frame, read where a segment starts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import geometry
from .quotient import Space, opaque, table
from .shapes import margin_on
from .tracer import Hit

# Emitters that have a meaning in Nil, by the name of their class. (Mitsuba itself samples no
# directionalarea light and gives it no radiance: in a path tracer it is dark, here too.)
AREA = ("AreaLight",)
DARK = ("DirectionalArea",)
POINT = ("PointLight", "SpotLight", "Projector")
DIRECTIONAL = ("DirectionalEmitter",)
ENVIRONMENT = (
    "ConstantBackgroundEmitter",
    "EnvironmentMapEmitter",
    "SunskyEmitter",
    "TimedSunskyEmitter",
)


# By what part of its length a geodesic may end beside the point it was connected to: 30 roundings.
ARRIVAL_ROUNDING = 2**-19
# What leaves a light at a smaller cosine is so little that it may be hidden by the light itself.
GRAZING = 1 / 32


@dataclass
class LightSample:
    """Light that may arrive at a vertex.

    ``direction``: frame direction of the geodesic towards the light; ``reach``: length (cells)
    along it on which nothing may stand in the way, infinite for directional light; ``weight``:
    radiance over probability; ``pdf``: with respect to solid angle, 0 for ``delta`` light, which no
    other technique finds; ``angle``: half angle (radians) of the light that this image of it shows
    the receiver, 0 for ``delta`` light.
    """

    direction: mi.Vector3f
    reach: mi.Float
    weight: mi.Spectrum
    pdf: mi.Float
    delta: mi.Bool
    angle: mi.Float


def lobe_angle(pdf):
    """Half angle (radians) of a cone in which directions of solid-angle density ``pdf`` lie."""
    return dr.rsqrt(dr.pi * dr.maximum(pdf, 1e-8))


class Images:
    """Chooses one of the images g·q, g in Γ, of a point q for a receiver p, both in the unit cube.

    The light that an image brings goes with 1/A, A its area density. Seen from p, the image has
    the horizontal offset (x, y) and the symmetric height z. With 1/A ~ 1/(r² + z²) near p, and
    A growing like k² r⁴ far off, x is drawn from a density ~ 1/(s + |x|), y from 1/√(s² + x² + y²)
    and z from a Cauchy density as wide as r (1 + k r/6), or from one about ±2π/k, where geodesics
    meet again near a fibre; all cut off where an image is certainly beyond ``max_distance``. An
    image's probability is that of its own unit interval: differences of closed-form distribution
    functions. The nearest image and the nearest column of images get shares of their own.
    """

    # All three by experiment, against a choice in proportion to 1/A (benchmarks/emitter_sampling).
    # Cells: below, an image's interval does not tell 1/A from a constant.
    SOFTENING = 0.3
    # Cells: where the column of images along one fibre is as bright as all the others.
    COLUMN = 0.02
    # 1/A of the nearest image against the sum over all others, ~ 4π × five cells of free path.
    NEAREST = 60

    def __init__(self, space: Space, max_distance: float):
        k = abs(space.twist_number)
        self.space = space
        self.radius = dr.opaque(mi.Float, max_distance + 0.5)
        # |Z~| ≤ T + k T² (u − sin u)/2u², and the last factor is below 0.16
        self.height = dr.opaque(mi.Float, max_distance * (1 + 0.16 * k * max_distance) + 0.5)
        # Near a fibre the light that comes from beyond the height 2π/k is to that from below as
        # (2/π) atan √((k T/2π)² − 1) to 1 (∫ dz/A); a tenth before, as A falls towards it.
        beyond = (
            2 / math.pi * math.atan(math.sqrt(max((k * max_distance / (2 * math.pi)) ** 2 - 1, 0)))
        )
        self.focused = dr.opaque(mi.Float, max(beyond / (1 + beyond), 0.1) if k else 0)
        self.focus = dr.opaque(mi.Float, 2 * math.pi / k if k else 1)

    def _height_offset(self, p, q, gx, gy):
        """Symmetric height of g·q seen from p, without its integer part g_z."""
        k = self.space.twist
        x, y = gx + q.x - p.x, gy + q.y - p.y
        return q.z - p.z + k * (gx * q.y - p.x * y - 0.5 * x * y), x, y

    def _scales(self, x, y):
        s = self.SOFTENING
        rho = dr.sqrt(dr.fma(x, x, s * s))
        r = dr.sqrt(dr.fma(y, y, dr.square(rho)))
        return rho, r * dr.fma(dr.abs(self.space.twist) / 6, r, 1)

    def _focus_share(self, x, y):
        """Share of the heights about ±2π/k, where geodesics near a fibre meet again."""
        return self.focused / (1 + 0.25 * dr.square(self.space.twist) * (x * x + y * y))

    def _about_focus(self, z):
        """Angle of a height ≥ 0 in the Cauchy density about 2π/k, a third as wide."""
        return dr.atan((z - self.focus) * 3 / self.focus)

    def _nearest(self, p, q):
        gx, gy = -dr.round(q.x - p.x), -dr.round(q.y - p.y)
        offset, x, y = self._height_offset(p, q, gx, gy)
        gz = -dr.round(offset)
        square = dr.square(x) + dr.square(y) + dr.square(offset + gz)
        # Both shares vanish where two are equally near, at |x|, |y| or |z| = 1/2: rounding decides
        # between them there, and not always as it did when the light was sampled.
        share = dr.maximum(1 - 4 * square, 0) / dr.fma(self.NEAREST, square, 1)
        across = dr.square(x) + dr.square(y)
        # At most half: what a column brings from below the focus does not grow without bound.
        column = dr.maximum(1 - 4 * across, 0) * self.COLUMN / (2 * self.COLUMN + dr.sqrt(across))
        return mi.Vector3i(gx, gy, gz), share, column

    def choose(
        self, p: mi.Point3f, q: mi.Point3f, u1: mi.Float, u2: mi.Point2f
    ) -> tuple[mi.Vector3i, mi.Float]:
        """A deck element and its probability."""
        s, R, Z = self.SOFTENING, self.radius, self.height
        near, share, column = self._nearest(p, q)
        take_near = u1 < share
        u1 = (u1 - share) / (1 - share)
        take_column = u1 < column
        u1 = (u1 - column) / (1 - column)
        u1, u2, u3 = (2 * u - 1 for u in (u1, u2.x, u2.y))

        x = dr.copysign(s * (dr.exp(dr.abs(u1) * dr.log(1 + R / s)) - 1), u1)
        gx = dr.select(take_column, mi.Float(near.x), dr.round(x - (q.x - p.x)))
        _, dx, _ = self._height_offset(p, q, gx, 0)
        rho, _ = self._scales(dx, 0)
        y = rho * dr.sinh(u2 * dr.asinh(R / rho))
        gy = dr.select(take_column, mi.Float(near.y), dr.round(y - (q.y - p.y)))
        offset, dx, dy = self._height_offset(p, q, gx, gy)
        _, sigma = self._scales(dx, dy)
        focused = self._focus_share(dx, dy)
        u4 = dr.abs(u3)
        take_focus = u4 < focused
        u4 = dr.select(take_focus, u4 / focused, (u4 - focused) / (1 - focused))
        angle = dr.lerp(self._about_focus(mi.Float(0)), self._about_focus(Z), u4)
        z = dr.select(
            take_focus,
            self.focus * (1 + dr.tan(angle) / 3),
            sigma * dr.tan(u4 * dr.atan(Z / sigma)),
        )
        z = dr.copysign(z, u3)
        gz = dr.round(z - offset)

        g = dr.select(take_near, near, mi.Vector3i(gx, gy, gz))
        return g, self.probability(p, q, g)

    def probability(self, p: mi.Point3f, q: mi.Point3f, g: mi.Vector3i) -> mi.Float:
        """Probability with which `choose` draws the deck element ``g``."""
        s, R, Z = self.SOFTENING, self.radius, self.height
        near, share, column = self._nearest(p, q)
        gx, gy, gz = (mi.Float(c) for c in g)
        offset, x, y = self._height_offset(p, q, gx, gy)
        z = offset + gz
        rho, sigma = self._scales(x, y)

        def interval(f, t, bound):
            return f(dr.clip(t + 0.5, -bound, bound)) - f(dr.clip(t - 0.5, -bound, bound))

        def in_x(t):
            return dr.copysign(dr.log(1 + dr.abs(t) / s), t)

        def in_z(t):
            low, high = self._about_focus(mi.Float(0)), self._about_focus(Z)
            about = (self._about_focus(dr.abs(t)) - low) / (high - low)
            return dr.copysign(
                dr.lerp(
                    dr.atan(dr.abs(t) / sigma) / dr.atan(Z / sigma), about, self._focus_share(x, y)
                ),
                t,
            )

        across = (
            interval(in_x, x, R)
            / (2 * dr.log(1 + R / s))
            * interval(lambda t: dr.asinh(t / rho), y, R)
            / (2 * dr.asinh(R / rho))
        )
        is_column = (g.x == near.x) & (g.y == near.y)
        across = dr.fma(1 - column, across, dr.select(is_column, column, 0))
        far = across * interval(in_z, z, Z) / 2
        is_near = is_column & (g.z == near.z)
        return dr.fma(1 - share, far, dr.select(is_near, share, 0))


class Lights:
    """The emitters of a scene, seen from points in Nil."""

    def __init__(self, scene: mi.Scene, space: Space, max_distance: float):
        self.scene = scene
        self.space = space
        self.max_distance = dr.opaque(mi.Float, max_distance)
        emitters = scene.emitters()
        names = [emitter.class_name() for emitter in emitters]
        for emitter, name in zip(emitters, names):
            if name not in AREA + DARK + POINT + DIRECTIONAL + ENVIRONMENT:
                raise RuntimeError(
                    f'the integrator "nil" has no meaning for the emitter "{name}"'
                    f"{f' ({emitter.id()})' if emitter.id() else ''}: use area, point, spot, "
                    "projector, directional, constant, envmap or sunsky."
                )
        self.has_area = any(name in AREA for name in names)
        self.has_point = any(name in POINT for name in names)
        self.has_infinite = any(name in DIRECTIONAL + ENVIRONMENT for name in names)
        self.exist = self.has_area or self.has_point or self.has_infinite
        self.textures: list[mi.Texture] = []  # of the radiance of textured area lights
        if self.has_area:
            self._number_area_lights(emitters, names)
            self.turned_spheres = self._turned_spheres(emitters, names)

        weights = [emitter.sampling_weight() for emitter in emitters]
        self.uniform = all(weight == weights[0] for weight in weights)
        self.pmf = 1 / len(emitters) if self.uniform and emitters else 0
        self.weight_scale = 1 / sum(weights) if weights and not self.uniform else 0
        # All that is not minimising has half turns beyond π: arcs longer than 2π/|k|
        self.has_further = (
            space.twist_number != 0 and abs(space.twist_number) * max_distance > 2 * math.pi
        )
        if self.has_point:
            self.positions = self._point_positions(emitters, names)
        self.images = Images(space, max_distance) if space.quotient else None

    def _point_positions(self, emitters, names):
        """Positions (scene) of the point-like emitters, by their index among all emitters."""
        at = [[0.0, 0.0, 0.0]] * len(emitters)
        for i, (emitter, name) in enumerate(zip(emitters, names)):
            if name in POINT:
                # Mitsuba tells the position of every kind in a direction sample.
                sample, _ = emitter.sample_direction(dr.zeros(mi.Interaction3f), mi.Point2f(0.5))
                at[i] = [sample.p[axis][0] for axis in range(3)]
        return table(at)

    def _number_area_lights(self, emitters, names):
        """Tables of the densities of points on area lights, by the number of the emitter's pointer.

        An untextured light has one density per coordinate area (scene units). It is asked of each
        shape by itself: asked of an array of shapes, every kind that lives in the process answers,
        those that cannot be lights with an exception.
        """
        pointers = list(dr.reinterpret_array(mi.UInt32, self.scene.emitters_dr()))
        densities = [0.0] * (max(pointers) + 1)
        margins = [0.0] * len(emitters)
        # As the scene knows them: an emitter's own shape may not tell that it is a mesh
        shapes = {
            dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(shape.emitter()))[0]: shape
            for shape in self.scene.shapes()
            if shape.is_emitter()
        }
        textures = [-1] * len(densities)
        for i, (emitter, name, pointer) in enumerate(zip(emitters, names, pointers)):
            if name not in AREA:
                continue
            margins[i] = margin_on(shapes.get(pointer))
            if mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying):
                textures[pointer] = len(self.textures)
                self.textures.append(_radiance_texture(emitter))
            else:
                densities[pointer] = _density_on(emitter.get_shape())
        self.area_densities = opaque(mi.Float(densities))
        self.area_margins = opaque(mi.Float(margins))
        if self.textures:
            self.texture_numbers = opaque(mi.Int32(textures))

    def _turned_spheres(self, emitters, names):
        """Centres (scene) of glowing spheres whose normals Mitsuba forgets to turn, and which way
        those point, as points by the emitter's index; None if there are none."""
        centres, sides = [[0.0, 0.0, 0.0]] * len(emitters), [0.0] * len(emitters)
        for i, (emitter, name) in enumerate(zip(emitters, names)):
            shape = emitter.get_shape() if name in AREA else None
            if shape is None or shape.class_name() != "Sphere":
                continue
            u = mi.Point2f(0.3, 0.6)
            ps, centre = shape.sample_position(0, u), shape.bbox().center()
            outward = dr.normalize(ps.p - mi.Point3f(centre))
            side = dr.sign(dr.dot(ps.n, mi.warp.square_to_uniform_sphere(u)))
            if (side * dr.dot(outward, ps.n))[0] < 1 - 1e-5:
                centres[i], sides[i] = list(centre), side[0]
        if not any(sides):
            return None
        return table(centres), opaque(mi.Float(sides))

    # ---------------------------------------------------------------- sampling

    def sample(
        self, si: mi.SurfaceInteraction3f, sampler: mi.Sampler, active: mi.Bool
    ) -> LightSample:
        """Draw light that may arrive at a surface; visibility is left to the caller."""
        scene, space = self.scene, self.space
        p = space.to_cells(si.p)
        index, weight, _ = scene.sample_emitter(sampler.next_1d(), active)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active)
        u = sampler.next_2d()
        image_u1, image_u2 = mi.Float(0), mi.Point2f(0)
        if space.quotient and (self.has_area or self.has_point):
            image_u1, image_u2 = sampler.next_1d(), sampler.next_2d()

        kinds = self.has_area + self.has_point + self.has_infinite
        flags = emitter.flags() if kinds > 1 else None

        def among(flag):
            return active if kinds == 1 else active & mi.has_flag(flags, flag)

        sample = dr.zeros(LightSample)
        if self.has_infinite:
            lit = among(mi.EmitterFlags.Infinite)
            found = self._sample_infinite(emitter, si, u, lit)
            sample = dr.select(lit, found, sample)
        if self.has_area:
            lit = among(mi.EmitterFlags.Surface)
            found = self._sample_area(emitter, index, si, p, u, image_u1, image_u2, lit)
            sample = dr.select(lit, found, sample)
        if self.has_point:
            lit = among(mi.EmitterFlags.DeltaPosition)
            light = dr.gather(mi.Point3f, self.positions, index, lit)
            found = self._sample_point(emitter, light, si, p, u.x, image_u1, image_u2, lit)
            sample = dr.select(lit, found, sample)
        sample.weight *= weight
        sample.pdf /= weight
        return sample

    def _sample_infinite(self, emitter, si, u, active):
        ds, weight = emitter.sample_direction(si, u, active)
        return LightSample(
            mi.Vector3f(ds.d),
            mi.Float(dr.inf),
            dr.select(ds.pdf > 0, weight, 0),
            dr.select(ds.delta, 0, ds.pdf),
            mi.Bool(ds.delta),
            dr.select(ds.delta, 0, lobe_angle(ds.pdf)),
        )

    def _image_of(self, p, q, u1, u2):
        """An image (cells) of the point ``q`` of the unit cube, and its probability."""
        if self.images is None:
            return q, mi.Float(1)
        g, probability = self.images.choose(p, q, u1, u2)
        return mi.Point3f(geometry.multiply(mi.Point3f(g), q, self.space.twist)), probability

    def _in_cube(self, q):
        if not self.space.quotient:
            return mi.Bool(True)
        return dr.all((q >= 0) & (q <= 1))

    def _sample_area(self, emitter, index, si, p, u, u1, u2, active):
        space = self.space
        ps, area = emitter.sample_position(si.time, u, active)
        if self.turned_spheres is not None:
            centres, sides = self.turned_spheres
            side = dr.gather(mi.Float, sides, index, active)
            outward = dr.normalize(ps.p - dr.gather(mi.Point3f, centres, index, active))
            ps.n = dr.select(side != 0, side * outward, ps.n)
        q = space.to_cells(ps.p)
        active = active & self._in_cube(q) & (area > 0)
        image, probability = self._image_of(p, q, u1, u2)
        way = geometry.connect(p, image, space.twist)
        direction = space.to_scene_axes(mi.Vector3f(way.direction))
        arrival = mi.Vector3f(way.arrival)  # cell axes, as the next
        n = mi.Normal3f(geometry.conormal(q, space.to_cell_axes(ps.n), space.twist))
        stretch = dr.norm(n)
        cosine = -dr.dot(n, arrival) / stretch

        # Radiance where the emitter is seen from its front
        at_light = mi.SurfaceInteraction3f(ps, si.wavelengths)
        at_light.shape = emitter.get_shape()
        at_light.wi = mi.Vector3f(0, 0, 1)
        radiance = emitter.eval(at_light, active)
        density = way.area_density * dr.square(space.size)  # scene units
        density /= area * stretch * cosine
        pdf = probability * density
        reached = active & (cosine > 0) & (density > 0) & (way.distance <= self.max_distance)
        pdf = dr.select(reached, pdf, 0)
        # The light's own surface, met at a grazing angle, must not hide it
        margin = dr.gather(mi.Float, self.area_margins, index, active) * space.cells_per_unit
        margin = dr.fma(ARRIVAL_ROUNDING, way.distance, margin)
        reach = way.distance - margin / dr.maximum(cosine, GRAZING)
        return LightSample(
            direction,
            reach,
            dr.select(pdf > 0, radiance * dr.rcp(pdf), 0),
            pdf,
            mi.Bool(False),
            lobe_angle(density),
        )

    def _sample_point(self, emitter, light, si, p, u, u1, u2, active):
        space = self.space
        q = space.to_cells(light)
        if space.quotient:
            q = mi.Point3f(geometry.wrap(q, space.twist)[0])
        image, probability = self._image_of(p, q, u1, u2)
        way = geometry.connect(p, image, space.twist)
        if self.has_further:
            # One in (count + 1) goes to the minimising geodesic, the dimmest as a rule. Those of
            # the last intervals, seen from them as number n = 1, 2, … have 1/A ~ 1/n.
            count = further_intervals(p, image, space.twist, self.max_distance)
            minimising = dr.rcp(1 + count)
            further = u >= minimising
            v = 2 * (u - minimising) / (1 - minimising)
            second = v >= 1
            v = dr.select(second, v - 1, v)
            n = dr.clip(dr.floor(dr.power(1 + count, v)), 1, count)
            m = count + 1 - n
            exists, other = further_geodesic(p, image, space.twist, m, second)
            way = dr.select(further, other, way)
            active &= ~further | exists
            chosen = dr.log((n + 1) / n) / dr.log(1 + count)
            probability *= dr.select(further, 0.5 * (1 - minimising) * chosen, minimising)

        # What the emitter sends along the geodesic's last direction is its intensity: at a distance
        # L before the light L² times what it brings. Far beyond the light's own coordinates, so
        # that they take no digits of the direction.
        L = 8 * (1 + dr.max(dr.abs(light)))
        reference = dr.zeros(mi.Interaction3f)
        reference.p = dr.fma(-L, space.to_scene_axes(mi.Vector3f(way.arrival)), light)
        reference.wavelengths, reference.time = si.wavelengths, si.time
        ds, intensity = emitter.sample_direction(reference, mi.Point2f(0.5), active)
        density = dr.abs(way.area_density) * dr.square(space.size)
        reached = active & (density > 0) & (way.distance <= self.max_distance) & (ds.pdf > 0)
        intensity *= dr.square(L)
        weight = dr.select(reached, intensity * dr.rcp(density * probability), 0)
        reach = way.distance * (1 - ARRIVAL_ROUNDING)
        direction = space.to_scene_axes(mi.Vector3f(way.direction))
        return LightSample(direction, reach, weight, mi.Float(0), mi.Bool(True), mi.Float(0))

    # ------------------------------------------------------------------ weights

    def pdf(
        self,
        hit: Hit,
        si: mi.SurfaceInteraction3f,
        emitter: mi.EmitterPtr,
        p: mi.Point3f,
        start: mi.Point3f,
        v: mi.Vector3f,
        g: mi.Vector3i,
        active: mi.Bool,
    ) -> mi.Float:
        """Solid-angle density with which `sample` at ``p`` (cells) draws the light just found.

        The segment that found it started at ``start``, beside ``p``, in the frame direction ``v``.
        ``g``: deck element of the image that was hit, relative to the cell of ``p``. 0 where
        `sample` could not have drawn it.
        """
        result = mi.Float(0)
        if self.has_area:
            lit = active & hit.valid
            result = dr.select(lit, self._pdf_area(hit, si, emitter, p, start, g, lit), result)
        environment = self.scene.environment()
        if environment is not None:
            ds = dr.zeros(mi.DirectionSample3f)
            ds.d = v
            lit = active & ~hit.valid
            pdf = environment.pdf_direction(dr.zeros(mi.Interaction3f), ds, lit)
            result = dr.select(lit, pdf, result)
        if self.uniform:
            return result * self.pmf
        return result * emitter.sampling_weight() * self.weight_scale

    def _pdf_area(self, hit, si, emitter, p, start, g, active):
        space = self.space
        lit = active & (emitter != None)  # noqa: E711 - an array of pointers
        q = space.to_cells(si.p)
        n, arrival = space.to_cell_axes(si.n), space.to_cell_axes(hit.arrival)
        # |N| is lost in the Nil unit normal, which has length 1/|N| as a Euclidean normal.
        stretch = dr.rcp(dr.norm(geometry.conormal(q, n, -space.twist)))
        number = dr.reinterpret_array(mi.UInt32, emitter)
        # Density on the surface per unit of Nil's area
        per_area = dr.gather(mi.Float, self.area_densities, number, lit) / stretch
        if self.textures:
            texture = dr.gather(mi.Int32, self.texture_numbers, number, lit)
            varying = lit & (texture >= 0)
            # Not an array of textures, of which every kind that lives in the process would answer
            per_uv = dr.switch(
                dr.select(varying, mi.UInt32(texture), 0),
                [texture.pdf_position for texture in self.textures],
                si.uv,
                varying,
            )
            textured = per_uv / dr.norm(dr.cross(si.dp_du, si.dp_dv))
            per_area = dr.select(varying, textured, per_area)

        # What the segment would have found from the vertex itself, as `sample` does: of the light's
        # tangent plane the point in the same direction, which is as far as the start is off the
        # vertex along the light's normal. Where that is far, the light is seen edge on.
        beside = geometry.to_frame(p, mi.Vector3f(start - p), space.twist)
        ahead = dr.dot(n, beside) / dr.dot(n, arrival)
        distance = hit.distance * (1 + dr.clip(ahead / hit.distance, -0.25, 0.25))
        density = geometry.area_density(distance, arrival.z, space.twist)
        density *= dr.square(space.size)
        cosine = dr.abs(dr.dot(n, arrival))
        half_turn = 0.5 * dr.abs(space.twist * arrival.z) * hit.distance
        pdf = per_area * density / cosine
        if self.images is not None:
            pdf *= self.images.probability(p, q, g)
        return dr.select(lit & (half_turn < dr.pi) & (cosine > 0), pdf, 0)


def _density_on(shape):
    """Density per coordinate area (scene units) with which Mitsuba draws points of a shape.

    0 for shapes of which it draws none, and for None: it knows no shape of an "ellipsoidsmesh".
    """
    if shape is None:
        return 0.0
    try:
        return shape.pdf_position(dr.zeros(mi.PositionSample3f))[0]
    except RuntimeError as error:
        name = f' "{shape.id()}"' if shape.id() else ""
        raise RuntimeError(
            f"the {shape.class_name()}{name} cannot be an area light, as Mitsuba draws no points "
            "on shapes of its kind: put the light on a mesh, a sphere, a cylinder, a disk or a "
            "rectangle."
        ) from error


def _radiance_texture(emitter):
    """The texture of an area light: the only one among what hangs on it directly."""
    nodes = mi.traverse(emitter).hierarchy
    return next(
        node for node, (_, depth) in nodes.items() if depth == 1 and isinstance(node, mi.Texture)
    )


def _symmetric_height(p, q, twist):
    """Height of q over p in the symmetric coordinate, by which geodesics wind round a fibre."""
    return q.z - p.z - 0.5 * twist * (p.x + q.x) * (q.y - p.y)


def _relative(p, q, twist):
    """Horizontal displacement of q from p, ζ with the sign of its height, and R² as in `connect`.

    R stays clear of 0, where each further geodesic is a circle of them: at 1e-6 it moves none that
    float32 tells from its fibre.
    """
    dx, dy = q.x - p.x, q.y - p.y
    zeta = twist * _symmetric_height(p, q, twist)
    return dx, dy, zeta, dr.maximum(0.25 * dr.square(twist) * dr.fma(dx, dx, dy * dy), 1e-12)


def further_intervals(
    p: mi.Point3f, q: mi.Point3f, twist: mi.Float, max_distance: mi.Float
) -> mi.Float:
    """How many of the intervals (mπ, (m+1)π), m ≥ 1, may hold half turns of geodesics to q.

    They are the first ones, as 2v + R² μ(v) = ζ has there, with v = mπ + x and c = cot x, the left
    side 2v + R² (v + v c² − c). That is at least (2 + R²) v − R²/4v, and, as its minimum has c > 0
    and x ≥ π/2 − c, at least (2 + R²)(mπ + π/2) − (1 + R²)²/(R² mπ). The first bound is close for
    small R, the second for large R; solved for mπ, they leave at most one interval without any.
    """
    _, _, zeta, R2 = _relative(p, q, twist)
    zeta = dr.abs(zeta)
    slope = 2 + R2
    small = zeta + dr.sqrt(dr.fma(zeta, zeta, slope * R2))
    excess = dr.fma(-0.5 * dr.pi, slope, zeta)
    large = excess + dr.sqrt(dr.fma(excess, excess, 4 * slope * dr.square(1 + R2) / R2))
    most = dr.minimum(small, large) / (2 * slope)
    # An arc is longer than 2v √(1 + R²)/|k|
    most = dr.minimum(most, 0.5 * dr.abs(twist) * max_distance * dr.rsqrt(1 + R2))
    # Beyond 2²⁴ a float32 counts no more
    return dr.minimum(dr.floor(most / dr.pi), 2**24)


def further_geodesic(
    p: mi.Point3f, q: mi.Point3f, twist: mi.Float, m: mi.Float, second: mi.Bool
) -> tuple[mi.Bool, geometry.Connection]:
    """The first or ``second`` geodesic from p to q (cells) whose half turn is in (mπ, (m+1)π).

    Returns whether there is one, and it; its area density is signed. 2v + R² μ(v) is convex there,
    with poles at both ends, so it meets ζ twice or not at all. The minimum and the root are
    bisected in the sign of smooth functions.
    """
    k = dr.abs(twist)
    dx, dy, zeta, R2 = _relative(p, q, twist)
    orientation = dr.select(zeta < 0, mi.Float(-1), 1)
    zeta = dr.abs(zeta)
    r = dr.sqrt(dr.fma(dx, dx, dy * dy))
    low = dr.pi * m

    def bisect(lower, upper, rises):
        for _ in range(22):  # 3 / 2²² is below the rounding of v
            middle = 0.5 * (lower + upper)
            up = rises(middle)
            lower, upper = dr.select(up, lower, middle), dr.select(up, middle, upper)
        return 0.5 * (lower + upper)

    def past_minimum(x):
        # d/dv (2v + R² μ) = 2 + 2 R² (sin v − v cos v)/sin³ v, times |sin³ v|, with v = mπ + x
        s, c = dr.sincos(x)
        return s**3 + R2 * (s - (low + x) * c) > 0

    x_min = bisect(mi.Float(0), mi.Float(dr.pi), past_minimum)

    def excess(x):
        s, c = dr.sincos(x)
        return (2 * (low + x) - zeta) * dr.square(s) + R2 * (low + x - s * c)

    exists = (excess(x_min) < 0) & (r > 0)
    x = bisect(
        dr.select(second, x_min, 0),
        dr.select(second, dr.pi, x_min),
        lambda x: dr.select(second, excess(x) > 0, excess(x) < 0),
    )
    v = low + x
    horizontal = r * v / dr.sin(x)
    vertical = 2 * v / k
    distance = dr.hypot(horizontal, vertical)
    a, w = horizontal / distance, vertical / distance
    # Displacement and direction differ by the half turn; an odd m turns round by π in addition.
    odd = (m - 2 * dr.floor(0.5 * m)) > 0.5
    angle = dr.atan2(dy, dx) + dr.select(odd, dr.pi, 0)
    turn = v * orientation
    s0, c0 = dr.sincos(angle - turn)
    s1, c1 = dr.sincos(angle + turn)
    w *= orientation * dr.sign(twist)
    return exists, geometry.Connection(
        mi.Point3f(a * c0, a * s0, w),
        mi.Point3f(a * c1, a * s1, w),
        distance,
        geometry.area_density(distance, w, twist),
    )
