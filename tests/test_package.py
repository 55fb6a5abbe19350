"""What is installed: the wheel's contents, and that it works where nothing else is."""

import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

import nil_mitsuba

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The project's wheel, built by pip in an environment of its own."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "--wheel-dir",
            str(folder),
            str(ROOT),
        ],
        check=True,
    )
    (path,) = folder.glob("nil_mitsuba-*.whl")
    return path


def test_the_wheel_holds_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        info = [name for name in archive.namelist() if ".dist-info/" in name]
    modules = {f"nil_mitsuba/{path.name}" for path in (ROOT / "nil_mitsuba").glob("*.py")}
    assert names == modules | {"nil_mitsuba/py.typed", "nil_mitsuba/viewfinder.html"}
    assert any(name.endswith("/licenses/LICENSE") for name in info)
    assert any(name.endswith("/entry_points.txt") for name in info)


def test_who_cites_the_software_names_the_version_that_is_installed():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.MULTILINE) == [nil_mitsuba.__version__]
    bibtex = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"^ +version += \{(.*)\}$", bibtex, re.MULTILINE) == [nil_mitsuba.__version__]


def test_the_map_names_every_module_and_where_it_is_tested():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| `")]
    modules = {name for row in rows for name in re.findall(r"`(\w+\.py)`", row[0])}
    assert modules == {path.name for path in (ROOT / "nil_mitsuba").glob("*.py")} - {"__init__.py"}
    tests = {name for row in rows for name in row[2].split(", ")}
    assert [name for name in tests if not (ROOT / "tests" / f"test_{name}.py").exists()] == []


@pytest.mark.verify
def test_the_wheel_renders_in_an_empty_environment(wheel, tmp_path):
    """Nothing from this checkout or its environment takes part."""
    home = tmp_path / "environment"
    venv.create(home, with_pip=True)
    scripts = home / ("Scripts" if os.name == "nt" else "bin")
    clean = {
        key: value
        for key, value in os.environ.items()
        if key not in ("PYTHONPATH", "DRJIT_LIBLLVM_PATH", "VIRTUAL_ENV")
    }
    subprocess.run(
        [scripts / "python", "-m", "pip", "install", "--quiet", str(wheel)], check=True, env=clean
    )
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<scene version="3.0.0"><integrator type="nil"/><emitter type="constant"/>'
        '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="16"/>'
        '<integer name="height" value="16"/></film></sensor></scene>'
    )
    command = [scripts / "nil-mitsuba", "render", scene, "--spp", "1", "--png", "out.png"]
    subprocess.run(command, check=True, env=clean, cwd=tmp_path)
    assert (tmp_path / "scene.exr").stat().st_size > 0
    assert (tmp_path / "out.png").stat().st_size > 0
