"""Tables that a hand-written file can hold although nobody means them: each costs one clear line."""

from __future__ import annotations

from typing import Any

import pytest

import drivers

NET = {"name": "net", "protocol": "modbus-tcp", "host": "10.0.0.5"}
COUPLES = {"name": "d", "line": "net", "model": "adam-6018", "address": 1, "inputs": [{"input": 0, "couple": "K"}]}
PROBE = {"um_per_v": 5.0, "polarity": 1, "standoff_um": 50.0, "volt_min": -9.9, "volt_max": 9.9}
NAN = float("nan")


def probe(**changes: Any) -> dict[str, Any]:
    return {**COUPLES, "model": "adam-6017", "inputs": [{"input": 0, "probe": {**PROBE, **changes}}]}


MISTAKES = [
    ([5], [], "lines[0]: is 5, expected a table"),
    ([None], [], "lines[0]: is None, expected a table"),
    (["net"], [], "lines[0]: is 'net', expected a table"),
    ([{}], [], "lines[0]: key 'protocol' is missing, expected one of modbus-tcp"),
    ([{**NET, "protocol": ["modbus-tcp"]}], [], "key 'protocol' is ['modbus-tcp'], expected one of"),
    ([{**NET, "timeout_s": NAN}], [], "key 'timeout_s' is nan"),
    ([NET], ["d"], "devices[0]: is 'd', expected a table"),
    ([NET], [{}], "devices[0]: key 'model' is missing, expected one of icpdas-m7018r"),
    ([NET], [{**COUPLES, "model": ["adam-6018"]}], "key 'model' is ['adam-6018'], expected one of"),
    ([NET], [{**COUPLES, "address": True}], "key 'address' is True, expected int, got bool"),
    ([NET], [{**COUPLES, "address": 1.5}], "key 'address' is 1.5, expected int, got float"),
    ([NET], [{**COUPLES, "inputs": "0"}], "key 'inputs' is '0', expected array, got str"),
    ([NET], [probe(um_per_v=NAN)], "inputs[0] probe: key 'um_per_v' is nan"),
    ([NET], [probe(volt_min=NAN)], "inputs[0] probe: key 'volt_min' is nan"),
    ([NET], [probe(standoff_um=NAN)], "inputs[0] probe: key 'standoff_um' is nan"),
    ([NET], [{**probe(), "range_v": NAN}], "key 'range_v' is nan, expected one of 10, 5"),
    ([NET, {**NET, "name": "b", "host": "10.0.0.5", "protocol": "modbus-rtu-over-tcp"}], [], "is on line 'net' and"),
    # A name with a line break in it does not tear the message apart.
    ([NET], [{**COUPLES, "name": "a\nb", "adress": 1}], "devices[0] \"a\\nb\": key 'adress' is not known"),
    ([{**NET, "name": "a\nb"}], [COUPLES], "key 'line' is 'net', expected the name of a line (a\\nb)"),
    ([], [COUPLES], "expected the name of a line (none configured)"),
]


@pytest.mark.parametrize(("lines", "devices", "text"), MISTAKES)
def test_mistake_costs_one_line(lines: list[Any], devices: list[Any], text: str) -> None:
    with pytest.raises(drivers.DriverConfigError) as caught:
        drivers.build(lines, devices, source="shop.toml")
    assert str(caught.value).startswith("shop.toml: ")
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_serial_port_by_another_name_is_the_same_port(tmp_path: Any) -> None:
    (tmp_path / "ttyUSB0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    one = {"name": "one", "protocol": "modbus-rtu", "port": str(tmp_path / "ttyUSB0")}
    two = {"name": "two", "protocol": "dcon", "port": str(tmp_path / "by-id")}
    with pytest.raises(drivers.DriverConfigError, match="on line 'one' and on line 'two'"):
        drivers.build([one, two], [], source="shop.toml")


def test_tables_are_left_as_they_are() -> None:
    line, device = dict(NET), {**COUPLES, "inputs": [{"input": 0, "couple": "K"}]}
    drivers.build([line], [device], source="shop.toml")
    assert line == NET
    assert device == COUPLES
