"""An image as a sequence of passes: any sample count and any size in bounded memory.

Each pass has a seed of its own, so any of them can be rendered on its own, in any order and on any
machine, and their sums added up. Layers come from the first vertices of the same paths.
"""

from __future__ import annotations

import math
from time import perf_counter
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from .camera import Camera
from .errors import raising_causes
from .layers import LAYERS, channel_names
from .sums import LUMINANCE, Sums, develop, luminance, plane

# Camera samples in one pass (or one per pixel), and in one wavefront, which is what is traced at
# once: more use no processor better, and memory grows with them.
WAVEFRONT_SAMPLES = 2**21

# Nothing interrupts a wavefront, so it should take about so many seconds. To record the next one
# takes one processor about 0.02 s meanwhile: one percent of two. An integrator's first is
# small, and they grow by this factor at most, since one part of a picture may cost much more than
# another. The renders that come after begin at the pace that it had.
WAVEFRONT_SECONDS = 1.0
FIRST_SAMPLES = 2**16
GROWTH = 16
_paces: WeakKeyDictionary = WeakKeyDictionary()  # seconds a sample, by integrator
# They are multiples of this. No pixel with a power of two of samples is cut, so that its sum under
# a box filter is the same bit by bit.
STEP_SAMPLES = 2**12

# Samplers other than "independent" seed a wavefront as a whole: where it is cut shows in the
# picture. Such a tile holds about so many samples, whatever time they take.
TILE_SAMPLES = 2**19

NO_PIXEL = 2**32 - 1  # number of a pixel outside of the crop


