"""The charts, drawn by altair."""

import math
import re

import mitsuba as mi

from .methods import DEFAULT, PACKAGE
from .rays import IMAGE, LENGTHS
from .scenes import MAIN, TWIST
from .tables import chosen

# Colours that the colour-blind can tell apart (Okabe and Ito); the package in black
STYLES = {
    PACKAGE: "#000000",
    "stable form": "#0072B2",
    "printed form": "#CC79A7",
    "Runge–Kutta 4": "#009E73",
    "Dormand–Prince": "#56B4E9",
    "Euler pieces": "#E69F00",
}
# What legends call methods where their name would not do
LONG_NAMES = {"printed form": "report's form (divides by w)"}


def logarithmic(alt, values, title, between, below=1.3):
    """Arguments of a logarithmic axis with ticks at 10ⁿ · ``between``, as far as values go.

    There is room for another value that is smaller by the factor ``below``.
    """
    low, high = min(values), max(values)
    ticks = [float(f"{b}e{n}") for n in range(-12, 6) for b in between]
    ticks = [t for t in ticks if low / below < t < 1.3 * high]
    scale = alt.Scale(type="log", domain=[low / below, 1.3 * high], nice=False)
    decades = high / low > 1e3
    return {
        "title": title,
        "scale": scale,
        "axis": alt.Axis(values=ticks, format="~e" if decades else "~g"),
    }


def curves(alt, data, title_x, title_y, width, height, domain=None, size=34):
    """Curves, one a method, with the package's default marked.

    ``domain``: data whose range the axes span, if it is more than ``data``. ``size`` of the points.
    """
    span = domain or data
    base = (
        alt.Chart(alt.Data(values=data))
        .encode(
            alt.X("time:Q", **logarithmic(alt, [d["time"] for d in span], title_x, (1, 2, 5))),
            alt.Y(
                "value:Q", **logarithmic(alt, [d["value"] for d in span], title_y, (1,), below=2.5)
            ),
            alt.Color(
                "method:N",
                title=None,
                scale=alt.Scale(
                    domain=[LONG_NAMES.get(name, name) for name in STYLES],
                    range=list(STYLES.values()),
                ),
                legend=alt.Legend(
                    orient="top",
                    columns=6,
                    symbolType="stroke",
                    symbolStrokeWidth=3,
                    labelFontSize=12,
                    labelLimit=300,
                ),
            ),
            order=alt.Order("knob:Q"),
        )
        .properties(width=width, height=height)
    )
    seen, ours = ~alt.datum.none, alt.datum.method == PACKAGE
    return (
        base.transform_filter(seen & ~ours).mark_line(strokeWidth=1.7),
        base.transform_filter(seen & ours).mark_line(strokeWidth=3.2),
        base.transform_filter(seen).mark_point(
            shape="square" if size < 20 else "circle", filled=True, size=size, opacity=1
        ),
        base.transform_filter(alt.datum.none).mark_point(size=40, fill="white", opacity=1),
        base.transform_filter(alt.datum.default).mark_point(
            shape="diamond", size=180, filled=True, opacity=1, color=STYLES[PACKAGE]
        ),
    )


def plotted(rows, measure):
    """Points of the chart: what was not seen once among N is drawn, hollow, at half of 1/N."""
    result = []
    for row in rows:
        value, none = row[measure], False
        if measure.startswith("other surface") and value == 0:
            value, none = 0.5 / row["rays"], True
        if value and math.isfinite(value):
            result.append(
                {
                    "method": LONG_NAMES.get(row["method"], row["method"]),
                    "knob": row["knob"],
                    "none": none,
                    "default": (row["method"], row["knob"]) == (PACKAGE, DEFAULT),
                    "time": float(f"{row['microseconds']:.4g}"),
                    "value": float(f"{value:.4g}"),
                }
            )
    return result


def main_chart(alt, rows):
    """Two panels for one scene: error of position and share of wrong surfaces."""
    rows = chosen(rows, **MAIN)
    panels = []
    # The label stands where the package's own curve is not
    for measure, title, align, dx in (
        ("position 99 %", "position error that 1 % of the hits exceed (cells)", "left", 4),
        ("other surface", "share of rays that name another surface", "right", -6),
    ):
        data = plotted(rows, measure)
        layers = curves(alt, data, "processor time per ray (µs)", title, 360, 330)
        default = next(d for d in data if d["default"])
        label = (
            alt.Chart(alt.Data(values=[default]))
            .mark_text(
                text="default",
                dx=dx,
                dy=16,
                align=align,
                fontSize=13,
                fontWeight="bold",
            )
            .encode(alt.X("time:Q"), alt.Y("value:Q"))
        )
        panels.append(alt.layer(*layers, label))
    count = max(row["rays"] for row in rows)
    return alt.hconcat(*panels, spacing=30).properties(
        title=alt.TitleParams(
            "Accuracy against speed of tracing geodesics of Nil: lower left is better",
            subtitle=[
                f"Camera rays in the quotient, twist {TWIST}, up to {MAIN['length']} cells, "
                f"mesh of {30 * 2 * 64**2:,} triangles, a {IMAGE}×{IMAGE} image; float64 "
                "root finding as truth.",
                "Each curve: one method, its step or tolerance varied. Hollow: none among "
                f"{count:,} rays (drawn at half of one).",
            ],
            anchor="start",
            fontSize=16,
            subtitleFontSize=12,
            offset=14,
        )
    )


