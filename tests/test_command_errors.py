"""What the command says, in one sentence, of what went wrong, and what it does not say."""

import drjit as dr
import mitsuba as mi
import pytest

import nil_mitsuba
from nil_mitsuba import errors, llvm

SCENE = """
<scene version="3.0.0">
    <integrator type="nil"/>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="4"/><integer name="height" value="4"/>
        </film>
    </sensor>
    <emitter type="constant"/>
    <shape type="sphere">
        <point name="center" value="0.5, 0.5, 0.5"/><float name="radius" value="0.2"/>BSDF
    </shape>
</scene>
"""
WARNS = SCENE.replace("0.2", "0.7")  # of a ball that reaches out of the cube
WITHOUT = SCENE.replace('<integrator type="nil"/>', "")  # and says so


@pytest.fixture
def broken(rgb):
    """Registers the material "broken", which raises what is put here while paths are traced.

    Black afterwards, since Dr.Jit asks every material that is alive in the process.
    """
    raised = []

    def result(value):
        def method(*_):
            if raised:
                raise raised[0]
            return value()

        return method

    class Broken(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        eval = result(lambda: mi.Spectrum(0))
        pdf = result(lambda: mi.Float(0))
        eval_pdf = result(lambda: (mi.Spectrum(0), mi.Float(0)))
        sample = result(lambda: (dr.zeros(mi.BSDFSample3f), mi.Spectrum(0)))

        def to_string(self):
            return "Broken[]"

    mi.register_bsdf("broken", Broken)
    yield raised
    raised.clear()


@pytest.fixture
def render(command, folder):
    """Runs the command on a scene: its status, what it printed and its complaints."""

    def run(scene, *arguments):
        (folder / "scene.xml").write_text(scene)
        return command("render", "scene.xml", *arguments)

    return run


def material(name):
    return SCENE.replace("BSDF", f'<bsdf type="{name}"/>')


# --------------------------------------------------------- errors inside of loops


def test_an_error_of_a_plugin_while_paths_are_traced_is_told(render, broken):
    broken.append(ValueError("the material has run out of paint."))
    assert render(material("broken"), "--spp", "1") == (
        1,
        "",
        "nil-mitsuba: the material has run out of paint.\n",
    )


@pytest.mark.parametrize("wrapper", ["", "moment"])
def test_an_error_while_paths_are_traced_is_the_one_that_python_sees(broken, wrapper, capfd):
    broken.append(ValueError("the material has run out of paint."))
    nil = '<integrator type="nil"/>'
    text = material("broken")
    if wrapper:
        text = text.replace(nil, f'<integrator type="{wrapper}">{nil}</integrator>')
    scene = mi.load_string(text)
    with pytest.raises(ValueError, match="^the material has run out of paint.$"):
        scene.integrator().render(scene, scene.sensors()[0], spp=1)
    # Mitsuba's own function wraps it once more
    with pytest.raises(RuntimeError) as caught:
        mi.render(scene, spp=1)
    assert str(errors.cause_of(caught.value)) == "the material has run out of paint."
    if not wrapper:
        with pytest.raises(ValueError, match="^the material has run out of paint.$"):
            nil_mitsuba.render(scene, spp=1)


def test_an_interruption_while_paths_are_traced_stays_one(broken):
    broken.append(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        nil_mitsuba.render(mi.load_string(material("broken")), spp=1)


def test_an_error_without_a_cause_is_its_own():
    error = RuntimeError("dr.while_loop(): encountered an exception (see above).")
    assert errors.cause_of(error) is error


# ------------------------------------------------------------------ GPU variants


@pytest.mark.parametrize("variant", ["cuda_ad_rgb", "cuda_ad_spectral"])
def test_a_gpu_that_is_not_there_is_missed_in_a_sentence(render, variant):
    if dr.has_backend(dr.JitBackend.CUDA):
        pytest.skip("there is one here")
    status, out, err = render(SCENE.replace("BSDF", ""), "-m", variant)
    assert (status, out) == (1, "")
    assert err == (
        f'nil-mitsuba: the variant "{variant}" needs an NVIDIA GPU and its driver, and Dr.Jit '
        f'finds none here: use "{variant.replace("cuda", "llvm")}", which needs none.\n'
    )
    with pytest.raises(ImportError, match="needs an NVIDIA GPU"):
        mi.set_variant(variant)
    assert mi.variant() == "llvm_ad_rgb"


def test_a_gpu_that_is_there_is_used(monkeypatch):
    monkeypatch.setattr(dr, "has_backend", lambda backend: backend == dr.JitBackend.CUDA)
    llvm.require_gpu("cuda_ad_rgb")
    llvm.require_gpu("scalar_rgb")
    with pytest.raises(ImportError, match='"metal_ad_rgb" needs an Apple GPU'):
        llvm.require_gpu("metal_ad_rgb")


# -------------------------------------------------------------------- properties


def test_a_misspelt_property_is_told_in_one_sentence_with_the_nearest(render):
    status, out, err = render(SCENE.replace("BSDF", ""), "-P", "twsit=2")
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert 'the integrator "nil" has no property "twsit": did you mean "twist"?' in err
    assert "Traceback" not in err


# ------------------------------------------------------------------------- quiet


@pytest.mark.parametrize("workers", [(), ("--workers", "2")], ids=["alone", "workers"])
@pytest.mark.parametrize("scene", [WARNS, WITHOUT], ids=["warns", "notes"])
def test_quiet_is_quiet(render, scene, workers):
    if workers:
        pytest.importorskip("distributed")
    scene = scene.replace("BSDF", "")
    assert render(scene, "--spp", "1", "-q", *workers) == (0, "", "")
    status, out, err = render(scene, "--spp", "1", "-o", "b.exr")
    assert status == 0 and out.endswith("b.exr\n")
    assert "reaches" in out + err or "has no integrator" in out + err


def test_quiet_tells_errors(render):
    status, out, err = render(SCENE.replace("BSDF", ""), "-q", "-P", "twist=0.5")
    assert (status, out) == (1, "") and "does not glue the faces" in err
