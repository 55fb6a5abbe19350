"""Images that picture files are made of in tests."""

import drjit as dr
import mitsuba as mi

from nil_mitsuba import exr, exr_header
from nil_mitsuba.layers import LAYERS

HEIGHT, WIDTH = 37, 53  # nothing divides them
METADATA = {
    "commandLine": 'nil-mitsuba render "my scene.xml" -D a=ü',
    "scene": "my scene.xml",
    "sceneHash": "9f86d081884c7d65",
    "spp": 64,
    "seed": 2**32 - 1,
    "passes": "0:16",
    "renderTime": 12.345678901,
    "x_fov": 80.0,
    "twist": 1,
    "tolerance": 0.25,
    "quotient": True,
    "integrator": "NilIntegrator[\n  twist = 1\n]",
    "cell_origin": [-1, 0.1, 2],
}


def random_image(channels, seed=0, height=HEIGHT, width=WIDTH):
    numbers = mi.PCG32(height * width * channels, initstate=seed).next_float32()
    return mi.TensorXf(numbers, (height, width, channels))


def smooth_image(channels):
    """An image that a lossy compression changes little."""
    index = dr.arange(mi.UInt32, HEIGHT * WIDTH * channels) // channels
    x, y = mi.Float(index % WIDTH) / WIDTH, mi.Float(index // WIDTH) / HEIGHT
    return mi.TensorXf(0.5 + 0.4 * dr.sin(4 * x) * dr.cos(3 * y), (HEIGHT, WIDTH, channels))


def all_layers():
    images = {
        key: random_image(len(layer.channels), seed)
        for seed, (key, layer) in enumerate(LAYERS.items())
    }
    return images | {
        "position": 100 * images["position"] - 50,
        "normal": 2 * images["normal"] - 1,
        "cell": dr.floor(2**25 * images["cell"]) - 2**24,
        "shape": dr.floor(1000 * images["shape"]) - 1,
        "samples": dr.floor(2**24 * images["samples"]),
    }


def equal(first, second):
    return first.shape == second.shape and dr.all(first.array == second.array)


def as_half(tensor):
    return mi.TensorXf(mi.TensorXf16(tensor))


def metadata_of(path):
    """Attributes of an EXR file other than those that say how its pixels are stored."""
    header = exr_header.read(path)[0]
    return {name: value for name, (_, value) in header.items() if name not in exr.STRUCTURE}
