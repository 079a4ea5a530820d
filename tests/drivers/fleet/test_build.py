"""Configuration: what is accepted, and one clear line for every mistake."""

from __future__ import annotations

from typing import Any

import pytest

import drivers

BUS = {"name": "bus", "protocol": "modbus-rtu", "port": "/dev/none"}
NET = {"name": "net", "protocol": "modbus-tcp", "host": "10.0.0.5"}
TEXT = {"name": "text", "protocol": "dcon", "port": "/dev/none2"}
CAP = {"name": "cap", "protocol": "capancdt", "host": "10.0.0.6"}
LINES = [BUS, NET, TEXT, CAP]

K0 = [{"input": 0, "couple": "K"}]
PROBE = {"um_per_v": 5.0, "polarity": 1, "standoff_um": 50.0, "volt_min": -9.9, "volt_max": 9.9}
RPM = {"input": 0, "unit": "rpm", "address": 100, "type": "uint16"}


def device(model: str, line: str, inputs: Any = None, **keys: Any) -> dict[str, Any]:
    table = {"name": "d", "line": line, "model": model, "inputs": K0 if inputs is None else inputs, **keys}
    if model != "capancdt-6200":
        table.setdefault("address", 1)
    return table


GOOD = [
    device("icpdas-m7018r", "bus", format="engineering", step_degc=0.1, verify=False),
    device("icpdas-m7019r", "bus", [{"input": 0, "couple": "K"}, {"input": 7, "couple": "J"}]),
    device("icpdas-et7018z", "net", [{"input": 9}], couple="T", format="hex"),
    device("icpdas-m7017", "bus", [{"input": 0}, {"input": 1, "probe": PROBE}]),
    device("icpdas-et7017", "net", [{"input": 0}], range_v=5.0),
    device("adam-4018p", "bus", scaling="hundredths", burnout_coil=-1),
    device("adam-4118", "bus"),
    device("adam-6018", "net", burnout_coil=16),
    device("adam-4117", "bus", [{"input": 3, "probe": PROBE}], range_v=10.0),
    device("adam-6017", "net", [{"input": 0}]),
    device("moxa-e1262", "net", word_order="little", register="multiplied"),
    device("modbus-map", "bus", [{**RPM, "bad_values": {"0xFFFF": "invalid"}, "maximum": 30000}], max_gap=4),
    device("dcon", "text", checksum=True, format="hex", vendor="icpdas", diagnose=True, address=0),
    device("capancdt-6200", "cap", [{"input": 0}, {"input": 1}], window_s=5.0),
]


@pytest.mark.parametrize("table", GOOD, ids=lambda table: table["model"])
async def test_every_model_builds_without_opening_anything(table: dict[str, Any]) -> None:
    fleet = drivers.build(LINES, [table], source="shop.toml")
    made = fleet.devices["d"]
    assert made.name == "d"
    assert set(made.units) == {given["input"] for given in table["inputs"]}
    await fleet.close()
    await fleet.close()
    with pytest.raises(drivers.DeviceDisconnected, match="closed"):
        await made.read()


def test_every_model_is_covered() -> None:
    assert {table["model"] for table in GOOD} == set(drivers.MODELS)


def test_units() -> None:
    table = next(table for table in GOOD if table["model"] == "icpdas-m7017")
    fleet = drivers.build(LINES, [table], source="x")
    assert fleet.devices["d"].units == {0: "v", 1: "um"}


LINE_MISTAKES = [
    (
        {"name": "b", "protocol": "modbus-rtu", "prt": "/dev/x"},
        "lines[0] \"b\": key 'prt' is not known (known: name,",
    ),
    ({"name": "b", "protocol": "modbus-rtu"}, "key 'port' is missing"),
    ({"name": "b"}, "key 'protocol' is missing, expected one of modbus-tcp,"),
    ({"name": "b", "protocol": "can"}, "key 'protocol' is 'can', expected one of modbus-tcp,"),
    ({**BUS, "timeout_s": 5}, "key 'timeout_s' is 5, expected float <= 2.0"),
    ({**BUS, "timeout_s": 0.001}, "key 'timeout_s' is 0.001, expected float >= 0.02"),
    ({**BUS, "parity": "X"}, "key 'parity' is 'X'"),
    ({**BUS, "stopbits": 3}, "key 'stopbits' is 3"),
    ({**NET, "tcp_port": "502"}, "key 'tcp_port' is '502', expected int, got str"),
    ({**NET, "port": "/dev/x"}, "key 'port' is not known"),
    ({**BUS, "name": ""}, "key 'name' is ''"),
]


