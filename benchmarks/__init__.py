"""The laboratory: what the package is measured with, and the truth that it is measured against.

Run from the root of a checkout, with the extra ``test`` installed (``chart`` for pictures):

    python -m benchmarks.camera_rays         # camera rays, one by one, against the truth
    python -m benchmarks.reference_geometry  # errors of the formulas
    python -m benchmarks.failures            # where methods fail
    python -m benchmarks.chart               # accuracy against speed of all methods
    python -m benchmarks.speed               # cost against ``path``
    python -m benchmarks.accuracy            # images at two tolerances
    python -m benchmarks.emitter_sampling    # what emitter sampling is worth
    python -m benchmarks.walk                # pictures a second in the viewfinder
    python -m benchmarks.stills              # what passes, layers and checkpoints cost
    python -m benchmarks.offsets             # whether next rays leave their surface, and leaks

The truth: ``truth`` (first hits by root finding in float64), ``reference_geometry`` (mpmath and
ODEs), ``light_truth`` (which geodesics bring light) and ``face_crossing``. The peers:
``report_formulas`` and ``tracing_methods``, and ``tracers``, which lets them and the package trace
the same rays. ``flip`` compares images, ``studio`` makes small things to photograph.

Tests import from here, and nothing here imports tests. The package comes first, here and so for
every module: it chooses the LLVM that Dr.Jit will use.
"""

import nil_mitsuba  # noqa: F401
