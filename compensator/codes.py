"""Codes with their words: what each means, and what to do.

Each domain has an enumeration of its own, derived from `Code`. A member is the code itself: it compares, formats and
encodes as the text in messages, recordings and JSON.
"""

from __future__ import annotations

from enum import StrEnum


class Code(StrEnum):
    """A code of a domain; derive from it, and give each member its code, meaning and action.

    Attributes
    ----------
    meaning : str
        What it means, one sentence.
    action : str
        What to do, one sentence.

    Examples
    --------
    >>> class Valve(Code):
    ...     OPEN = "open", "Coolant flows.", "Nothing."
    >>> Valve.OPEN == "open", Valve.OPEN.action
    (True, 'Nothing.')
    """

    meaning: str
    action: str

    def __new__(cls, code: str, meaning: str, action: str) -> Code:
        """Make a member of its code, meaning and action."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.meaning, member.action = meaning, action
        return member
