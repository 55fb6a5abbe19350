"""The chart of accuracy against speed for every serious way of tracing geodesics of Nil.

Traces the same camera rays by the package and by the methods of ``tracing_methods.py``, through
sparse, dense and glossy scenes in plain Nil and in the quotient, up to 1, 5 and 20 cells, and
compares each hit with float64 root finding on analytic surfaces (``truth.py``), which shares no
code with any of them. ``python -m benchmarks.chart`` writes tables and charts into ``charts/``.

The dense scene is a mesh of 245,760 triangles that makes up the 30 faces of five boxes: planes cut
into triangles are still planes, so the truth about the mesh is exact.

Times are processor time of kernels on two threads; see ``timed``. Take them on an idle machine.
"""

import mitsuba as mi

# The package's modules, and so those that measure them, are written for one variant when they are
# imported
mi.set_variant("llvm_ad_rgb")
