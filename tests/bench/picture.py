"""The picture of the README: a day of the loop, drawn from the recordings of a `make demo`.

    python -m tests.bench.picture [demo-out] [compensator/report/loop.svg]

Above: the measured deformation, the published offset and their sum, the remaining error. Below: the remaining error
with the calibrated model, and with the model extended by the diagnosis, which the running service adopts after an hour.
The remaining error is the measured mean of each minute plus the offset that was in force, its rate followed for half
of the minute.
"""

import json
import re
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from compensator.recording.reading import read_messages
from compensator.report.drawing import svg
from compensator.report.figure import Figure, Line

TOP = Path(__file__).resolve().parents[2]
WIDTH, GAP = 9.0, 6.0
UNIT = re.compile(r'width="([\d.]+)pt" height="([\d.]+)pt"')


def day(folder):
    """Return hours since the start; measured deformation, offset and remaining error of each minute, µm."""
    rows = {}
    for path in sorted(folder.glob("*.mcap"), key=lambda path: path.name):
        for record in read_messages(path, ("estimate", "offset")):
            message = json.loads(record.data)
            rows.setdefault(message["seq"], {}).update(message)
    kept = [rows[seq] for seq in sorted(rows)]
    # null is missing and stays so: a gap in the curve.
    y, offset, rate = (
        np.array([row.get(name) for row in kept], dtype=float)
        for name in ("y_um", "y_offset_um", "y_offset_rate_um_per_min")
    )
    hours = np.array([row["time_utc_ns"] for row in kept], dtype=float) / 3.6e12
    left = np.full(y.size, np.nan)
    for i, (before, after) in enumerate(pairwise(kept), start=1):
        if after["seq"] == before["seq"] + 1:
            left[i] = y[i] + offset[i - 1] + 0.5 * rate[i - 1]
    return hours - hours[0], y, offset, left


def figures(demo):
    hours, y, offset, extended = day(demo / "second-day-extended" / "recordings")
    hours_first, _, _, first = day(demo / "second-day-first" / "recordings")
    judged = hours > 1.5
    rms = {
        name: float(np.sqrt(np.nanmean(v[m] ** 2)))
        for name, v, m in (("first", first, hours_first > 1.5), ("extended", extended, judged), ("none", y, judged))
    }
    common = {"x_label": "time, h", "x_limits": (0.0, 24.0)}
    below = Figure(
        title="",
        y_label="error in Y, µm",
        height=2.9,
        lines=(
            Line(f"calibrated model: {rms['first']:.1f} µm rms", hours_first, first),
            Line(f"model extended by diagnose, adopted after 1 h: {rms['extended']:.1f} µm rms", hours, extended),
        ),
        **common,
    )
    # One figure, so that both axes of time line up.
    return (
        Figure(
            title="A working day of the simulated conduction machine",
            y_label="Y, µm",
            lines=(
                Line("thermal deformation, measured", hours, y),
                Line("Y offset, published", hours, offset),
                Line("remaining error", hours, extended),
            ),
            height=2.9,
            below=(below,),
            **common,
        ),
    ), rms


def stacked(pictures):
    """Put pictures below each other into one that stands alone, in light and dark."""
    text = (TOP / "compensator/report/style.css").read_text(encoding="utf-8")
    light, dark = (" ".join(re.findall(r"--[\w-]+: #[0-9a-f]{6};", block)) for block in text.split("{", 4)[1:4:2])
    parts, below, width = [], 0.0, 0.0
    for i, picture in enumerate(pictures):
        # The style below names the font once, and nobody zooms a picture of the README.
        drawn = re.sub(r"font-family: [^;\"]*;? ?| data-plot=\"[^\"]*\"", "", svg(picture, f"p{i}", WIDTH))
        width, height = (float(v) for v in UNIT.search(drawn).groups())
        parts.append(drawn.replace("<svg ", f'<svg x="0" y="{below:g}" ', 1).replace('pt"', '"'))
        below += height + GAP
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'viewBox="0 0 {width:g} {below:g}" width="{width:g}pt" height="{below:g}pt" role="img">'
        f"<title>{'; '.join(picture.title for picture in pictures)}</title>"
        f"<style>:root {{ {light} }} @media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }} "
        "text { font-family: system-ui, sans-serif; }</style>"
        '<rect width="100%" height="100%" style="fill: var(--paper)"/>'
    )
    return head + "".join(parts) + "</svg>\n"


def main(demo="demo-out", out=TOP / "compensator/report/loop.svg"):
    pictures, rms = figures(Path(demo) / "conduction")
    Path(out).write_text(stacked(pictures), encoding="utf-8")
    print(
        f"{out}: {Path(out).stat().st_size / 1024:.0f} KB; µm rms after 1.5 h: without {rms['none']:.2f}, "
        f"first model {rms['first']:.2f}, extended {rms['extended']:.2f}"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
