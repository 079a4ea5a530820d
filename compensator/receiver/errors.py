"""The receiver's only error: it cannot be started. Received messages never raise an error."""

from __future__ import annotations


class ReceiverError(Exception):
    """The receiver cannot be started: one line with file, key, value and what was expected."""

    exit_code = 2
