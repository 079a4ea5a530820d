"""Follow the Y offset, a line each minute: python subscriber.py [tcp/127.0.0.1:7447 [shop/vmc-07 [COUNT]]]."""

import json
import signal
import sys

import zenoh

for number in (signal.SIGINT, signal.SIGTERM):  # they end it, also in the background of a script
    signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])
given = dict(enumerate(sys.argv))
endpoint, prefix = given.get(1, "tcp/127.0.0.1:7447"), given.get(2, "shop/vmc-07")
connect = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
with zenoh.open(zenoh.Config.from_json5(json.dumps(connect))) as session:  # an error where nobody answers
    subscriber = session.declare_subscriber(f"{prefix}/thermal/y/offset")  # without a name it would be gone at once
    for _ in range(int(given.get(3, sys.maxsize))):
        offset = json.loads(subscriber.recv().payload.to_bytes())
        good = offset["state"] in ("ok", "degraded")  # else hold what was applied last, and never jump
        value = "{y_offset_um:+.2f} µm {y_offset_rate_um_per_min:+.2f} µm/min" if good else "{reasons}: hold"
        print(("{seq} {state} " + value).format(**offset), flush=True)
