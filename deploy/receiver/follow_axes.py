"""The smallest program that brings several axes to a control: `follow_axes.py receiver_axes.toml`."""

import os
import signal
import sys
import time

from compensator.receiver import AppliedAxes, AxesReceiver, AxesSettings, ControlState, ReceiverError, load_any


def read() -> ControlState:
    """Read your control here: without a length the tilt acts for its reference, without a position the slope stands."""
    return ControlState(tool_length_mm=None, positions_mm={"y": None}, cutting=True)


def apply(applied: AppliedAxes) -> None:
    """Write all axes to your control here, or none; each is added to the commanded position, µm."""
    print(applied.text, flush=True)


ending = (signal.SIGINT, signal.SIGTERM)
for number in ending:
    signal.signal(number, signal.default_int_handler)
try:
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ending)  # whoever starts it may have blocked or ignored them
    settings, _ = load_any(sys.argv[1] if len(sys.argv) > 1 else "receiver_axes.toml")
    if not isinstance(settings, AxesSettings):
        sys.exit("follow_axes.py: expected a table such as [axis.z]; of Y alone: follow.py")
    applied_um = dict.fromkeys(settings.linear, 0.0)  # the offsets at your control now
    with AxesReceiver(settings, applied_um=applied_um) as receiver:
        while True:
            apply(receiver.poll(read()))
            time.sleep(0.5)
except ReceiverError as error:
    sys.exit(f"follow_axes.py: {error}")
except OSError as error:  # nobody reads what it prints; the applied offsets stay
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python would try to print it again at the end
    sys.exit(f"follow_axes.py: {error.strerror or error}")
except KeyboardInterrupt:
    pass  # the applied offsets stay