class Passes:
    """The passes of an image that `integrator` renders of `scene` through `sensor`.

    ``spp`` is the number of samples per pixel in each pass, ``count`` the number of passes that
    hold at least the samples asked for. Both follow from the scene and the settings alone.
    A pass holds as many samples as fit into `WAVEFRONT_SAMPLES`, or ``pass_spp`` per pixel if that
    is less, but at least one per pixel. It is rendered in wavefronts; with the sampler
    "independent" each sample has a seed of its own, so that it does not matter where they are cut.
    ``general``: at the twist 0, too, the kernels of other twists, for who changes it while looking.
    ``judged``: if there is one pass only, what its halves differ by is summed up, too, where they
    are independent and the film holds colours.
    """

    def __init__(
        self,
        integrator,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
        pass_spp: int | None = None,
        general: bool = False,
        judged: bool = False,
    ):
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

        self.sampler = self.sensor.sampler().clone()
        self.own_seeds = self.sampler.class_name() == "IndependentSampler"
        wanted = spp or self.sampler.sample_count()
        fits = max(1, WAVEFRONT_SAMPLES // pixels)
        if not self.own_seeds:
            fits = min(fits, TILE_SAMPLES)  # A pixel's samples are in the same tile
        if pass_spp is None:
            pass_spp = math.ceil(wanted / math.ceil(wanted / fits))
        self.sampler.set_sample_count(min(pass_spp, fits))
        self.spp = self.sampler.sample_count()  # Some samplers round it up
        self.sampler.set_samples_per_wavefront(self.spp)
        self.count = math.ceil(wanted / self.spp)
        self.samples = pixels * self.spp  # Of a pass
        special = mi.has_flag(self.film.flags(), mi.FilmFlags.Special)
        self.halved = judged and self.count == 1 < self.spp and self.own_seeds and not special

        pace = _paces.get(integrator)
        self.wavefront = samples_in_time(pace) if pace else FIRST_SAMPLES  # in the next one
        self.begun, self.done = 0.0, 0  # When the pass in work began, and its samples
        if not self.own_seeds:
            self.tiles = math.ceil(pixels / max(1, TILE_SAMPLES // self.spp))
            self.wavefront = math.ceil(pixels / self.tiles) * self.spp

        self.view = integrator.view(scene, general, self.sensor)
        self.camera = Camera(self.sensor, self.view.space, integrator.tolerance)
        self.film.prepare(channel_names(self.layers, "mean"))

    @property
    def left(self) -> float | None:
        """Estimated seconds until the pass that is being rendered is done; None if unknown."""
        if not 0 < self.done < self.samples:
            return None
        return (perf_counter() - self.begun) * (self.samples / self.done - 1)

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
        """Render pass number ``index``."""
        with dr.suspend_grad():
            block = self.film.create_block()
            # As Mitsuba does: samples of one pixel are summed up before they reach the film
            block.set_coalesce(block.coalesce() and self.spp >= 4)
            crop = self.film.crop_size()
            depth = len(channel_names(self.layers, "first"))
            points = dr.zeros(mi.Int32, crop.y * crop.x * depth)
            halves = self._block_of_halves(block) if self.halved else None
            self._render_wavefronts(block, points, index, halves)
            # Double precision only while they are added: a third of the memory
            values = block.tensor()
            return Sums(
                mi.TensorXd(values),
                self._moments(values),
                mi.TensorXi(points, (crop.y, crop.x, depth)),
                ((index, index + 1),),
                self._enlarged(halves.tensor()) if halves else None,
            )

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

    def _block_of_halves(self, block):
        # Of luminance and weight, negative in one half. Channels more in the film's own block would
        # have it summed up in another order, and pictures of one pass differ from others' first.
        return mi.ImageBlock(
            block.size(),
            block.offset(),
            2,
            block.rfilter(),
            block.has_border(),
            coalesce=block.coalesce(),
        )

    def _enlarged(self, differences):
        # Their means differ by a variance that goes with 1/a + 1/b, that of halves with 4/(a + b)
        a, b = self.spp // 2, self.spp - self.spp // 2
        scale = self.spp / (2 * math.sqrt(a * b))
        height, width, count = differences.shape
        planes = [scale * plane(differences, i) for i in range(count)]
        return mi.TensorXd(dr.concat(planes), (count, height, width))

    def _render_wavefronts(self, block, points, index, halves):
        # Added to `block` and `halves`; the layers of a pixel's first sample to `points`
        self.begun, self.done, lanes = perf_counter(), 0, 0
        start = self.begun
        try:
            while self.done + lanes < self.samples:
                # Recorded while the one before it is traced, but not begun; and recorded once. To
                # look for what its loops leave as it is, Dr.Jit would record each of them again,
                # those inside others four times and more, and LLVM finds the same.
                with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
                    add, lanes_of_next = self._record(index, self.done + lanes)
                self._finish(lanes, start)
                start, lanes = perf_counter(), lanes_of_next
                add(block, points, halves)
                del add  # what it has needs not be kept
                # Together: what is evaluated later would be traced again
                dr.eval(block.tensor(), points, halves.tensor() if halves else None)
            self._finish(lanes, start)
        except BaseException:
            # Nothing that was scattered or begun outlives the scene
            dr.eval()
            dr.sync_thread()
            raise

    def _finish(self, lanes, start):
        # Wait for the wavefront in work, and choose the size of those to come
        dr.sync_thread()
        self.done += lanes
        if self.own_seeds and lanes:
            pace = (perf_counter() - start) / lanes
            if self.integrator in _paces:
                self.wavefront = min(samples_in_time(pace), lanes * GROWTH)
                _paces[self.integrator] = pace
            else:
                _paces[self.integrator] = 0.0  # the first has been compiled, which is no measure

    def _record(self, index, first):
        """Trace the samples from number ``first`` on; returns what adds them up, and how many."""
        # Opaque, so that one kernel does for all passes and wavefronts
        spp = dr.opaque(mi.UInt32, self.spp)
        lanes = self.wavefront
        if self.own_seeds:
            left = self.samples - first
            pieces = max(1, round(left / lanes))  # no small rest
            steps = max(1, round(left / pieces / STEP_SAMPLES))
            lanes = left if pieces == 1 else min(steps * STEP_SAMPLES, left)
            lanes = max(2, lanes)  # a single one is another kernel
        sample = dr.arange(mi.UInt32, lanes) + dr.opaque(mi.UInt32, first)
        sampler = self.sampler.clone()
        if self.own_seeds:
            sampler.seed(sample_seeds(self.seed, index, sample), 1)
        else:
            tile = index * self.tiles + first // lanes
            sampler.seed(dr.opaque(mi.UInt32, pass_seed(self.seed, tile)), lanes)
        number, inside, ray, weight, position, across = self._sample_rays(sampler, sample // spp)
        start = self.camera.start(ray, across)
        # Where a sensor shows nothing, as around a dome's picture, nothing is traced
        shown = inside & dr.any(weight != 0)
        radiance, valid, seen = self.integrator.trace(self.view, sampler, ray, *start, shown)

        def add(block, points, halves):
            value, one = dr.select(inside, radiance * weight, 0), dr.select(inside, mi.Float(1), 0)
            if halves:
                sign = dr.select((sample % spp) & 1 == 1, -one, one)
                halves.put(position, [sign * _luminance(value, ray.wavelengths), sign])
            ADIntegrator._splat_to_block(
                block,
                self.film,
                position,
                value=value,
                weight=one,
                alpha=dr.select(valid & shown, mi.Float(1), 0),
                aovs=self._channels(seen, "mean"),
                wavelengths=ray.wavelengths,
            )
            channels = self._channels(seen, "first")
            if channels:  # in one scatter: a second one would have the paths of the first traced
                dr.scatter(
                    points, mi.ArrayXi(channels), number, (number != NO_PIXEL) & (sample % spp == 0)
                )

        return add, lanes

    def _sample_rays(self, sampler, pixel):
        """Camera rays of the pixels with these numbers, as `ADIntegrator.sample_rays`."""
        film, sensor = self.film, self.sensor
        inside = pixel < dr.prod(self.size)
        place = mi.Vector2i(pixel % self.size.x, pixel // self.size.x)
        if film.sample_border():
            place -= film.rfilter().border_size()
        # A pixel's own number in the crop; those of the border have none
        own = (
            inside
            & (place.x >= 0)
            & (place.y >= 0)
            & (place.x < film.crop_size().x)
            & (place.y < film.crop_size().y)
        )
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
        return [
            channel
            for layer in self.layers
            if LAYERS[layer].rule == rule
            for channel in seen[layer]
        ]


def _luminance(value, wavelengths):
    """That of the colour which Mitsuba adds to a film."""
    if mi.is_spectral:
        value = mi.spectrum_to_srgb(value, wavelengths)
    elif mi.is_monochromatic:
        value = mi.Color3f(value.x)
    return sum(c * channel for c, channel in zip(LUMINANCE, value, strict=True))


def samples_in_time(pace: float) -> int:
    """Samples in a wavefront of about `WAVEFRONT_SECONDS`, if each takes ``pace`` seconds."""
    steps = int(min(WAVEFRONT_SECONDS / pace, WAVEFRONT_SAMPLES) / STEP_SAMPLES)
    return max(1, steps) * STEP_SAMPLES


def sample_seeds(seed: int, index: int, sample: mi.UInt32) -> mi.UInt32:
    """Seeds of the samples with these numbers in pass number ``index``.

    They are hashed. Two samples of 2³² share a seed by chance, as those of any two renders may:
    where such a pair lies follows no pattern.
    """
    return mi.sample_tea_32(sample, dr.opaque(mi.UInt32, pass_seed(seed, index)))[0]


def pass_seed(seed: int, index: int) -> int:
    """Seed of pass number ``index``: ``seed`` itself, then steps of 2³² times the golden ratio."""
    return (seed + index * 0x9E3779B9) % 2**32
