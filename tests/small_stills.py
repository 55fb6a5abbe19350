"""Little scenes, and stills of them."""

import drjit as dr
import mitsuba as mi

from nil_mitsuba import stills

SCENE = """
<scene version="3.0.0">
    <default name="spp" value="16"/>
    <default name="resolution" value="12"/>
    <default name="twist" value="1"/>
    <integrator type="nil"><float name="twist" value="$twist"/></integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0.1, 0.1, 0.6" target="0.7, 1, 0.4" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resolution"/>
            <integer name="height" value="$resolution"/>
            <string name="component_format" value="float32"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant"/>
    <shape type="obj"><string name="filename" value="triangle.obj"/></shape>
    <shape type="sphere">
        <point name="center" value="0.5, 0.5, 0.5"/><float name="radius" value="0.2"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.2, 0.1"/></bsdf>
    </shape>
</scene>
"""
TRIANGLE = "v 0.1 0.1 .9\nv 0.9 0.1 .9\nv 0.1 0.9 .9\nf 1 3 2\n"


def description(size=8, rfilter="box", **integrator):
    return {
        "type": "scene",
        "integrator": {"type": "nil", "max_depth": 4} | integrator,
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0.1, 0.1, 0.6], [0.7, 1, 0.4], [0, 0, 1]),
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "component_format": "float32",
                "rfilter": {"type": rfilter},
            },
        },
        "lamp": {
            "type": "sphere",
            "center": [0.3, 0.4, 0.8],
            "radius": 0.1,
            "light": {"type": "area"},
        },
        "sky": {"type": "constant", "radiance": 0.1},
        "ball": {
            "type": "sphere",
            "center": [0.5, 0.5, 0.5],
            "radius": 0.2,
            "bsdf": {"type": "diffuse"},
        },
    }


def still_of(scene, spp=64, pass_spp=16, seed=0, **more):
    return stills.Still(scene, seed=seed, rules=stills.Rules(spp=spp), pass_spp=pass_spp, **more)


def equal(a, b):
    return dr.all(a.array == b.array, axis=None)


def sums_of(still, *indices):
    state = still.nothing()
    for index in indices:
        state = state.plus(still.render(index))
    return state
