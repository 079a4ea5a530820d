"""Send one probe: python probe.py ENDPOINT PREFIX FEATURE MEASURED_UM OFFSET_APPLIED_UM [SECONDS_AGO].

python probe.py tcp/127.0.0.1:7447 shop/vmc-07 sphere-1 3.2 -12.3
"""

import getpass
import json
import sys
import time

import zenoh

try:
    endpoint, prefix, feature, *numbers = sys.argv[1:]
    measured_um, applied_um, ago_s = [*map(float, numbers), 0.0][:3]
except ValueError:
    sys.exit("expected: python probe.py ENDPOINT PREFIX FEATURE MEASURED_UM OFFSET_APPLIED_UM [SECONDS_AGO]")
if not feature:
    sys.exit("FEATURE is empty, expected a name, always the same: each feature has its own zero")
probe = {
    "schema": 1,
    "time_utc_ns": time.time_ns() - round(ago_s * 1e9),  # when it touched, not when it is sent
    "axis": "y",
    "measured_um": measured_um,
    "offset_applied_um": applied_um,
    "feature": feature,
}
config = zenoh.Config()  # with certificates: zenoh.Config.from_file("probe.json5")
try:
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)
except zenoh.ZError as error:
    sys.exit(f"{endpoint}: not reached: {str(error).partition(' at /')[0]}")
with session:
    key = f"{prefix}/thermal/command/probe/{getpass.getuser()}"  # with certificates: the common name
    for answer in session.get(key, payload=json.dumps(probe), timeout=10.0):
        if answer.ok is not None:
            reply = json.loads(answer.ok.payload.to_bytes())
            # What was received is not yet taken: that is decided at the next sample.
            print(reply["text"] if reply["ok"] else f"refused: {reply['text']}")
            sys.exit(0 if reply["ok"] else 1)
sys.exit(f"{key}: no answer; the same probe may be sent again")
