import re
import sys

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import llvm, registration

JIT_VARIANTS = ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral"]

SCENE = """
<scene version="3.0.0">
    <default name="twist" value="1"/>
    <integrator type="nil"><float name="twist" value="$twist"/></integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0.5, 0.5, 0.1" target="0.5, 0.5, 1" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="8"/>
            <integer name="height" value="8"/>
        </film>
    </sensor>
    <shape type="sphere">
        <point name="center" x="0.5" y="0.5" z="0.7"/>
        <float name="radius" value="0.15"/>
        <emitter type="area"/>
    </shape>
</scene>
"""


def mean(image):
    return dr.mean(image.array)[0]


def description(integrator):
    return {
        "type": "scene",
        "integrator": integrator,
        "sensor": {
            "type": "perspective",
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "component_format": "float32"},
        },
        "lamp": {"type": "sphere", "center": [0, 0, 0.7], "radius": 0.1, "light": {"type": "area"}},
    }


@pytest.fixture(autouse=True)
def back_to_rgb():
    mi.set_variant("llvm_ad_rgb")
    yield
    mi.set_variant("llvm_ad_rgb")


def test_nil_renders_in_every_jit_variant_and_after_switching_back():
    means = []
    for variant in [*JIT_VARIANTS, "scalar_rgb", *JIT_VARIANTS]:
        mi.set_variant(variant)
        if variant != "scalar_rgb":
            means.append(mean(mi.render(mi.load_string(SCENE), spp=16)))
    assert all(0.05 < value < 2 for value in means)
    assert means[: len(JIT_VARIANTS)] == pytest.approx(means[len(JIT_VARIANTS) :], rel=1e-4)


def test_a_variant_set_for_a_while_has_nil_too():
    with mi.util.scoped_set_variant("llvm_ad_mono"):
        assert mean(mi.render(mi.load_string(SCENE), spp=4)) > 0
    assert mean(mi.render(mi.load_string(SCENE), spp=4)) > 0


def test_a_variant_set_before_the_import_has_nil(fresh_python):
    libraries = llvm._wheel_libraries() or llvm._system_libraries()
    if not libraries:
        pytest.skip("Dr.Jit finds its LLVM by itself here")
    run = fresh_python(
        "import mitsuba as mi\n"
        "mi.set_variant('llvm_ad_spectral')\n"
        "import nil_mitsuba\n"
        "mi.load_dict({'type': 'nil'})\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "print(mi.load_dict({'type': 'nil'}).twist)",
        DRJIT_LIBLLVM_PATH=libraries[0],
    )
    assert run.stdout.strip() == "1.0", run.stderr


def test_registering_twice_registers_once(monkeypatch):
    registration.install()
    registration.install()
    assert sum(isinstance(finder, llvm.Guard) for finder in sys.meta_path) == 1

    calls = []
    monkeypatch.setattr(llvm, "require", calls.append)
    mi.set_variant("llvm_ad_mono")
    assert calls.count("llvm_ad_mono") == 1


@pytest.mark.parametrize("variant", ["scalar_rgb", "scalar_spectral", "llvm_ad_mono_polarized"])
def test_a_variant_that_cannot_run_nil_names_one_that_can(variant):
    mi.set_variant(variant)
    with pytest.raises(RuntimeError, match=f'cannot run in {variant} .* variant "llvm_ad_rgb"'):
        mi.load_dict({"type": "nil"})


def test_cuda_is_refused_only_when_polarized():
    cuda = [name for name in mi.variants() if name.startswith("cuda_")]
    refused = [name for name in cuda if registration.refusal(name)]
    assert cuda and refused == [name for name in cuda if name.endswith("_polarized")]


@pytest.mark.parametrize("derivative", ["render_forward", "render_backward"])
def test_gradients_are_declined_in_a_sentence(derivative):
    scene = mi.load_string(SCENE)
    with pytest.raises(Exception, match="gradients"):
        getattr(scene.integrator(), derivative)(scene, None, None, sensor=0)


@pytest.mark.parametrize("parallel", [True, False])
def test_files_strings_and_parameters_reach_nil(tmp_path, parallel):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    of_file = mi.load_file(str(path), parallel=parallel, twist="2").integrator()
    of_string = mi.load_string(SCENE, parallel=parallel).integrator()
    assert (of_file.twist, of_string.twist) == (2, 1)


def test_render_takes_spp_seed_and_sensor():
    two = description({"type": "nil"})
    two["wide"] = two["sensor"] | {"fov": 90.0}
    scene = mi.load_dict(two)
    first = mi.render(scene, spp=4, seed=1)
    assert dr.allclose(first, mi.render(scene, spp=4, seed=1, sensor=0))
    assert not dr.allclose(first, mi.render(scene, spp=4, seed=2))
    assert mean(mi.render(scene, spp=64, sensor=1)) < mean(mi.render(scene, spp=64, sensor=0))


def test_moments_of_nil_agree_with_its_image():
    wrapped = mi.load_dict(description({"type": "moment", "inner": {"type": "nil"}}))
    image = mi.render(wrapped, spp=64)
    plain = mi.render(mi.load_dict(description({"type": "nil"})), spp=64)
    assert image.shape[2] > plain.shape[2]
    assert mean(image[:, :, :3]) == pytest.approx(mean(plain), rel=0.05)
    second = image[:, :, plain.shape[2] + 3 :]
    assert mean(second) >= mean(plain) ** 2


def test_aovs_around_nil_run_and_warn_that_they_are_traced_straight(capfd):
    wrapped = mi.load_dict(
        description({"type": "aov", "aovs": "depth:depth", "inner": {"type": "nil"}})
    )
    image = mi.render(wrapped, spp=4)
    assert mean(image[:, :, :3]) > 0
    assert "straight" in capfd.readouterr().out


def test_rendering_without_writing_leaves_numpy_alone(fresh_python):
    run = fresh_python(
        "import sys, nil_mitsuba, mitsuba as mi, drjit as dr\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        f"dr.eval(mi.render(mi.load_string({SCENE!r}), spp=1))\n"
        "print('numpy' in sys.modules)"
    )
    assert run.stdout.strip().splitlines()[-1] == "False", run.stderr


def test_shapes_outside_the_cube_are_named(rgb, capfd):
    """What is never seen is said; nothing is said of what is inside."""
    mi = rgb
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nil", "max_depth": 1},
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
            "inside": {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.1},
            "outside": {"type": "sphere", "center": [0.5, 0.5, 0.9], "radius": 0.25},
        }
    )
    mi.render(scene, spp=1)
    text = capfd.readouterr().out
    assert '"outside" reaches 0.15 scene units out of the cube' in text
    assert '"inside"' not in text


def test_many_shapes_outside_the_cube_are_one_warning(rgb, capfd):
    mi = rgb
    ball = {"type": "sphere", "radius": 0.2}
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    scene = {"type": "scene", "sensor": {"type": "perspective", "film": film}}
    scene |= {f"ball{i}": ball | {"center": [i, 0.5, 0.5]} for i in range(1, 8)}
    mi.render(mi.load_dict(scene), integrator=mi.load_dict({"type": "nil"}), spp=1)
    (warning,) = re.findall(r"nil: the shape .*", capfd.readouterr().out)
    assert '"ball7" reaches 6.2 scene units' in warning and "(the farthest of 7)" in warning
