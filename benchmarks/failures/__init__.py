"""Where methods of tracing geodesics of Nil fail, and by how much.

``python -m benchmarks.failures`` prints two Markdown tables.

The first is about a geodesic alone. The formula is the closed form of VISGRAF TR-19-06, which
divides by w; RK4 takes steps of 1/20 of a cell; the adaptive pair is that of Dormand and Prince
with a tolerance of 1e-6. Errors are distances in cells from the true point, the largest of all
rays, and in brackets the share of rays that are off by more than 1e-3. Crossings of faces are those
of ``face_crossing.py``, which brackets the package's ``flow`` between its extrema.

The second is about rays that look for surfaces; in brackets, the share of rays that name another
one. The tracers are those of ``tracers.py``: chords of 1/20 of a cell by the
printed formula and by RK4, the adaptive pair with a tolerance of 1e-4 for its chords, and the
package at its default tolerance.

All are in float32; the truth is computed in float64 by code of its own (``truth.py``). Twist 1
unless a row says otherwise. Takes about five minutes of two cores.
"""
