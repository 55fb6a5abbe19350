"""A recorded render would go on with numbers of a scene that has changed: it is refused."""

import gc
import re

import drjit as dr
import mitsuba as mi
import pytest

SENTENCE = 'the integrator "nil" takes numbers from the scene .*: render without dr.freeze.'


@pytest.fixture
def scene(rgb):
    gc.collect()  # Dr.Jit aborts where an earlier test's scene is collected while it records
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nil", "quotient": False},
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
            "sky": {"type": "constant"},
            "ball": {"type": "sphere", "center": [0, 0, 3]},
        }
    )


def causes(error):
    while error is not None:
        yield str(error)
        error = error.__cause__


@pytest.mark.parametrize("kind", ["mi.render", "integrator", "moment"])
def test_a_frozen_render_is_refused(scene, kind):
    integrator = scene.integrator()
    if kind == "moment":
        integrator = mi.load_dict({"type": "moment", "of": {"type": "nil", "quotient": False}})

    @dr.freeze
    def frozen(scene):
        if kind == "integrator":
            return integrator.render(scene, spp=4)
        return mi.render(scene, integrator=integrator, spp=4)

    for _ in range(2):  # nothing of the first attempt is replayed
        with pytest.raises(RuntimeError) as refused:
            frozen(scene)
        assert any(re.search(SENTENCE, sentence) for sentence in causes(refused.value))
    assert dr.mean(mi.render(scene, integrator=integrator, spp=4).array)[0] > 0


def test_without_recording_a_frozen_render_follows_the_scene(scene):
    @dr.freeze
    def frozen(scene):
        return mi.render(scene, spp=4)

    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        before = frozen(scene)
        parameters = mi.traverse(scene)
        parameters["ball.to_world"] = mi.Transform4f().translate([0.7, 0, 3])
        parameters.update()
        assert not dr.allclose(frozen(scene), before)
        assert dr.allclose(frozen(scene), mi.render(scene, spp=4))
