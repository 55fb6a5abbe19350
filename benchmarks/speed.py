"""Prints what curvature costs: time against ``path``, empty space, triangles, compilation, memory.

Times are processor time of all threads, because machines are noisy: the least, and the median of
what was measured in rounds, in which everything that a row compares takes turns. With ``--beside``
another checkout of this repository takes turns with this one, under the same scenes and clocks.
Targets that are fractions, or 1, are parts of what that one takes.
"""

import argparse
import os
import pathlib
import platform
import statistics
import subprocess
import sys
from dataclasses import dataclass

from .worker import ROOT, Worker


@dataclass
class Row:
    """A cost of a contestant of a workload, over that of another one if ``over`` names it.

    ``cost`` is one of those of ``workloads``, or "queries" (a path or a ray).
    """

    workload: str
    contestant: str
    what: str
    cost: str = "passes"
    over: str = ""
    target: str = ""


def ray_rows(space, chords):
    for length in (1, 5, 20):
        contestant, what = f"length {length}", f"camera rays, sparse {space}, length {length}"
        workload = f"rays {space}"
        yield Row(workload, contestant, f"{what}: chords", "queries", "", chords)
        yield Row(workload, contestant, f"{what}: kernels", "kernels", "", "½")


ROWS = [
    Row("box", "twist 1", "bent Cornell box, twist 1, over path", "passes", "path", "≤ 1.5"),
    Row("box", "twist 1", "its kernels", "kernels", "path"),
    Row("box", "twist 0", "the same at twist 0, over path", "passes", "path", "≤ 1.05"),
    Row("box", "twist 0", "its kernels", "kernels", "path", "≤ 1.05"),
    Row("open", "twist 1", "open scene, twist 1, over path", "passes", "path", "≤ 2.5"),
    Row("open", "twist 0", "the same at twist 0, over path", "passes", "path"),
    Row("lattice", "twist 1", "small lattice, over twist 0", "passes", "twist 0", "≤ 1.7"),
    *ray_rows("plain", "¼"),
    *ray_rows("quotient", "⅓"),
    Row("stills", "lattice", "lattice", target="½"),
    Row("stills", "showcase", "showcase", target="½"),
    Row("dense", "twist 1", "dense mesh, by length, over twist 0", over="twist 0", target="≤ 1.2"),
    Row("triangles", "1,000,000", "1,000,000 triangles, over 10,000", over="10,000"),
    Row("grounds", "twist 1, 10", "ground of 20 cells, over path", over="path, 10"),
    Row("grounds", "twist 1, 100,000", "ground of 200,000 cells, over path", over="path, 100,000"),
    Row("fog", "twist 0", "a block of fog, twist 0, over volpath", over="volpath", target="≤ 1.3"),
    Row("fog", "twist 1", "the same at twist 1, over volpath", over="volpath", target="≤ 1.8"),
    Row("cloud", "twist 0", "a cloud, twist 0, over volpath", over="volpath", target="≤ 1.3"),
    Row("cloud", "twist 1", "the same at twist 1, over volpath", over="volpath", target="≤ 1.8"),
    Row("lattice in fog", "foggy", "lattice in fog, over clear", over="clear"),
    Row("lattice in fog", "endless", "the same without a horizon, over 12 cells", over="foggy"),
    Row("fresh", "first render", "first render, compilation included", target="1"),
    Row("fresh", "first render", "memory for a million samples", "MiB"),
    Row("passes", "bent box", "a pass of 256 paths"),
]


class Column:
    """What is found of one checkout."""

    def __init__(self, name, checkout):
        self.name, self.worker = name, Worker(checkout)
        self.units, self.rounds, self.counts, self.failed = {}, {}, {}, {}

    def ask(self, workload, *arguments):
        """The worker's answer; a workload that failed is left out from then on."""
        if workload in self.failed:
            return None
        try:
            return self.worker.ask(*arguments)
        except RuntimeError as error:
            self.failed[workload] = str(error)
            return None

    def values(self, row):
        """What the row states, round by round; empty if that failed."""
        if row.workload in self.failed:
            return []
        if row.cost == "queries":
            return [sum(self.counts[row.workload][row.contestant]["queries"].values())]
        rounds = self.rounds[row.workload]
        over = [costs[row.over][row.cost] if row.over else 1 for costs in rounds]
        return [costs[row.contestant][row.cost] / o for costs, o in zip(rounds, over)]

    def costs(self, row):
        """The row's own contestant, round by round."""
        return self.values(Row(row.workload, row.contestant, row.what, row.cost))


