"""A value in the PLC's memory that follows the offset: decides what may be written to it, and when.

No protocol, no clock. Only a value that was read back is trusted: after a start, a lost connection, a write with
unknown outcome, or a write by another program, the offset continues from the PLC's value.
"""

from __future__ import annotations

import math
import struct

from compensator.codes import BridgeTrouble, Remark
from compensator.receiver import Follower


class Register:
    """One REAL or LREAL.

    Parameters
    ----------
    follower : Follower
        Provides the offset to apply; is rebased to the PLC's value.
    sign : int
        1 or −1.
    unit_um : float
        µm for each unit of the value.
    tolerance_um : float
        Largest difference between the value read back and the value written, µm.
    resume_after_s : float
        Time for which a value written by another program must not change, s.
    single : bool
        Whether it holds 32 bits.

    Attributes
    ----------
    trouble : str
        Why nothing is written, as text; empty while the offset is written.
    """

    def __init__(
        self,
        follower: Follower,
        *,
        sign: int,
        unit_um: float,
        tolerance_um: float,
        resume_after_s: float,
        single: bool = True,
    ) -> None:
        self._follower = follower
        self._per_um = sign / unit_um
        self._tolerance_um = tolerance_um
        self._resume_after_s = resume_after_s
        self.single = single
        self.trouble = ""
        self._written: float | None = None
        self._found: tuple[float, float] | None = None  # value, since
        self._known = False

    def lost(self, why: str) -> None:
        """Mark the PLC's value as unknown."""
        self.trouble = why
        self._known, self._written, self._found = False, None, None

    def check(self, now_s: float, value: float) -> bool:
        """Check a value that was read; return whether the offset may move.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        value : float
            In the PLC's unit.
        """
        if not self._known:
            return self._continue_from(value)
        if self._written is None or self._same(value, self._written):
            return True
        if self._found is None or not self._same(value, self._found[0]):
            self._found = (value, now_s)
        found_um, left_um = value / self._per_um, self._written / self._per_um
        figures = f"the PLC holds {found_um:+.3f} µm instead of the written {left_um:+.3f} µm."
        self.trouble = Remark(BridgeTrouble.PLC_WRITTEN_OVER, figures).marked
        if now_s - self._found[1] < self._resume_after_s:
            return False
        return self._continue_from(value)

    def _same(self, a: float, b: float) -> bool:
        return abs(a - b) <= self._tolerance_um * abs(self._per_um)  # false for NaN

    def _continue_from(self, value: float) -> bool:
        offset_um = value / self._per_um
        largest = self._follower.limits.offset_max_um
        if not (math.isfinite(offset_um) and abs(offset_um) <= largest):
            figures = f"the PLC holds {offset_um:g} µm, beyond {largest:g} µm; nothing is written."
            self.trouble = Remark(BridgeTrouble.PLC_BEYOND_LIMIT, figures).marked
            return False
        self._follower.rebase(offset_um)
        self._known, self._written, self._found = True, value, None
        self.trouble = ""
        return True

    def value(self, offset_um: float) -> float | None:
        """Return the value to write for an offset; None if the PLC already has it.

        Parameters
        ----------
        offset_um : float
            Offset to apply, µm.
        """
        value = offset_um * self._per_um
        if self.single:
            value = struct.unpack("f", struct.pack("f", value))[0]
        return None if value == self._written else value

    def wrote(self, value: float) -> None:
        """Store a confirmed write."""
        self._written = value
