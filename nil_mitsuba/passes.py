"""An image as a sequence of passes: any sample count and any size in bounded memory.

Each pass has a seed of its own, so any of them can be rendered on its own, in any order and on any
machine, and their sums added up. Layers come from the first vertices of the same paths.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from .camera import Camera
from .errors import raising_causes
from .layers import LAYERS, channel_names
from .sums import Sums, develop, luminance

# Camera samples in one wavefront: more use no processor better, and memory grows with them.
WAVEFRONT_SAMPLES = 2**21

NO_PIXEL = 2**32 - 1  # number of a pixel outside of the crop


class Passes:
    """The passes of an image that `integrator` renders of `scene` through `sensor`.

    ``spp`` is the number of samples per pixel in each pass, ``count`` the number of passes that
    hold at least the samples asked for. Both follow from the scene and the settings alone.
    A pass holds as many samples as fit into `WAVEFRONT_SAMPLES`, or ``pass_spp`` per pixel if that
    is less, but at least one per pixel; larger images are rendered in bands.
    """

    def __init__(self, integrator, scene: mi.Scene, sensor: int | mi.Sensor = 0, seed: int = 0,
                 spp: int = 0, pass_spp: int | None = None):
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
        fits = max(1, WAVEFRONT_SAMPLES // pixels)
        if pass_spp is None:
            pass_spp = math.ceil(wanted / math.ceil(wanted / fits))
        self.sampler = self.sensor.sampler().clone()
        self.sampler.set_sample_count(min(pass_spp, fits))
        self.spp = self.sampler.sample_count()       # Some samplers round it up
        self.sampler.set_samples_per_wavefront(self.spp)
        self.count = math.ceil(wanted / self.spp)

        self.view = integrator.view(scene)
        self.camera = Camera(self.sensor, self.view.space, integrator.tolerance)
        self.film.prepare(channel_names(self.layers, "mean"))

    def nothing(self) -> Sums:
        """The sums of no passes."""
        crop = self.film.crop_size()
        depth = len(channel_names(self.layers, "first"))
        values = dr.zeros(mi.TensorXd, (crop.y, crop.x, self.film.create_block().channel_count()))
        moments = dr.zeros(mi.TensorXd, (3, crop.y, crop.x))
        # In memory, so that the first pass is added by the same kernel as all others
        dr.make_opaque(values, moments)
        return Sums(values, moments, dr.zeros(mi.TensorXi, (crop.y, crop.x, depth)), ())

    @raising_causes
    def render(self, index: int) -> Sums:
        """Render pass number ``index``, whose first seed is `pass_seed`."""
        with dr.suspend_grad():
            block = self.film.create_block()
            # As Mitsuba does: samples of one pixel are summed up before they reach the film
            block.set_coalesce(block.coalesce() and self.spp >= 4)
            crop = self.film.crop_size()
            depth = len(channel_names(self.layers, "first"))
            points = dr.zeros(mi.Int32, crop.y * crop.x * depth)
            for band in range(self.bands):
                self._render_band(block, points, index * self.bands + band, band * self.band)
            # Double precision only while they are added: a third of the memory
            values = block.tensor()
            return Sums(mi.TensorXd(values), self._moments(values),
                        mi.TensorXi(points, (crop.y, crop.x, depth)), ((index, index + 1),))

    def develop(self, sums: Sums) -> mi.TensorXf:
        """The image (height × width × channels) of what passes have added up to.

        The sensor's film holds the same image afterwards, except for layers of whole numbers.
        """
        return develop(self.film, self.layers, sums, self.spp)

    def _moments(self, values):
        total, weight = luminance(self.film, values)
        crop = self.film.crop_size()
        return mi.TensorXd(
            dr.concat([dr.square(total), total * weight, dr.square(weight)]), (3, crop.y, crop.x)
        )

    def _render_band(self, block, points, index, first):
        sampler = self.sampler.clone()
        # Opaque, so that one kernel does for all passes and bands
        sampler.seed(dr.opaque(mi.UInt32, pass_seed(self.seed, index)), self.band * self.spp)
        number, inside, ray, weight, position, across = self._sample_rays(sampler, first)
        start = self.camera.start(ray, across)
        radiance, valid, seen = self.integrator.trace(self.view, sampler, ray, *start, inside)
        ADIntegrator._splat_to_block(
            block, self.film, position,
            value=dr.select(inside, radiance * weight, 0),
            weight=dr.select(inside, mi.Float(1), 0),
            alpha=dr.select(valid & inside, mi.Float(1), 0),
            aovs=self._channels(seen, "mean"), wavelengths=ray.wavelengths,
        )
        channels = self._channels(seen, "first")
        del sampler, ray, weight, position, across, start, radiance, valid, seen, inside
        # Together: what is evaluated later would be traced again
        dr.eval(block.tensor(), [number, *channels] if channels else [])
        if channels:
            self._scatter_first(points, number, channels)
        dr.sync_thread()

    def _scatter_first(self, points, number, channels):
        """Give each pixel the channels of its first sample."""
        sample = dr.arange(mi.UInt32, self.band) * dr.opaque(mi.UInt32, self.spp)
        number = dr.gather(mi.UInt32, number, sample)
        for i, channel in enumerate(channels):
            dr.scatter(points, dr.gather(mi.Int32, channel, sample), number * len(channels) + i,
                       number != NO_PIXEL)
        dr.eval(points)

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
        own = inside & (place.x >= 0) & (place.y >= 0) & (place.x < film.crop_size().x) \
            & (place.y < film.crop_size().y)
        number = dr.select(own, mi.UInt32(place.y * film.crop_size().x + place.x), NO_PIXEL)

        place += mi.Vector2i(film.crop_offset())
        position = mi.Vector2f(place) + sampler.next_2d()
        scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Vector2f(0)
        time = sensor.shutter_open()
        if sensor.shutter_open_time() > 0:
            time += sampler.next_1d() * sensor.shutter_open_time()
        wavelength = sampler.next_1d() if mi.is_spectral else 0
        on_film = dr.fma(position, scale, -mi.ScalarVector2f(film.crop_offset()) * scale)
        ray, weight = sensor.sample_ray_differential(time, wavelength, on_film, aperture)
        # Under a box filter a sample belongs to its pixel whatever rounding says
        if film.rfilter().is_box_filter():
            position = mi.Vector2f(place)
        return number, inside, ray, weight, position, on_film.x

    def _channels(self, seen, rule):
        return [channel for layer in self.layers if LAYERS[layer].rule == rule
                for channel in seen[layer]]


def pass_seed(seed: int, index: int) -> int:
    """Seed of pass number ``index``: ``seed`` itself, then steps of 2³² times the golden ratio."""
    return (seed + index * 0x9E3779B9) % 2**32
