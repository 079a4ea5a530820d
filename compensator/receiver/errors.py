"""The receiver's one error: it cannot be started. Messages that arrive are data, and never raise."""

from __future__ import annotations


class ReceiverError(Exception):
    """The receiver cannot be started: one line with file, key, value and what was expected."""

    exit_code = 2
