"""A page of several axes: what is said of the machine, and a section for each axis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from compensator.axes import label_of
from compensator.report.page import Block, Page, Section, Tone, Words

#: Tones from the best to the worst.
_TONES: tuple[Tone, ...] = ("good", "warn", "bad")


def page_of_axes(pages: Mapping[str, Page], verdict: str = "", blocks: Sequence[Block] = ()) -> Page:
    """Make one page of those of the axes.

    Parameters
    ----------
    pages : mapping of str to Page
        Page of each axis.
    verdict : str
        What is said of the machine; by default the verdicts of all axes.
    blocks : sequence of Block
        Blocks above the sections of the axes.
    """
    verdicts = " ".join(f"{label_of(axis)}: {page.verdict}" for axis, page in pages.items())
    data = dict.fromkeys(name for page in pages.values() for name in page.data)
    return Page(
        title=next(iter(pages.values())).title,
        verdict=verdict or verdicts,
        blocks=[*blocks, *(_section(axis, page, bool(verdict)) for axis, page in pages.items())],
        tone=worst(page.tone or "good" for page in pages.values()),
        data=tuple(data),
    )


def _section(axis: str, page: Page, says_verdict: bool) -> Section:
    own: list[Block] = [Words(title="Result", lines=[page.verdict])] if says_verdict else []
    return Section(title=f"Axis {label_of(axis)}", blocks=[*own, *page.blocks])


def worst(tones: Iterable[Tone]) -> Tone:
    """Return the worst of some tones."""
    return max(tones, key=_TONES.index)
