import os
import sys

import drjit as dr
import pytest

from nil_mitsuba import llvm

LLVM_14, LLVM_15 = (f"/usr/lib/x86_64-linux-gnu/libLLVM-{version}.so.1" for version in (14, 15))

needs_old_llvm = pytest.mark.skipif(
    not os.path.exists(LLVM_15), reason="the system has no LLVM 15 for Dr.Jit to stumble on"
)
needs_wheel = pytest.mark.skipif(
    not llvm._wheel_libraries(), reason=f"{llvm.WHEEL} is not installed"
)

RENDER = """
s = mi.load_dict(mi.cornell_box() | {"integrator": {"type": "path"}})
print("mean", dr.mean(mi.render(s, spp=1), axis=None))
"""


@pytest.fixture
def before_drjit(monkeypatch):
    """The choice as it is made in a process that has not loaded Dr.Jit."""
    monkeypatch.delitem(sys.modules, "drjit")
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "_rejected", [])
    monkeypatch.setattr(llvm, "_too_late", False)


@needs_wheel
def test_the_wheel_wins_over_an_older_llvm_of_the_system(fresh_python):
    run = fresh_python(
        "import nil_mitsuba, mitsuba as mi, drjit as dr\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "print(*dr.detail.llvm_version())" + RENDER
    )
    assert run.returncode == 0, run.stderr
    assert int(run.stdout.split()[0]) >= llvm.OLDEST
    assert "mean 0." in run.stdout


@needs_old_llvm
@pytest.mark.parametrize("library", [LLVM_14, LLVM_15, "/nowhere/libLLVM.so"])
def test_an_unusable_llvm_of_the_users_own_is_refused_in_a_sentence(fresh_python, library):
    run = fresh_python(
        "import nil_mitsuba, mitsuba as mi\nmi.set_variant('llvm_ad_rgb')",
        DRJIT_LIBLLVM_PATH=library,
    )
    assert run.returncode == 1  # an exception; an abort is negative
    sentence = run.stderr.splitlines()[-1]
    assert library in sentence
    for way_out in ("pip install karellen-llvm-core", "package manager", "DRJIT_LIBLLVM_PATH"):
        assert way_out in sentence


@needs_old_llvm
def test_mitsuba_imported_first_is_stopped_at_set_variant(fresh_python):
    run = fresh_python(
        "import mitsuba as mi\nimport nil_mitsuba\nmi.set_variant('llvm_ad_rgb')" + RENDER
    )
    assert run.returncode == 1
    assert "import nil_mitsuba before mitsuba" in run.stderr.splitlines()[-1]


@needs_old_llvm
def test_a_second_choice_of_variant_is_taken_when_llvm_is_unusable(fresh_python):
    run = fresh_python(
        "import mitsuba as mi, nil_mitsuba\n"
        "mi.set_variant('llvm_ad_rgb', 'scalar_rgb')\nprint(mi.variant())"
    )
    assert run.stdout.strip() == "scalar_rgb", run.stderr


@needs_old_llvm
def test_an_llvm_variant_loaded_before_the_package_is_stopped_when_it_comes_back(fresh_python):
    run = fresh_python(
        "import mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\nmi.set_variant('scalar_rgb')\n"
        "import nil_mitsuba\nprint('imported')\nmi.set_variant('llvm_ad_rgb')" + RENDER
    )
    assert run.stdout.strip() == "imported"
    assert run.returncode == 1
    assert "import nil_mitsuba before mitsuba" in run.stderr.splitlines()[-1]


def test_a_library_of_the_users_own_is_left_alone(before_drjit, monkeypatch):
    monkeypatch.setenv(llvm.VARIABLE, "/my/libLLVM.so")
    llvm.select()
    assert os.environ[llvm.VARIABLE] == "/my/libLLVM.so"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere Dr.Jit chooses")
def test_without_the_wheel_the_newest_llvm_of_the_system_is_chosen(
    before_drjit, monkeypatch, tmp_path
):
    for name in ("libLLVM-15.so.1", "libLLVM.so.18.1", "libLLVM.so.19.1", "libLLVM-21.so.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.19.1")
    monkeypatch.setattr(llvm, "_wheel_libraries", list)
    monkeypatch.setattr(llvm, "SYSTEM_FOLDERS", (str(tmp_path),))

    # Empty files: the loader takes none of them.
    llvm.select()
    assert llvm.VARIABLE not in os.environ
    tried = [text.removeprefix(f"{tmp_path}/").split(" ")[0] for text in llvm._rejected]
    assert tried == ["libLLVM-21.so.1", "libLLVM.so.19.1"]

    # By the file's name: pytest counts its folders, too, and comes to pytest-21.
    monkeypatch.setattr(llvm, "_loads", lambda path: "21" not in os.path.basename(path))
    llvm.select()
    assert os.environ[llvm.VARIABLE] == str(tmp_path / "libLLVM.so.19.1")


@needs_wheel
def test_what_the_wheel_misses_is_named(fresh_python, monkeypatch, tmp_path):
    # The wheel's library finds its C++ runtime by its own place: elsewhere it cannot be loaded.
    (tmp_path / "lib").mkdir()
    stray = tmp_path / "lib" / "libLLVM.so.23.1"
    stray.symlink_to(llvm._wheel_libraries()[0])
    run = fresh_python(
        "import runpy\n"  # by itself, since the package would load the library from its own place
        "llvm = runpy.run_path('nil_mitsuba/llvm.py')\n"
        f"print(llvm['_loads']({str(stray)!r}), *llvm['_rejected'])"
    )
    if run.stdout.startswith("True"):
        pytest.skip("the system has a C++ runtime that the library accepts")
    assert "libc++.so.1: cannot open shared object file" in run.stdout, run.stderr

    monkeypatch.setattr(llvm, "_rejected", ["lib: libatomic.so.1: cannot open"])
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (-1, -1, -1))
    assert "libatomic.so.1" in llvm.problem()


def test_no_llvm_at_all_is_one_sentence_with_three_ways_out(monkeypatch):
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (-1, -1, -1))
    sentence = llvm.problem()
    assert "no LLVM 19 or newer was found" in sentence
    assert "pip install" in sentence and "package manager" in sentence and "set DRJIT_" in sentence
    assert "\n" not in sentence
    with pytest.raises(ImportError, match="no LLVM"):
        llvm.require("llvm_ad_rgb")


def test_variants_without_llvm_do_not_ask_for_it(monkeypatch):
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (15, 0, 6))
    llvm.require("cuda_ad_rgb")
    llvm.require("scalar_rgb")


@pytest.mark.parametrize(
    "name, version",
    [
        ("libLLVM.so.23.1", (23, 1)),
        ("libLLVM-19.so.1", (19,)),
        ("libLLVM-19.so", (19,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM.so.20.1-rust-1.87.0-stable", (20, 1)),
        ("libLLVM.so", ()),
        ("libLLVMSupport.so.19", ()),
    ],
)
def test_a_librarys_name_tells_its_version(name, version):
    assert llvm._version_in_name(f"/usr/lib/{name}") == version
