#!/usr/bin/env python3
"""Make a small certificate authority and the certificates of router, machines, receivers, operators, probes and tools.

The router's access list goes by the common name of each certificate. Keys are written with mode 0600. Running it again
keeps what is there and valid, and makes what is missing, has expired or is for other hosts of the router; `--renew`
replaces certificates with less than `--renew-below` days left, too. Needs the package cryptography
(`pip install quill-compensator[tls]`).

example: certificates.py keys --router localhost --machine vmc-07 --receiver cnc-07 --operator anna
"""

from __future__ import annotations

import argparse
import datetime
import ipaddress
import os
import re
import stat
import sys
from pathlib import Path

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError:
    sys.exit("certificates.py: needs the package cryptography: pip install quill-compensator[tls]")

ROLES = ("machine", "receiver", "operator", "probe", "tool")
#: Largest file of a key or certificate, bytes.
LONGEST = 100_000
#: Longest time in days, of an expired certificate for tests, too.
LONGEST_DAYS, EXPIRED_DAYS = 36_500, 3_650
CLOCK_SKEW = datetime.timedelta(hours=1)


def now() -> datetime.datetime:
    """Return the time, UTC, in whole seconds as certificates have it."""
    return datetime.datetime.now(datetime.UTC).replace(microsecond=0)


def read(path: Path) -> bytes:
    """Return the bytes of a regular file of at most 100,000; a device or a pipe may have no end."""
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                sys.exit(f"{path}: not a regular file")
            data = file.read(LONGEST + 1)
    except OSError as error:
        sys.exit(f"{path}: {error.strerror}")
    if len(data) > LONGEST:
        sys.exit(f"{path}: larger than {LONGEST} bytes, expected a key or a certificate")
    return data


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate with a common name."""
    try:
        certificate = x509.load_pem_x509_certificate(read(path))
        common_name(certificate)
    except (ValueError, IndexError):
        sys.exit(f"{path}: expected a certificate in PEM with a common name")
    return certificate


def write(path: Path, data: bytes, mode: int) -> None:
    """Write a file that never exists with wider permissions or half its content."""
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def new_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Make a key, on disk before it signs anything."""
    key = ec.generate_private_key(ec.SECP256R1())
    form = serialization.PrivateFormat.PKCS8
    write(path, key.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption()), 0o600)
    return key


def read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Read a key; refuse one that others can read."""
    if path.stat().st_mode & 0o077:
        sys.exit(f"{path}: mode {path.stat().st_mode & 0o777:04o}, expected 0600: chmod 600 {path}")
    try:
        key = serialization.load_pem_private_key(read(path), None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        sys.exit(f"{path}: expected a key in PEM without a password")
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        sys.exit(f"{path}: expected an elliptic-curve key")
    return key


def name_of(common_name: str) -> x509.Name:
    """Return a subject with a common name alone."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def common_name(certificate: x509.Certificate) -> str:
    """Return the common name of a certificate's subject."""
    return str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)


def authority(folder: Path, days: int) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Read the authority of a folder, or make one."""
    path, key_path = folder / "ca.pem", folder / "ca.key"
    if path.exists() != key_path.exists():
        missing = key_path if path.exists() else path
        sys.exit(f"{missing}: missing, but the other half of the authority exists; nothing is overwritten")
    if path.exists():
        certificate = read_certificate(path)
        if certificate.not_valid_after_utc <= now():
            until = f"{certificate.not_valid_after_utc:%Y-%m-%d}"
            sys.exit(f"{path}: has expired on {until}; nothing is overwritten, expected another folder")
        return certificate, read_key(key_path)
    key = new_key(key_path)
    # A log could not tell two authorities of one name apart.
    name = name_of(f"compensator CA {os.urandom(4).hex()}")
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now() - CLOCK_SKEW)
        .not_valid_after(now() + datetime.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(key_usage(sign=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    write(path, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    return certificate, key


def key_usage(*, sign: bool) -> x509.KeyUsage:
    """Return the usage of a key: signing certificates, or authentication."""
    return x509.KeyUsage(
        digital_signature=not sign,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=sign,
        crl_sign=sign,
        encipher_only=False,
        decipher_only=False,
    )


def alternative(host: str) -> x509.GeneralName:
    """Return a host as a certificate has it: an address or a name."""
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def issue(
    folder: Path,
    stem: str,
    name: str,
    hosts: list[str],
    ca: tuple[x509.Certificate, ec.EllipticCurvePrivateKey],
    *,
    begins: datetime.datetime,
    ends: datetime.datetime,
) -> None:
    """Make a key and a certificate. Only one with hosts may act as a server: a receiver's cannot pose as the router."""
    authority_certificate, authority_key = ca
    key = new_key(folder / f"{stem}.key")
    usage = [ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [ExtendedKeyUsageOID.CLIENT_AUTH]
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name_of(name))
        .issuer_name(authority_certificate.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begins)
        .not_valid_after(min(ends, authority_certificate.not_valid_after_utc))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(key_usage(sign=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usage), critical=False)
        .add_extension(x509.SubjectAlternativeName([alternative(host) for host in hosts or [name]]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()), critical=False)
        .sign(authority_key, hashes.SHA256())
    )
    write(folder / f"{stem}.pem", certificate.public_bytes(serialization.Encoding.PEM), 0o644)


