"""Texts of the loop's events for people; programs read their data."""

from __future__ import annotations

from compensator.events import ComparisonData, DiagnosisData
from compensator.service.transfer.second_opinion import described


def ended(why: str, verdict: ComparisonData) -> str:
    """Return why a shadow has ended."""
    return {
        "limits": "the candidate reaches limits that the present model keeps",
        "worse": f"the candidate is worse: {described(verdict)}",
        "no_answer": f"nobody answered the proposal: {described(verdict)}",
        "no_difference": f"the candidate shows no clear difference: {described(verdict)}",
        "watched": f"the model before is no longer compared: {described(verdict)}",
        "dismissed": "the candidate is dismissed by an operator",
    }[why]


def nothing_follows(why: str, found: DiagnosisData) -> str:
    """Return why nothing follows from a diagnosis."""
    effects = ", ".join(found.effects) or "no added effect"
    words = {
        "failed": f"the diagnosis failed: {found.needs}",
        "unexplained": f"the diagnosis explains nothing that can be compensated ({found.verdict}); {found.needs}",
        "refused": f"the candidate cannot be used: {found.refused}",
        "nothing_found": f"the diagnosis finds nothing that can be compensated; {found.needs}",
        "unchanged": f"the diagnosis finds what the model has: {effects}",
        "in_shadow": f"the diagnosis finds what is in shadow already: {effects}",
        "avoided": f"{effects}: the service went back from it, or an operator dismissed it, a short time ago",
        "waits": f"{effects}: waits while another model takes over, or is proposed; looked for again later",
    }
    return words[why].rstrip("; ")
