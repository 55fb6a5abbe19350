"""Files are written whole or not at all: full disks, bad targets, interruptions, links."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from images import (
    random_image,
)
from nil_mitsuba import exr, files, png

pytestmark = pytest.mark.usefixtures("rgb")


def test_a_full_disk_leaves_the_last_good_file(tmp_path):
    """A limit on the size of files, wherever it falls, does what a full disk does."""
    code = (
        "import resource, sys, nil_mitsuba, mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "from nil_mitsuba import exr, png\n"
        "numbers = mi.PCG32(100 * 90 * 3).next_float32()\n"
        "image = mi.TensorXf(numbers, (100, 90, 3))\n"
        "import OpenEXR\n"
        "writers = {'a.exr': lambda path: exr.write(path, ('RGB', image)),\n"
        "           'a.png': lambda path: png.write(path, image)}\n"
        "for name, write in writers.items():\n"
        "    path = sys.argv[1] + '/' + name\n"
        "    write(path)\n"
        "    data = open(path, 'rb').read()\n"
        "    for limit in (0, 100, 5000, len(data) - 1):\n"
        "        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))\n"
        "        try:\n"
        "            write(path)\n"
        "        except OSError as error:\n"
        "            message = str(error)\n"
        "        else:\n"
        "            message = 'written'\n"
        "        finally:\n"
        "            unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)\n"
        "            resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)\n"
        "        print(message)\n"
        "        assert open(path, 'rb').read() == data\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    expected = [
        f'cannot write "{tmp_path}/{name}": File too large.'
        for name in ("a.exr", "a.png")
        for _ in range(4)
    ]
    assert done.stdout.splitlines() == expected
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "a.png"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
def test_a_disk_that_fills_with_the_last_bytes_is_noticed(monkeypatch):
    # A picture this small is written when the file is closed, where OpenEXR ignores errors.
    monkeypatch.setattr(exr, "replacing", lambda path: contextlib.nullcontext("/dev/full"))
    with pytest.raises(OSError, match="the disk may be full"):
        exr.write("a.exr", ("RGB", random_image(3, height=2, width=2)))


@pytest.mark.parametrize("suffix", ["exr", "png"])
def test_targets_that_cannot_be_written_get_a_sentence(tmp_path, suffix):
    def write(path):
        image = random_image(3)
        exr.write(path, ("RGB", image)) if suffix == "exr" else png.write(path, image)

    (tmp_path / f"folder.{suffix}").mkdir()
    os.mkfifo(tmp_path / f"pipe.{suffix}")
    for name, reason in {
        f"nowhere/a.{suffix}": "No such file or directory",
        f"folder.{suffix}": "it is a folder",
        f"pipe.{suffix}": "it is not an ordinary file",
    }.items():
        with pytest.raises(OSError) as error:
            write(tmp_path / name)
        assert str(error.value) == f'cannot write "{tmp_path / name}": {reason}.'
    if os.geteuid() == 0:  # to whom no folder is read-only
        return
    (tmp_path / "locked").mkdir(mode=0o500)
    with pytest.raises(OSError, match="Permission denied"):
        write(tmp_path / "locked" / f"a.{suffix}")


def test_an_interrupted_write_leaves_no_trace(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("before")
    with pytest.raises(KeyboardInterrupt), files.replacing(path) as part:
        Path(part).write_text("half of")
        raise KeyboardInterrupt
    assert path.read_text() == "before" and os.listdir(tmp_path) == ["a.txt"]


def test_who_reads_the_old_file_is_not_disturbed(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("before")
    with open(path) as reader:
        with files.replacing(path) as part:
            Path(part).write_text("after")
        assert reader.read() == "before"
    assert path.read_text() == "after"


def test_a_link_goes_on_pointing_at_the_file(tmp_path):
    (tmp_path / "disk").mkdir()
    path, link = tmp_path / "disk" / "a.txt", tmp_path / "a.txt"
    path.write_text("before")
    link.symlink_to(path)
    with files.replacing(link) as part:
        assert Path(part).parent == path.parent  # a file can only be moved within a disk
        Path(part).write_text("after")
    assert link.is_symlink() and path.read_text() == "after"
