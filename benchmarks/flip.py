"""The perceptual difference LDR-FLIP of two images, in Dr.Jit.

P. Andersson, J. Nilsson, T. Akenine-Möller, M. Oskarsson, K. Åström and M. D. Fairchild, "FLIP: A
Difference Evaluator for Alternating Images", Proc. ACM on Computer Graphics and Interactive
Techniques 3(2), 2020. Names and constants are the paper's.
"""

import math

import drjit as dr
import mitsuba as mi

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180  # 0.7 m from a screen 0.7 m wide, of 4K
QC, PC, PT, QF = 0.7, 0.4, 0.95, 0.5
FEATURE_WIDTH = 0.082  # degrees

# Sums of Gaussians (a, b): sensitivity to contrast of brightness, red-green and blue-yellow
CONTRAST = (((1, 0.0047),), ((1, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))

# Linear sRGB to XYZ, and the white of the screen
TO_XYZ = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)
WHITE = tuple(sum(row) for row in TO_XYZ)


def flip(image, reference):
    """The FLIP error of each pixel, a TensorXf of height × width, 0 (equal) to 1.

    ``image``, ``reference``: TensorXf of height × width × 3, linear sRGB; what lies outside [0, 1]
    is clipped, as a screen does.
    """
    shape = image.shape
    if shape != reference.shape or len(shape) != 3 or shape[2] != 3:
        raise ValueError(
            f"flip() compares two images of height x width x 3 of one size, and got "
            f"{shape} and {reference.shape}."
        )
    size = shape[:2]
    pair = [_opponent([dr.clip(x, 0, 1) for x in _planes(x)]) for x in (image, reference)]

    # Colour: what the eye cannot resolve is filtered away, then distance in Hunt-adjusted L*a*b*
    seen = [_hunt_lab([dr.clip(x, 0, 1) for x in _linear(_filtered(x, size))]) for x in pair]
    largest = _hyab(_hunt_lab((0.0, 1.0, 0.0)), _hunt_lab((0.0, 0.0, 1.0))) ** QC
    distance = dr.power(_hyab(*seen), QC)
    knee = PC * largest
    colour = dr.select(
        distance < knee, PT / knee * distance, PT + (distance - knee) / (largest - knee) * (1 - PT)
    )

    # Features: edges and points that one image has and the other has not
    luminance = [(x[0] + 16) / 116 for x in pair]
    edges, points = zip(*(_features(x, size) for x in luminance))
    feature = dr.maximum(dr.abs(edges[0] - edges[1]), dr.abs(points[0] - points[1]))
    feature = dr.power(feature / math.sqrt(2), QF)
    return mi.TensorXf(dr.power(colour, 1 - feature), size)


def _planes(image):
    return [
        dr.gather(mi.Float, image.array, 3 * dr.arange(mi.UInt32, len(image.array) // 3) + i)
        for i in range(3)
    ]


def _opponent(rgb):
    """Linear sRGB to Y'CxCz."""
    x, y, z = (sum(m * c for m, c in zip(row, rgb)) / white for row, white in zip(TO_XYZ, WHITE))
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


def _linear(opponent):
    """Y'CxCz to linear sRGB."""
    y = (opponent[0] + 16) / 116
    xyz = (y + opponent[1] / 500, y, y - opponent[2] / 200)
    inverse = dr.rcp(dr.scalar.Matrix3f64(TO_XYZ))
    return [sum(inverse[i, j] * WHITE[j] * xyz[j] for j in range(3)) for i in range(3)]


def _hunt_lab(rgb):
    """Linear sRGB to L*a*b* whose colours fade where it is dark (Hunt)."""
    delta = 6 / 29

    def root(t):
        return dr.select(t > delta**3, dr.cbrt(dr.maximum(t, 1e-9)), t / (3 * delta**2) + 4 / 29)

    x, y, z = (
        root(sum(m * c for m, c in zip(row, rgb)) / white) for row, white in zip(TO_XYZ, WHITE)
    )
    lightness = 116 * y - 16
    return lightness, 0.01 * lightness * 500 * (x - y), 0.01 * lightness * 200 * (y - z)


def _hyab(lab, other):
    difference = [a - b for a, b in zip(lab, other)]
    return dr.abs(difference[0]) + dr.sqrt(difference[1] ** 2 + difference[2] ** 2)


def _convolved(plane, size, weights, axis):
    """``plane`` filtered along rows (axis 1) or columns (0); the border is repeated outwards."""
    height, width = size
    index = dr.arange(mi.Int32, height * width)
    x, y = index % width, index // width
    radius = len(weights) // 2
    result = mi.Float(0)
    for i, weight in enumerate(weights):
        shift = i - radius
        at = (
            y * width + dr.clip(x + shift, 0, width - 1)
            if axis
            else dr.clip(y + shift, 0, height - 1) * width + x
        )
        result = dr.fma(weight, dr.gather(mi.Float, plane, mi.UInt32(at)), result)
    dr.eval(result)
    return result


def _gaussian(radius, exponent):
    return [math.exp(-exponent * i * i) for i in range(-radius, radius + 1)]


def _filtered(planes, size):
    """Opponent colours without what the eye cannot resolve at this distance."""
    widest = max(b for gaussians in CONTRAST for _, b in gaussians)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * PIXELS_PER_DEGREE)
    result = []
    for plane, gaussians in zip(planes, CONTRAST):
        total, norm = mi.Float(0), 0
        for a, b in gaussians:
            weights = _gaussian(radius, math.pi**2 / b / PIXELS_PER_DEGREE**2)
            scale = a * math.sqrt(math.pi / b)
            both = _convolved(_convolved(plane, size, weights, 1), size, weights, 0)
            total, norm = total + scale * both, norm + scale * sum(weights) ** 2
        result.append(total / norm)
    return result


def _features(luminance, size):
    """Strength of edges and of points."""
    sigma = 0.5 * FEATURE_WIDTH * PIXELS_PER_DEGREE
    radius = math.ceil(3 * sigma)
    blur = _gaussian(radius, 0.5 / sigma**2)
    offsets = range(-radius, radius + 1)
    edge = [-i * g for i, g in zip(offsets, blur)]
    point = [(i * i / sigma**2 - 1) * g for i, g in zip(offsets, blur)]
    blur = [g / sum(blur) for g in blur]
    strengths = []
    for weights in (edge, point):
        # What rises and what falls counts the same
        rise, fall = sum(w for w in weights if w > 0), -sum(w for w in weights if w < 0)
        weights = [w / (rise if w > 0 else fall) for w in weights]
        across = [
            _convolved(_convolved(luminance, size, weights, axis), size, blur, 1 - axis)
            for axis in (0, 1)
        ]
        strengths.append(dr.sqrt(across[0] ** 2 + across[1] ** 2))
    return strengths
