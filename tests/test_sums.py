"""Sums of passes: in any order, of any number, none twice."""

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import checkpoint, stills
from small_stills import description, equal, still_of, sums_of


def test_sums_of_more_than_2_to_the_32_samples_lose_nothing(small):
    still = still_of(small, spp=2**34)
    state = sums_of(still, 0)
    many = 2**33 // 16
    far = checkpoint.Checkpoint(
        state.settings,
        type(state.sums)(
            state.sums.values * many, state.sums.moments * many, state.sums.points, ((0, many),)
        ),
    )
    index = next(still.todo(far))
    assert index == many
    more = far.plus(still.render(index))

    weight = more.sums.values.array[3]
    assert weight == 2**33 + 16  # float32 would know multiples of 1024 here
    assert more.sums.count * 16 == 2**33 + 16
    assert dr.allclose(still.develop(more), still.develop(state), rtol=1e-6)
    assert not still.rules.met(stills.Progress(many, 2**33, 1.0, None, still.rules))
    assert still.rules.met(stills.Progress(2 * many, 2**34, 1.0, None, still.rules))


def test_the_order_of_passes_does_not_matter(rgb):
    scene = mi.load_dict(description(aovs="shape, cell"))
    still = still_of(scene)
    forth = still.develop(sums_of(still, 0, 1, 2, 3))
    back = still.develop(sums_of(still, 3, 1, 0, 2))
    assert dr.allclose(forth, back, rtol=1e-6)
    assert equal(forth[:, :, 3:], back[:, :, 3:])


@pytest.mark.parametrize(
    "present, expected", [([], [0, 1, 2, 3, 4]), ([(0, 3)], [3, 4]), ([(1, 2), (4, 5)], [0, 2, 3])]
)
def test_passes_that_are_there_are_not_rendered_again(small, present, expected):
    still = still_of(small)
    state = still.nothing()
    state.sums.passes = tuple(present)
    assert list(still.todo(state, stop=5)) == expected
    endless = still.todo(state)
    assert [next(endless) for _ in expected] == expected
