"""Steps and turns of a camera, in double precision."""

import math

import mitsuba as mi
import pytest

from nil_mitsuba import geometry
from nil_mitsuba.pose import Chart, Pose, unit


@pytest.fixture
def chart(rgb):
    nil = mi.load_dict(
        {"type": "nil", "fibres": "y", "cell_size": 2.0, "cell_origin": [-1, 0, 0.5]}
    )
    return Chart.of(nil)


def camera():
    return mi.Transform4f().look_at([0.1, 0.5, 0.8], [0.7, 0.2, 1.5], [0, 1, 0])


def entries(transform):
    matrix = transform.matrix
    numbers = [matrix[i, j] for i in range(4) for j in range(4)]
    return [number if isinstance(number, float) else number[0] for number in numbers]


def test_a_pose_gives_back_the_transform_that_it_is_of(chart):
    pose = Pose.of(camera(), chart)
    assert entries(pose.to_world(chart)) == pytest.approx(entries(camera()), abs=1e-6)


def test_a_walk_there_and_back_ends_where_it_began(chart):
    start = pose = Pose.of(camera(), chart)
    for _ in range(50):
        pose = pose.moved((0.3, 0.1, 1), 0.2, chart)
    assert pose.cell != (0, 0, 0)
    for _ in range(50):
        pose = pose.moved((-0.3, -0.1, -1), 0.2, chart)
    assert pose.cell == (0, 0, 0)
    assert entries(pose.to_world(chart)) == pytest.approx(entries(start.to_world(chart)), abs=1e-6)


def test_whoever_walks_straight_ahead_walks_one_geodesic(chart):
    pose = Pose.of(camera(), chart)
    view = pose.view / math.hypot(*pose.view)
    place, view = geometry.flow(pose.place, view, 3.0, chart.twist)
    for _ in range(30):
        pose = pose.moved((0, 0, 1), 0.1, chart)
    assert list(pose.covering(chart)) == pytest.approx(list(place), abs=1e-9)
    assert list(pose.view) == pytest.approx(list(view), abs=1e-6)


def test_the_place_of_a_walk_is_that_of_its_image_in_the_first_cell(chart):
    pose = Pose.of(camera(), chart).moved((0.2, -0.4, 1), 7.0, chart)
    assert all(0 <= c < 1 for c in pose.place)
    again, cell = geometry.wrap(pose.covering(chart), chart.twist)
    assert list(again) == pytest.approx(list(pose.place), abs=1e-9)
    assert tuple(cell) == pose.cell


def test_turns_keep_the_horizon_level_and_end_before_the_zenith(chart):
    pose = Pose.of(camera(), chart)
    turned = pose.turned(0.7, 0.2)
    assert turned.left.z == pytest.approx(0, abs=1e-7)  # upright is the scene's y, the cell's z
    assert turned.view.z == pytest.approx(math.sin(math.asin(pose.view.z) + 0.2))
    assert list(turned.turned(-0.7, -0.2).view) == pytest.approx(list(pose.view))
    zenith = pose.turned(0, 9.0)
    assert math.degrees(math.asin(zenith.view.z)) == pytest.approx(89)
    assert math.degrees(math.asin(zenith.turned(0, -9.0).view.z)) == pytest.approx(-89)


@pytest.mark.parametrize("off", [0.0, 1e-9, 0.003])
@pytest.mark.parametrize("scale", [[1, 1, 1], [-1, 1, 1]])
def test_whoever_has_aimed_at_the_zenith_can_look_down_again(chart, off, scale):
    start = Pose.of(camera() @ mi.Transform4f().scale(scale), chart)
    ahead = unit(start.view)
    zenith = start.looking(unit(chart.to_cell_axes([0, 1, 0]) + off * ahead))
    assert zenith.view.z > 0.99999
    down = zenith.turned(0, -1.0)
    heights = [math.atan2(v.z, math.hypot(v.x, v.y)) for v in (down.view, zenith.view)]
    assert heights[0] == pytest.approx(heights[1] - 1, abs=1e-3)
    # To the side where it looked before it turned up
    azimuths = [math.atan2(v.y, v.x) for v in (down.view, ahead)]
    assert azimuths[0] == pytest.approx(azimuths[1], abs=1e-3)
    assert down.left.z == pytest.approx(0, abs=1e-6)


def test_steps_that_cancel_each_other_lead_nowhere(chart):
    pose = Pose.of(camera(), chart).looking(chart.to_cell_axes([0, 1, 0]))
    assert pose.moved((0, 1, -1), 0.3, chart) == pose


@pytest.mark.parametrize("scale", [[1, 1, 1], [-1, 1, 1]])
def test_a_turn_to_the_left_is_one_to_the_left_of_the_picture(chart, scale):
    pose = Pose.of(camera() @ mi.Transform4f().scale(scale), chart)
    turned = pose.turned(0.1, 0)
    assert sum(a * b for a, b in zip(turned.view, pose.left)) > 0.05


def test_looking_at_a_direction_ends_there_with_a_level_horizon(chart):
    pose = Pose.of(camera(), chart)
    towards = Pose.of(camera(), chart).turned(2.5, 0.9).view
    looking = pose.looking(towards)
    assert list(looking.view) == pytest.approx(list(towards), abs=1e-7)
    assert looking.left.z == pytest.approx(0, abs=1e-7)
