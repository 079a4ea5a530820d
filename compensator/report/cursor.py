"""What the script of a page (`cursor.js`) needs to zoom a plot and to read values off it."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from importlib import resources
from typing import Any

from dateutil.tz import tzlocal  # type: ignore[import-untyped]
from matplotlib.axes import Axes

from compensator.report.figure import Figure

#: Seconds of a day, the unit of an axis of times of day; of an hour.
_DAY_S, _HOUR_S = 86400.0, 3600.0
_WEEK_H = 168


@cache
def script() -> str:
    """Return the script."""
    return resources.files("compensator.report").joinpath("cursor.js").read_text(encoding="utf-8")


@cache
def script_hash() -> str:
    """Return the source expression by which a content security policy permits the script and no other."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script().encode()).digest()).decode()}'"


def can_be_read(figure: Figure) -> bool:
    """Whether a figure has curves over a linear axis."""
    panels = (figure, *figure.below)
    plain = not any(panel.bars or panel.unit_circle or panel.x_log or panel.stems for panel in panels)
    return plain and any(line.x.size for panel in panels for line in panel.lines)


def axes_id(number: int) -> str:
    """Return the identifier of a panel in the picture."""
    return f"panel-{number}"


def line_id(panel: int, number: int) -> str:
    """Return the identifier of a curve in the picture."""
    return f"panel-{panel}-line-{number}"


def plot_data(figure: Figure, axes: Sequence[Axes], prefix: str) -> str:
    """Return where the panels and curves of a drawn figure are, as JSON.

    Parameters
    ----------
    figure : Figure
        What was drawn.
    axes : sequence of matplotlib.axes.Axes
        Its panels as they were drawn.
    prefix : str
        Prefix of its identifiers on the page.
    """
    panels = (figure, *figure.below)
    first, last = (float(value) for value in axes[0].get_xlim())
    data = {
        "x": [first, last],
        "unit": _unit(panels[-1].x_label),
        "clock": figure.clock,
        "zone": _zone(first, last) if figure.clock and figure.local else [[0.0, 0.0]],
        "panels": [_panel(i, *pair, prefix) for i, pair in enumerate(zip(panels, axes, strict=True))],
    }
    return json.dumps(data, ensure_ascii=False, separators=(",", ":"))


def _panel(number: int, panel: Figure, axes: Axes, prefix: str) -> dict[str, Any]:
    canvas = axes.figure
    width, height = (72.0 * size for size in canvas.get_size_inches())  # type: ignore[union-attr]
    box = axes.get_position()
    return {
        "id": f"{prefix}-{axes_id(number)}",
        "box": [round(v, 3) for v in (box.x0 * width, (1 - box.y1) * height, box.x1 * width, (1 - box.y0) * height)],
        "y": [float(value) for value in axes.get_ylim()],
        "log": axes.get_yscale() == "log",
        "unit": _unit(panel.y_label),
        "lines": [
            {"id": f"{prefix}-{line_id(number, i)}", "name": line.name or panel.y_label.rpartition(", ")[0]}
            for i, line in enumerate(panel.lines)
        ],
    }


def _unit(label: str) -> str:
    """Return the unit of an axis: what follows the last comma, or all of it.

    Examples
    --------
    >>> _unit("residual, µm"), _unit("K")
    ('µm', 'K')
    """
    return label.rpartition(", ")[2]


def _zone(first: float, last: float) -> list[list[float]]:
    """Return the offsets of this computer's zone between two times, each with the time from which it is valid; days."""
    hour, end = int(first * _DAY_S // _HOUR_S), int(last * _DAY_S // _HOUR_S)
    offsets = [[hour * _HOUR_S / _DAY_S, _ahead(hour)]]
    while hour < end:
        # It changes once within a week at most. A time that is far off is centuries of hours away.
        low, high = hour, min(hour + _WEEK_H, end)
        if _ahead(high) != offsets[-1][1]:
            while high - low > 1:
                middle = (low + high) // 2
                low, high = (middle, high) if _ahead(middle) == offsets[-1][1] else (low, middle)
            offsets.append([high * _HOUR_S / _DAY_S, _ahead(high)])
        hour = high
    return offsets


def _ahead(hour: int) -> float:
    """Return by how much this computer's zone is ahead of UTC in an hour since 1970, days."""
    offset = datetime.fromtimestamp(hour * _HOUR_S, tz=UTC).astimezone(tzlocal()).utcoffset()
    return offset.total_seconds() / _DAY_S if offset is not None else 0.0
