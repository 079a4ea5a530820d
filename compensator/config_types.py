"""Types of the configuration that several of its tables use."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

#: Above 0, with the largest value that a machine can have: a limit beyond it is a slip of the pen, and no limit.
Micrometres = Annotated[float, Meta(gt=0, le=5000)]
MicrometresPerMin = Annotated[float, Meta(gt=0, le=1000)]
Text = Annotated[str, Meta(max_length=4096)]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]


class Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table that refuses unknown keys."""