@pytest.mark.parametrize(("table", "text"), LINE_MISTAKES)
def test_mistakes_in_a_line(table: dict[str, Any], text: str) -> None:
    assert text in mistake([table], [])


DEVICE_MISTAKES = [
    (
        device("adam-4118", "bus", adress=1),
        "devices[0] \"d\": key 'adress' is not known (known: name, line, model,",
    ),
    (device("adam-4119", "bus"), "key 'model' is 'adam-4119', expected one of icpdas-m7018r, "),
    ({"name": "d"}, "key 'model' is missing, expected one of"),
    (device("adam-4118", "bos"), "key 'line' is 'bos', expected the name of a line (bus, net, text, cap)"),
    (
        device("adam-6018", "bus"),
        "with protocol 'modbus-rtu', expected a line with protocol modbus-tcp for adam-6018",
    ),
    (device("dcon", "bus"), "expected a line with protocol dcon"),
    (device("adam-4118", "bus", address=0), "key 'address' is 0, expected int >= 1"),
    (device("adam-4118", "bus", address=248), "key 'address' is 248, expected int <= 247"),
    (device("dcon", "text", address=256), "key 'address' is 256, expected int <= 255"),
    (
        device("adam-4118", "bus", [{"input": 8, "couple": "K"}]),
        "inputs[0]: key 'input' is 8, expected 0..7 on adam",
    ),
    (device("icpdas-et7018z", "net", [{"input": 10, "couple": "K"}]), "expected 0..9 on icpdas-et7018z"),
    (device("adam-4118", "bus", [*K0, *K0]), "inputs[1]: input 0 is given twice"),
    (device("adam-4118", "bus", []), "key 'inputs' is [], expected at least one input"),
    (
        device("adam-4118", "bus", [{"input": 0}]),
        "inputs[0]: key 'couple' is missing, expected one of J, K, T",
    ),
    (
        device("adam-4118", "bus", [{"input": 0, "couple": "N"}]),
        "key 'couple' is 'N', expected one of J, K, T",
    ),
    (device("adam-4118", "bus", couple="X"), "key 'couple' is 'X'"),
    (device("adam-4118", "bus", [{"couple": "K"}]), "inputs[0]: key 'input' is missing"),
    (device("adam-4118", "bus", ["K"]), "inputs[0]"),
    (
        device("icpdas-m7018r", "bus", [{"input": 0, "couple": "K"}, {"input": 1, "couple": "J"}]),
        "one type for all inputs, the inputs name ['J', 'K']",
    ),
    (device("icpdas-m7018r", "bus", format="ascii"), "key 'format' is 'ascii'"),
    (
        device("icpdas-m7017", "bus", [{"input": 0}], range_v=3.0),
        "key 'range_v' is 3.0, expected one of 10, 5,",
    ),
    (
        device("icpdas-m7017", "bus", [{"input": 0}], range_v=5.0, format="engineering"),
        "expected 10 in engineering",
    ),
    (device("adam-4117", "bus", [{"input": 0}], range_v=2.0), "key 'range_v' is 2.0"),
    (
        device("adam-4117", "bus", [{"input": 0, "probe": {**PROBE, "um_per_v": 0.0}}]),
        "inputs[0] probe: key 'um_per_v' is 0.0, expected float > 0.0",
    ),
    (
        device("adam-4117", "bus", [{"input": 0, "probe": {"um_per_v": 5.0}}]),
        "probe: key 'polarity' is missing",
    ),
    (device("adam-4117", "bus", [{"input": 0, "probe": {**PROBE, "polarity": 2}}]), "key 'polarity' is 2"),
    (
        device("adam-4117", "bus", [{"input": 0, "probe": {**PROBE, "volt_max": -9.9}}]),
        "key 'volt_max' is -9.9, expected more than volt_min (-9.9)",
    ),
    (device("moxa-e1262", "net"), "key 'word_order' is missing"),
    (device("dcon", "text", format="hex"), "key 'vendor' is missing, format = \"hex\" needs it"),
    (
        device("dcon", "text", [{"input": 3, "couple": "K"}], channels=2),
        "key 'input' is 3, expected 0..1 on dcon",
    ),
    (device("modbus-map", "bus", [{**RPM, "type": "int64"}]), "key 'type' is 'int64'"),
    (device("modbus-map", "bus", [{**RPM, "address": 65535, "type": "int32"}]), "expected room for int32"),
    (device("modbus-map", "bus", [{**RPM, "scale": 0.0}]), "key 'scale' is 0.0"),
    (
        device("modbus-map", "bus", [{**RPM, "scale": float("nan")}]),
        "key 'scale' is nan, expected a finite number",
    ),
    (
        device("modbus-map", "bus", [{**RPM, "minimum": 2.0, "maximum": 1.0}]),
        "expected more than minimum (2.0)",
    ),
    (
        device("modbus-map", "bus", [{**RPM, "bad_values": {"32767": "broken"}}]),
        "key 'bad_values.32767' is 'broken'",
    ),
    (
        device("modbus-map", "bus", [{**RPM, "bad_values": {"x": "invalid"}}]),
        "expected a number as in the registers",
    ),
    (
        device("modbus-map", "bus", [{**RPM, "type": "int16", "bad_values": {"stale": [3276.7]}}]),
        "expected a number as in the registers, which int16 can hold",
    ),
    (
        device("modbus-map", "bus", [{**RPM, "type": "uint16", "bad_values": {"70000": "stale"}}]),
        "expected a number as in the registers, which uint16 can hold",
    ),
    (
        device("modbus-map", "bus", [{**RPM, "type": "float32", "bad_values": {"0xC479F99A": "stale"}}]),
        "expected a number as in the registers, which float32 can hold",
    ),
    (
        device("modbus-map", "bus", [{**RPM, "type": "float32", "bad_values": {"nan": "stale"}}]),
        "expected a number as in the registers, which float32 can hold",
    ),
    (device("modbus-map", "bus", [{**RPM, "function": 1}]), "key 'function' is 1"),
    (device("capancdt-6200", "cap", [{"input": 0, "couple": "K"}]), "inputs[0]: key 'couple' is not known"),
    (device("capancdt-6200", "cap", [{"input": 0}], address=1), "key 'address' is not known"),
]


