"""The advice of a diagnosis on its page: what to measure and to test next."""

from __future__ import annotations

from compensator.diagnose.advice_words import advice_lines
from compensator.diagnose.outcome import Diagnosis
from compensator.report.page import Block, Section, Table, Words


def advice_blocks(diagnosis: Diagnosis) -> list[Block]:
    """Return a section with the advice; none where there is nothing to do."""
    lines, advice = advice_lines(diagnosis.advice), diagnosis.advice
    if not lines or advice is None:
        return []
    blocks: list[Block] = [Words(title="Advice", lines=lines)]
    if advice.unexplained is not None and advice.nearest:
        rows = [[near.channel, f"{near.evidence:.1f}", f"{near.lag_min:+.0f}"] for near in advice.nearest]
        blocks.append(
            Table(
                head=["nearest channel", "adds to the log evidence", "best single lag, min"],
                rows=rows,
                note="Each channel alone, with lags in both directions. Negative: the channel follows the cause.",
            )
        )
    return [Section(title="What to measure and test next", blocks=blocks)]
