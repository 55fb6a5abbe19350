"""Participating media along geodesics: which a scene holds, how far light flies in them before it
is met, and what part of it passes.

Nil is unimodular and radiance is constant along its geodesics, so the transport equation is that of
straight light: dL/ds = −σ_t L + σ_s ∫ p L dω, with the arc length s in scene units and directions
in frame components. Media are asked for their coefficients and for their phase functions; what
Mitsuba's own ``sample_interaction`` does along a ray is straight.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from . import geometry
from .box import Box, Passage
from .quotient import Space, opaque, table
from .shapes import ROUNDING, Shapes, corners_of, name_of

# How a medium's collisions are found: by its constant extinction; one by one, and none where the
# geodesic has left the box of the shapes that it is in; or one by one where it is in the box of
# the medium's own volumes.
CONSTANT, WITHIN, OPEN = range(3)
# So near (cells) a boundary is on a face: much more than rays start off surfaces.
NEAR = 1e-4
# Light that has this optical depth before it is not looked for: 2e-9 of it arrive.
OPAQUE_DEPTH = 20.0
FAINT = math.exp(-OPAQUE_DEPTH)
# Cells past which the direction of what is seen is lost in float32.
MOST_CELLS = 2000.0


class Media:
    """The media of a scene as seen through ``sensor``, of which the one that it names fills space.

    ``exist``: whether there are any. ``coloured``: whether any has an extinction that differs by
    channel or wavelength, so that the one by which lengths are drawn has to be told from others.
    ``on_faces``: whether any boundary lies on a face of the quotient's cell.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor | None, space: Space, shapes: Shapes):
        self.space = space
        self.scene = scene
        self.filling = _around(sensor) if sensor is not None else None
        boxes = _boxes(scene, shapes)
        self.bounded = list(boxes)
        if self.filling is not None:
            boxes[self.filling] = None
        self.exist = bool(boxes)
        if not self.exist:
            return
        for medium in boxes:
            _check_coefficients(medium)
        self.coloured = any(is_coloured(medium) for medium in boxes)
        faces = [[0, edge] for edge in space.EDGES]
        self.on_faces = space.quotient and any(
            abs(end - face) < NEAR
            for shape, extent in zip(shapes.shapes, shapes.extents)
            if shape.is_medium_transition() and extent.box.valid()
            for axis, ends in enumerate(self._corners(extent.box))
            for end in ends
            for face in faces[axis]
        )
        self.microflakes = any(_is_microflake(medium) for medium in boxes)
        self._tabulate(boxes)

    def _tabulate(self, boxes):
        """Tables by the number of a medium's pointer: the kind of it, and its box (cells)."""
        pointers = [dr.reinterpret_array(mi.UInt32, mi.MediumPtr(medium))[0] for medium in boxes]
        kinds = [CONSTANT] * (max(pointers) + 1)
        lower, upper = [[-math.inf] * 3] * len(kinds), [[math.inf] * 3] * len(kinds)
        for (medium, box), pointer in zip(boxes.items(), pointers):
            if is_closed_form(medium):
                continue
            kinds[pointer] = WITHIN
            # A homogeneous one has no box, even if the volumes that it is made of do
            if box is None and not self.space.quotient and not medium.is_homogeneous():
                kinds[pointer], box = OPEN, _volume_box(medium)
                if not all(map(math.isfinite, (*box.min, *box.max))):
                    raise RuntimeError(
                        f"{_called(medium)} has no bounds, and in plain Nil its collisions would "
                        "be looked for without end: make it the interior of a closed shape."
                    )
            if box is not None:
                lower[pointer], upper[pointer] = self._in_cells(box)
        self.kinds = opaque(mi.UInt32(kinds))
        self.lower, self.upper = table(lower), table(upper)
        present = {kinds[pointer] for pointer in pointers}
        self.integrates = CONSTANT in present
        self.tracks = bool(present - {CONSTANT})
        self.has_open = OPEN in present

    def _corners(self, box):
        """By axis, the ends (cells) of a box (scene)."""
        corners = [self.space.to_cells(mi.Point3f(corner)) for corner in (box.min, box.max)]
        return [[corner[axis][0] for corner in corners] for axis in range(3)]

    def _in_cells(self, box):
        ends = self._corners(box)
        # What is on the boundary is inside, however it was rounded
        slack = 64 * ROUNDING * max(abs(end) for pair in ends for end in pair)
        return [low - slack for low, _ in ends], [high + slack for _, high in ends]

    def reach(self, max_distance: float) -> float:
        """The length (cells) past which no light arrives through the medium that fills space, or
        ``max_distance`` if that is less, or if the extinction is not known to be anywhere.

        Raises RuntimeError in the quotient if there is no end to either.
        """
        least = 0.0
        if self.exist and self.filling is not None and is_closed_form(self.filling):
            least = min(_coefficients(self.filling)[1])
        if self.space.quotient and math.isinf(max_distance):
            cells = 'set "max_distance", which is in cells (12 if it is left out)'
            if least == 0:
                raise RuntimeError(
                    '"max_distance" is infinite, and in the quotient only a homogeneous medium of '
                    f"the sensor that absorbs everywhere ends a ray that meets nothing: {cells}."
                )
            if _greatest_albedo(self.filling) >= 1:
                raise RuntimeError(
                    f'"max_distance" is infinite, and {_called(self.filling)}, which fills the '
                    "cell, absorbs nothing: the radiance would be infinite, too. Give it an albedo "
                    f"below 1, or {cells}."
                )
            if OPAQUE_DEPTH / (least * self.space.size_number) > MOST_CELLS:
                raise RuntimeError(
                    f'"max_distance" is infinite, and {_called(self.filling)}, which fills the '
                    f"cell, is so thin that light comes from beyond {MOST_CELLS:g} cells: {cells}."
                )
        if least == 0 or (self.bounded and not math.isinf(max_distance)):
            return max_distance
        return min(max_distance, OPAQUE_DEPTH / (least * self.space.size_number))

    def warnings(self, max_distance: float) -> list[str]:
        """A sentence on each of the things that the media of the scene do not do."""
        sentences = []
        for emitter in self.scene.emitters():
            medium = emitter.get_medium()
            if medium is not None and medium is not self.filling and medium not in self.bounded:
                name = f'"{emitter.id()}"' if emitter.id() else emitter.class_name()
                sentences.append(
                    f"the emitter {name} names a medium that fills nothing: name it in the sensor, "
                    "or as the interior or exterior of a shape, too."
                )
        for shape in self.scene.shapes():
            if shape.is_medium_transition() and _is_open(shape):
                sentences.append(
                    f"the shape {name_of(shape)} is a medium's boundary and is not closed: what "
                    "goes round its edge is taken to be in the medium from which it came."
                )
        lit = any(
            mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
            for emitter in self.scene.emitters()
        )
        filling = self.filling
        # Others end with the box of their grids
        endless = filling is not None and filling not in self.bounded and filling.is_homogeneous()
        if lit and endless and math.isinf(max_distance):
            sentences.append(
                f"{_called(filling)} is all around the sensor without end, so that no light "
                "arrives from infinity (environments, directional): set max_distance to have it "
                "stand there, or end the medium by a closed shape."
            )
        return sentences

    # ------------------------------------------------------------- coefficients

    def interaction(
        self, medium: mi.MediumPtr, p: mi.Point3f, v: mi.Vector3f, like: mi.Interaction3f
    ) -> mi.MediumInteraction3f:
        """Mitsuba's interaction with a medium at ``p`` (cells) of what arrives in frame direction
        ``v`` (scene axes), at the time and the wavelengths of ``like``."""
        mei = dr.zeros(mi.MediumInteraction3f)
        mei.medium = medium
        mei.p = self.space.to_scene(p)
        mei.wi = -v
        mei.sh_frame = mi.Frame3f(mei.wi)
        mei.time, mei.wavelengths = like.time, like.wavelengths
        return mei

    def of_channel(self, spectrum: mi.UnpolarizedSpectrum, channel: mi.UInt32) -> mi.Float:
        """The component by which lengths are drawn."""
        result = spectrum[0]
        if self.coloured:
            for i in range(1, len(spectrum)):
                result = dr.select(channel == i, spectrum[i], result)
        return result

    def _majorant(self, medium, mei, active):
        """Extinction (per scene unit) that no point of a medium and no direction exceeds."""
        majorant = dr.max(medium.get_majorant(mei, active))
        if mi.is_spectral:
            # What a constant volume says is its greatest value is a mean over wavelengths
            _, _, σ_t = medium.get_scattering_coefficients(mei, active)
            majorant = dr.maximum(majorant, dr.max(σ_t))
        if self.microflakes:
            phase = medium.phase_function()
            area, most = phase.projected_area(mei, active), phase.max_projected_area()
            # A homogeneous medium's is that of this direction
            here = medium.is_homogeneous() & (area > 0)
            majorant *= dr.select(here, most / area, dr.maximum(most, 1))
        return majorant

    # ---------------------------------------------------------- along geodesics

    def flight(
        self,
        mei: mi.MediumInteraction3f,
        p: mi.Point3f,
        limit: mi.Float,
        channel: mi.UInt32,
        sampler: mi.Sampler,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.UInt32]:
        """Length (cells) to the first collision along a geodesic from ``p`` (cells), drawn by one
        ``channel``; infinite where there is none before ``limit``. And the seed that drew it.

        ``mei``: the `interaction` with the medium at ``p``, of the direction of the geodesic.
        """
        length, seed = mi.Float(dr.inf), mi.UInt32(0)
        u = sampler.next_1d(active)
        kind = self._kind(mei.medium, active)
        if self.integrates:
            constant = active & (kind == CONSTANT)
            σ = self.of_channel(mei.medium.get_majorant(mei, constant), channel)
            drawn = -dr.log(1 - u) / σ * self.space.cells_per_unit
            length = dr.select(constant & (σ > 0) & (drawn < limit), drawn, dr.inf)
        if self.tracks:
            seed = self.seed(u)
            drawn, _ = self._track(mei, p, limit, channel, seed, kind, active & (kind != CONSTANT))
            length = dr.minimum(length, drawn)
        return length, seed

    def weights(
        self,
        start: mi.MediumInteraction3f,
        p: mi.Point3f,
        length: mi.Float,
        end: mi.MediumInteraction3f,
        collided: mi.Bool,
        channel: mi.UInt32,
        seed: mi.UInt32,
        active: mi.Bool,
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        """What a path is multiplied by over the ``length`` (cells) of a `flight` that ends by a
        surface or has ``collided`` with the medium, over the density by which the ``channel`` draws
        it; and the other channels' densities over that one."""
        σ_s, _, σ_t = end.medium.get_scattering_coefficients(end, collided)
        σ = self.of_channel(σ_t, channel)
        per = dr.select(σ > 0, dr.rcp(σ), 0)
        f = dr.select(collided, σ_s * per, 1)
        if not self.coloured:
            return f, mi.UnpolarizedSpectrum(1)
        r = dr.select(collided, σ_t * per, 1)
        passed = mi.UnpolarizedSpectrum(1)
        kind = self._kind(start.medium, active)
        if self.integrates:
            constant = active & (kind == CONSTANT)
            σ_t = start.medium.get_majorant(start, constant)
            more = (σ_t - self.of_channel(σ_t, channel)) * self.space.size
            some = dr.select(constant & (more != 0), dr.exp(-more * length), 1)
            passed = mi.UnpolarizedSpectrum(some)
        if self.tracks:
            tracked = active & (kind != CONSTANT)
            _, nulls = self._track(start, p, length, channel, seed, kind, tracked, weigh=True)
            passed = dr.select(tracked, nulls, passed)
        return f * passed, r * passed

    def seed(self, u: mi.Float) -> mi.UInt32:
        """A seed for collisions from a random number in [0, 1)."""
        return mi.sample_tea_32(dr.reinterpret_array(mi.UInt32, 1 + u), 0x5EED)[0]

    def transmittance(
        self,
        mei: mi.MediumInteraction3f,
        p: mi.Point3f,
        length: mi.Float,
        seed: mi.UInt32,
        active: mi.Bool,
    ) -> mi.UnpolarizedSpectrum:
        """The part of light that passes a ``length`` (cells) of the geodesic from ``p`` (cells), as
        an estimate by ``seed`` where the medium is not constant; ``mei`` as for `flight`."""
        result = mi.UnpolarizedSpectrum(1)
        kind = self._kind(mei.medium, active)
        if self.integrates:
            constant = active & (kind == CONSTANT)
            σ = mei.medium.get_majorant(mei, constant)
            depth = dr.select(σ > 0, σ * self.space.size * length, 0)
            result = mi.UnpolarizedSpectrum(dr.exp(-depth))
        if self.tracks:
            tracked = active & (kind != CONSTANT)
            _, passed = self._track(mei, p, length, None, seed, kind, tracked, weigh=True)
            result = dr.select(tracked, passed, result)
        return result

    def deep(self, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Float:
        """Length (cells) that hardly any light passes in a constant medium, infinite in others."""
        constant = active & (self._kind(mei.medium, active) == CONSTANT)
        least = dr.min(mei.medium.get_majorant(mei, constant))
        depth = OPAQUE_DEPTH * self.space.cells_per_unit
        return dr.select(constant & (least > 0), depth / least, dr.inf)

    def _kind(self, medium, active):
        return dr.gather(mi.UInt32, self.kinds, dr.reinterpret_array(mi.UInt32, medium), active)

    @dr.syntax
    def _track(self, mei, p, limit, channel, seed, kind, active, weigh=False):
        """Tentative collisions, at the density of the majorant, along the geodesic from ``p`` up to
        the ``limit`` (cells). Without a ``channel`` all are null, and weigh what they let through;
        with one the first real one ends them, at the length that is returned, and the null ones
        before it weigh what that channel has drawn too often or too seldom of the others."""
        space = self.space
        number = dr.reinterpret_array(mi.UInt32, mei.medium)
        box = Box(
            dr.gather(mi.Point3f, self.lower, number, active),
            dr.gather(mi.Point3f, self.upper, number, active),
        )
        v = space.to_cell_axes(-mei.wi)
        majorant = self._majorant(mei.medium, mei, active)
        step = space.cells_per_unit / majorant
        passage = Passage(p, v, space.twist)
        t, real, count = mi.Float(0), mi.Bool(False), mi.UInt32(0)
        weight = mi.UnpolarizedSpectrum(1)
        searching = active & (majorant > 0)

        while searching:
            t -= step * dr.log(1 - mi.sample_tea_float32(seed, 2 * count))
            u = mi.sample_tea_float32(seed, 2 * count + 1)
            count += 1
            searching &= t < limit
            point, arrival = geometry.flow(p, v, t, space.twist)
            outside = box.excludes(point)
            if dr.hint(self.has_open, mode="scalar"):
                # None before the geodesic comes to the box, nor if it never does
                away = searching & outside & (kind == OPEN)
                if away:
                    t += box.clearance(point, arrival, passage)
                searching &= ~outside | (kind == OPEN)
            else:
                searching &= ~outside
            if dr.hint(space.quotient, mode="scalar"):
                point = mi.Point3f(geometry.wrap(point, space.twist)[0])
            here = self.interaction(
                mei.medium, mi.Point3f(point), space.to_scene_axes(arrival), mei
            )
            looked = searching & ~outside
            σ_t = self._extinction(here, looked)
            if dr.hint(channel is None, mode="scalar"):
                weight = dr.select(looked, weight * (1 - σ_t / majorant), weight)
                # Of a light at infinity the last bit might stay for ever
                searching &= dr.any(weight > FAINT)
            else:
                σ = self.of_channel(σ_t, channel)
                real |= looked & (u * majorant < σ)
                searching &= ~real
                if dr.hint(weigh, mode="scalar"):
                    null = (majorant - σ_t) / (majorant - σ)
                    weight = dr.select(looked & ~real, weight * null, weight)
        return dr.select(real, t, dr.inf), weight

    def _extinction(self, mei, active):
        """Extinction at a point, which is 0 outside of the box of the medium's own volume."""
        # Along an axis Mitsuba takes a ray beside the box for one that meets it
        ray = dr.zeros(mi.Ray3f)
        ray.o, ray.d = mei.p, mi.Vector3f(math.sqrt(1 / 3))
        hit, first, last = mei.medium.intersect_aabb(ray)
        _, _, σ_t = mei.medium.get_scattering_coefficients(mei, active)
        return dr.select(active & hit & (first <= 0) & (last >= 0), σ_t, 0)


def is_closed_form(medium: mi.Medium) -> bool:
    """Whether a medium's transmittance follows from lengths alone."""
    return medium.is_homogeneous() and not _is_microflake(medium)


def _is_microflake(medium):
    return mi.has_flag(medium.phase_function().flags(), mi.PhaseFunctionFlags.Microflake)


def is_coloured(medium: mi.Medium) -> bool:
    """Whether a medium's extinction may differ by channel or wavelength."""
    # In spectral variants a grid of colours has a fourth channel
    if any(mi.traverse(grid)["data"].shape[3] in (3, 4) for grid in _grids(medium)):
        return True
    _, values = _coefficients(medium)
    return max(values) - min(values) > 1e-5 * max(values)


def _coefficients(medium):
    """Scattering and extinction (per scene unit) at the origin by channel, or every 4 nm."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    mei.wi = mi.Vector3f(0, 0, 1)
    if mi.is_spectral:
        mei.wavelengths = dr.linspace(mi.Float, 360, 830, 118)
    σ_s, _, σ_t = medium.get_scattering_coefficients(mei)
    return list(dr.ravel(σ_s)), list(dr.ravel(σ_t))


def _grids(medium):
    return [v for v in _nodes(medium, mi.Volume) if v.class_name() == "GridVolume"]


def _greatest_albedo(medium):
    """The largest albedo of a medium of constant extinction."""
    σ_s, σ_t = _coefficients(medium)
    grids = [grid.max() for grid in _grids(medium) if mi.traverse(grid)["data"].shape[3] in (1, 3)]
    return max([s / t for s, t in zip(σ_s, σ_t)] + grids)


def _check_coefficients(medium):
    """Raise RuntimeError for coefficients that no medium has."""
    σ_s, σ_t = _coefficients(medium)
    data = [mi.traverse(grid)["data"] for grid in _grids(medium)]
    # Four channels are those of a spectrum, and six those of microflakes: of any sign
    voxels = [dr.min(voxels.array)[0] for voxels in data if voxels.shape[3] in (1, 3)]
    values = [*σ_s, *σ_t, *voxels]
    if not all(value >= 0 for value in values):
        raise RuntimeError(
            f"{_called(medium)} has coefficients that are negative or no numbers: sigma_t, scale "
            "and albedo must be 0 or more."
        )


def _called(medium):
    return f'the medium "{medium.id()}"' if medium.id() else f"a {medium.class_name()}"


def _around(sensor):
    """The medium around a sensor, which those of a batch share."""
    medium = sensor.get_medium()
    inner = [s.get_medium() for s in _nodes(sensor, mi.Sensor) if s is not sensor]
    for other in inner:
        if other is not (medium or inner[0]) and not (medium and other is None):
            raise RuntimeError(
                "the sensors of a batch have different media: give one to the batch itself, or the "
                "same to each of them."
            )
    return medium or (inner[0] if inner else None)


def _nodes(root, kind) -> list[Any]:
    """Objects of one kind among what hangs on ``root``."""
    return [node for node in mi.traverse(root).hierarchy if isinstance(node, kind)]


def _volume_box(medium):
    """Box (scene) that holds all of a medium's own volumes."""
    box = mi.ScalarBoundingBox3f()
    for volume in _nodes(medium, mi.Volume):
        box.expand(volume.bbox())
    return box


def has_media(scene: mi.Scene, sensor: mi.Sensor) -> bool:
    """Whether light meets any medium in a scene that this sensor sees."""
    return _around(sensor) is not None or any(map(_media_of, _boundaries(scene)))


def is_passable(scene: mi.Scene) -> bool:
    """Whether light goes straight through any surface, as through a medium's boundary."""
    return any(
        shape.bsdf() is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)
        for shape in _shapes(scene)
    )


def _shapes(scene):
    """A scene's shapes, those in shapegroups included."""
    shapes = scene.shapes()
    grouped = any(shape.class_name() == "Instance" for shape in shapes)
    return _nodes(scene, mi.Shape) if grouped else shapes


def _boundaries(scene):
    """The shapes that may be boundaries of media."""
    return [shape for shape in _shapes(scene) if _media_of(shape)]


def _media_of(shape):
    """What a shape has inside and outside, where those are any."""
    return [m for m in (shape.interior_medium(), shape.exterior_medium()) if m is not None]


def _boxes(scene: mi.Scene, shapes: Shapes) -> dict[mi.Medium, mi.ScalarBoundingBox3f | None]:
    """The media that have boundaries, and the box (scene units) of the shapes that each is inside
    of; None where that is not known, and where it is outside of any."""
    found: dict[mi.Medium, mi.ScalarBoundingBox3f | None] = {}
    boxes = {shape: extent.box for shape, extent in zip(shapes.shapes, shapes.extents)}
    for shape in _boundaries(scene):
        for medium in _media_of(shape):
            # What is in a shapegroup is elsewhere
            bounded = medium is shape.interior_medium() and shape in boxes
            box = found.setdefault(medium, mi.ScalarBoundingBox3f()) if bounded else None
            found[medium] = box
            if box is not None:
                box.expand(boxes[shape])
    return found


def _is_open(shape):
    """Whether a shape certainly has an edge."""
    if not shape.is_mesh():
        return bool(shape.shape_type() & (mi.ShapeType.Rectangle | mi.ShapeType.Disk))
    a, b, c = corners_of(shape)
    # The area vectors of a closed surface add up to zero
    area = dr.cross(b - a, c - a)
    total = [dr.sum(component)[0] for component in area]
    return math.hypot(*total) > 1e-3 * dr.sum(dr.norm(area))[0]
