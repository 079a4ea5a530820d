"""What `check` says of TLS files, open doors and serial ports."""

from __future__ import annotations

import base64
import datetime
import importlib.util
import json
import re
import shutil
import sys
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from compensator.certificates import check_files, remarks
from compensator.cli import main
from compensator.config import load_config
from compensator.demo.machine import configuration
from compensator.service.session import tls_files
from tests.security.shop import DEPLOY, script

LINES = {"rtu": "/dev/ttyS90", "dcon": "/dev/ttyS91", "tcp": 1502, "plc": 1503, "data": 10001, "command": 10023}
TLS = """connect = ["tls/127.0.0.1:7447"]
tls_ca = "keys/ca.pem"
tls_certificate = "keys/{stem}.pem"
tls_key = "keys/{stem}.key"
"""


def written(folder: Path, zenoh: str = "", **lines: object) -> Path:
    text = configuration("vmc-07", {**LINES, **lines}, 7447)
    text = re.sub(r'listen = \["tcp/127.0.0.1:7447"\]\n', zenoh.replace("\\", "\\\\"), text)
    path = folder / "machine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def secured(folder: Path, keys: Path, stem: str = "machine-vmc-07") -> Path:
    shutil.copytree(keys, folder / "keys")
    return written(folder, TLS.format(stem=stem))


