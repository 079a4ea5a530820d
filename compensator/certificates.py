"""Checks TLS files before they are used: for an invalid file Zenoh reports only that it cannot connect.

Certificates are read with the package `cryptography` (extra `tls`); without it only the presence and the permissions
of the files are checked.
"""

from __future__ import annotations

import datetime
import stat
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from compensator.codes import Remark, ServiceWarning
from compensator.errors import ConfigError
from compensator.input_file import KEY_BYTES, read_file

#: Number of days before the expiry of a certificate from which a warning is given.
SOON_DAYS = 30.0
MISSING = "certificates are not checked without the package cryptography: pip install quill-compensator[tls]"


class TlsFiles(NamedTuple):
    """The files of one side of a link.

    Parameters
    ----------
    ca, certificate, key : pathlib.Path
        Authority of the peer, own certificate, own private key; PEM.
    names : tuple of str
        Their keys in the configuration.
    """

    ca: Path
    certificate: Path
    key: Path
    names: tuple[str, str, str] = ("zenoh.tls_ca", "zenoh.tls_certificate", "zenoh.tls_key")


class Certificate(NamedTuple):
    """Content of a certificate.

    Parameters
    ----------
    common_name : str
        Its owner.
    begins, ends : datetime.datetime
        Period of validity, UTC.
    """

    common_name: str
    begins: datetime.datetime
    ends: datetime.datetime

    def wrong_at(self, now: datetime.datetime) -> str | None:
        """Return why it cannot be used at a time; None if it can."""
        if now > self.ends:
            return f"certificate of {self.common_name!r} has expired on {self.ends:%Y-%m-%d %H:%M} UTC"
        if now < self.begins:
            return f"certificate of {self.common_name!r} is valid from {self.begins:%Y-%m-%d %H:%M} UTC only"
        return None


def check_files(source: str, files: TlsFiles) -> Certificate | None:
    """Check that the files exist and belong together, and that only the owner can read the key.

    Parameters
    ----------
    source : str
        The configuration, for the message.
    files : TlsFiles
        Files to check.

    Returns
    -------
    Certificate or None
        The own certificate, even if not valid now; None without the package `cryptography`.

    Raises
    ------
    ConfigError
        One line that names configuration, key, file and what was expected.
    """
    for name, path in zip(files.names, files[:3], strict=True):
        if not path.is_file():
            raise ConfigError(f"{source}: {name} = {str(path)!r}: no such file, expected a PEM file")
    mode = stat.S_IMODE(files.key.stat().st_mode)
    if mode & 0o037:
        raise ConfigError(
            f"{source}: {files.names[2]} = {str(files.key)!r}: mode {mode:04o}, expected 0600, or 0640 if "
            "the service's own group reads it; otherwise other users could use the key"
        )
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives.serialization import load_pem_private_key
    except ImportError:
        return None
    authorities = _read(source, files.names[0], files.ca, x509.load_pem_x509_certificates)
    own = _read(source, files.names[1], files.certificate, _with_known_key)
    key = _read(source, files.names[2], files.key, lambda data: load_pem_private_key(data, None))
    if own[0].public_key() != key.public_key():
        raise ConfigError(f"{source}: {files.names[2]} = {str(files.key)!r}: not the key of {files.certificate}")
    if len(own) == 1 and not any(_issued(own[0], authority) for authority in authorities):
        raise ConfigError(
            f"{source}: {files.names[1]} = {str(files.certificate)!r}: not issued by the authority {files.ca}"
        )
    return Certificate(_common_name(own[0]), own[0].not_valid_before_utc, own[0].not_valid_after_utc)


def common_name_of(path: Path) -> str:
    """Return the common name of a certificate.

    Raises
    ------
    ConfigError
        If it cannot be read.
    """
    try:
        from cryptography import x509
    except ImportError as error:
        raise ConfigError(f"{path}: {MISSING}") from error
    return _common_name(_read(str(path), "certificate", path, x509.load_pem_x509_certificates)[0])


def remarks(certificate: Certificate | None, now: datetime.datetime) -> list[Remark]:
    """Return warnings about a usable certificate."""
    if certificate is None:
        return [
            Remark(ServiceWarning.CERTIFICATES_UNREAD, "Certificates are not checked without the package cryptography.")
        ]
    days = (certificate.ends - now).total_seconds() / 86400.0
    if days >= SOON_DAYS:
        return []
    figures = (
        f"The certificate of {certificate.common_name!r} expires on {certificate.ends:%Y-%m-%d}, in {days:.0f} day(s)."
    )
    return [Remark(ServiceWarning.CERTIFICATE_ENDS, figures)]


def _with_known_key(data: bytes) -> Any:
    """Return certificates; one whose key is of a kind that nobody knows is none."""
    from cryptography import x509

    found = x509.load_pem_x509_certificates(data)
    found[0].public_key()
    return found


def _read(source: str, name: str, path: Path, load: Callable[[bytes], Any]) -> Any:
    from cryptography.exceptions import UnsupportedAlgorithm

    try:
        return load(read_file(path, KEY_BYTES))
    except OSError as error:
        raise ConfigError(f"{source}: {name} = {str(path)!r}: {error.strerror or error}") from error
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise ConfigError(
            f"{source}: {name} = {str(path)!r}: not a PEM file of this kind without a password"
        ) from error


def _issued(certificate: Any, authority: Any) -> bool:
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm

    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature, UnsupportedAlgorithm):
        return False
    return True


def _common_name(certificate: Any) -> str:
    from cryptography.x509.oid import NameOID

    names: Sequence[Any] = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""
