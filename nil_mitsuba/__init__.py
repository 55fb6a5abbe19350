"""Path tracing in Nil geometry with Mitsuba 3.

Importing the package before ``mitsuba`` chooses an LLVM library that Dr.Jit can use, and makes the
integrator ``nil`` available in every variant, whenever that variant is set.
"""

from . import llvm

__version__ = "0.1.0"

llvm.select()  # Dr.Jit looks for LLVM once, while it is imported: everything else comes after

from . import geometry, registration  # noqa: E402
from .aiming import look_at  # noqa: E402
from .stills import render  # noqa: E402

registration.install()

__all__ = ["geometry", "look_at", "render", "__version__"]
