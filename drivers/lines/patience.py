"""Space out the tries of a device that does not answer, so that it starves nobody on its line."""

from __future__ import annotations

# Below this many failures in a row every call is a try: one lost reply must not cost a second sample.
FREE_TRIES = 3
FIRST_HOLD_S = 0.25


class Patience:
    """Decide when a failing device, or line, is tried again.

    Parameters
    ----------
    timeout_s : float
        What one try can cost, s. The longest hold follows from it: 8 times as long, at least 2 s, at most 5
        s.
    """

    def __init__(self, timeout_s: float) -> None:
        self._longest_s = min(5.0, max(2.0, 8.0 * timeout_s))
        self._failures = 0
        self._retry_at_s = 0.0

    def failed(self, now_s: float) -> None:
        """Take note of a try that cost its full time."""
        self._failures += 1
        if self._failures >= FREE_TRIES:
            hold_s = FIRST_HOLD_S * 2.0 ** min(self._failures - FREE_TRIES, 10)
            self._retry_at_s = now_s + min(hold_s, self._longest_s)

    def succeeded(self) -> None:
        """Take note of an answer."""
        self._failures = 0
        self._retry_at_s = 0.0

    def hold_s(self, now_s: float) -> float:
        """Tell how long no try is due yet, s; 0 when one is."""
        return max(0.0, self._retry_at_s - now_s)

    @property
    def failures(self) -> int:
        """Failures in a row."""
        return self._failures
