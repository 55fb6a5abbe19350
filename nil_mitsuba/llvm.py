"""Which LLVM library Dr.Jit compiles with.

Dr.Jit loads LLVM while it is imported and takes what it finds in the system's library folder. Too
old an LLVM aborts the process in the middle of a render (LLVM 15: "Cannot select fminimum"), so
the choice is made before, and what Dr.Jit ended up with is checked before a variant needs it. So is
the GPU of variants that compile for one.
"""

from __future__ import annotations

import contextlib
import ctypes
import glob
import importlib.abc
import importlib.metadata
import os
import re
import sys
from typing import NamedTuple

OLDEST = 19  # 14 is refused by Dr.Jit, 15 aborts, 16 to 18 are untried; 19 and 23 are known to work
WHEEL = "karellen-llvm-core"
VARIABLE = "DRJIT_LIBLLVM_PATH"

WAYS_OUT = (
    f"pip install {WHEEL} (Linux x86-64), install LLVM {OLDEST} or newer with the system's package "
    f"manager, or set {VARIABLE} to such a libLLVM.so"
)

# Where Linux distributions, their -dev packages, local builds and conda keep shared libraries.
SYSTEM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm*/lib*",
    "/usr/lib64/llvm*/lib*",
    "/usr/local/lib*",
    os.path.join(sys.prefix, "lib"),
)


class Gpu(NamedTuple):
    """Name of a backend in Dr.Jit, and what it needs."""

    name: str
    needs: str


GPUS = {
    "cuda": Gpu("CUDA", "an NVIDIA GPU and its driver"),
    "metal": Gpu("Metal", "an Apple GPU"),
}

_too_late = False
_rejected: list[str] = []  # libraries that would have been chosen, each with the loader's objection


def select() -> None:
    """Point ``DRJIT_LIBLLVM_PATH`` to a usable LLVM, unless the user has set it.

    The order is the ``karellen-llvm-core`` wheel, then the system's LLVM libraries of version 19
    or newer, highest first. Nothing happens where Dr.Jit is loaded already, and outside Linux,
    where Dr.Jit knows the usual places itself. Raises nothing: see `problem`.
    """
    global _too_late
    _too_late = "drjit" in sys.modules
    if _too_late or os.environ.get(VARIABLE) or not sys.platform.startswith("linux"):
        return
    for path in [*_wheel_libraries(), *_system_libraries()]:
        if _loads(path):
            os.environ[VARIABLE] = path
            return


def problem() -> str | None:
    """One sentence on why LLVM variants cannot be used in this process, or None if they can."""
    import drjit as dr

    version = dr.detail.llvm_version()
    if version[0] >= OLDEST:
        return None

    ways_out = WAYS_OUT
    found = ".".join(str(number) for number in version if number >= 0)
    path = os.environ.get(VARIABLE)
    if path and found:
        what = f'{VARIABLE}="{path}" is LLVM {found}, but {OLDEST} or newer is needed'
    elif path:
        what = f'{VARIABLE}="{path}" cannot be loaded or is too old for Dr.Jit'
    elif found:
        what = f"Dr.Jit has loaded LLVM {found}, but {OLDEST} or newer is needed"
    else:
        what = f"no LLVM {OLDEST} or newer was found"
    if _rejected:
        what += f" ({'; '.join(_rejected)})"
    if _too_late and not path:
        ways_out = (
            f"import nil_mitsuba before mitsuba and drjit, or set {VARIABLE} to the libLLVM.so "
            f"of LLVM {OLDEST} or newer"
        )
    return f"LLVM variants cannot be used: {what}; {ways_out}."


def require(variant: str) -> None:
    """Raise an ImportError with one sentence if `variant` needs an LLVM that is not there."""
    if variant.startswith("llvm_"):
        sentence = problem()
        if sentence:
            raise ImportError(sentence)


def require_gpu(variant: str) -> None:
    """Raise an ImportError with one sentence if `variant` needs a GPU that is not there."""
    import drjit as dr

    backend, _, rest = variant.partition("_")
    # Dr.Jit may look for a GPU only later: where there is a driver, it is left to judge for itself
    if backend in GPUS and not (
        dr.has_backend(getattr(dr.JitBackend, GPUS[backend].name)) or _has_driver(backend)
    ):
        raise ImportError(
            f'the variant "{variant}" needs {GPUS[backend].needs}, and Dr.Jit finds none here: '
            f'use "llvm_{rest}", which needs none.'
        )


def _has_driver(backend: str) -> bool:
    if backend == "metal":
        return sys.platform == "darwin"
    names = (os.environ.get("DRJIT_LIBCUDA_PATH"), "libcuda.so.1", "libcuda.so", "nvcuda.dll")
    for name in filter(None, names):
        with contextlib.suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


class Guard(importlib.abc.MetaPathFinder):
    """Stops the import of Mitsuba's variants while there is no usable LLVM or GPU for them.

    ``set_variant`` imports ``mitsuba.<variant>`` on first use. Raising there, rather than in a
    variant callback, leaves the current variant alone and lets
    ``set_variant("llvm_ad_rgb", "scalar_rgb")`` go on to its second choice.
    """

    def find_spec(self, fullname, path=None, target=None):
        package, _, name = fullname.partition(".")
        if package == "mitsuba":
            require(name)
            require_gpu(name)
        return None


def _wheel_libraries() -> list[str]:
    try:
        files = importlib.metadata.files(WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    # Not libLLVM.so itself: the wheel makes that link at a later start of Python.
    return [os.path.realpath(f.locate()) for f in files if f.name.startswith("libLLVM.so.")]


def _system_libraries() -> list[str]:
    versions: dict[str, tuple[int, ...]] = {}
    for folder in SYSTEM_FOLDERS:
        for path in glob.glob(os.path.join(folder, "libLLVM*.so*")):
            path = os.path.realpath(path)
            version = _version_in_name(path)
            if version >= (OLDEST,):
                versions[path] = version
    return sorted(versions, key=lambda path: versions[path], reverse=True)


def _version_in_name(path: str) -> tuple[int, ...]:
    """(19, 1) for libLLVM.so.19.1 and libLLVM-19.so.1: the version without loading the library."""
    match = re.fullmatch(
        r"libLLVM(?:-(\d+(?:\.\d+)*)\.so.*|\.so\.(\d+(?:\.\d+)*).*)", os.path.basename(path)
    )
    if not match:
        return ()
    return tuple(int(number) for number in (match[1] or match[2]).split("."))


def _loads(path: str) -> bool:
    """Whether the dynamic loader accepts the library; Dr.Jit, which is next, finds it loaded."""
    try:
        ctypes.CDLL(path)
        return True
    except OSError as error:
        # The loader's text names what is missing: "libatomic.so.1: cannot open shared object ..."
        _rejected.append(f"{path} cannot be loaded: {error}")
        return False
