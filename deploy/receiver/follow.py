"""The smallest program that brings the offset to a control: `follow.py receiver.toml`."""

import os
import signal
import sys
import time

from compensator.receiver import Receiver, ReceiverError, load_settings


def apply(offset_um: float, why: str) -> None:
    """Write it to your control here; it is added to the commanded Y, µm."""
    print(f"{offset_um:+.2f} µm  {why}", flush=True)


ending = (signal.SIGINT, signal.SIGTERM)
for number in ending:
    signal.signal(number, signal.default_int_handler)
try:
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ending)  # whoever starts it may have blocked or ignored them
    settings, _ = load_settings(sys.argv[1] if len(sys.argv) > 1 else "receiver.toml")
    with Receiver(settings, applied_um=0.0) as receiver:  # applied_um: the offset at your control now
        while True:
            applied = receiver.poll()
            apply(applied.offset_um, f"{applied.state} {' '.join(reason.marked for reason in applied.reasons)}")
            time.sleep(0.5)
except ReceiverError as error:
    sys.exit(f"follow.py: {error}")
except OSError as error:  # nobody reads what it prints; the applied offset stays
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python would try to print it again at the end
    sys.exit(f"follow.py: {error.strerror or error}")
except KeyboardInterrupt:
    pass  # the applied offset stays
