"""Send one probe: python probe.py ENDPOINT PREFIX FEATURE MEASURED_UM OFFSET_APPLIED_UM [SECONDS_AGO].

python probe.py tcp/127.0.0.1:7447 shop/vmc-07 sphere-1 3.2 -12.3
"""

import getpass
import json
import sys
import time

import zenoh

endpoint, prefix, feature, measured, applied, *ago = sys.argv[1:]
probe = {
    "schema": 1,
    "time_utc_ns": time.time_ns() - round(float(ago[0] if ago else 0) * 1e9),  # when it touched, not when it is sent
    "axis": "y",
    "measured_um": float(measured),
    "offset_applied_um": float(applied),
    "feature": feature,
}
config = zenoh.Config()  # with certificates: zenoh.Config.from_file("probe.json5")
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    key = f"{prefix}/thermal/command/probe/{getpass.getuser()}"  # with certificates: the common name
    for answer in session.get(key, payload=json.dumps(probe), timeout=10.0):
        if answer.ok is not None:
            reply = json.loads(answer.ok.payload.to_bytes())
            print(f"{'accepted' if reply['ok'] else 'refused'}: {reply['text']}")
            sys.exit(0 if reply["ok"] else 1)
sys.exit(f"{key}: no answer; the same probe may be sent again")
