"""A process that measures one checkout's package with this checkout's benchmarks.

It is told over its standard input what to do, and answers on its standard output, a line of JSON
each. It stays alive, so that two of them can take turns.
"""

import json
import os
import pathlib
import subprocess
import sys
import traceback

ROOT = pathlib.Path(__file__).resolve().parents[1]

# The package comes from the one folder, all that measures it from the other
START = """
import sys
package, laboratory = sys.argv[1:3]
sys.path.insert(0, package)
import nil_mitsuba
sys.path[0] = laboratory
"""


def command(checkout, code, *arguments):
    """The command of a new Python process that runs ``code`` with the package of a checkout."""
    return [sys.executable, "-c", START + code, str(checkout), str(ROOT), *map(str, arguments)]


def alone(words):
    """A command whose process has a peak of memory (``ru_maxrss``) of its own: on Linux one that
    executes another program hands it on, and who measures here may have had more."""
    return ["sh", "-c", '"$@"; exit $?', "sh", *words]


class Worker:
    """The process, as who gives it work sees it."""

    def __init__(self, checkout):
        self.checkout = pathlib.Path(checkout).resolve()
        if not (self.checkout / "nil_mitsuba" / "__init__.py").is_file():
            raise SystemExit(f"{checkout} is no checkout: it holds no folder nil_mitsuba.")
        self.process = subprocess.Popen(
            command(self.checkout, "from benchmarks.worker import serve\nserve(package)"),
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, what, *arguments):
        """The answer, or an exception with what went wrong there."""
        print(json.dumps([what, *arguments]), file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the worker of {self.checkout} has died")
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer["answer"]

    def close(self):
        self.process.stdin.close()
        self.process.wait()


class Desk:
    """What the process has in hand: one workload at a time."""

    def prepare(self, name, quick):
        """Build a workload and run it once, which compiles."""
        from .workloads import WORKLOADS

        self.contestants = {}
        self.contestants = WORKLOADS[name](quick)
        self.round(0)
        return {name: one.unit for name, one in self.contestants.items()}

    def round(self, seed):
        return {name: one.run(seed) for name, one in self.contestants.items()}

    def counts(self):
        return {name: one.counts() for name, one in self.contestants.items()}


def serve(checkout):
    """Work until the standard input ends."""
    import nil_mitsuba

    # What Mitsuba logs goes elsewhere
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    desk = Desk()
    where = pathlib.Path(nil_mitsuba.__file__).resolve()
    for line in sys.stdin:
        what, *arguments = json.loads(line)
        try:
            if not where.is_relative_to(pathlib.Path(checkout).resolve()):
                raise RuntimeError(f"nil_mitsuba is {where}, which does not lie in {checkout}")
            answer = {"answer": getattr(desk, what)(*arguments)}
        except Exception as error:
            traceback.print_exc()
            answer = {"error": str(error)}
        print(json.dumps(answer), file=answers, flush=True)
