"""The way of a flight: along shortest geodesics, at an even speed, past keys or round in a loop."""

import math

import drjit as dr
import drjit.scalar as ds
import mitsuba as mi
import pytest

from nil_mitsuba import geometry
from nil_mitsuba.flight import Flight, rotation
from nil_mitsuba.keys import Key, UnfitError
from nil_mitsuba.pose import Chart, Pose, rotated

CHART = Chart(1.0, True, (0.0, 0.0, 0.0), 1.0, (0, 1, 2))
CELLS_OF_TWO = Chart(1.0, True, (-1.0, 0.0, 0.5), 2.0, (2, 0, 1))  # fibres along the scene's y
OPEN = Chart(0.37, False, (0.0, 0.0, 0.0), 1.0, (0, 1, 2))
AXES = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def pose(place=(0.25, 0.1, 0.7), axis=(0.3, -0.5, 0.8), angle=0.7, sizes=(1, 1, 1), cell=(0, 0, 0)):
    axis = ds.Array3f64(axis) / math.hypot(*axis)
    basis = (ds.Array3f64(1, 0, 0), ds.Array3f64(0, 1, 0), ds.Array3f64(0, 0, 1))
    left, up, view = (s * rotated(v, axis, angle) for s, v in zip(sizes, basis))
    return Pose(ds.Array3f64(place), left, up, view, up, cell)


def key(pose, chart=CHART, **parameters):
    columns = [chart.to_scene_axes(v) for v in (pose.left, pose.up, pose.view)]
    columns.append(chart.to_scene(pose.place))
    rows = [list(row) for row in zip(*columns)]
    return Key([*rows[0], *rows[1], *rows[2], 0.0, 0.0, 0.0, 1.0], pose.cell, parameters)


def flight(*keys, frames=9, chart=CHART, **own):
    return Flight(keys, frames, chart, own)


def poses(flight, frames=9):
    return [flight.at(i)[0] for i in range(frames)]


def close(pose, other, tolerance=1e-12):
    assert pose.cell == other.cell
    for name in ("place", "left", "up", "view"):
        assert list(getattr(pose, name)) == pytest.approx(list(getattr(other, name)), abs=tolerance)


def distance(p, q, chart=CHART):
    return geometry.connect(p, q, chart.twist).distance


# ---------------------------------------------------------------------------- ways


@pytest.mark.parametrize("chart", [CHART, CELLS_OF_TWO, OPEN], ids=["cell", "turned", "open"])
def test_frames_lie_on_the_shortest_geodesic_at_equal_steps(chart):
    cell = (1, -2, 0) if chart.quotient else (0, 0, 0)
    start, end = pose(), pose((0.8, 0.6, 0.2), (0, 1, 0.2), -1.1, cell=cell)
    places = [
        p.covering(chart) for p in poses(flight(key(start, chart), key(end, chart), chart=chart))
    ]
    steps = [distance(p, q, chart) for p, q in zip(places, places[1:])]
    whole = distance(start.covering(chart), end.covering(chart), chart)
    assert steps == pytest.approx([whole / 8] * 8, rel=1e-9)
    assert list(places[0]) == pytest.approx(list(start.covering(chart)), abs=1e-12)
    assert list(places[-1]) == pytest.approx(list(end.covering(chart)), abs=1e-9)


@pytest.mark.parametrize("chart", [CHART, CELLS_OF_TWO], ids=["cell", "turned"])
def test_between_the_ends_of_a_straight_walk_the_flight_is_that_walk(chart):
    start = pose()
    end = start.moved((0.2, 0, 1), 2.4, chart)
    assert end.cell != (0, 0, 0)
    for i, frame in enumerate(poses(flight(key(start, chart), key(end, chart), chart=chart))):
        close(frame, start.moved((0.2, 0, 1), 2.4 * i / 8, chart), 1e-9)


