# SPDX-License-Identifier: GPL-2.0-or-later
"""From a wanted offset to `axis.L.eoffset-counts`: lost changes are repeated, and nothing jumps.

LinuxCNC adds up *changes* of the counts, and only while the machine is on, homed, enabled and not being cleared; a
change at any other time is lost. So the counts do not show the offset. `axis.L.eoffset-request` does, the sum that
LinuxCNC has accepted, and each step here is the difference to it.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Pause after the axis has become ready: `is-all-homed` reads true for a moment while LinuxCNC starts.
SETTLE_S = 0.1
#: How long a change of the counts may take to show in the request, and how many may be lost in a row.
ANSWER_S, MISSES_MAX = 0.2, 3
#: While no change arrives, one count is tried this often.
PAUSE_S = 1.0
#: An offset that should move and does not is nudged after this time; after the second nudge it counts as stuck.
NUDGE_S = 3.0
#: Longest time between two steps that counts for moving.
STEP_MAX_S = 0.02
_COUNTS_MAX = 2**31 - 1
_UNLINKED = "axis.L.eoffset-counts does not follow this component: link it as the only writer"
_UNHEARD = "axis.L.eoffset-request does not follow the counts"
_STUCK = "axis.L.eoffset does not follow eoffset-request: is OFFSET_AV_RATIO above 0?"


@dataclass(frozen=True)
class AxisView:
    """The axis as LinuxCNC shows it.

    Parameters
    ----------
    counts : int
        `axis.L.eoffset-counts`.
    scale_um : float
        µm for each count.
    request_um, eoffset_um : float
        Sum that LinuxCNC has accepted, and how far it has moved.
    acts : bool
        Whether the axis has its offset. It has none while the machine is off, not homed or cleared, when the pins show
        an old one. In joint mode and without `eoffset-enable` it acts, although no change of it is taken.
    ready : bool
        Whether a change of the counts is taken and moves the axis at once.
    limited : bool
        Whether the axis is at a soft limit.
    """

    counts: int
    scale_um: float
    request_um: float
    eoffset_um: float
    acts: bool
    ready: bool
    limited: bool


class Reconciler:
    """Brings the axis to the wanted offset by changes of the counts.

    Parameters
    ----------
    counts : int
        `axis.L.eoffset-counts` as found: the first value written must be the present one.
    slew_um_per_s : float
        How fast an offset that LinuxCNC has lost (off, cleared) is restored.

    Attributes
    ----------
    counts : int
        Value of the component's pin.
    trouble : str
        Why the offset does not reach the axis, in words; empty where it does.
    """

    def __init__(self, counts: int, slew_um_per_s: float) -> None:
        self.counts = counts
        self.trouble = ""
        self._slew = slew_um_per_s
        self._before_s: float | None = None
        self._ready_since: float | None = None
        self._expected: tuple[float, float] | None = None  # request_um, until when
        self._misses = 0
        self._pause_until = 0.0
        self._allowance_um = 0.0
        self._still_since: float | None = None
        self._eoffset_um = 0.0
        self._nudges = 0

    def step(self, now_s: float, wanted_um: float, view: AxisView) -> int:
        """Return the counts to set now.

        Parameters
        ----------
        now_s : float
            Monotonic clock, s.
        wanted_um : float
            Offset that the axis should have, µm.
        view : AxisView
            The axis.
        """
        elapsed_s = 0.0 if self._before_s is None else min(max(now_s - self._before_s, 0.0), STEP_MAX_S)
        self._before_s = now_s
        # The allowance is limited to one count or one long step, never that of a whole pause.
        self._allowance_um = min(
            self._allowance_um + self._slew * elapsed_s, max(self._slew * STEP_MAX_S, view.scale_um)
        )
        if view.counts != self.counts:
            # Not linked yet, or linked to another writer. The pin must have the present value when it is linked: a
            # difference would be a jump of any size.
            self.counts, self._expected = view.counts, None
            self._pause_until = now_s + PAUSE_S
            self.trouble = _UNLINKED
            return self.counts
        if not view.ready or view.scale_um <= 0.0:
            self._ready_since = self._expected = self._still_since = None
            self._misses = self._nudges = 0
            if self.trouble != _UNLINKED:
                self.trouble = "" if view.scale_um > 0.0 else "axis.L.eoffset-scale is not above 0"
            return self.counts
        if self._ready_since is None:
            self._ready_since = now_s
        if now_s - self._ready_since >= SETTLE_S and not self._waits(now_s, view):
            self._correct(now_s, wanted_um, view)
        self._watch(now_s, view)
        return self.counts

    def _waits(self, now_s: float, view: AxisView) -> bool:
        """Return whether the last change has not arrived yet."""
        if self._expected is None:
            return False
        request_um, until_s = self._expected
        if abs(view.request_um - request_um) < 0.5 * view.scale_um:
            self._expected, self._misses = None, 0
            if self.trouble in (_UNLINKED, _UNHEARD):
                self.trouble = ""
            return False
        if now_s < until_s:
            return True
        self._expected = None
        self._misses += 1
        return False

    def _correct(self, now_s: float, wanted_um: float, view: AxisView) -> None:
        way = wanted_um - view.request_um
        largest = self._allowance_um
        delta = round(max(-largest, min(largest, way)) / view.scale_um)
        if delta == 0:
            return
        if self._misses >= MISSES_MAX:
            self.trouble = _UNHEARD
        if self.trouble in (_UNLINKED, _UNHEARD):
            # No change arrives. They must not pile up and come all at once: one count a second.
            if now_s < self._pause_until:
                return
            self._pause_until = now_s + PAUSE_S
            delta = 1 if delta > 0 else -1
        self._change(now_s, delta, view)

    def _change(self, now_s: float, delta: int, view: AxisView) -> None:
        if abs(self.counts + delta) > _COUNTS_MAX:
            self.trouble = "axis.L.eoffset-counts is exhausted: restart LinuxCNC"
            return
        self.counts += delta
        self._allowance_um = max(0.0, self._allowance_um - abs(delta) * view.scale_um)
        self._expected = (view.request_um + delta * view.scale_um, now_s + ANSWER_S)

    def _watch(self, now_s: float, view: AxisView) -> None:
        """Detect an offset that should move and does not.

        LinuxCNC forgets the rest of a move that was interrupted in coordinated mode until the counts change again,
        and without `OFFSET_AV_RATIO` it never moves; it reports neither.
        """
        moved = abs(view.eoffset_um - self._eoffset_um) > 0.1 * view.scale_um
        self._eoffset_um = view.eoffset_um
        there = abs(view.eoffset_um - view.request_um) <= 0.5 * view.scale_um
        if there or moved or view.limited:
            self._still_since = None
            if there:
                self._nudges = 0
                if self.trouble == _STUCK:
                    self.trouble = ""
            return
        if self._still_since is None:
            self._still_since = now_s
        elif now_s - self._still_since >= NUDGE_S and self._expected is None:
            self._still_since = now_s
            self._nudges += 1
            if self._nudges > 1:
                self.trouble = _STUCK
            self._change(now_s, 1, view)
