"""Settings of the OPC UA bridge: a TOML file with `[receiver]` and `[opcua]`; an unknown key is an error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

from compensator.errors import ConfigError, one_line
from compensator.input_file import KEY_BYTES, read_file, resolved
from compensator.receiver import ReceiverError
from compensator.receiver.settings import read_table, require_sign

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

#: µm for each unit that the PLC may use.
UNITS_UM = {"mm": 1000.0, "um": 1.0}
#: How the sign of an offset is determined.
SIGN_BY = "with a dial gauge"
#: Security policies of OPC UA that are secure.
POLICIES = ("Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss")
C = TypeVar("C", bound="Connection")
_FILES = ("password_file", "certificate", "private_key", "server_certificate")


@dataclass(frozen=True, slots=True, kw_only=True)
class Connection:
    """What `[opcua]` has for one axis and for several.

    Parameters
    ----------
    endpoint : str
        Such as `opc.tcp://192.168.214.241:4840`.
    unit : str
        `mm` or `um`: unit of the values.
    cycle_s : float
        Interval of reading and writing, s.
    readback_tolerance_um : float
        Largest difference between the value read back and the value written, µm.
    resume_after_s : float
        Time for which the PLC's value must not change after a difference before the offset continues from it, s.
    retry_s, timeout_s : float
        Pause before the next attempt to connect, and time limit of a reply, s.
    heartbeat_node, state_node, enable_node, probe_wanted_node : str
        Optional: an integer that counts up each cycle; one for the state; a BOOL of the PLC, false holds the offset; a
        BOOL for whether a touch probe is wanted.
    user, password_file : str
        Login; the file contains only the password.
    security_policy, certificate, private_key, server_certificate : str
        For a signed and encrypted connection: one of the policies, and its files. Without them the connection is not
        protected.
    """

    endpoint: str
    unit: str
    cycle_s: float = 1.0
    readback_tolerance_um: float = 0.1
    resume_after_s: float = 10.0
    retry_s: float = 5.0
    timeout_s: float = 4.0
    heartbeat_node: str = ""
    state_node: str = ""
    enable_node: str = ""
    probe_wanted_node: str = ""
    user: str = ""
    password_file: str = ""
    security_policy: str = ""
    certificate: str = ""
    private_key: str = ""
    server_certificate: str = ""

    @property
    def unit_um(self) -> float:
        """Return µm for each unit of the PLC."""
        return UNITS_UM[self.unit]


@dataclass(frozen=True, slots=True, kw_only=True)
class OpcUa(Connection):
    """`[opcua]` of one axis.

    Parameters
    ----------
    offset_node : str
        A REAL or LREAL, such as `ns=2;s=/Plc/DB100.DBD0:REAL`.
    sign : int
        1 or −1: whether the control adds or subtracts it. There is no default: it is determined on the machine.
    sign_checked : str
        Who determined it, when and how, as text.
    """

    offset_node: str
    sign: int
    sign_checked: str


def opcua_from(tables: dict[str, Any], path: str) -> OpcUa:
    """Check the tables beside `[receiver]` of one axis.

    Raises
    ------
    ConfigError, ReceiverError
        One line that names file, key, value and what was expected.
    """
    table = opcua_table(tables, path, "receiver, opcua")
    require_sign(table, f"{path}: opcua", how=SIGN_BY)
    opcua = read_table(OpcUa, table, source=path, name="opcua")
    check_value(opcua, f"{path}: opcua")
    check_connection(opcua, path)
    return with_files(opcua, path)


def opcua_table(tables: dict[str, Any], path: str, expected: str) -> dict[str, Any]:
    """Return `[opcua]`, beside which a bridge's file has no other table.

    Raises
    ------
    ReceiverError
        If it is missing, or another one is there.
    """
    table = tables.pop("opcua", None)
    if not isinstance(table, dict):
        raise ReceiverError(f"{path}: opcua: missing, expected a table [opcua]")
    if tables:
        raise ReceiverError(f"{path}: {next(iter(tables))}: unknown table, expected {expected}")
    return table


def with_files(opcua: C, path: str) -> C:
    """Make the names of files absolute.

    Raises
    ------
    ConfigError
        Where one is not there, or cannot be read.
    """
    folder = Path(path).parent
    given = {key: getattr(opcua, key) for key in _FILES}
    files: dict[str, Any] = {key: str(resolved(folder / name)) for key, name in given.items() if name}
    for key, file in files.items():
        where = f"{path}: opcua.{key} = {given[key]!r}"
        if not Path(file).is_file():
            raise ConfigError(f"{where}: no such file")
        try:
            _READ[key](read_file(Path(file), KEY_BYTES))
        except (OSError, ValueError, TypeError) as error:
            raise ConfigError(f"{where}: {one_line(str(error))}, expected {_EXPECTED[key]}") from error
    return replace(opcua, **files)


def certificate_of(data: bytes) -> Certificate:
    """Return the certificate of a file, PEM or DER; ValueError if it is none."""
    from cryptography import x509  # with asyncua, the extra of this bridge

    return (x509.load_pem_x509_certificate if data.startswith(b"-----") else x509.load_der_x509_certificate)(data)


def _private_key(data: bytes) -> None:
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import rsa

    load = serialization.load_pem_private_key if data.startswith(b"-----") else serialization.load_der_private_key
    try:
        key = load(data, password=None)
    except UnsupportedAlgorithm as error:
        raise ValueError(str(error)) from error
    if not isinstance(key, rsa.RSAPrivateKey):
        raise ValueError("a key of another kind")


_READ: dict[str, Callable[[bytes], object]] = {
    "password_file": lambda data: data.decode("utf-8"),
    "certificate": certificate_of,
    "private_key": _private_key,
    "server_certificate": certificate_of,
}
_EXPECTED = {
    "password_file": "a password in UTF-8",
    "certificate": "an X.509 certificate, PEM or DER",
    "private_key": "an RSA key without a password, PEM or DER",
    "server_certificate": "an X.509 certificate, PEM or DER",
}


def check_value(one: Any, where: str) -> None:
    """Check node and sign of a value."""

    def wrong(key: str, expected: str) -> ReceiverError:
        return ReceiverError(f"{where}.{key} = {getattr(one, key)!r}: expected {expected}")

    if one.sign not in (1, -1):
        raise wrong("sign", "1 or -1, determined on this machine with a dial gauge")
    if not one.sign_checked.strip():
        raise wrong("sign_checked", "who determined the sign, when and how")
    if not one.offset_node:
        raise wrong("offset_node", "a node such as ns=2;s=/Plc/DB100.DBD0:REAL")


def check_connection(opcua: Connection, path: str) -> None:
    """Check what is the same for one axis and for several."""

    def wrong(key: str, expected: str) -> ReceiverError:
        return ReceiverError(f"{path}: opcua.{key} = {getattr(opcua, key)!r}: expected {expected}")

    if opcua.unit not in UNITS_UM:
        raise wrong("unit", f"one of {', '.join(UNITS_UM)}")
    try:
        url = urlsplit(opcua.endpoint)
        is_endpoint = url.scheme == "opc.tcp" and bool(url.hostname) and url.port is not None
    except ValueError:  # a port that is none, a bracket that is not closed
        is_endpoint = False
    if not is_endpoint:
        raise wrong("endpoint", "opc.tcp://HOST:PORT")
    bounds = {
        "cycle_s": (0.05, 10.0),
        "readback_tolerance_um": (1e-4, 10.0),
        "resume_after_s": (1.0, 3600.0),
        "retry_s": (0.1, 300.0),
        "timeout_s": (0.1, 60.0),
    }
    for key, (least, most) in bounds.items():
        if not least <= getattr(opcua, key) <= most:
            raise wrong(key, f"{least:g} to {most:g}")
    if opcua.resume_after_s < 2.0 * opcua.cycle_s:
        raise wrong("resume_after_s", "at least two cycles")
    if bool(opcua.user) != bool(opcua.password_file):
        raise wrong("user", "user and password_file together")
    files = (opcua.certificate, opcua.private_key, opcua.server_certificate)
    if opcua.security_policy and opcua.security_policy not in POLICIES:
        raise wrong("security_policy", f"one of {', '.join(POLICIES)}")
    if bool(opcua.security_policy) != any(files) or (any(files) and not all(files)):
        raise wrong("security_policy", "security_policy, certificate, private_key and server_certificate together")