def measure(columns, workload, rounds, quick):
    """Let the checkouts take turns."""
    for column in columns:
        column.units[workload] = column.ask(workload, "prepare", workload, quick)
        column.rounds[workload] = []
    for seed in range(1, rounds + 1):
        # Neither always comes second
        for column in columns[:: -1 if seed % 2 else 1]:
            column.rounds[workload].append(column.ask(workload, "round", seed))
    for column in columns:
        column.counts[workload] = column.ask(workload, "counts")


def number(x):
    return f"{x:.0f}" if x >= 100 else f"{x:.2f}"


def cell(values):
    if not values:
        return "failed"
    return " / ".join(number(x) for x in dict.fromkeys((min(values), statistics.median(values))))


def table(columns, workloads):
    """The rows of these workloads as text."""
    lines = [["least / median", "unit", *(column.name for column in columns), "target"]]
    if len(columns) == 2:
        lines[0].insert(4, "cost there : here")
    for row in ROWS:
        if row.workload not in workloads:
            continue
        units = next((c.units[row.workload] for c in columns if row.workload not in c.failed), {})
        unit = "" if row.over else units.get(row.contestant, "")
        unit = {"queries": "", "MiB": "MiB"}.get(row.cost, unit)
        line = [row.what, unit, *(cell(column.values(row)) for column in columns), row.target]
        if len(columns) == 2:
            there, here = (column.costs(row) for column in columns)
            line.insert(4, cell([b / a for a, b in zip(there, here)]))
        lines.append(line)
    return aligned(lines)


def counts_table(columns, workloads):
    """Rays, queries and packet iterations of each kind of ray, as text."""
    lines = []
    for workload in workloads:
        for column in columns:
            for contestant, counts in (column.counts[workload] or {}).items():
                if not counts:
                    continue
                if not lines:
                    kinds = list(next(iter(counts.values())))
                    titles = [f"{what}: {' + '.join(kinds)}" for what in counts]
                    lines.append(["", "", "", *titles])
                sums = [
                    f"{sum(each.values()):.2f} = {' + '.join(f'{x:.2f}' for x in each.values())}"
                    for each in counts.values()
                ]
                lines.append([workload, contestant, column.name, *sums])
    return aligned(lines)


def aligned(lines):
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))] if lines else []
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths)).rstrip() for line in lines
    )


def machine():
    """Which processor this is, and how many of its cores can be used."""
    model = platform.processor() or platform.machine()
    information = pathlib.Path("/proc/cpuinfo")
    if information.is_file():
        names = [x for x in information.read_text().splitlines() if x.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    return f"{model}, {len(os.sched_getaffinity(0))} cores, {platform.system()}"


def commit(checkout):
    """The commit that is checked out there, with a + if files have been changed since."""
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty=+", "--exclude=*"],
        cwd=checkout,
        capture_output=True,
        text=True,
    )
    return git.stdout.strip() or "?"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    parser.add_argument("--beside", metavar="FOLDER", help="another checkout, to compare with")
    known = list(dict.fromkeys(row.workload for row in ROWS))
    parser.add_argument("--only", nargs="+", choices=known, help="workloads (default: all)")
    parser.add_argument("--rounds", type=int, default=5, help="(default: 5)")
    arguments = parser.parse_args()
    quick, workloads = arguments.quick, arguments.only or known

    columns = [Column("here", ROOT)]
    if arguments.beside:
        columns.insert(0, Column("there", arguments.beside))
    print(machine())
    for column in columns:
        print(f"{column.name}: {column.worker.checkout}, {commit(column.worker.checkout)}")
    for workload in workloads:
        measure(columns, workload, 1 if quick else arguments.rounds, quick)
        for column in columns:
            if workload in column.failed:
                print(f"{workload}, {column.name}: {column.failed[workload]}", file=sys.stderr)
        print(f"\n{table(columns, [workload])}", flush=True)
    for column in columns:
        column.worker.close()
    print("\nEverything, and what is asked of Embree for a path or ray:\n")
    print(table(columns, workloads))
    print(f"\n{counts_table(columns, workloads)}")
    if columns[-1].failed:
        sys.exit(f"failed here: {', '.join(columns[-1].failed)}")


if __name__ == "__main__":
    main()
