"""Scenes for the command, what it writes, and what it says."""

import re

import mitsuba as mi
import pytest

SENSOR = """
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0.5, 0.5, 0.1" target="0.5, 0.5, 1" up="0, 1, 0"/>
        </transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="12"/>
            <integer name="height" value="8"/>
            <string name="component_format" value="$format"/>
        </film>
    </sensor>
"""
LAMP = """
    <shape type="sphere">
        <point name="center" x="0.5" y="0.5" z="0.7"/>
        <float name="radius" value="0.15"/>
        <emitter type="area"/>
    </shape>
"""
NIL = '<integrator type="nil"><float name="max_distance" value="1"/></integrator>'  # one lamp
DEFAULTS = '<default name="spp" value="4"/><default name="format" value="float16"/>'
# Two renders are equal to the bit only with a box filter: else threads add to the same pixels
REPEATABLE = SENSOR.replace("</film>", '<rfilter type="box"/></film>')
BOX = REPEATABLE.replace("$format", "float32")
BALL = """
    <shape type="sphere" id="ball">
        <point name="center" x="0.3" y="0.5" z="0.6"/><float name="radius" value="0.1"/>
        <bsdf type="diffuse"/>
    </shape>
    <bsdf type="diffuse" id="paper"/>
    <shape type="ply"><string name="filename" value="a.ply"/><ref id="paper"/></shape>
    <shape type="ply"><string name="filename" value="b.ply"/><ref id="paper"/></shape>
"""
MESH = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
{x} .1 .9
{x} .9 .9
.5 .5 .9
3 0 1 2
"""


def scene(*parts):
    return f'<scene version="3.0.0">{DEFAULTS}{"".join(parts)}</scene>'


def read(path):
    """Header, pixel types and pixels of an EXR file; pixels as a Mitsuba tensor."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = dict(file.header())
        types = {name: str(channel.pixels.dtype) for name, channel in file.channels().items()}
    bitmap = mi.Bitmap(str(path))
    if bitmap.component_format() != mi.Struct.Type.Float32:
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32)
    return header, types, mi.TensorXf32(bitmap)


def planes(path):
    """The channels of a file by name, as lists of rows."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.tolist() for name, channel in file.channels().items()}


def assert_close(rows, others):
    """Other kernels round otherwise."""
    for row, expected in zip(rows, others):
        assert row == pytest.approx(expected, rel=1e-4, abs=1e-6)


def remarks(err):
    """What was said, without the line on samples and noise that ends a still."""
    return re.sub(r"^\d+ samples? per pixel, noise .*\.\n", "", err, flags=re.M)


def complaint(err):
    """The one line of complaint; what was said before it is a note on the integrator."""
    lines = err.splitlines()
    assert lines[-1].startswith("nil-mitsuba: ") and "Traceback" not in err
    assert not [line for line in lines[:-1] if line and '"nil"' not in line]
    assert not re.search(r"\.cpp|\.py", lines[-1])
    return lines[-1]
