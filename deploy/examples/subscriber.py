"""Follow the Y offset, a line each minute: python subscriber.py tcp/127.0.0.1:7447 shop/vmc-07 [COUNT]."""

import json
import sys

import zenoh

endpoint, prefix, count = sys.argv[1], sys.argv[2], int((*sys.argv, sys.maxsize)[3])
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    # Kept in a name: a subscriber that nobody holds is undeclared at once, and nothing ever comes.
    subscriber = session.declare_subscriber(f"{prefix}/thermal/y/offset")
    for _ in range(count):
        offset = json.loads(subscriber.recv().payload.to_bytes())
        good = offset["state"] in ("ok", "degraded")  # else hold what was applied last, and never jump
        value = "{y_offset_um:+.2f} µm {y_offset_rate_um_per_min:+.2f} µm/min" if good else "{reasons}: hold"
        print(("{seq} {state} " + value).format(**offset), flush=True)