def test_a_flight_far_from_the_first_cell_is_as_exact_as_near_it():
    start, end = pose(), pose((0.8, 0.6, 0.2), angle=1.3, cell=(2, 1, -1))
    far = ds.Array3i64(10**6, -(10**6), 10**6)

    def carried(pose):
        cell = geometry.multiply(far, ds.Array3i64(pose.cell), 1)
        return Pose(pose.place, pose.left, pose.up, pose.view, pose.upright, tuple(map(int, cell)))

    away = poses(flight(key(carried(start)), key(carried(end))))
    for near, there in zip(poses(flight(key(start), key(end))), away):
        close(carried(near), there)


def test_the_last_frame_is_the_last_key_however_far_that_is():
    last = pose((0.7, 0.4, 0.2), cell=(10**6, -(10**6), 10**6))
    close(flight(key(pose()), key(last)).at(8)[0], last, 1e-15)


@pytest.mark.parametrize("chart", [CHART, CELLS_OF_TWO, OPEN], ids=["cell", "turned", "open"])
def test_a_key_that_stands_too_far_away_is_named(chart):
    far = Pose(ds.Array3f64(0.5, 1.1e6, 0.5), *(ds.Array3f64(v) for v in AXES), AXES[1])
    with pytest.raises(UnfitError, match="key 2 of 2: .* more than a million cells"):
        flight(key(pose(), chart), key(far, chart), chart=chart)
    near = Pose(ds.Array3f64(0.5, 0.9e6, 0.5), far.left, far.up, far.view, far.upright)
    flight(key(pose(), chart), key(near, chart), chart=chart)


def test_the_first_and_the_last_frame_are_the_first_and_the_last_key():
    ends = pose(), pose((0.9, 0.2, 0.4), angle=2.0)
    way = flight(key(ends[0]), key(pose(angle=-1.0)), key(ends[1]), frames=5)
    close(way.at(0)[0], ends[0])
    close(way.at(4)[0], ends[1])
    close(flight(key(ends[0]), key(ends[1]), frames=1).at(0)[0], ends[0])


def test_past_a_key_the_speed_stays_the_same():
    keys = [key(pose(place)) for place in ((0.1, 0.1, 0.1), (0.6, 0.2, 0.3), (0.7, 0.9, 0.8))]
    way = flight(*keys, frames=1001)
    places = [p.covering(CHART) for p in poses(way, 1001)]
    steps = [distance(p, q) for p, q in zip(places, places[1:])]
    # The one around the corner is cut short
    assert sorted(steps)[1:] == pytest.approx([way.length / 1000] * 999, rel=1e-6)


def test_way_turn_and_zoom_count_like_sides_at_right_angles():
    # 0.3 cells and 0.4 radians together are 0.5, and so is the zoom behind them: half of the frames
    ends = key(pose((0.2, 0.2, 0.2))), key(pose((0.2, 0.2, 0.5), angle=1.1))
    wide = key(pose((0.2, 0.2, 0.5), angle=1.1), focus_distance=2.0)
    way = flight(*ends, wide, focus_distance=1.0)
    assert way.at(4)[1]["focus_distance"] == pytest.approx(1)
    assert way.at(5)[1]["focus_distance"] == pytest.approx(1.25)
    close(way.at(4)[0], pose((0.2, 0.2, 0.5), angle=1.1), 1e-9)


# --------------------------------------------------------------------------- loops


def around(**last):
    """The walk of four cells along y that comes back one storey higher."""
    first = pose((0.25, 0, 0.655))
    return key(first), key(pose(**{"place": (0.25, 0, 0.655), "cell": (0, 4, 1)} | last))


def test_the_step_from_a_loops_last_frame_to_its_first_is_as_all_others():
    way = flight(*around())
    assert way.loop and way.length == pytest.approx(4)
    places = [p.covering(CHART) for p in poses(way)]
    places.append(geometry.multiply(ds.Array3f64(0, 4, 1), places[0]))
    steps = [distance(p, q) for p, q in zip(places, places[1:])]
    assert steps == pytest.approx([4 / 9] * 9, rel=1e-9)
    assert way.at(0)[0].cell == (0, 0, 0)


