"""What was measured as text and as JSON."""

import importlib.util
import json
import math

from .end_points import throughput_ratio
from .images import REFERENCE
from .methods import PACKAGE

# What tables call methods where their name would not do
SHORT_NAMES = {"printed form": "report's form"}
# Columns of the rays in JSON only
UNPRINTED = ("hits", "direction", "direction max")
SHORT = {
    "microseconds": "µs",
    "rays per second": "rays/s",
    "nanoseconds": "ns",
    "position 99 %": "99 %",
    "position max": "max",
    "direction 99 %": "direction",
    "other surface": "other",
    "not a number": "NaN",
    "other surface, away": "away",
    "other surface, near": "near",
}


def chosen(rows, **values):
    return [row for row in rows if all(row[key] == value for key, value in values.items())]


def table(rows):
    """The rows as lines of text."""
    names = [name for name in rows[0] if name not in UNPRINTED]
    cells = [
        [
            f"{row[name]:.2g}"
            if isinstance(row[name], float)
            else SHORT_NAMES.get(row[name], str(row[name]))
            for name in names
        ]
        for row in rows
    ]
    names = [SHORT.get(name, name) for name in names]
    widths = [max(len(name), *(len(line[i]) for line in cells)) for i, name in enumerate(names)]
    return "\n".join(
        " ".join(cell.rjust(width) for cell, width in zip(line, widths)) for line in (names, *cells)
    )


def columns(rows):
    """The rows as JSON: the names once."""

    def short(x):
        # JSON knows no NaN
        return x if not isinstance(x, float) else float(f"{x:.3g}") if math.isfinite(x) else None

    return {"columns": list(rows[0]), "rows": [[short(x) for x in row.values()] for row in rows]}


def write(folder, rows, end_rows, image_rows, differences):
    """Write the tables as text and as JSON."""
    text = [
        "Rays: error of position (cells: median, 99 %, max) and direction (99 %), share that",
        "names another surface (of all; of those whose eight neighbours, 1.4 to 2.8 pixels",
        "away, all see the same one; of the others), share for which a segment is no number",
        "(they count as naming another surface), segments searched per ray, and",
        "processor time per ray or rays per second of one processor core",
        table(rows),
        "",
        "End points alone (nanoseconds of processor time, or end points per second of one",
        "core; error: root mean square, cells)",
        table(end_rows),
        "",
        *ratio_lines(end_rows),
        "",
        "Images (processor seconds)",
        table(image_rows),
        "",
        "What is left of the images' error without noise: the mean of (I - R)²/(R² + 0.01) and",
        "its standard error; its root and what one standard error more adds to that. R is by",
        f"the {REFERENCE[0]}, chords of {REFERENCE[1]} cells.",
        table(differences),
        "",
    ]
    (folder / "accuracy_vs_speed.txt").write_text("\n".join(text))
    tables = {
        "rays": rows,
        "end points": end_rows,
        "images": image_rows,
        "images without noise": differences,
    }
    (folder / "accuracy_vs_speed.json").write_text(
        json.dumps(
            {name: columns(x) for name, x in tables.items()},
            ensure_ascii=False,
            separators=(",", ":"),
        )
    )


def ratio_lines(rows):
    """What the closed form is worth, against the fastest ODE method of the same error."""
    lines = []
    for length in dict.fromkeys(row["length"] for row in rows):
        for precision in ("float32", "float64"):
            ours = chosen(rows, length=length, method=PACKAGE, precision=precision)[0]["error"]
            tightest = min(
                row["error"] for row in rows if row["method"] != PACKAGE and row["length"] == length
            )
            error = 1e-6 if length == 5 else 1.001 * max(ours, tightest)
            ratio, us, best = throughput_ratio(rows, length, error, precision)
            lines.append(
                f"end points at length {length}, error {error:.1e}: flow in {precision} "
                f"{us['nanoseconds']:.2f} ns, best ODE {best['nanoseconds']:.0f} ns "
                f"({best['method']}, {best['precision']}, {best['knob']:.2g}): {ratio:.0f} times"
            )
    if importlib.util.find_spec("heyoka") is None:
        lines.append("heyoka took no part: it is not installed")
    return lines
