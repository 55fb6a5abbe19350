"""Past conjugate points, and beside silhouettes: as many rays meet something as along geodesics."""

import pytest

from benchmarks.conjugate_points import compare


@pytest.mark.parametrize("kind", ["soft", "shadow"])
def test_rays_that_leave_a_thing_come_back_to_it_past_a_conjugate_point(rgb, kind):
    """Within one per cent and four standard errors: by chance one run in 30,000 is farther off."""
    *hazards, unmet = compare(f"from surfaces, {kind}", 2**19, 3, (6.5, 10.5, 12))
    for difference, error in (hazards[0], unmet):
        assert error < 0.005
        assert abs(difference) <= 0.01 + 4 * error


def test_as_many_rays_are_hit_by_their_chords_alone_as_by_their_geodesics_alone(rgb):
    """Within four standard errors: by chance one run in 16,000 is farther off."""
    difference, error = compare("from a camera, seen", 2**20, 3)[-1]
    assert 0 < error < 2e-4
    assert abs(difference) <= 4 * error
