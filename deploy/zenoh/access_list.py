#!/usr/bin/env python3
"""Make the router's configuration, access list included, from a list of participants.

Zenoh's rules go by the common name of a certificate, in both directions; what no rule allows is denied. Errors in a
hand-written list, a missing direction or one right too many, show nowhere; so it is generated.

example: access_list.py shop.toml > /etc/compensator/zenoh/router.json5
"""

from __future__ import annotations

import argparse
import json
import os
import re
import stat
import sys
import tomllib
from pathlib import Path
from typing import Any

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
PREFIX = re.compile(r"[A-Za-z0-9._-]+(/[A-Za-z0-9._-]+)*")
KEYS = {
    "router": {"listen", "ca", "certificate", "key"},
    "machine": {"name", "prefix"},
    "receiver": {"name", "machines"},
    "operator": {"name", "machines"},
    "probe": {"name", "machines"},
    "tool": {"name", "machines"},
}
#: What a receiver may query; anything else below a prefix is published or is a command.
ANSWERED = ("thermal/*/offset", "thermal/status", "thermal/sample", "thermal/estimate")

#: What a control publishes of its tool, and a receiver may query, too.
TOOL_LENGTH = "thermal/tool_length"
#: Largest list, bytes.
LONGEST = 1_000_000
#: Most points in a line of it.
MOST_POINTS = 300
#: Keys whose value is a list of texts; the others are a text.
LISTS = {"listen", "machines"}

HEADER = """\
// Configuration of the Zenoh router: compensator router --config router.json5, or zenohd --config router.json5.
// Made by access_list.py from shop.toml: change that file and run the program again.
"""


def rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    """Return a rule that allows messages in one direction: ingress comes from the client, egress goes to it."""
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}


def machine_rules(machine: dict[str, Any]) -> list[dict[str, Any]]:
    """Let a service publish, answer and be alive below its own prefix, and receive subscriptions and queries."""
    name, own = machine["name"], [f"{machine['prefix']}/thermal/**"]
    return [
        rule(f"{name} publishes", "ingress", ["put", "reply", "declare_queryable", "liveliness_token"], own),
        # It queries whether the machine has a service already.
        rule(f"{name} queries", "ingress", ["liveliness_query"], own),
        rule(f"{name} sees liveliness", "egress", ["liveliness_token"], own),
        rule(f"{name} receives", "egress", ["declare_subscriber", "query"], ["**"]),
    ]


def reading_rules(name: str, prefixes: list[str]) -> list[dict[str, Any]]:
    """Let a receiver subscribe, and query the latest and who is alive; it may send nothing else."""
    below = [prefix if prefix == "**" else f"{prefix}/**" for prefix in prefixes]
    asked = [f"{prefix}/{key}" for prefix in prefixes for key in (*ANSWERED, TOOL_LENGTH)]
    subscribes = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
    return [
        rule(f"{name} subscribes", "ingress", subscribes, below),
        rule(f"{name} queries", "ingress", ["query"], asked),
        rule(f"{name} reads", "egress", ["put", "reply", "liveliness_token"], below),
    ]


def operator_rules(name: str, prefixes: list[str]) -> list[dict[str, Any]]:
    """Let an operator read, and send commands in its own name only.

    Commands without a name pass as well: the service refuses them in words, unless `zenoh.unproven_commands` is set
    there.
    """
    own = [f"{prefix}/thermal/command/*{end}" for prefix in prefixes for end in (f"/{name}", "")]
    return [*reading_rules(name, prefixes), rule(f"{name} commands", "ingress", ["query"], own)]


def probe_rules(name: str, prefixes: list[str]) -> list[dict[str, Any]]:
    """Let a source of touch probes send probes in its own name and receive the answers; it may read nothing."""
    own = [f"{prefix}/thermal/command/probe/{name}" for prefix in prefixes]
    return [rule(f"{name} probes", "ingress", ["query"], own), rule(f"{name} is answered", "egress", ["reply"], own)]


def tool_rules(name: str, prefixes: list[str]) -> list[dict[str, Any]]:
    """Let a control publish the length of the tool in its spindle, and answer with it; it may read nothing."""
    own = [f"{prefix}/{TOOL_LENGTH}" for prefix in prefixes]
    return [
        rule(f"{name} publishes", "ingress", ["put", "reply", "declare_queryable"], own),
        rule(f"{name} is asked", "egress", ["query"], own),
        # Who subscribes to more than the length would not be found else.
        rule(f"{name} is heard", "egress", ["declare_subscriber"], ["**"]),
    ]


def access_control(shop: dict[str, Any]) -> dict[str, Any]:
    """Return Zenoh's access list."""
    machines = {machine["name"]: machine for machine in shop["machine"]}
    rules: dict[str, list[dict[str, Any]]] = {name: machine_rules(machine) for name, machine in machines.items()}
    for role, make in (
        ("receiver", reading_rules),
        ("operator", operator_rules),
        ("probe", probe_rules),
        ("tool", tool_rules),
    ):
        for client in shop.get(role, []):
            # Zenoh passes a subscription or query only where one rule includes all of it.
            prefixes = [machines[name]["prefix"] for name in client["machines"]] if "machines" in client else ["**"]
            rules[client["name"]] = make(client["name"], prefixes)
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [one for of_client in rules.values() for one in of_client],
        "subjects": [{"id": name, "cert_common_names": [name]} for name in rules],
        "policies": [{"rules": [one["id"] for one in its], "subjects": [name]} for name, its in rules.items()],
    }


