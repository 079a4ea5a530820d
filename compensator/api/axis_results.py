"""Results of several axes of a machine, by axis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from compensator.api.files import Paged
from compensator.axes import label_of
from compensator.display import Listing, Shown, Table, Words
from compensator.model.thermal_model import ThermalModel

if TYPE_CHECKING:
    from compensator.api.plotting import Plot
    from compensator.report.page import Page

_Result = TypeVar("_Result", bound=Any)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class AxisResults(Shown, Mapping[str, _Result], Generic[_Result]):
    """Results of several axes, by axis.

    Parameters
    ----------
    results : dict of str to result
        What the same function returns for each axis alone.
    """

    results: Mapping[str, _Result]

    def __getitem__(self, axis: str) -> _Result:
        return self.results[axis]

    def __iter__(self) -> Iterator[str]:
        return iter(self.results)

    def __len__(self) -> int:
        return len(self.results)

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of each axis."""
        return {"axes": {axis: result.to_dict() for axis, result in self.results.items()}}

    def contents(self) -> Sequence[str | Table | Words | Listing]:
        """Return the content of each axis below its name."""
        return [part for axis, result in self.results.items() for part in (_heading(axis), *result.contents())]

    def plot(self) -> Plot:
        """Plot what the result of each axis plots, one below another."""
        from compensator.api.plotting import stacked

        found = [(label_of(axis), panel) for axis, result in self.results.items() for panel in result.panels()]
        return stacked(
            (label if label.startswith(name) else f"{name} {label}", curves) for name, (label, curves) in found
        )[0]


def _heading(axis: str) -> str:
    return f"Axis {label_of(axis)}"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class PagedAxes(AxisResults[_Result], Paged):
    """Results of several axes that have one page."""

    def as_page(self) -> Page:
        """Return the page: a section for each axis, below what is said of the machine."""
        from compensator.report.axes import page_of_axes

        return page_of_axes({axis: result.as_page() for axis, result in self.results.items()})


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class AxisModels(PagedAxes[_Result]):
    """Results of several axes that each have a model; one file holds them all."""

    @property
    def model(self) -> dict[str, ThermalModel]:
        """The model of each axis, as read back from their file."""
        return {axis: result.model for axis, result in self.results.items()}

    @property
    def sha256(self) -> str:
        """Hash of the model file."""
        return str(next(iter(self.results.values())).sha256)
