"""A still is the sum of passes, which follow from the scene and the settings alone."""

import drjit as dr
import mitsuba as mi
import pytest

import nil_mitsuba
from nil_mitsuba import stills
from small_stills import description, equal, still_of, sums_of


def test_a_still_is_the_mean_of_renders_with_the_seeds_of_its_passes(small):
    from nil_mitsuba.passes import pass_seed

    still = still_of(small, seed=5)
    image = still.develop(sums_of(still, *range(4)))
    separate = [mi.render(small, spp=16, seed=pass_seed(5, index)) for index in range(4)]
    mean = sum(separate[1:], separate[0]) / 4
    assert not equal(separate[0], separate[1])
    assert dr.allclose(image, mean, rtol=1e-6, atol=1e-7)


def test_it_is_what_mitsuba_renders(small):
    assert dr.allclose(nil_mitsuba.render(small, spp=24, seed=3), mi.render(small, spp=24, seed=3))


def test_no_pass_compiles_anything_after_the_first(small):
    kernels = []

    def kernels_of_this_pass(_):
        history = dr.kernel_history([dr.KernelType.JIT])
        kernels.append({entry["hash"] for entry in history})
        dr.kernel_history_clear()

    still = still_of(small)
    state = still.nothing()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        still.accumulate(state, (still.render(i) for i in range(3)), kernels_of_this_pass)
    before, *passes = kernels
    assert len(passes) == 3 and len(passes[0]) > 2
    assert passes[1] <= passes[0] | before and passes[2] == passes[1]


def test_sizes_of_passes_follow_from_the_scene_and_the_settings_alone(small):
    sizes = []
    for threads in (1, 2):
        dr.set_thread_count(threads)
        still = stills.Still(small, rules=stills.Rules(spp=10**6))
        sizes.append((still.passes.spp, still.count))
    assert sizes[0] == sizes[1]
    size, count = sizes[0]
    assert 64 * size <= 2**21 and size * count >= 10**6 > size * (count - 1)


def test_a_wrapper_renders_in_one_go_only(rgb):
    scene = mi.load_dict(description() | {"integrator": {"type": "moment", "of": {"type": "nil"}}})
    with pytest.raises(ValueError, match="in one go"):
        nil_mitsuba.render(scene)
