"""A value in somebody else's memory that follows the offset: what may be written to it, and when not.

Knows no protocol and no clock. The value is trusted only as far as it was read back: after a start, a lost
connection, a write of unknown outcome or somebody else's write the offset goes on from what the PLC holds.
"""

from __future__ import annotations

import math
import struct

from compensator.reasons import Remark
from compensator.receiver import Follower


class Register:
    """One REAL or LREAL.

    Parameters
    ----------
    follower : Follower
        Says what should be applied; is put back to what the PLC holds.
    sign : int
        1 or −1.
    unit_um : float
        µm for each unit of the value.
    tolerance_um : float
        How far what is read back may be from what was written, µm.
    resume_after_s : float
        How long a value that somebody else wrote must stand, s.
    single : bool
        Whether it holds 32 bits.

    Attributes
    ----------
    trouble : str
        Why nothing is written, in words; empty where it is.
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
        self._stands: tuple[float, float] | None = None  # value, since
        self._known = False

    def lost(self, why: str) -> None:
        """Note that what the PLC holds is not known any more."""
        self.trouble = why
        self._known, self._written, self._stands = False, None, None

    def seen(self, now_s: float, value: float) -> bool:
        """Take what was read; tell whether the offset may move.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        value : float
            In the PLC's unit.
        """
        if not self._known:
            # A first value is taken at once: nobody was progress anything else before.
            return self._go_on_from(value)
        if self._written is None or self._same(value, self._written):
            return True
        if self._stands is None or not self._same(value, self._stands[0]):
            self._stands = (value, now_s)
        found_um, left_um = value / self._per_um, self._written / self._per_um
        figures = f"the PLC holds {found_um:+.3f} µm, written was {left_um:+.3f} µm: somebody else writes there."
        self.trouble = Remark("plc_written_over", figures).marked
        if now_s - self._stands[1] < self._resume_after_s:
            return False
        return self._go_on_from(value)

    def _same(self, a: float, b: float) -> bool:
        return abs(a - b) <= self._tolerance_um * abs(self._per_um)  # false for NaN

    def _go_on_from(self, value: float) -> bool:
        offset_um = value / self._per_um
        largest = self._follower.limits.offset_max_um
        if not (math.isfinite(offset_um) and abs(offset_um) <= largest):
            figures = f"the PLC holds {offset_um:g} µm, beyond {largest:g} µm; nothing is written."
            self.trouble = Remark("plc_beyond_limit", figures).marked
            return False
        self._follower.rebase(offset_um)
        self._known, self._written, self._stands = True, value, None
        self.trouble = ""
        return True

    def value(self, offset_um: float) -> float | None:
        """Return what is to be written for an offset; None where the PLC holds it already.

        Parameters
        ----------
        offset_um : float
            What is to be applied, µm.
        """
        value = offset_um * self._per_um
        if self.single:
            value = struct.unpack("f", struct.pack("f", value))[0]
        return None if value == self._written else value

    def wrote(self, value: float) -> None:
        """Note a write that was confirmed."""
        self._written = value