@pytest.mark.parametrize(("table", "text"), DEVICE_MISTAKES)
def test_mistakes_in_a_device(table: dict[str, Any], text: str) -> None:
    assert text in mistake(LINES, [table])


def test_two_at_one_place() -> None:
    one, two = {**device("adam-4118", "bus"), "name": "one"}, {**device("adam-4117", "bus"), "name": "two"}
    assert "address 1 on line 'bus' is used by 'one' and by 'two'" in mistake(LINES, [one, two])
    one = {**device("capancdt-6200", "cap", [{"input": 0}]), "name": "one"}
    assert "'one' and by 'two'" in mistake(LINES, [one, {**one, "name": "two"}])
    assert "key 'name' is 'one'" in mistake(LINES, [one, one])
    assert "/dev/none is on line 'bus' and on line 'b2'" in mistake([BUS, {**BUS, "name": "b2"}], [])
    assert "10.0.0.5:502 is on line" in mistake([NET, {**NET, "name": "n2"}], [])
    assert "key 'name' is 'bus'" in mistake([BUS, {**TEXT, "name": "bus"}], [])
    drivers.build([NET, {**NET, "name": "n2", "tcp_port": 503}], [], source="x")


def mistake(lines: list[dict[str, Any]], devices: list[dict[str, Any]]) -> str:
    with pytest.raises(drivers.DriverConfigError) as caught:
        drivers.build(lines, devices, source="shop.toml")
    text = str(caught.value)
    assert text.startswith("shop.toml: ") and "\n" not in text
    assert "`" not in text
    return text
