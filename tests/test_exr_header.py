"""Headers of OpenEXR files that are damaged, cut, or of something else."""

import random

import pytest

from images import METADATA, metadata_of, random_image
from nil_mitsuba import exr, exr_header

pytestmark = pytest.mark.usefixtures("rgb")


def test_a_damaged_header_gets_one_sentence_or_a_description(tmp_path):
    exr.write(tmp_path / "a.exr", ("RGB", random_image(3, height=2, width=2)), metadata=METADATA)
    data, rng = (tmp_path / "a.exr").read_bytes(), random.Random(1)
    sentences = 0
    for _ in range(1000):
        damaged = bytearray(data)
        damaged[rng.randrange(4, 700)] = rng.randrange(256)
        (tmp_path / "b.exr").write_bytes(damaged)
        try:
            assert "pixels" in exr.describe(tmp_path / "b.exr")
        except ValueError as error:
            sentences += "is damaged" in str(error)
    assert sentences > 10


def test_a_description_does_not_steer_the_terminal(tmp_path):
    picture = "RGB", random_image(3)
    exr.write(tmp_path / "a.exr", picture, metadata={"owner": "\x1b[2J\rA\x9b", "big": 3.4e38})
    text = exr.describe(tmp_path / "a.exr")
    assert "[2J" in text and not set("\x1b\r\x9b") & set(text)


def test_what_is_not_an_exr_file_gets_one_sentence(tmp_path):
    (tmp_path / "a.exr").write_text("hello")
    (tmp_path / "empty.exr").touch()
    for name, words in {
        "a.exr": "is not an OpenEXR file",
        "empty.exr": "is not an OpenEXR file",
        "none.exr": "No such file",
        ".": "directory",
    }.items():
        for function in (exr.describe, exr_header.read):
            with pytest.raises((OSError, ValueError)) as error:
                function(tmp_path / name)
            assert words in str(error.value) and str(tmp_path / name) in str(error.value)
            assert "\n" not in str(error.value)


@pytest.mark.parametrize("compression", ["zip", "dwaa", "none"])
def test_a_file_cut_anywhere_is_known_to_be_incomplete(tmp_path, compression):
    path, cut = tmp_path / "a.exr", tmp_path / "cut.exr"
    picture = "RGB", random_image(3, height=20, width=4)
    distance = random_image(1, height=20, width=4)
    exr.write(path, picture, {"distance": distance}, METADATA, compression=compression)
    data = path.read_bytes()
    assert exr_header.is_complete(path)
    for size in range(len(data) - 1, -1, -3):
        cut.write_bytes(data[:size])
        assert not exr_header.is_complete(cut), size
        # Either the header is there or there is a sentence.
        try:
            assert metadata_of(cut)["spp"] == 64
        except ValueError as error:
            assert "is damaged" in str(error) or size < 4
    cut.write_bytes(data + b"\0")
    assert not exr_header.is_complete(cut)
