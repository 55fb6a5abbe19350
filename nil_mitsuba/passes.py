"""An image as a sequence of passes: any sample count and any size in bounded memory.

Each pass has a seed of its own, so any of them can be rendered on its own, in any order and on any
machine, and their sums added up. Layers come from the first vertices of the same paths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from .camera import Camera

# Camera samples in one wavefront: more use no processor better, and memory grows with them.
WAVEFRONT_SAMPLES = 2**21

# Layers that are averaged over a pixel as the picture is, with their channels, ...
MEAN_LAYERS = {
    "distance": ("depth.Z",),
    "position": ("position.x", "position.y", "position.z"),
    "normal": ("normal.x", "normal.y", "normal.z"),
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
}
# ... and layers of whole numbers, which no average could name: those of a pixel's first sample.
POINT_LAYERS = {
    "cell": ("cell.x", "cell.y", "cell.z"),
    "shape": ("shape.X",),
}
LAYERS = MEAN_LAYERS | POINT_LAYERS


@dataclass
class Sums:
    """What passes add up to: ``values`` (TensorXf, height × width × channels of the film, weights
    included) and ``points`` (TensorXi, height × width × channels of the point layers)."""

    values: mi.TensorXf
    points: mi.TensorXi

    def plus(self, later: Sums) -> Sums:
        """The sums of both; the point layers are those of the earlier pass."""
        return Sums(self.values + later.values, self.points)


def layer_channels(layers, of: dict[str, tuple[str, ...]] = LAYERS) -> list[str]:
    """Names of the channels of those of ``layers`` that are in `of`, in its order."""
    return [name for layer, names in of.items() if layer in layers for name in names]


class Passes:
    """The passes of an image that `integrator` renders of `scene` through `sensor`.

    ``spp`` is the number of samples per pixel in each pass, ``count`` the number of passes that
    hold at least the samples asked for. Both follow from the scene and the settings alone.
    A pass holds as many samples as fit into `WAVEFRONT_SAMPLES`, but at least one per pixel; larger
    images are rendered in bands.
    """

    def __init__(self, integrator, scene: mi.Scene, sensor: int | mi.Sensor = 0, seed: int = 0,
                 spp: int = 0):
        self.integrator = integrator
        self.scene = scene
        self.sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        self.seed = seed
        self.layers = integrator.layers
        self.film = self.sensor.film()
        self.size = mi.ScalarVector2u(self.film.crop_size())
        if self.film.sample_border():
            self.size += 2 * self.film.rfilter().border_size()
        pixels = dr.prod(self.size)
        self.bands = max(1, math.ceil(pixels / WAVEFRONT_SAMPLES))
        self.band = math.ceil(pixels / self.bands)   # Pixels of a band

        wanted = spp or self.sensor.sampler().sample_count()
        count = math.ceil(wanted / max(1, WAVEFRONT_SAMPLES // pixels))
        self.sampler = self.sensor.sampler().clone()
        self.sampler.set_sample_count(math.ceil(wanted / count))
        self.spp = self.sampler.sample_count()       # Some samplers round it up
        self.sampler.set_samples_per_wavefront(self.spp)
        self.count = math.ceil(wanted / self.spp)

        self.view = integrator.view(scene)
        self.camera = Camera(self.sensor, self.view.space, integrator.tolerance)
        self.film.prepare(layer_channels(self.layers, MEAN_LAYERS))

    def render(self, index: int) -> Sums:
        """Render pass number ``index``, whose first seed is `pass_seed`."""
        with dr.suspend_grad():
            block = self.film.create_block()
            # As Mitsuba does: samples of one pixel are summed up before they reach the film
            block.set_coalesce(block.coalesce() and self.spp >= 4)
            crop = self.film.crop_size()
            depth = len(layer_channels(self.layers, POINT_LAYERS))
            points = dr.zeros(mi.Int32, crop.y * crop.x * depth)
            for band in range(self.bands):
                self._render_band(block, points, index * self.bands + band, band * self.band)
            return Sums(block.tensor(), mi.TensorXi(points, (crop.y, crop.x, depth)))

    def develop(self, sums: Sums) -> mi.TensorXf:
        """The image (height × width × channels) of what passes have added up to.

        The sensor's film holds the same image afterwards.
        """
        film = self.film
        film.clear()
        film.put_block(mi.ImageBlock(sums.values, film.crop_offset()))
        image = film.develop()
        if sums.points.shape[2] == 0:
            return image
        return dr.concat([image, mi.TensorXf(sums.points)], axis=2)

    def _render_band(self, block, points, index, first):
        sampler = self.sampler.clone()
        # Opaque, so that one kernel does for all passes and bands
        sampler.seed(dr.opaque(mi.UInt32, pass_seed(self.seed, index)), self.band * self.spp)
        number, inside, ray, weight, position = self._sample_rays(sampler, first)
        p, v, cone = self.camera.start(ray, position)
        radiance, valid, seen = self.integrator.trace(self.view, sampler, ray, p, v, cone, inside)
        ADIntegrator._splat_to_block(
            block, self.film, position,
            value=dr.select(inside, radiance * weight, 0),
            weight=dr.select(inside, mi.Float(1), 0),
            alpha=dr.select(valid & inside, mi.Float(1), 0),
            aovs=self._channels(seen, MEAN_LAYERS), wavelengths=ray.wavelengths,
        )
        self._scatter_points(points, seen, number, inside)
        del sampler, ray, weight, position, p, v, cone, radiance, valid, seen, number, inside
        dr.eval(block.tensor(), points)
        dr.sync_thread()

    def _sample_rays(self, sampler, first):
        """Camera rays of the pixels from number ``first`` on, as `ADIntegrator.sample_rays`."""
        film, sensor = self.film, self.sensor
        index = dr.arange(mi.UInt32, self.band * self.spp)
        pixel = index // dr.opaque(mi.UInt32, self.spp) + dr.opaque(mi.UInt32, first)
        inside = pixel < dr.prod(self.size)
        place = mi.Vector2i(pixel % self.size.x, pixel // self.size.x)
        if film.sample_border():
            place -= film.rfilter().border_size()
        # A pixel's own number in the crop; those of the border have none
        own = (place.x >= 0) & (place.y >= 0) & (place.x < film.crop_size().x) \
            & (place.y < film.crop_size().y) & (index % dr.opaque(mi.UInt32, self.spp) == 0)
        number = dr.select(own, mi.UInt32(place.y * film.crop_size().x + place.x), 0xFFFFFFFF)

        place += mi.Vector2i(film.crop_offset())
        position = mi.Vector2f(place) + sampler.next_2d()
        scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Vector2f(0)
        time = sensor.shutter_open()
        if sensor.shutter_open_time() > 0:
            time += sampler.next_1d() * sensor.shutter_open_time()
        wavelength = sampler.next_1d() if mi.is_spectral else 0
        ray, weight = sensor.sample_ray_differential(
            time, wavelength,
            dr.fma(position, scale, -mi.ScalarVector2f(film.crop_offset()) * scale), aperture,
        )
        # Under a box filter a sample belongs to its pixel whatever rounding says
        if film.rfilter().is_box_filter():
            position = mi.Vector2f(place)
        return number, inside, ray, weight, position

    def _channels(self, seen, of):
        return [channel for layer in of if layer in self.layers for channel in seen[layer]]

    def _scatter_points(self, points, seen, number, inside):
        channels = self._channels(seen, POINT_LAYERS)
        active = inside & (number != 0xFFFFFFFF)
        for i, channel in enumerate(channels):
            dr.scatter(points, channel, number * len(channels) + i, active)


def pass_seed(seed: int, index: int) -> int:
    """Seed of pass number ``index``: ``seed`` itself, then steps of 2³² times the golden ratio."""
    return (seed + index * 0x9E3779B9) % 2**32
