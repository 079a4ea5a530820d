"""A Zenoh router as a process of its own: `router.py PORT`; ends with its standard input."""

import json
import sys

import zenoh

if __name__ == "__main__":
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{sys.argv[1]}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        print("ready", flush=True)
        sys.stdin.read()
