"""Key files are read back as they were written, and refused in one sentence if they are none."""

import json
import os

import pytest

from nil_mitsuba import keys
from nil_mitsuba.keys import Key

MATRIX = [0.6, 0, 0.8, 0.25, 0, 1, 0, 1 / 3, -0.8, 0, 0.6, 1e-9, 0, 0, 0, 1]


def test_keys_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "cameras.json"
    written = [
        Key([float(c) for c in MATRIX]),
        Key([float(c) for c in MATRIX], (0, -4, 1), {"x_fov": 49.1, "focus_distance": 0.1}),
    ]
    keys.save(path, written)
    assert keys.load(path) == written
    assert json.loads(path.read_text())["keys"][1]["cell"] == [0, -4, 1]
    keys.save(path, [])
    assert keys.load(path) == []


def test_keys_that_cannot_be_written_leave_the_file_as_it_was(tmp_path):
    path = tmp_path / "cameras.json"
    keys.save(path, [Key(MATRIX)])
    with pytest.raises(TypeError):
        keys.save(path, [Key(MATRIX), Key(MATRIX, parameters={"x_fov": object()})])
    assert len(keys.load(path)) == 1 and os.listdir(tmp_path) == ["cameras.json"]


def test_a_file_by_hand_needs_whole_numbers_no_points(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text('{"keys": [{"to_world": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1], "x_fov": 60}]}')
    assert keys.load(path) == [
        Key([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], (0, 0, 0), {"x_fov": 60})
    ]


def test_a_mark_before_the_text_does_no_harm(tmp_path):
    path = tmp_path / "cameras.json"
    keys.save(path, [Key(MATRIX)])
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert keys.load(path) == [Key(MATRIX)]


def sheared():
    return [1, 0.1, *MATRIX[2:]]


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "is not JSON: .* in line 1, column 1"),
        ("{\n]", "is not JSON: .* in line 2, column 1"),
        ("\xff", "is no key file: it is not text"),
        ("[" * 100_000, "is no key file"),
        ("[]", r'must be one object {"keys": \[...\]}'),
        ('{"keys": 3}', r'must be one object {"keys": \[...\]}'),
        ('{"keys": [], "fps": 25}', "with nothing beside"),
        ('{"keys": [], "keys": []}', '"keys" stands twice in one object'),
        ('{"keys": [{"x_fov": 40, "x_fov": 50}]}', '"x_fov" stands twice in one object'),
        ('{"keys": [1%s]}' % ("0" * 5000), "a number in it has too many digits"),
    ],
    ids=range(10),
)
def test_what_is_no_key_file_is_refused(tmp_path, text, words):
    path = tmp_path / "cameras.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=rf'^"{path}" .*{words}'):
        keys.load(path)


@pytest.mark.parametrize(
    "entry, words",
    [
        (7, "a key is an object .*, and this is 7"),
        ({}, '"to_world" must be a list of 16 numbers, row by row .*, and it is none'),
        ({"to_world": MATRIX[:12]}, "and it is a list of 12"),
        ({"to_world": [*MATRIX[:15], "1"]}, 'and it is a list of 16 with "1"'),
        ({"to_world": [True, *MATRIX[1:]]}, "with true"),
        ({"to_world": [float("nan"), *MATRIX[1:]]}, "with NaN"),
        ({"to_world": [10**400, *MATRIX[1:]]}, "with 10000"),
        ({"to_world": [*MATRIX[:3], 1e16, *MATRIX[4:]]}, "must be below 1e15"),
        ({"to_world": [MATRIX[4 * (i % 4) + i // 4] for i in range(16)]}, "row 0, 0, 0, 1"),
        ({"to_world": [0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "must be longer"),
        ({"to_world": [c * 1e-200 for c in MATRIX[:12]] + [0, 0, 0, 1]}, "must be longer"),
        ({"to_world": sheared()}, "must be at right angles"),
        ({"to_world": MATRIX, "cell": [0, 1]}, '"cell" must be a list of three whole numbers'),
        ({"to_world": MATRIX, "cell": [0, 1.0, 2]}, '"cell" must be'),
        ({"to_world": MATRIX, "cell": [0, True, 2]}, '"cell" must be'),
        ({"to_world": MATRIX, "cell": [0, 0, 10**7]}, '"cell" must be'),
        (
            {"to_world": MATRIX, "x_fov": 180},
            '"x_fov" must be degrees between 0 and 180, .* is 180',
        ),
        ({"to_world": MATRIX, "x_fov": "45"}, 'and it is "45"'),
        ({"to_world": MATRIX, "focus_distance": 0}, "a length greater than 0"),
        ({"to_world": MATRIX, "aperture_radius": -1}, "a length from 0 on"),
        ({"to_world": MATRIX, "x_fow": 45}, 'no "x_fow": did you mean "x_fov"'),
        ({"to_world": MATRIX, "film": {}}, "a key may have aperture_radius, cell"),
    ],
    ids=range(22),
)
def test_a_key_that_is_none_is_named(tmp_path, entry, words):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"keys": [{"to_world": MATRIX}, entry, {"to_world": MATRIX}]}))
    with pytest.raises(ValueError, match=rf'^"{path}", key 2 of 3: .*{words}'):
        keys.load(path)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(OSError, match="cannot read .*none.json.*No such file"):
        keys.load(tmp_path / "none.json")
    with pytest.raises(OSError, match="cannot read .*directory"):
        keys.load(tmp_path)