def test_there_and_back_is_a_loop_in_any_space():
    for chart in (CHART, OPEN):
        ends = key(pose(), chart), key(pose((0.8, 0.2, 0.4), angle=2), chart)
        assert flight(*ends, ends[0], chart=chart).loop
        assert not flight(*ends, chart=chart).loop


def test_a_loop_bears_rounding_and_nothing_more():
    assert flight(*around(place=(0.25 + 1e-6, 0, 0.655), angle=0.7 + 1e-6)).loop
    assert not flight(*around(place=(0.251, 0, 0.655))).loop
    assert not flight(*around(angle=0.701)).loop
    assert not flight(*around(sizes=(1.001, 1, 1))).loop
    zoomed = around()[1]
    zoomed = Key(zoomed.to_world, zoomed.cell, {"x_fov": 50.1})
    assert not flight(around()[0], zoomed, x_fov=50.0).loop


def test_a_loop_may_end_on_the_other_side_of_a_face():
    # 1e-7 beyond the face x = 0, and 1e-7 before its image
    start, end = pose((1e-7, 0.3, 0.5)), pose((-1e-7, 0.3, 0.5)).within(CHART)
    assert end.cell[0] == -1
    way = flight(key(start), key(pose((0.5, 0.3, 0.5))), key(end))
    assert way.loop and way.length == pytest.approx(1, abs=0.01)


def test_in_plain_nil_a_cell_further_on_is_no_image():
    ends = key(pose((0.25, 0, 0.5)), OPEN), key(pose((0.25, 1, 0.5)), OPEN)
    assert not flight(*ends, chart=OPEN).loop


def test_equal_keys_make_frames_of_one_place():
    way = flight(key(pose()), key(pose()))
    assert not way.loop
    for frame in poses(way):
        close(frame, pose())


# ----------------------------------------------------------------------- rotations


@pytest.mark.parametrize("angle", [0, 1e-12, 1e-6, 0.5, 2, 3.1, math.pi - 1e-9, math.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 2, -3), (-1, 1e-3, 1)])
def test_a_rotation_is_told_by_its_axis_and_angle(axis, angle):
    a = pose()
    axis = ds.Array3f64(axis) / math.hypot(*axis)
    basis = (a.left, a.up, a.view)
    turned = [rotated(v, axis, angle) for v in basis]
    found, size = rotation(basis, turned)
    assert size == pytest.approx(angle, abs=1e-14)
    if angle == math.pi:  # either way round
        found *= math.copysign(1, dr.dot(found, axis))
    assert list(size * found) == pytest.approx(list(angle * axis), abs=1e-12)


def test_a_camera_that_turns_on_the_spot_turns_evenly_about_one_axis():
    axis = (0.3, -0.5, 0.8)
    way = flight(key(pose(axis=axis, angle=0.2)), key(pose(axis=axis, angle=3.2)))
    for i, frame in enumerate(poses(way)):
        close(frame, pose(axis=axis, angle=0.2 + 3 * i / 8))


@pytest.mark.parametrize("upright", [(0, 0, 1), (0, -1, 0)])
def test_between_level_views_the_horizon_stays_level(upright):
    """About one axis it would lean by up to ten degrees here."""
    axis = ds.Array3f64(upright)
    level = pose(axis=(1, 0, 0), angle=math.pi / 2)  # up along z, and looks along −y
    if upright[1]:
        level = pose(axis=(0, 0, 1), angle=math.pi)
    start, end = (
        level.__class__(**{**vars(level), "upright": axis}).turned(aside, above)
        for aside, above in ((0.3, -0.5), (-1.4, 0.6))
    )
    seen = poses(flight(key(start), key(end)))
    heights = [math.asin(float(sum(a * b for a, b in zip(p.view, axis)))) for p in seen]
    assert all(abs(sum(a * b for a, b in zip(p.left, axis))) < 1e-9 for p in seen)
    steps = [b - a for a, b in zip(heights, heights[1:])]
    assert steps == pytest.approx([1.1 / 8] * 8)
    close(seen[0], start)
    close(seen[-1], end)