def router(shop: dict[str, Any]) -> dict[str, Any]:
    """Return the whole configuration."""
    own = shop["router"]
    return {
        "mode": "router",
        "listen": {"endpoints": own["listen"]},
        "connect": {"endpoints": []},
        # Participants are configured: no scouting, no gossip.
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "adminspace": {"enabled": False},
        "transport": {
            # Refused, whatever stands here: a second session under an id that is connected. Not refused: sessions that
            # share a certificate, each under an id of its own; max_links counts the links within one session. After a
            # power cut all connect at once. A connection that does not authenticate holds a place for 3 s; the firewall
            # has to bound more of them than there are places.
            "unicast": {"max_links": 1, "accept_pending": 4000, "accept_timeout": 3000},
            # Else long messages would bypass the links, through memory that others on this computer can open.
            "shared_memory": {"enabled": False},
            "link": {
                # Services whose clocks agree publish at one instant: a client's queue holds a whole shop's messages.
                "tx": {"queue": {"size": {"interactive_high": 16, "data": 16}}},
                # A model file is the largest message.
                "rx": {"max_message_size": 4 * 1024 * 1024},
                "protocols": sorted({endpoint.split("/", 1)[0] for endpoint in own["listen"]}),
                "tls": {
                    "root_ca_certificate": own["ca"],
                    "listen_certificate": own["certificate"],
                    "listen_private_key": own["key"],
                    "enable_mtls": True,
                    "close_link_on_expiration": True,
                },
            },
        },
        "access_control": access_control(shop),
    }


def checked(shop: dict[str, Any], source: Path) -> dict[str, Any]:
    """Refuse a list that would grant other rights than intended."""

    def refuse(text: str) -> None:
        sys.exit(f"{source}: {text}")

    for key in shop:
        if key not in KEYS:
            refuse(f"{key}: unknown, expected one of: {', '.join(KEYS)}")
    if not isinstance(shop.get("router"), dict) or not shop.get("machine"):
        refuse("expected a table [router] and at least one [[machine]]")
    names: list[str] = []
    for kind, keys in KEYS.items():
        tables = [shop["router"]] if kind == "router" else shop.get(kind, [])
        if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
            refuse(f"{kind}: expected tables [[{kind}]]")
        for table in tables:
            for key, value in table.items():
                texts = value if key in LISTS else [value]
                if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
                    refuse(f"{kind}: {key} = {value!r:.60}, expected {'texts' if key in LISTS else 'a text'}")
            for key in {*table} ^ keys:
                if key in table or key != "machines":
                    refuse(f"{kind}: {key}: {'unknown' if key in table else 'missing'}, keys are {', '.join(keys)}")
            if kind == "router":
                continue
            if not NAME.fullmatch(table["name"]) or table["name"] in names:
                refuse(
                    f"{kind}: name {table['name']!r}, expected letters, digits, . _ - and each name once, in one role"
                )
            names.append(table["name"])
            if kind == "machine" and not PREFIX.fullmatch(table["prefix"]):
                refuse(f"machine {table['name']!r}: prefix {table['prefix']!r}, expected words between single slashes")
            if table.get("machines") == []:
                refuse(
                    f"{kind} {table['name']!r}: machines = [], expected at least one, or no such line for all of them"
                )
            for machine in table.get("machines", []):
                if machine not in [known["name"] for known in shop["machine"]]:
                    refuse(f"{kind} {table['name']!r}: machine {machine!r}: no such [[machine]]")
    prefixes = [machine["prefix"] for machine in shop["machine"]]
    for one in prefixes:
        if sum(other == one or f"{other}/".startswith(f"{one}/thermal/") for other in prefixes) > 1:
            refuse(f"machine: prefix {one!r} is used twice, or another is below it")
    if not shop["router"]["listen"]:
        refuse("router: listen = [], expected at least one tls/HOST:PORT")
    for endpoint in shop["router"]["listen"]:
        if not endpoint.startswith(("tls/", "quic/")):
            refuse(f"router: listen {endpoint!r}, expected tls/HOST:PORT: only TLS proves who connects")
    return shop


def read(path: Path) -> bytes:
    """Return the bytes of a regular file; a device or a pipe may have no end."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise ValueError("not a regular file")
        data = file.read(LONGEST + 1)
    if len(data) > LONGEST:
        raise ValueError(f"larger than {LONGEST} bytes")
    # The time to read a key grows with the square of its parts.
    if any(line.count(b".") > MOST_POINTS for line in data.splitlines()):
        raise ValueError(f"a line with more than {MOST_POINTS} points")
    return data


def main() -> int:
    """Write the configuration to stdout."""
    text, _, example = (__doc__ or "").rpartition("\n\n")
    parser = argparse.ArgumentParser(description=text, epilog=example)
    parser.add_argument("shop", type=Path, metavar="FILE", help="the participants, TOML")
    path = parser.parse_args().shop
    try:
        shop = tomllib.loads(read(path).decode("utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        sys.exit(f"{path}: {getattr(error, 'strerror', None) or error}")
    sys.stdout.write(HEADER + json.dumps(router(checked(shop, path)), indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
