"""End points of geodesics by heyoka, a Taylor integrator, as a peer for the chart.

heyoka brings numpy and an LLVM of its own, so it runs in a process of its own, and it is optional.
Reads {"starts": [[x, y, z, a, b, w], …], "length", "tolerance"} from the standard input, and
writes {"ends": [[x, y, z], …], "seconds"}; k = 1. ``seconds`` is the processor time of all of them,
less what it takes to hand the states over, which geodesics of length 0 show. A tighter tolerance
means terms of higher order and fewer steps, and so hardly more time.
"""

import json
import sys
import time

import heyoka

# Geodesics at once: with fewer a step costs more, with more the compiler takes seconds
BATCH = 32

task = json.load(sys.stdin)
if len(task["starts"]) % BATCH:
    sys.exit(f"the number of starts has to be a multiple of {BATCH}")
x, y, z, a, b = heyoka.make_vars("x", "y", "z", "a", "b")
w = heyoka.par[0]
integrator = heyoka.taylor_adaptive_batch(
    [(x, a), (y, b), (z, w + x * b), (a, -w * b), (b, w * a)],
    state=[[0.0] * BATCH] * 5,
    pars=[[0.0] * BATCH],
    tol=task["tolerance"],
)

# In its own arrays, which are handed over faster than lists
batches = []
for i in range(0, len(task["starts"]), BATCH):
    columns = list(zip(*task["starts"][i : i + BATCH]))
    integrator.state[:], integrator.pars[:] = columns[:5], columns[5:]
    batches.append((integrator.state.copy(), integrator.pars.copy()))


def run(length):
    """Follow all geodesics; returns the processor seconds that took and their end points."""
    ends = []
    begin = time.process_time()
    for state, pars in batches:
        integrator.state[:], integrator.pars[:] = state, pars
        integrator.set_time(0.0)
        integrator.propagate_until(length)
        ends.append(integrator.state[:3].copy())
    return time.process_time() - begin, ends


idle = min(run(0.0)[0] for _ in range(5))
seconds = min(run(task["length"])[0] for _ in range(5))
_, ends = run(task["length"])
json.dump(
    {
        "ends": [list(point) for columns in ends for point in zip(*columns.tolist())],
        "seconds": seconds - idle,
    },
    sys.stdout,
)
