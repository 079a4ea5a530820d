"""Signatures: what they add to the chain, and what is said where they are missing or false."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from compensator.audit.machine_audit import audit, summary
from compensator.config import load_config
from compensator.errors import ConfigError, UsageError
from compensator.messages import Seal, encode
from compensator.recording.reading import recordings
from compensator.recording.signature import Signer, Verifier
from compensator.service.loading import load_signer
from tests.audit.attacks import rechained, without_seals
from tests.audit.made import CONFIG, MACHINE, MINUTE_NS, Service
from tests.audit.tampering import Line, find, lines_of, rewrite, with_new_values


def write_key(folder: Path, name: str, number: int) -> tuple[Path, Path]:
    """A pair of keys that is the same every time."""
    key = Ed25519PrivateKey.from_private_bytes(bytes([number]) * 32)
    private, public = folder / f"{name}.pem", folder / f"{name}.pub.pem"
    private.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    public.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    return private, public


@pytest.fixture
def signed(tmp_path: Path) -> tuple[Path, Path]:
    """A recording of two hours and a bit, and the public key."""
    private, public = write_key(tmp_path, "machine", 7)
    Service(tmp_path / "rec", signer=Signer(private)).run(130).stop()
    return tmp_path / "rec", public


def path_in(folder: Path) -> Path:
    return recordings(folder, MACHINE)[0]


def test_signed_every_hour_and_at_the_end(signed: tuple[Path, Path]) -> None:
    folder, public = signed
    found = audit([path_in(folder)], public_key=public)
    assert found.clean and not found.remarks and found.files[0].signed == 3
    assert "only a signature" not in summary(found)
    seals = [msgspec.json.decode(line.data, type=Seal) for line in lines_of(path_in(folder))[0] if line.topic == "seal"]
    assert [seal.reason for seal in seals] == ["hour", "hour", "stop"]


def test_without_the_key_the_signature_is_said_and_not_believed(signed: tuple[Path, Path]) -> None:
    found = audit([path_in(signed[0])])
    assert found.clean and "not checked" in found.remarks[0]
    assert "only a signature" in summary(found)


def test_the_key_of_another_machine(signed: tuple[Path, Path], tmp_path: Path) -> None:
    _, other = write_key(tmp_path, "other", 8)
    found = audit([path_in(signed[0])], public_key=other)
    assert [f.kind for f in found.findings] == ["false_signature"] * 3


def test_a_recording_that_is_not_signed(tmp_path: Path) -> None:
    _, public = write_key(tmp_path, "machine", 7)
    Service(tmp_path / "rec").run(5).stop()
    found = audit([path_in(tmp_path / "rec")], public_key=public)
    assert [f.kind for f in found.findings] == ["unsigned"]


def forged(lines: list[Line], key: Signer | None) -> list[Line]:
    """The offset of a sample changed, the chain and the seals made anew with another key or none."""
    lines = [line for line in lines if not (line.topic == "seal" and b'"hour"' in line.data)]
    at = find(lines, "offset", 30)
    lines[at] = lines[at].edited(b'"valid_for_s":150.0', b'"valid_for_s":950.0')
    seal = msgspec.json.decode(lines[find(lines, "seal", -1)].data, type=Seal)
    seal = msgspec.structs.replace(seal, public_key="", signature="")
    lines[find(lines, "seal", -1)] = replace(
        lines[find(lines, "seal", -1)], data=encode(key.sign(seal) if key else seal)
    )
    return lines


@pytest.mark.parametrize(("own_key", "kind"), [(True, "false_signature"), (False, "unsigned")])
def test_who_computes_the_chain_anew_has_no_signature(
    signed: tuple[Path, Path], tmp_path: Path, own_key: bool, kind: str
) -> None:
    folder, public = signed
    forger = Signer(write_key(tmp_path, "forger", 9)[0]) if own_key else None
    contents = lines_of(path_in(folder))[1]
    rewrite(path_in(folder), lambda lines: with_new_values(forged(lines, forger), contents))
    found = audit([path_in(folder)], public_key=public)
    assert kind in {f.kind for f in found.findings}


def test_what_is_behind_the_last_signature_of_a_live_file_is_said(tmp_path: Path) -> None:
    private, public = write_key(tmp_path, "machine", 7)
    service = Service(tmp_path / "rec", signer=Signer(private)).run(70)
    found = audit([path_in(tmp_path / "rec")], public_key=public)
    assert found.clean and f"{9 * 3} record(s) after the last signature" in " ".join(found.remarks)
    service.kill()


# ------------------------------------------------------------------ a seal as a whole


def _also(text: bytes) -> Callable[[Line], Line]:
    return lambda line: replace(line, data=line.data[:-1] + text + b"}")


def _turned(line: Line) -> Line:
    return replace(line, data=encode(dict(reversed(msgspec.json.decode(line.data).items()))))


def _signature(change: Callable[[str], str]) -> Callable[[Line], Line]:
    def changed(line: Line) -> Line:
        seal = msgspec.json.decode(line.data, type=Seal)
        return replace(line, data=encode(msgspec.structs.replace(seal, signature=change(seal.signature))))

    return changed


def _later(minutes: int) -> Callable[[Line], Line]:
    return lambda line: replace(line, time_ns=line.time_ns + minutes * MINUTE_NS)


#: What is no part of the bytes that are signed.
UNSIGNED_BYTES: dict[str, Callable[[Line], Line]] = {
    "a key": _also(b',"note":"approved by QA"'),
    "a key again": _also(b',"reason":"stop"'),
    "a space": _also(b" "),
    "another order": _turned,
    "capitals": _signature(str.upper),
    "spaces": _signature(lambda text: f"{text[:2]} {text[2:]}"),
    "a day later": _later(1440),
    "a minute earlier": _later(-1),
}


SIGNATURES = [UNSIGNED_BYTES[name] for name in ("capitals", "spaces")]


@pytest.mark.parametrize("change", UNSIGNED_BYTES.values(), ids=UNSIGNED_BYTES)
@pytest.mark.parametrize("finished", [True, False])
def test_no_byte_of_the_last_seal_is_unsigned(
    signed: tuple[Path, Path], change: Callable[[Line], Line], finished: bool
) -> None:
    """No seal after it covers its record; whoever makes the chain anew may write the rest of it as he likes."""
    folder, public = signed
    path = path_in(folder)
    contents = lines_of(path)[1]

    def changed(lines: list[Line]) -> list[Line]:
        at = find(lines, "seal", -1)
        seal = change(lines[at])
        return [*lines[:at], seal, replace(lines[at + 1], time_ns=seal.time_ns)]

    if finished:
        rewrite(path, lambda lines: with_new_values(changed(lines), contents))
    else:
        rechained(path, changed)
    found = audit([path], public_key=public)
    kind = "altered" if change not in SIGNATURES else "false_signature"
    assert [(finding.kind, finding.topic) for finding in found.findings] == [(kind, "seal")], summary(found)
    assert audit([path]).clean == (change in SIGNATURES)


@pytest.mark.parametrize("count", [1, 3])
def test_nothing_follows_the_seal_of_an_end(signed: tuple[Path, Path], count: int) -> None:
    folder, public = signed
    path = path_in(folder)
    contents = lines_of(path)[1]

    def longer(lines: list[Line]) -> list[Line]:
        last = lines[-1]
        return [*lines, *(replace(last, sequence=last.sequence + 1 + i, time_ns=i) for i in range(count))]

    rewrite(path, lambda lines: with_new_values(longer(lines), contents))
    found = audit([path], public_key=public)
    assert found.findings_count == count and "nothing follows the seal of an end" in found.findings[0].line()


@pytest.mark.parametrize("minutes", [-60, -1, 1, 30, 60, 67])
def test_the_time_of_a_seal_is_the_one_that_is_signed(tmp_path: Path, minutes: int) -> None:
    """A later one would make what follows it young, although its next seal was removed."""
    private, public = write_key(tmp_path, "machine", 7)
    Service(tmp_path / "rec", signer=Signer(private)).run(140).kill()
    path = path_in(tmp_path / "rec")

    def shifted(lines: list[Line]) -> list[Line]:
        first, second = find(lines, "seal", 0), find(lines, "seal", 1)
        kept = [*lines[:second], *lines[second + 2 :]]
        return [_later(minutes)(line) if i in (first, first + 1) else line for i, line in enumerate(kept)]

    rechained(path, shifted)
    found = audit([path], public_key=public)
    assert [finding.kind for finding in found.findings] == ["unsigned", "altered"], summary(found)
    assert "79 sample(s), 79 min" in summary(found) and "another time than the one it states" in summary(found)


# ------------------------------------------------------------------ keys


@pytest.mark.parametrize("part", [60, 10**12])
def test_times_of_records_that_were_pushed_together_do_not_make_a_stripped_file_young(
    tmp_path: Path, part: int
) -> None:
    private, public = write_key(tmp_path, "machine", 7)
    Service(tmp_path / "rec", signer=Signer(private)).run(100).kill()
    (path,) = recordings(tmp_path / "rec", MACHINE)
    assert audit([path], public_key=public).clean

    def pushed(lines: list[Line]) -> list[Line]:
        first = lines[0].time_ns
        return [replace(line, time_ns=first + (line.time_ns - first) // part) for line in without_seals(lines)]

    rechained(path, pushed)
    found = audit([path], public_key=public)
    (finding,) = found.findings
    assert "unsigned: no valid signature covers" in finding.line() and "100 sample(s)" in finding.line()


def test_a_key_among_the_recordings_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rec").mkdir()
    private, _ = write_key(tmp_path / "rec", "machine", 7)
    for name, reason in ((private.name, "expected a key"), (f"rec/{private.name}", "in the recording folder")):
        config = tmp_path / "machine.toml"
        config.write_bytes(
            CONFIG.replace(b"recording.folder", f'recording.signing_key = "{name}"\nrecording.folder'.encode())
        )
        with pytest.raises(ConfigError, match=reason):
            load_signer(load_config(config))
    private.rename(tmp_path / private.name)
    config.write_bytes(CONFIG.replace(b"recording.folder", b'recording.signing_key = "machine.pem"\nrecording.folder'))
    assert load_signer(load_config(config)) is not None


def test_what_is_no_key_is_said(tmp_path: Path) -> None:
    private, public = write_key(tmp_path, "machine", 7)
    wrong = tmp_path / "x25519.pem"
    key = X25519PrivateKey.from_private_bytes(b"1" * 32)
    wrong.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    with pytest.raises(ConfigError, match="expected an Ed25519 private key"):
        Signer(wrong)
    with pytest.raises(ConfigError, match="no PEM private key"):
        Signer(public)
    curve = bytes.fromhex("06082a8648ce3d030107")
    known = ec.generate_private_key(ec.SECP256R1()).private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption())
    unknown = base64.b64encode(known.replace(curve, curve[:-1] + b"\x7f"))
    wrong.write_bytes(b"-----BEGIN PRIVATE KEY-----\n" + unknown + b"\n-----END PRIVATE KEY-----\n")
    with pytest.raises(ConfigError, match="no PEM private key"):
        Signer(wrong)  # of a curve that the package does not know
    with pytest.raises(UsageError, match="is a private key"):
        Verifier(private)
    with pytest.raises(UsageError, match="expected a key"):
        Verifier(tmp_path / "none.pem")
    wrong.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    with pytest.raises(UsageError, match="expected an Ed25519 public key"):
        Verifier(wrong)


# ------------------------------------------------------------------ the end that no seal covers yet


def _behind(path: Path, more: Callable[[list[Line]], list[list[Line]]]) -> None:
    """Write groups of forged records behind the last one, with a chain that fits."""

    def longer(lines: list[Line]) -> list[Line]:
        made = list(lines)
        for group in more(lines):
            made += [*group, replace(lines[-1], time_ns=group[0].time_ns)]  # the chain is made anew
        return made

    rechained(path, longer)


def _dated(line: Line, time_ns: int) -> Line:
    """Return a record as if it were of another time."""
    old = f'"time_utc_ns":{line.time_ns},'.encode()
    assert old in line.data
    return replace(line, time_ns=time_ns, data=line.data.replace(old, f'"time_utc_ns":{time_ns},'.encode()))


@pytest.fixture
def running(tmp_path: Path) -> tuple[Path, Path, int]:
    """A recording of a service that runs, half an hour after its last seal, the public key, and its last time."""
    private, public = write_key(tmp_path, "machine", 7)
    Service(tmp_path / "rec", signer=Signer(private)).run(90).kill()
    path = path_in(tmp_path / "rec")
    assert audit([path], public_key=public).clean
    return path, public, lines_of(path)[0][-1].time_ns


def _unsigned(path: Path, public: Path) -> bool:
    return "unsigned" in {finding.kind for finding in audit([path], public_key=public).findings}


@pytest.mark.parametrize("apart_ns", [0, 1, MINUTE_NS])
def test_offsets_without_samples_are_not_young_for_ever(running: tuple[Path, Path, int], apart_ns: int) -> None:
    path, public, last_ns = running

    def held(lines: list[Line]) -> list[list[Line]]:
        offset = lines[find(lines, "offset", -1)]
        return [[_dated(offset, last_ns + (i + 1) * apart_ns)] for i in range(60 if apart_ns == MINUTE_NS else 100)]

    _behind(path, held)
    assert _unsigned(path, public)


@pytest.mark.parametrize("days", [-30, 30])
@pytest.mark.parametrize("topic", ["offset", "sample", "estimate"])
def test_what_has_another_time_than_its_group_is_not_young(
    running: tuple[Path, Path, int], topic: str, days: int
) -> None:
    path, public, last_ns = running

    def dated(lines: list[Line]) -> list[list[Line]]:
        day = _dated(lines[find(lines, topic, -1)], last_ns + days * 1440 * MINUTE_NS)
        return [[replace(day, time_ns=last_ns)]]

    _behind(path, dated)
    assert _unsigned(path, public)


@pytest.mark.parametrize("topic", ["offset", "event"])
def test_nothing_follows_the_group_with_which_a_seal_is_due(running: tuple[Path, Path, int], topic: str) -> None:
    """All of one time: the recorder writes the seal behind the first."""
    path, public, last_ns = running

    def ahead(lines: list[Line]) -> list[list[Line]]:
        return [[_dated(lines[find(lines, topic, -1)], last_ns + 30 * 1440 * MINUTE_NS)]] * 2

    _behind(path, ahead)
    assert _unsigned(path, public)


def test_seals_without_a_signature_do_not_make_a_file_young(running: tuple[Path, Path, int]) -> None:
    path, public, last_ns = running

    def sealed(lines: list[Line]) -> list[list[Line]]:
        seal = msgspec.json.decode(lines[find(lines, "seal", -1)].data, type=Seal)
        made = []
        for i in range(3):
            time_ns = last_ns + (i + 1) * 30 * 1440 * MINUTE_NS
            data = encode(msgspec.structs.replace(seal, time_utc_ns=time_ns, public_key="", signature=""))
            made.append([replace(lines[find(lines, "seal", -1)], time_ns=time_ns, data=data)])
        return made

    _behind(path, sealed)
    assert _unsigned(path, public)


@pytest.mark.parametrize("minutes", [-600, 120])
def test_the_time_that_a_probe_or_an_event_states_does_not_make_a_file_old(
    running: tuple[Path, Path, int], minutes: int
) -> None:
    """A control in local time is two hours ahead; what is reported late was measured long before."""
    path, public, last_ns = running

    def stated(lines: list[Line]) -> list[list[Line]]:
        event = _dated(lines[find(lines, "event", -1)], last_ns + minutes * MINUTE_NS)
        return [[replace(event, time_ns=last_ns)], [replace(event, time_ns=last_ns)]]

    _behind(path, stated)
    assert not _unsigned(path, public)


@pytest.mark.parametrize("name", ["vmc-99_20260106T000000Z.mcap", "other.mcap"])
def test_a_file_of_another_machine_is_not_the_one_that_is_being_written(signed: tuple[Path, Path], name: str) -> None:
    folder, public = signed
    forged = folder / name
    forged.write_bytes(path_in(folder).read_bytes())
    rechained(forged, lambda lines: without_seals(lines)[:150], before=b"\0" * 32, machine="vmc-99")
    assert [finding.kind for finding in audit([path_in(folder), forged], public_key=public).findings] == ["unsigned"]
    assert audit([path_in(folder)], public_key=public).clean
