"""End points of geodesics by heyoka, a Taylor integrator, as a peer for ``accuracy_vs_speed.py``.

heyoka brings numpy and an LLVM of its own, so it runs in a process of its own, and it is optional.
Reads {"starts": [[x, y, z, a, b, w], …], "length", "tolerance"} from the standard input, and
writes {"ends": [[x, y, z], …], "seconds"}; k = 1. Python takes longer to hand a state over than
heyoka to follow it, so what is written is the processor time of the steps alone: what one takes on
long geodesics (less what those of length 0 take), times their number.
"""

import json
import sys
import time

import heyoka

task = json.load(sys.stdin)
x, y, z, a, b = heyoka.make_vars("x", "y", "z", "a", "b")
w = heyoka.par[0]
batch = heyoka.recommended_simd_size()
integrator = heyoka.taylor_adaptive_batch(
    [(x, a), (y, b), (z, w + x * b), (a, -w * b), (b, w * a)],
    state=[[0.0] * batch] * 5, pars=[[0.0] * batch], tol=task["tolerance"])
starts = task["starts"]
batches = [[list(column) for column in zip(*starts[i:i + batch])]
           for i in range(0, len(starts) - batch + 1, batch)]


def run(length):
    """Processor seconds, steps of all batches, and end points."""
    ends, steps = [], 0
    begin = time.process_time()
    for columns in batches:
        integrator.state[:] = columns[:5]
        integrator.pars[0] = columns[5]
        integrator.set_time(0.0)
        integrator.propagate_until(length)
        # A batch goes on until the last of its rays is there
        steps += max(result[3] for result in integrator.propagate_res)
        ends.append(integrator.state[:3].tolist())
    return time.process_time() - begin, steps, ends


LONG = 50.0
idle = min(run(0.0)[0] for _ in range(3))
seconds, steps = min(run(LONG)[:2] for _ in range(3))
_, wanted, ends = run(task["length"])
json.dump({"ends": [list(point) for columns in ends for point in zip(*columns)],
           "seconds": (seconds - idle) * wanted / steps}, sys.stdout)
