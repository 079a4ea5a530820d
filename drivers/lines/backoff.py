"""Back-off: delays attempts to reach a device that does not answer, so that it does not block others on its line."""

from __future__ import annotations

# Below this number of failures in a row every call is an attempt, so that one lost reply costs only one sample.
FREE_ATTEMPTS = 3
FIRST_WAIT_S = 0.25


class Backoff:
    """Decide when a failing device or line is tried again.

    Parameters
    ----------
    timeout_s : float
        Duration of one failed attempt, s. The longest wait is 8 times as long, at least 2 s, at most 5 s.
    """

    def __init__(self, timeout_s: float) -> None:
        self._longest_s = min(5.0, max(2.0, 8.0 * timeout_s))
        self._failures = 0
        self._retry_at_s = 0.0

    def failed(self, now_s: float) -> None:
        """Note an attempt that timed out."""
        self._failures += 1
        if self._failures >= FREE_ATTEMPTS:
            wait_s = FIRST_WAIT_S * 2.0 ** min(self._failures - FREE_ATTEMPTS, 10)
            self._retry_at_s = now_s + min(wait_s, self._longest_s)

    def succeeded(self) -> None:
        """Note an answer."""
        self._failures = 0
        self._retry_at_s = 0.0

    def wait_s(self, now_s: float) -> float:
        """Return the time until the next attempt, s; 0 where it is due."""
        return max(0.0, self._retry_at_s - now_s)

    @property
    def failures(self) -> int:
        """Failures in a row."""
        return self._failures
