"""Figures of results with matplotlib, displayed by a notebook without set-up."""

from __future__ import annotations

import io
from collections.abc import Iterable

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compensator.arrays import Vector

#: A label and the times, h, and values of a line.
Curve = tuple[str, Vector, Vector]
#: Label of the values, and the curves, of a panel.
Panel = tuple[str, list[Curve]]


class Plot(Figure):
    """A matplotlib figure that a notebook displays; it has no window and need not be closed."""

    def _repr_png_(self) -> bytes:
        data = io.BytesIO()
        self.savefig(data, format="png", bbox_inches="tight")
        return data.getvalue()


def stacked(panels: Iterable[tuple[str, Iterable[Curve]]]) -> tuple[Plot, list[Axes]]:
    """Draw curves over time, one panel above another.

    Parameters
    ----------
    panels : iterable of (str, iterable of Curve)
        Label of the values, and the curves, of each panel.
    """
    panels = list(panels)
    figure = Plot(figsize=(9.0, 2.6 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0].tolist()
    for axis, (label, curves) in zip(axes, panels, strict=True):
        for name, hours, values in curves:
            axis.plot(hours, values, label=name, linewidth=1.0)
        axis.set_ylabel(label, wrap=True)
        axis.grid(alpha=0.3)
        axis.legend(loc="best", fontsize="small")
    axes[-1].set_xlabel("time, h")
    return figure, axes
