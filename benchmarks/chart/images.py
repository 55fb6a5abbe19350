"""Whole images by each method: error over time, and what is left of it without noise."""

import math
import statistics
from unittest import mock

import drjit as dr
import mitsuba as mi

from nil_mitsuba import view

from .. import truth
from ..flip import flip
from .methods import DEFAULT, PACKAGE, timed, tracer_of
from .scenes import MAIN, TWIST, triangles

COLOURS = ((0.75, 0.25, 0.15), (0.2, 0.45, 0.7), (0.8, 0.65, 0.25), (0.35, 0.6, 0.3))

# Settings with about as many chords a ray as the package takes at 1 to 4 pixels; for the package
# those between which its default is to be chosen
IMAGE_KNOBS = (
    ("Euler pieces", 0.03),
    ("Runge–Kutta 4", 0.1),
    ("Dormand–Prince", 1e-3),
    ("printed form", 0.1),
    ("stable form", 0.1),
    (PACKAGE, 4),
    (PACKAGE, 1),
    (PACKAGE, DEFAULT),
)
# What images are compared with is not the package's tracer: chords whose sagitta is 1e-4 cells at
# most, a few thousandths of a pixel. That the package comes to the same is seen from its CHECK.
REFERENCE = ("stable form", 0.03)
CHECK = (PACKAGE, DEFAULT / 16)


def picture(setup, width, height):
    """The setup with materials, a sky and a lamp by the camera."""

    def coloured(i):
        return {
            "type": "diffuse",
            "reflectance": {"type": "rgb", "value": list(COLOURS[i % len(COLOURS)])},
        }

    if setup.mesh:
        mesh = triangles(setup.surfaces, setup.mesh)
        mesh.set_bsdf(mi.load_dict({"type": "twosided", "bsdf": coloured(0)}))
        shapes = {"s0": mesh}
    else:
        shapes = truth.to_mitsuba(setup.surfaces, mi)
        for i, shape in enumerate(shapes.values()):
            shape["bsdf"] = (
                {"type": "conductor"}
                if i == setup.mirror
                else {"type": "twosided", "bsdf": coloured(i)}
            )
    lamp = [o + d for o, d in zip(setup.origin, (0.07, 0.03, 0.11))]
    return mi.load_dict(
        {
            "type": "scene",
            **shapes,
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.35, 0.42, 0.5]}},
            "lamp": {
                "type": "sphere",
                "center": lamp,
                "radius": 0.02,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 60.0}},
            },
            "sensor": {
                "type": "perspective",
                "fov": setup.fov,
                "to_world": mi.ScalarTransform4f().look_at(
                    list(setup.origin), list(setup.target), [0.01, 0.02, 1]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "pixel_format": "rgb",
                    "rfilter": {"type": "box"},
                },
            },
        },
        optimize=False,
    )  # Mitsuba 3.9 would merge shapes of one material, and lose their bounds


def rendered(scene, setup, method, knob, spp, seed):
    """An image and the processor seconds it took."""
    renderer = mi.load_dict(
        {
            "type": "nil",
            "twist": float(TWIST),
            "quotient": setup.quotient,
            "max_depth": 3,
            "max_distance": float(MAIN["length"]),
            "tolerance": knob if method == PACKAGE else DEFAULT,
        }
    )

    def tracer(scene, space, max_distance, shapes, focus):
        return tracer_of(method, knob, scene, space, max_distance, shapes, focus)

    with mock.patch.object(view, "Tracer", tracer):
        return timed(lambda: mi.render(scene, integrator=renderer, spp=spp, seed=seed))


def images(setup, knobs, width, height, spp, numbers, reference_spp):
    """Rows of image error over time, and of what is left of it without noise, for one setup.

    ``knobs``: pairs of a method and its knob. Each renders images of ``spp`` samples per pixel with
    the seeds 0, 1, …, of which the first so many as ``numbers`` tell are averaged.

    relMSE is (I − R)(I − R')/(R̄² + 0.01) with two references of other seeds that know nothing of
    each other, so that their own noise has mean zero in it. The error without noise has D D' in
    its numerator, where D = I − R is of images of one seed, whose paths are the same as far as the
    tracers agree and their noise with them, and D' the same of another seed. Its standard error is
    that of the mean over pairs of seeds that have none in common.
    """
    scene = picture(setup, width, height)

    def several(method, knob):
        return [rendered(scene, setup, method, knob, spp, seed) for seed in range(numbers[-1])]

    references = [
        rendered(scene, setup, *REFERENCE, reference_spp, seed)[0] for seed in (1001, 1002)
    ]
    mean = 0.5 * (references[0] + references[1])
    weight = dr.rcp(dr.square(mean.array) + 0.01)
    same_seeds = [image.array for image, _ in several(*REFERENCE)]
    rows, differences = [], []
    for method, knob in (*knobs, CHECK):
        pictures = several(method, knob)
        setting = {"scene": setup.kind, "space": setup.space, "method": method, "knob": knob}
        for n in numbers if (method, knob) != CHECK else ():
            image = sum(image for image, _ in pictures[:n]) / n
            off = [image.array - reference.array for reference in references]
            rows.append(
                setting
                | {
                    "spp": n * spp,
                    "seconds": sum(seconds for _, seconds in pictures[:n]),
                    "relMSE": dr.mean(off[0] * off[1] * weight)[0],
                    "FLIP": dr.mean(flip(image, mean).array)[0],
                }
            )
        off = [image.array - other for (image, _), other in zip(pictures, same_seeds)]
        pairs = [dr.mean(d * other * weight)[0] for d, other in zip(off[::2], off[1::2])]
        error = statistics.mean(pairs)
        deviation = statistics.stdev(pairs) / math.sqrt(len(pairs))
        root = math.sqrt(max(error, 0))
        differences.append(
            setting
            | {
                "relMSE without noise": error,
                "± relMSE": deviation,
                "relative error": root,
                "± up": math.sqrt(max(error, 0) + deviation) - root,
            }
        )
    return rows, differences