def is_valid(
    folder: Path, stem: str, name: str, hosts: list[str], ca: x509.Certificate, renew_below_days: float
) -> bool:
    """Return whether a certificate of this authority exists with its key, is for these hosts and lasts long enough."""
    path, key_path = folder / f"{stem}.pem", folder / f"{stem}.key"
    if not path.exists() or not key_path.exists():
        return False
    certificate = read_certificate(path)
    try:
        certificate.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature):
        sys.exit(f"{path}: of another authority than {folder / 'ca.pem'}; nothing is overwritten")
    if common_name(certificate) != name or certificate.public_key() != read_key(key_path).public_key():
        return False
    named = [one.value for one in certificate.extensions if isinstance(one.value, x509.SubjectAlternativeName)]
    if hosts and {name for one in named for name in one} != {alternative(host) for host in hosts}:
        return False
    return certificate.not_valid_after_utc - now() > datetime.timedelta(days=renew_below_days)


def main() -> int:
    """Make what is missing and list what is there."""
    made, arguments = [], parse()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    ca = authority(folder, arguments.ca_days)
    # One name in two roles would have the rights of both.
    for role in ROLES:
        for name in getattr(arguments, role):
            for other in {*ROLES} - {role}:
                if name in getattr(arguments, other) or (folder / f"{other}-{name}.pem").exists():
                    sys.exit(f"{name}: both {role} and {other}; the access list goes by the name, expected one role")
    wanted = [(f"{role}-{name}", name, []) for role in ROLES for name in getattr(arguments, role)]
    if arguments.router:
        wanted.insert(0, ("router", "router", arguments.router))
    begins, ends = now() - CLOCK_SKEW, now() + datetime.timedelta(days=arguments.days)
    if arguments.days < 0:  # an expired one, for tests
        begins = ends - datetime.timedelta(days=1)
    for stem, name, hosts in wanted:
        if not is_valid(folder, stem, name, hosts, ca[0], arguments.renew_below if arguments.renew else 0.0):
            issue(folder, stem, name, hosts, ca, begins=begins, ends=ends)
            made.append(stem)
    for path in sorted(folder.glob("*.pem")):
        certificate = read_certificate(path)
        until = f"{certificate.not_valid_after_utc:%Y-%m-%d}"
        print(f"{path.name:<28} {common_name(certificate):<28} until {until}{'  new' if path.stem in made else ''}")
    return 0


def parse() -> argparse.Namespace:
    """Read the command line."""
    text, _, example = (__doc__ or "").rpartition("\n\n")
    parser = argparse.ArgumentParser(description=text, epilog=example)
    parser.add_argument(
        "folder", type=Path, metavar="DIR", help="folder of keys and certificates; keep it out of repositories"
    )
    parser.add_argument("--router", action="append", default=[], metavar="HOST", help="name or address of the router")
    for role in ROLES:
        parser.add_argument(f"--{role}", action="append", default=[], metavar="NAME", help="may be repeated")
    parser.add_argument("--days", type=int, default=825, help="how long certificates last (825)")
    parser.add_argument("--ca-days", type=int, default=3650, help="how long the authority lasts (3650)")
    parser.add_argument("--renew", action="store_true", help="replace those that end soon")
    parser.add_argument("--renew-below", type=float, default=60.0, metavar="DAYS", help="what soon means (60)")
    arguments = parser.parse_args()
    # All of it before the first key is made: half an authority would stay.
    for option, least in (("days", -EXPIRED_DAYS), ("ca_days", 1), ("renew_below", 0)):
        value = getattr(arguments, option)
        if not least <= value <= LONGEST_DAYS or (option == "days" and value == 0):
            besides = ", not 0" if option == "days" else ""
            parser.error(f"--{option.replace('_', '-')} {value}: expected {least} to {LONGEST_DAYS} days{besides}")
    for host in arguments.router:
        if not re.fullmatch("[!-~]+", host):
            parser.error(f"--router {host!r}: expected an address, or a name in ASCII such as router.shop")
    for role in ROLES:
        for name in getattr(arguments, role):
            if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}", name):
                parser.error(f"--{role} {name!r}: expected letters, digits, . _ -; the name is part of keys")
            if name in ("router", *("ca",)):
                parser.error(f"--{role} {name!r}: this name is taken")
    return arguments


if __name__ == "__main__":
    sys.exit(main())