def refused(config: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["check", "--config", str(config)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "machine.toml" in error
    return error


def test_good_files_pass_without_a_word(tmp_path: Path, keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--config", str(secured(tmp_path, keys))]) == 0
    assert capsys.readouterr().err == ""


def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = secured(tmp_path, keys)
    key, ca = tmp_path / "keys/machine-vmc-07.key", tmp_path / "keys/ca.pem"
    good = key.read_bytes()
    for mode in (0o644, 0o660, 0o604):
        key.chmod(mode)
        assert f"mode {mode:04o}, expected 0600" in refused(config, capsys)
    key.chmod(0o640)  # a service with a user and group of its own
    assert main(["check", "--config", str(config)]) == 0
    capsys.readouterr()
    key.write_bytes((keys / "machine-vmc-08.key").read_bytes())
    assert "not the key of" in refused(config, capsys)
    curve = bytes.fromhex("06082a8648ce3d030107")
    known = ec.generate_private_key(ec.SECP256R1()).private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption())
    unknown = base64.b64encode(known.replace(curve, curve[:-1] + b"\x7f"))
    for bad in (b"nonsense", b"-----BEGIN PRIVATE KEY-----\n" + unknown + b"\n-----END PRIVATE KEY-----\n"):
        key.write_bytes(bad)
        assert "not a PEM file" in refused(config, capsys)
    key.write_bytes(good)
    ca.write_bytes((keys.parent / "other/ca.pem").read_bytes())
    assert "not issued by the authority" in refused(config, capsys)
    ca.unlink()
    assert "zenoh.tls_ca" in refused(config, capsys)


def test_an_expired_certificate_is_said_with_its_date(
    tmp_path: Path, keys: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = secured(tmp_path, keys, "operator-old")
    error = refused(config, capsys)
    files = tls_files(load_config(config).config.zenoh)
    assert files is not None
    ended = check_files("test", files)
    assert ended is not None and f"has expired on {ended.ends:%Y-%m-%d}" in error and "'old'" in error
    assert "valid from" in str(ended.wrong_at(ended.begins - datetime.timedelta(days=1)))
    assert ended.wrong_at(ended.begins + datetime.timedelta(hours=1)) is None
    assert remarks(ended, ended.ends - datetime.timedelta(days=31)) == []
    (soon,) = remarks(ended, ended.ends - datetime.timedelta(days=12))
    assert "in 12 day(s)" in soon and soon.code == "certificate_ends"
    assert [one.code for one in remarks(None, ended.ends)] == ["certificates_unread"]


@pytest.mark.parametrize(
    ("zenoh", "expected"),
    [
        (TLS.format(stem="a") + 'listen = ["tcp/127.0.0.1:7447"]\n', "only connect"),
        (TLS.format(stem="a").replace("tls/127", "tcp/127"), "expected tls/HOST:PORT"),
        ('connect = ["tls/127.0.0.1:7447"]\n', "with tls_ca, …"),
        ('connect = ["tls/127.0.0.1:7447"]\ntls_ca = "keys/ca.pem"\n', "zenoh.tls_certificate: missing"),
        ('listen = ["tls/127.0.0.1:7447"]\n', "compensator router"),
    ],
)
def test_what_would_not_be_secure_is_refused(
    tmp_path: Path, zenoh: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert expected in refused(written(tmp_path, zenoh), capsys)


def test_open_doors_and_numbered_ports_are_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = written(
        tmp_path,
        'listen = ["tcp/0.0.0.0:7447"]\nconnect = ["tcp/router.shop:7447"]\nunproven_commands = true\n',
        rtu="/dev/ttyUSB0",
    )
    assert main(["check", "--config", str(config)]) == 0
    said = capsys.readouterr().err
    for words in (
        "zenoh.listen tcp/0.0.0.0:7447",
        "zenoh.connect tcp/router.shop:7447",
        "zenoh.unproven_commands",
        "port /dev/ttyUSB0 is numbered in the order of connection",
    ):
        assert words in said, words
    assert said.count("\n") == 4 and "after a restart it may be another adapter" in said
    codes = ["numbered_port", "open_listen", "unsecured_connect", "unproven_commands"]
    assert re.findall(r"\[(\w+)\]$", said, re.MULTILINE) == codes
    assert main(["check", "--config", str(config), "--json"]) == 0
    out = capsys.readouterr()
    found = json.loads(out.out)
    assert found["warning_codes"] == codes and len(found["warnings"]) == 4
    written(tmp_path, 'listen = ["tcp/[::1]:7447", "tcp/127.0.0.1:7447"]\n', rtu="/dev/serial/by-id/usb-x-port0")
    assert main(["check", "--config", str(config)]) == 0
    assert capsys.readouterr().err == ""


def test_commands_of_nobody_are_taken_on_loopback_only(tmp_path: Path, keys: Path) -> None:
    def taken(zenoh: str) -> bool:
        return load_config(written(tmp_path, zenoh)).config.zenoh.accepts_unproven()

    assert taken("") and taken('listen = ["tcp/127.0.0.1:1"]\n') and taken('listen = ["unixsock-stream/run/z"]\n')
    for other in ("tcp/0.0.0.0:1", "tcp/[::]:1", "tcp/10.0.0.7:1", "tcp/localhost.evil:1"):
        assert not taken(f'listen = ["{other}"]\n')
    assert not taken(TLS.format(stem="a"))
    assert taken(TLS.format(stem="a") + "unproven_commands = true\n")


def test_certificates_are_made_once_and_for_the_owner_alone(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    first = script("certificates.py", str(folder), "--router", "localhost", "--operator", "anna")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert first.count("new") == 2 and folder.stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o777 for path in folder.glob("*.key")} == {0o600}
    again = script("certificates.py", str(folder), "--router", "localhost", "--operator", "anna", "--machine", "m1")
    assert again.count("new") == 1
    assert all((folder / name).read_bytes() == data for name, data in before.items())
    # One name in two roles would have the rights of both.
    assert "both machine and operator" in script("certificates.py", str(folder), "--machine", "anna", code=1)
    script("certificates.py", str(folder), "--operator", "anna", "--renew", "--renew-below", "9999")
    assert (folder / "operator-anna.pem").read_bytes() != before["operator-anna.pem"]
    assert (folder / "router.pem").read_bytes() == before["router.pem"]


def test_a_certificate_that_cannot_work_is_made_anew(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    hosts = ("--router", "192.168.10.2", "--router", "router.shop")
    script("certificates.py", str(folder), *hosts, "--machine", "m1", "--days", "-5")
    for _ in range(2):
        again = script("certificates.py", str(folder), "--machine", "m1")
    assert again.count("new") == 0 and is_good(folder / "machine-m1.pem") and not is_good(folder / "router.pem")
    assert script("certificates.py", str(folder), *hosts).count("new") == 1
    before = (folder / "router.pem").read_bytes()
    assert script("certificates.py", str(folder), *hosts[2:], *hosts[:2]).count("new") == 0
    moved = script("certificates.py", str(folder), "--router", "192.168.10.3", "--machine", "m1")
    assert moved.count("new") == 1 and (folder / "router.pem").read_bytes() != before
    names = x509.load_pem_x509_certificate((folder / "router.pem").read_bytes()).extensions
    (name,) = names.get_extension_for_class(x509.SubjectAlternativeName).value
    assert str(name.value) == "192.168.10.3"


def is_good(path: Path) -> bool:
    now = datetime.datetime.now(datetime.UTC)
    return x509.load_pem_x509_certificate(path.read_bytes()).not_valid_after_utc > now


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--days", "99999999", "-3650 to 36500 days, not 0"),
        ("--days", "0", "-3650 to 36500 days, not 0"),
        ("--days", "-36500", "-3650 to 36500 days, not 0"),
        ("--ca-days", "-2", "1 to 36500 days"),
        ("--ca-days", "0", "1 to 36500 days"),
        ("--renew-below", "nan", "0 to 36500 days"),
        ("--router", "r\u00f6uter", "an address"),
        ("--router", "", "an address"),
    ],
)
def test_what_no_certificate_can_have_is_refused_before_a_key_is_made(
    tmp_path: Path, option: str, value: str, expected: str
) -> None:
    folder = tmp_path / "keys"
    error = script("certificates.py", str(folder), "--machine", "m1", option, value, code=2)
    assert option in error and f"expected {expected}" in error and "Traceback" not in error and not folder.exists()


def test_an_authority_that_has_expired_signs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "keys"
    script("certificates.py", str(folder), "--machine", "m1", "--ca-days", "1")
    spec = importlib.util.spec_from_file_location("certificates", DEPLOY / "certificates.py")
    assert spec is not None and spec.loader is not None
    certificates = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(certificates)
    later = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=2)
    monkeypatch.setattr(certificates, "now", lambda: later)
    monkeypatch.setattr(sys, "argv", ["certificates.py", str(folder), "--machine", "m2"])
    with pytest.raises(SystemExit, match="has expired on"):
        certificates.main()
    assert not (folder / "machine-m2.pem").exists()
