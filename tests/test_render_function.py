"""nil_mitsuba.render as Python sees it."""

import pydoc
import typing

import drjit as dr
import mitsuba as mi
import pytest

import nil_mitsuba
from small_stills import description


@pytest.fixture
def scene(rgb):
    return mi.load_dict(description())


@pytest.fixture
def aside(rgb):
    """A sensor that is in no scene."""
    sensor = description()["sensor"]
    sensor["to_world"] = mi.ScalarTransform4f().look_at([0.2, 0.9, 0.6], [0.7, 0, 0.4], [0, 0, 1])
    return sensor


def test_the_package_shows_the_function():
    assert "render" in dir(nil_mitsuba) and "__version__" in dir(nil_mitsuba)
    assert "render(scene: " in pydoc.plain(pydoc.render_doc(nil_mitsuba))


def test_its_parameters_have_types(rgb):
    hints = typing.get_type_hints(nil_mitsuba.render)
    assert hints["sensor"] == int | mi.Sensor
    assert hints["integrator"] == mi.Integrator | None
    assert hints["return"] is mi.TensorXf


def test_a_sensor_is_taken_for_its_number(scene):
    by_number = nil_mitsuba.render(scene, 0, spp=4)
    by_object = nil_mitsuba.render(scene, scene.sensors()[0], spp=4)
    assert dr.all(by_number == by_object, axis=None)


def test_a_sensor_of_no_scene_renders_what_one_in_the_scene_does(scene, aside):
    image = nil_mitsuba.render(scene, mi.load_dict(aside), spp=4)
    inside = mi.load_dict(description() | {"sensor": aside})
    assert dr.all(image == nil_mitsuba.render(inside, spp=4), axis=None)
    assert not dr.all(image == nil_mitsuba.render(scene, spp=4), axis=None)


def test_samples_of_one_sensor_are_not_added_to_those_of_another(scene, aside, tmp_path):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(scene, mi.load_dict(aside), spp=4, checkpoint=path)
    again = nil_mitsuba.render(scene, mi.load_dict(aside), spp=4, checkpoint=path, resume=True)
    assert dr.all(again == nil_mitsuba.render(scene, mi.load_dict(aside), spp=4), axis=None)
    with pytest.raises(ValueError, match="sensor is .* there and 0 here"):
        nil_mitsuba.render(scene, spp=4, checkpoint=path, resume=True)


def test_a_scene_without_an_integrator_ends_in_a_sentence(rgb):
    scene = description()
    del scene["integrator"]
    with pytest.raises(ValueError, match='^the scene has no integrator: give it one of .* "nil"'):
        nil_mitsuba.render(mi.load_dict(scene), spp=1)
    image = nil_mitsuba.render(mi.load_dict(scene), integrator=mi.load_dict({"type": "nil"}), spp=1)
    assert image.shape == (8, 8, 3)
