import os
import pathlib
import subprocess
import sys

ENVIRONMENT = dict(os.environ)  # a user's, before the package has chosen an LLVM for this process

import nil_mitsuba  # noqa: E402, F401 - before mitsuba: it chooses the LLVM that Dr.Jit will use

# isort: split
import mitsuba as mi  # noqa: E402
import pytest  # noqa: E402

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
