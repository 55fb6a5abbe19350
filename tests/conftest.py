import os
import pathlib
import subprocess
import sys

ENVIRONMENT = dict(os.environ)  # a user's, before the package has chosen an LLVM for this process

import nil_mitsuba  # noqa: E402, F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
import pytest  # noqa: E402

from command_line import BALL, BOX, LAMP, MESH, NIL, REPEATABLE, SENSOR, scene  # noqa: E402
from nil_mitsuba import cli, stills  # noqa: E402
from small_stills import SCENE, TRIANGLE, description  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"


@pytest.fixture
def rgb():
    """Mitsuba in the variant that most tests use; returns the module."""
    mi.set_variant("llvm_ad_rgb")
    return mi


@pytest.fixture
def data():
    """Folder of scenes, meshes and environment maps that some checkouts have beside them."""
    if not DATA.is_dir():
        pytest.skip(f"{DATA} is not there")
    return DATA


@pytest.fixture
def fresh_python():
    """Runs code in a new interpreter, in which no LLVM has been chosen yet."""

    def run(code, **variables):
        environment = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"}
        return subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT,
            env=environment | variables,
            capture_output=True,
            text=True,
            timeout=120,
        )

    return run


@pytest.fixture
def small(rgb, monkeypatch):
    """A scene of 8 × 8 pixels, of which rules that need looks get passes of 16 samples each."""
    monkeypatch.setattr(stills, "LOOK_SAMPLES", 8 * 8 * 16)
    return mi.load_dict(description())


@pytest.fixture
def still_folder(tmp_path, rgb):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "triangle.obj").write_text(TRIANGLE)
    return tmp_path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a scene in it."""
    (tmp_path / "scene.xml").write_text(scene(NIL, SENSOR, LAMP))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def repeatable(folder):
    """The scene of `folder` with a box filter: two renders of it are equal to the bit."""
    (folder / "scene.xml").write_text(scene(NIL, REPEATABLE, LAMP))
    return folder


@pytest.fixture
def command(folder, monkeypatch, capfd):
    """Runs the command in `folder`: its status, what it printed and its complaints."""
    resolver, level, threads = mi.file_resolver(), mi.log_level(), dr.thread_count()

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["nil-mitsuba", *arguments])
        mi.set_file_resolver(resolver)
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        out, err = capfd.readouterr()
        return stopped.value.code or 0, out, err

    yield run
    mi.set_file_resolver(resolver)
    mi.set_log_level(level)
    dr.set_thread_count(threads)
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def meshes(folder):
    """A scene with two meshes, which Mitsuba would make one of."""
    (folder / "a.ply").write_text(MESH.format(x=0.05))
    (folder / "b.ply").write_text(MESH.format(x=0.95))
    (folder / "scene.xml").write_text(scene(NIL, BOX, LAMP, BALL))
    return folder


@pytest.fixture
def rendering_is_an_error(monkeypatch):
    def render(*_):
        raise AssertionError("rendering began")

    monkeypatch.setattr(stills.Still, "accumulate", render)
    monkeypatch.setattr(cli, "_render_in_one_go", render)
