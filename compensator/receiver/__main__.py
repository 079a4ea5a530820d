"""`python -m compensator.receiver --config receiver.toml`: show what a control would apply, without a control."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from contextlib import suppress

from .axes_receiver import AxesReceiver
from .axes_settings import AxesSettings, load_any
from .errors import ReceiverError
from .subscriber import Receiver


def main() -> int:
    """Print a line whenever state, reasons or number change, until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(
        prog="compensator.receiver",
        description="Show the offset that a control would apply, without writing to a control.",
        epilog="example: python -m compensator.receiver --config receiver.toml",
    )
    parser.add_argument("--config", required=True, metavar="FILE", help="TOML with a table [receiver]")
    arguments = parser.parse_args()
    # No threading.Event: a handler that sets it while this thread waits for it could wait for its lock for ever.
    ended: list[int] = []
    signals = (signal.SIGINT, signal.SIGTERM)
    for number in signals:
        signal.signal(number, lambda number, _: ended.append(number))
    # Who starts a program may have blocked them; one that waits would be lost were it still ignored.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
    try:
        settings, _ = load_any(arguments.config)
        receiver = AxesReceiver(settings) if isinstance(settings, AxesSettings) else Receiver(settings)
    except ReceiverError as error:
        sys.stderr.write(f"compensator.receiver: {error}\n")
        return error.exit_code
    reported: object = None
    with receiver:
        while not ended:
            time.sleep(0.1)
            applied = receiver.poll()
            # A changed figure in a detail (an age, a distance) does not cause a new line.
            shown = (applied.seq, applied.state, tuple(reason.code for reason in applied.reasons))
            if shown != reported:
                reported = shown
                try:
                    sys.stdout.write(applied.text + "\n")
                    sys.stdout.flush()
                except OSError as error:  # nobody reads it, and no control depends on it
                    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python would try to print it again at the end
                    with suppress(OSError):
                        sys.stderr.write(f"compensator.receiver: standard output: {error.strerror or error}\n")
                    return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
