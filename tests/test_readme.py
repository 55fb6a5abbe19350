"""Every command and code block of the README runs, at a small size."""

import re
import shlex
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from conftest import ENVIRONMENT

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)

# Programs that another test runs at a small size.
TESTED_BY = {
    "benchmarks.chart": "test_chart.py",
    "benchmarks.reference_geometry": "test_geometry.py",
    "examples/render_from_python.py": "test_examples.py",
    "examples/walk.py": "test_examples.py",
    "examples/twist.py": "test_examples.py",
    "examples/light_images.py": "test_examples.py",
    "examples/own_mesh.py": "test_examples.py",
}
QUICK = (
    "benchmarks.camera_rays",
    "benchmarks.speed",
    "benchmarks.accuracy",
    "benchmarks.emitter_sampling",
    "benchmarks.stills",
)


def blocks(*languages):
    return [text for language, text in BLOCKS if language in languages]


def lines(block):
    """The commands of a shell block, without comments."""
    found = [re.sub(r"\s+#.*", "", line).strip() for line in block.splitlines()]
    return [line for line in found if line and not line.startswith("#")]


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with the README's first scene and links to what its commands read."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(ROOT / "scenes", folder / "scenes")  # pictures are written beside scenes
    for name in (
        "examples",
        "benchmarks",
        "tests",
        "nil_mitsuba",
        "Makefile",
        "pyproject.toml",
        "README.md",
        "docs",
    ):
        (folder / name).symlink_to(ROOT / name)
    (folder / "hello.xml").write_text(blocks("xml")[0])
    return folder


def run(desk, arguments):
    result = subprocess.run(
        arguments, cwd=desk, capture_output=True, text=True, timeout=600, env=ENVIRONMENT
    )
    assert result.returncode == 0, f"{shlex.join(map(str, arguments))}\n{result.stderr[-2000:]}"


def test_the_readme_has_code_of_each_kind():
    assert {"sh", "xml", "python"} <= {language for language, _ in BLOCKS}
    assert all(language for language, _ in BLOCKS), "a block without a language is not tested"


@pytest.mark.parametrize("text", blocks("xml"))
def test_xml_is_whole(text):
    ElementTree.fromstring(text)


@pytest.mark.parametrize("text", blocks("python"))
def test_python_runs(desk, text):
    small = re.sub(r"\b256\b", "16", text)
    run(desk, [sys.executable, "-c", small])


@pytest.mark.parametrize("block", blocks("sh"), ids=lambda block: lines(block)[0])
def test_commands_run(desk, block):
    for line in lines(block):
        run_small(desk, line)


def run_small(desk, line):
    program, *words = shlex.split(line)
    command = [sys.executable, "-c", "from nil_mitsuba.cli import main; main()"]
    if program == "make":
        run(desk, ["make", "--dry-run", *words])
    elif program == "pip":
        # tests/test_package.py installs the wheel; here, that there are such extras
        project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
        extras = re.findall(r"\[([\w,]+)\]", words[-1])
        assert words[0] == "install" and extras
        assert all(
            re.search(rf"^{name} = \[", project, re.MULTILINE) for name in extras[0].split(",")
        )
    elif program == "nil-mitsuba" and words[0] == "render":
        # Scenes of the project take their size as parameters; the README's own is small
        size = [] if "hello.xml" in words else ["-D", "resx=32", "-D", "resy=18"]
        run(desk, [*command, *words, *size, "--spp", "2"])
    elif program == "nil-mitsuba":
        run(desk, [*command, *words])
    elif program == "python" and words[-1] in TESTED_BY:
        name = Path(words[-1].removeprefix("benchmarks.")).stem
        assert name in (ROOT / "tests" / TESTED_BY[words[-1]]).read_text(encoding="utf-8")
    elif program == "python" and words[-1] in QUICK:
        run(desk, [sys.executable, *words, "--quick"])
    else:
        pytest.fail(f"no way to run {line!r} at a small size: add one")