def scenes_chart(alt, rows):
    """Small multiples: one row a scene, error of position at one length, surfaces at all."""
    panels = [("position 99 %", MAIN["length"])] + [("other surface", n) for n in LENGTHS]
    grid = []
    for scene in dict.fromkeys((row["scene"], row["space"]) for row in rows):
        line = []
        for measure, length in panels:
            part = chosen(rows, scene=scene[0], space=scene[1], length=length)
            span = plotted(chosen(rows, length=length), measure)
            data = plotted(part, measure)
            name = "position error (cells)" if measure == "position 99 %" else "other surface"
            chart = alt.layer(*curves(alt, data, "", "", 170, 120, domain=span, size=16))
            if not grid:
                chart = chart.properties(title=f"{name}, up to {length}")
            line.append(chart)
        grid.append(
            alt.hconcat(
                *line,
                title=alt.TitleParams(
                    ", ".join(scene), orient="left", anchor="middle", fontSize=13
                ),
            )
        )
    return alt.vconcat(*grid).properties(
        title=alt.TitleParams(
            "Position error that 1 % of the hits exceed, and share of rays that name another "
            "surface, over processor time per ray (µs)",
            anchor="start",
            fontSize=14,
            offset=12,
            subtitle="Up to so many cells. Diamond: the package's default. "
            "Hollow: none seen (drawn at half of one ray).",
        )
    )


def image_chart(alt, rows):
    """relMSE and FLIP over time."""
    greys = {4: "#C0C0C0", 1: "#808080", DEFAULT: STYLES[PACKAGE]}
    series, data = {}, []
    for row in rows:
        ours = row["method"] == PACKAGE
        name = (
            f"{LONG_NAMES.get(row['method'], row['method'])}, {row['knob']:g} "
            f"{'pixels' if ours else 'cells'}"
        )
        series[name] = greys[row["knob"]] if ours else STYLES[row["method"]]
        # The estimate of relMSE may be below zero where there is next to none
        data += [
            {
                "scene": f"{row['scene']}, {row['space']}",
                "measure": measure,
                "series": name,
                "time": float(f"{row['seconds']:.4g}"),
                "value": float(f"{row[measure]:.4g}"),
                "spp": row["spp"],
            }
            for measure in ("relMSE", "FLIP")
            if row[measure] > 0
        ]
    grid = []
    for measure in ("relMSE", "FLIP"):
        line = []
        for scene in dict.fromkeys(d["scene"] for d in data):
            part = chosen(data, scene=scene, measure=measure)
            values = [d["value"] for d in chosen(data, measure=measure)]
            base = (
                alt.Chart(alt.Data(values=part))
                .encode(
                    alt.X(
                        "time:Q",
                        **logarithmic(
                            alt,
                            [d["time"] for d in part],
                            "processor time (s)" if grid else "",
                            (1, 2, 5),
                        ),
                    ),
                    alt.Y(
                        "value:Q", **logarithmic(alt, values, "" if line else measure, (1, 2, 5))
                    ),
                    alt.Color(
                        "series:N",
                        title=None,
                        scale=alt.Scale(domain=list(series), range=list(series.values())),
                        legend=alt.Legend(
                            orient="top",
                            columns=5,
                            symbolType="stroke",
                            symbolStrokeWidth=3,
                            labelFontSize=12,
                            labelLimit=300,
                        ),
                    ),
                    order=alt.Order("spp:Q"),
                )
                .properties(width=155, height=150, title="" if grid else scene)
            )
            line.append(
                base.mark_line(strokeWidth=2) + base.mark_point(filled=True, size=36, opacity=1)
            )
        grid.append(alt.hconcat(*line))
    counts = ", ".join(str(n) for n in sorted({row["spp"] for row in rows}))
    return alt.vconcat(*grid).properties(
        title=alt.TitleParams(
            "Error of images over time: lower left is better",
            anchor="start",
            fontSize=16,
            subtitle=f"{counts} samples per pixel, against a converged render. FLIP is a "
            "perceptual difference from 0 to 1. Each method with the step or tolerance named.",
            subtitleFontSize=12,
            offset=12,
        )
    )


def draw(folder, rows, image_rows):
    """Write the charts as SVG and PNG, if altair and vl-convert are installed."""
    try:
        import altair as alt
        import vl_convert  # noqa: F401 - what altair saves with
    except ImportError:
        print("no charts: pip install altair vl-convert-python")
        return
    drawings = {"accuracy_vs_speed": (main_chart(alt, rows), 90)}
    if len({(row["scene"], row["space"]) for row in rows}) > 1:
        drawings["by_scene"] = (scenes_chart(alt, rows), 72)
    if image_rows:
        drawings["images_over_time"] = (image_chart(alt, image_rows), 72)
    for name, (drawing, resolution) in drawings.items():
        drawing = drawing.configure(aria=False)
        drawing = drawing.configure_axis(gridOpacity=0.4, labelFontSize=11, titleFontSize=12)
        vector = folder / f"{name}.svg"
        drawing.save(vector)
        # Half of the file says nothing to a picture: classes, roles, a millionth of a pixel
        text = re.sub(r' (aria-\w+|role|class|pointer-events)="[^"]*"', "", vector.read_text())
        text = text.replace('<path d="" display="none"/>', "")
        vector.write_text(re.sub(r"(\.\d\d)\d+", r"\1", text))
        picture = str(folder / f"{name}.png")
        drawing.save(picture, ppi=resolution)
        # Without its alpha channel and packed more tightly it is a quarter of the size
        mi.Bitmap(picture).convert(mi.Bitmap.PixelFormat.RGB).write(picture)
        print(f"wrote {folder / name}.svg and .png")
