"""The page of `loop`: the machines of a shop, what their loops found and adopted, and what each needs from a person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from compensator.report.page import Block, Details, Page, Table, Tone, Words


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetRow:
    """A machine of the shop.

    Parameters
    ----------
    name : str
        Its name, or its folder where it cannot be read.
    span : str
        What its recordings cover, and whether the decisions are those of its service.
    error : str
        The error that is left in the last day with the model alone → with the loop.
    found, proposed, adopted, gone_back : str
        Effects and numbers.
    needs : str
        What a person has to do.
    steps : sequence of str
        Every decision, with its time.
    is_bad : bool
        Whether its recordings cannot be used.
    """

    name: str
    span: str = ""
    error: str = ""
    found: str = ""
    proposed: str = ""
    adopted: str = ""
    gone_back: str = ""
    needs: str = ""
    steps: Sequence[str] = ()
    is_bad: bool = False


def fleet_table(rows: Sequence[FleetRow], *, on_page: bool = False) -> Table:
    """Return the table of machines; on a page what a person has to do comes first, on a terminal last."""
    head = ["error, µm rms", "found", "proposed", "adopted", "back", "recordings"]
    cells = [[row.error, row.found, row.proposed, row.adopted, row.gone_back, row.span] for row in rows]
    place = 0 if on_page else len(head)
    head.insert(place, "action")
    for row, line in zip(rows, cells, strict=True):
        line.insert(place, row.needs or "none")
    note = (
        "Error: measured Y with the offset applied, or what touch probes found, in the last 24 h; with the model alone "
        "→ with the loop. Found: the last candidate; back: how often the loop went back."
    )
    lines = [[row.name, *line] for row, line in zip(rows, cells, strict=True)]
    return Table(title="Machines", head=["machine", *head], rows=lines, note=note)


def fleet_verdict(rows: Sequence[FleetRow]) -> str:
    """Return the result in one sentence."""
    waiting, bad = sum(bool(row.needs) for row in rows), sum(row.is_bad for row in rows)
    proposed = sum(bool(row.proposed) for row in rows)
    words = f"{len(rows)} machine(s): action needed on {waiting}"
    if proposed:
        words += f", {proposed} of them with a proposal"
    return f"{words}; {bad} could not be read." if bad else f"{words}."


def fleet_page(rows: Sequence[FleetRow]) -> Page:
    """Make the page."""
    tone: Tone = "bad" if any(row.is_bad for row in rows) else "warn" if any(row.needs for row in rows) else "good"
    blocks: list[Block] = [fleet_table(rows, on_page=True)]
    blocks += [
        Details(title=f"{row.name}: {len(row.steps)} decision(s)", blocks=[Words(title="", lines=list(row.steps))])
        for row in rows
        if row.steps
    ]
    return Page(title="The loop over a shop", verdict=fleet_verdict(rows), blocks=blocks, tone=tone)