def test_steep_views_along_axes_have_the_horizon_that_both_are_level_with():
    """Each by itself might as well be level about another axis, which it is nearer to."""
    level = pose(axis=(1, 0, 0), angle=math.pi / 2)  # up along z, and looks along −y
    level = level.__class__(**{**vars(level), "upright": ds.Array3f64(0, 0, 1)})
    start, end = level.turned(0, -1.05), level.turned(math.pi / 2, -0.9)
    assert all(abs(seen.left[2]) < 1e-9 for seen in poses(flight(key(start), key(end))))


def test_a_camera_stays_as_large_and_as_mirrored_as_its_matrix():
    a, b = pose(sizes=(-2, 2, 3)), pose(angle=0.9, sizes=(-8, 8, 3))
    middle = flight(key(a), key(b), frames=3).at(1)[0]
    close(middle, pose(angle=0.8, sizes=(-4, 4, 3)))
    with pytest.raises(UnfitError, match="key 2 of 2: it is a mirror image of the first"):
        flight(key(a), key(pose()))


# ---------------------------------------------------------------------- parameters


def test_a_zoom_is_even_in_the_picture_and_a_focus_in_length():
    first = key(pose(), x_fov=90.0, focus_distance=1.0, aperture_radius=0.0)
    last = key(pose(), x_fov=2 * math.degrees(math.atan(1 / 3)), focus_distance=4.0)
    way = flight(first, last, frames=3, x_fov=50.0, focus_distance=9.0, aperture_radius=0.2)
    _, middle = way.at(1)
    assert math.tan(math.radians(middle["x_fov"]) / 2) == pytest.approx(2 / 3)
    assert middle["focus_distance"] == pytest.approx(2.5)
    assert middle["aperture_radius"] == pytest.approx(0.1)  # to the sensor's own
    assert way.at(2)[1]["x_fov"] == pytest.approx(2 * math.degrees(math.atan(1 / 3)))


def test_a_zoom_on_the_spot_takes_its_time():
    keys = key(pose(), x_fov=80.0), key(pose(), x_fov=20.0), key(pose((0.9, 0.5, 0.7)))
    way = flight(*keys, frames=100, x_fov=20.0)
    angles = [way.at(i)[1]["x_fov"] for i in range(100)]
    assert 30 < sum(angle > 20.001 for angle in angles) < 70


def test_a_key_that_sets_what_the_sensor_lacks_is_named():
    with pytest.raises(UnfitError, match='key 2 of 2: the scene\'s sensor has no "focus_distance"'):
        flight(key(pose()), key(pose(), focus_distance=1.0), x_fov=50.0)


def test_plain_nil_has_no_other_cells():
    keys = key(pose(), OPEN), key(pose(cell=(0, 0, 1)), OPEN)
    with pytest.raises(UnfitError, match=r'key 2 of 2: plain Nil has no .*"cell" = \[0, 0, 1\]'):
        flight(*keys, chart=OPEN)


def test_a_pose_of_a_flight_is_what_the_sensor_gets(rgb):
    matrix = mi.ScalarTransform4f().look_at([0.1, 0.5, 0.8], [0.7, 0.2, 1.5], [0, 1, 0]).matrix
    numbers = [matrix[i, j] for i in range(4) for j in range(4)]
    got = flight(Key(numbers), Key(numbers), chart=CELLS_OF_TWO).at(0)[0].to_world(CELLS_OF_TWO)
    found = [got.matrix[i, j] for i in range(4) for j in range(4)]
    assert found == pytest.approx(numbers, abs=1e-6)
