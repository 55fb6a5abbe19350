"""Pictures for who is looking: of any size, from a camera that moves, by one kernel for all."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import geometry, png
from .camera import Camera
from .denoise import denoise, through_media
from .errors import raising_causes
from .interaction import surface_interaction
from .layers import GUIDES
from .media import has_media
from .passes import sample_seeds
from .quotient import multiply_cells, opaque
from .shapes import name_of
from .view import View

JPEG_QUALITY = 90


class Canvas:
    """What samples of a picture with ``width`` × ``height`` pixels have added up to.

    ``passes`` of one sample per pixel are whole; of the one in work the first ``begun`` pixels, row
    by row, have theirs.
    """

    def __init__(self, width: int, height: int, planes: int):
        self.width, self.height = width, height
        self.planes = [dr.zeros(mi.Float, 3 * width * height) for _ in range(planes)]
        dr.make_opaque(self.planes)
        self.passes = self.begun = 0

    @property
    def left(self) -> int:
        """Pixels that wait for the sample of the pass in work."""
        return self.width * self.height - self.begun

    def means(self) -> list[mi.TensorXf]:
        """Colour and guides; meant for the end of a pass."""
        one = dr.opaque(mi.Float, 1 / max(1, self.passes))
        return [mi.TensorXf(plane * one, (self.height, self.width, 3)) for plane in self.planes]


@dataclass(frozen=True)
class Sight:
    """What a pixel shows: the frame direction (scene axes) in which it looks; the ``shape``, the
    deck element of its copy's ``cell``, the ``position`` on it in the scene and its ``distance``
    (scene units), all None where it sees nothing."""

    direction: list[float]
    shape: str | None = None
    cell: tuple[int, int, int] | None = None
    position: list[float] | None = None
    distance: float | None = None


class Preview:
    """A scene as a sensor sees it, while the sensor and the integrator's parameters change.

    ``integrator`` is "nil"; its layers become what denoising wants, if ``guided``. Nothing is
    compiled again for other places, twists, tolerances, depths, sizes and lenses.
    """

    def __init__(self, scene: mi.Scene, integrator: mi.Integrator, sensor: mi.Sensor, guided: bool):
        self.scene, self.integrator, self.sensor = scene, integrator, sensor
        self.parameters = mi.traverse(sensor)
        self.sampler = mi.load_dict({"type": "independent"})
        self.layers: tuple[str, ...] = ()
        if guided:
            self.layers = GUIDES
            if has_media(scene, sensor):
                self.layers += ("transmittance",)
        integrator.aovs = ",".join(self.layers)
        self.seed = 0
        crop = sensor.film().crop_size()
        self.film_width = int(crop[0])
        self.view: View | None = None

    def look(self, to_world: mi.ScalarTransform4f | mi.Transform4f, **lens: float) -> None:
        """Place the sensor; ``lens`` are parameters of it."""
        # Opaque: what Mitsuba computes from them needs no other kernel for each place
        self.parameters["to_world"] = mi.Transform4f(opaque(mi.Matrix4f(to_world.matrix)))
        for name, value in lens.items():
            self.parameters[name] = dr.opaque(mi.Float, value)
        self.parameters.update()
        if self.view is not None:
            self.camera = Camera(self.sensor, self.view.space, self.integrator.tolerance)

    def change(self) -> None:
        """Take over what has changed of the integrator or the media."""
        if self.view is None:
            self.view = self.integrator.view(self.scene, True, self.sensor)
        else:  # what there was to warn of has been said
            self.view = View(self.scene, self.integrator, True, self.sensor)
        self.camera = Camera(self.sensor, self.view.space, self.integrator.tolerance)

    def canvas(self, width: int, height: int) -> Canvas:
        """An empty picture."""
        return Canvas(width, height, 1 + len(self.layers))

    @raising_causes
    def render(self, canvas: Canvas, lanes: int) -> None:
        """Add the next ``lanes`` samples, or those that are left of the pass; waits for them."""
        assert self.view is not None
        lanes = min(lanes, canvas.left)
        try:
            # As in `Passes`: loops are recorded once
            with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
                pixel = dr.arange(mi.UInt32, max(2, lanes))  # a single one is another kernel
                pixel += dr.opaque(mi.UInt32, canvas.begun)
                self._add(canvas, pixel)
                dr.eval(canvas.planes)
            dr.sync_thread()
        except BaseException:
            dr.eval()
            dr.sync_thread()
            raise
        canvas.begun += lanes
        if canvas.left == 0:
            canvas.begun = 0
            canvas.passes += 1

    def _add(self, canvas, pixel):
        width, height = (dr.opaque(mi.UInt32, n) for n in (canvas.width, canvas.height))
        inside = pixel < width * height
        sampler = self.sampler.clone()
        sampler.seed(sample_seeds(self.seed, canvas.passes, pixel), 1)
        place = mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()
        on_film = place / mi.Point2f(width, height)
        ray, weight = self._ray(sampler, on_film)
        p, v, cone, far, first = self.camera.start(ray, on_film.x)
        # A pixel here is as many of the film's as are wider
        pixels = dr.opaque(mi.Float, self.film_width / canvas.width)
        cone.width *= pixels
        cone.spread *= pixels
        radiance, valid, seen = self.integrator.trace(
            self.view, sampler, ray, p, v, cone, far, first, inside & dr.any(weight != 0)
        )
        colour = _rgb(dr.select(valid, radiance * weight, 0), ray.wavelengths)
        values = [colour, *(mi.Color3f(seen[layer]) for layer in self.layers)]
        for plane, value in zip(canvas.planes, values, strict=True):
            for i in range(3):
                c = dr.select(dr.isfinite(value[i]), value[i], 0)
                dr.scatter_reduce(
                    dr.ReduceOp.Add, plane, c, 3 * pixel + i, inside, dr.ReduceMode.NoConflicts
                )

    def _ray(self, sampler, on_film):
        sensor = self.sensor
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        time = mi.Float(sensor.shutter_open())
        if sensor.shutter_open_time() > 0:
            time += sampler.next_1d() * sensor.shutter_open_time()
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        return sensor.sample_ray_differential(time, wavelength, on_film, aperture)

    def picture(self, canvas: Canvas, denoised: bool, quick: bool) -> mi.TensorXf:
        """The canvas's colours (height × width × 3), linear; ``quick`` as of `denoise`."""
        colour, *guides = canvas.means()
        if not denoised:
            return colour
        albedo, normal, *passed = guides
        if passed:
            albedo, normal = through_media(albedo, normal, passed[0])
        return denoise(colour, albedo, normal, quick)

    @raising_causes
    def sight(self, x: float, y: float) -> Sight:
        """What is seen at a place of the picture, in parts of it from its upper left corner."""
        assert self.view is not None
        space, tracer = self.view.space, self.view.tracer
        on_film = mi.Point2f(dr.opaque(mi.Float, x), dr.opaque(mi.Float, y))
        time, wavelength = mi.Float(self.sensor.shutter_open()), mi.Float(0.5)
        ray, _ = self.sensor.sample_ray_differential(time, wavelength, on_film, mi.Point2f(0.5))
        p, v, cone, far, first = self.camera.start(ray, on_film.x)
        home = mi.Vector3i(0)
        if space.quotient:
            p, home = geometry.wrap(p, space.twist)
            p, home = mi.Point3f(p), mi.Vector3i(home)
        hit = tracer.intersect(p, v, cone, tracer.reach(p, v, far), mi.Bool(True), time)
        si = surface_interaction(hit, v, space, ray.wavelengths)
        cell = multiply_cells(home, hit.cell, space)
        distance = self.camera.near(ray, on_film.x) + hit.distance * space.size
        dr.eval(si, cell, distance, first)
        direction = _numbers(first)
        if not si.is_valid()[0]:
            return Sight(direction)
        shape = si.shape[0] if si.instance[0] is None else si.instance[0]
        return Sight(
            direction,
            shape.id() or name_of(shape),
            (int(cell.x[0]), int(cell.y[0]), int(cell.z[0])) if space.quotient else None,
            _numbers(si.p),
            distance[0],
        )


def as_jpeg(picture: mi.TensorXf, exposure: float, filmic: bool) -> bytes:
    """A picture as a JPEG file."""
    pixels = png.levels(picture, exposure=exposure, filmic=filmic)
    stream = mi.MemoryStream()
    bitmap = mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGB)
    bitmap.write(stream, mi.Bitmap.FileFormat.JPEG, JPEG_QUALITY)
    return stream.raw_buffer()


def _rgb(radiance, wavelengths):
    if mi.is_spectral:
        return mi.spectrum_to_srgb(radiance, wavelengths)
    return mi.Color3f(radiance.x) if mi.is_monochromatic else mi.Color3f(radiance)


def _numbers(v):
    return [c[0] for c in v]
