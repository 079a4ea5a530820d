"""Types of the configuration that several of its tables use."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

#: Between the smallest and the largest value that a machine can have: a limit beyond them is a slip of the pen; it
#: would limit nothing, or leave nothing. What no sensor resolves, such as a nanometre or a millikelvin, is no limit.
Micrometres = Annotated[float, Meta(ge=0.001, le=5000)]
MicrometresPerMin = Annotated[float, Meta(ge=0.001, le=1000)]
Kelvins = Annotated[float, Meta(ge=0.001, le=200)]
Minutes = Annotated[float, Meta(ge=0.01, le=100_000)]
#: Of a channel of any unit, such as rpm/min.
Rate = Annotated[float, Meta(ge=1e-9, le=1e9)]
Text = Annotated[str, Meta(min_length=1, max_length=4096)]
#: `$` would accept a line end after the last character, here as in every other pattern.
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z", examples=["vmc-07"])]


class Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table that refuses unknown keys."""
