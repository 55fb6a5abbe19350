"""Properties of "nil": checked alike in a scene file, in a dictionary and on an integrator."""

import drjit as dr
import mitsuba as mi
import pytest

from nil_mitsuba import parameters
from small_stills import description


@pytest.fixture
def nil(rgb):
    return mi.load_dict({"type": "nil"})


@pytest.fixture
def scene(rgb):
    return mi.load_dict(description(twist=1))


def render(scene):
    return mi.render(scene, spp=4, seed=1)


def same(a, b):
    return bool(dr.all(a.array == b.array, axis=None))


# Property, value, and what is said of it
WRONG = [
    ("twsit", 1, 'no property "twsit": did you mean "twist"?'),
    ("maxDepth", 3, 'no property "maxDepth": did you mean "max_depth"?'),
    ("cell-size", 2.0, 'no property "cell-size": did you mean "cell_size"?'),
    ("gravity", 9.81, 'no property "gravity", but twist, quotient, fibres'),
    ("twist", 0.5, "does not glue the faces of the cube: use an integer such as 0 or 1"),
    ("twist", "one", 'The property "twist" has the wrong type'),
    ("fibres", "up", '"fibres" must be an axis of the scene, x, y or z, and it is "up"'),
    ("fibres", 2, '"fibres" must be an axis of the scene, x, y or z, and it is "2"'),
    ("cell_size", 0.0, '"cell_size" must be greater than zero'),
    ("max_depth", -2, '"max_depth" must be set to -1'),
    ("aovs", "distance,normals", 'which is none of .*: did you mean "normal"?'),
]


@pytest.mark.parametrize("name, value, sentence", WRONG)
def test_what_a_scene_may_not_say_may_not_be_set_either(nil, name, value, sentence):
    before = str(nil)
    for how in (
        lambda: mi.load_dict({"type": "nil", name: value}),
        lambda: setattr(nil, name, value),
    ):
        with pytest.raises(RuntimeError, match=sentence.replace("?", r"\?")):
            how()
    assert str(nil) == before


def test_a_misspelt_property_of_a_scene_file_is_told_with_the_nearest_one(rgb):
    text = (
        '<scene version="3.0.0"><integrator type="nil"><integer name="twsit" value="1"/>'
        "</integrator></scene>"
    )
    with pytest.raises(RuntimeError, match=r'no property "twsit": did you mean "twist"\?$'):
        mi.load_string(text)


@pytest.mark.parametrize(
    "changes",
    [
        {"twist": 3},
        {"quotient": False, "twist": 0.5},
        {"cell_size": 1.5, "cell_origin": [-0.2] * 3},
        {"max_depth": 2},
        {"hide_emitters": True},
        {"max_distance": 0.4},
        {"quotient": False},
    ],
    ids=str,
)
def test_a_property_that_is_set_is_that_of_the_next_picture(scene, changes):
    before = render(scene)
    for name, value in changes.items():
        setattr(scene.integrator(), name, value)
    after = render(scene)
    loaded = mi.load_dict(description(**{"twist": 1} | changes))
    assert str(scene.integrator()) == str(loaded.integrator())
    assert same(after, render(loaded))
    assert not same(after, before)


def test_layers_that_are_set_are_those_of_the_next_picture(scene):
    scene.integrator().aovs = "normal, distance"
    assert scene.integrator().layers == ("distance", "normal")
    assert render(scene).shape[2] == 3 + 4


def test_the_default_distance_follows_the_space_and_a_given_one_stays(nil):
    assert nil.max_distance == 12
    nil.quotient = False
    assert nil.max_distance == dr.inf
    nil.max_distance = 3
    nil.quotient = True
    assert nil.max_distance == 3


def test_the_origin_of_the_cell_cannot_be_changed_behind_the_checks(nil):
    with pytest.raises(TypeError):
        nil.cell_origin[0] = dr.nan


def test_every_parameter_has_a_default_and_a_name(nil):
    assert set(parameters.checked({})) == {*parameters.NAMES, "layers"}
    assert all(hasattr(nil, name) for name in parameters.NAMES)
