"""Ed25519 signatures of a recording's hash chain; needs the package `cryptography` (extra `sign`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import msgspec

from compensator.errors import ConfigError, UsageError
from compensator.input_file import KEY_BYTES, read_file
from compensator.messages import Seal
from compensator.recording.chain import signed_bytes

_MISSING = "signatures need the package cryptography: pip install quill-compensator[sign]"
#: Why a file is not a valid key, by the expected half.
_UNREADABLE = {
    "private": "recording.signing_key: no PEM private key without a password",
    "public": "no PEM public key, expected the machine's (openssl pkey -pubout)",
    "exchanged": "is a private key, which stays on its machine; expected the public one (openssl pkey -pubout)",
}


class Signer:
    """Signs seals.

    Parameters
    ----------
    path : pathlib.Path
        Private key, PEM (PKCS#8, no password): `openssl genpkey -algorithm ed25519 -out FILE`.

    Raises
    ------
    ConfigError
        If the file cannot be read or is not such a key.
    """

    def __init__(self, path: Path) -> None:
        key = _read_key(path, "private", ConfigError)
        self._key = key
        self.public_key: str = key.public_key().public_bytes_raw().hex()

    def sign(self, seal: Seal) -> Seal:
        """Return the seal with its signature."""
        seal = msgspec.structs.replace(seal, public_key=self.public_key)
        return msgspec.structs.replace(seal, signature=self.sign_bytes(signed_bytes(seal)))

    def sign_bytes(self, data: bytes) -> str:
        """Return the signature of bytes, hexadecimal."""
        return str(self._key.sign(data).hex())

    def made(self, data: bytes, signature: str) -> bool:
        """Return whether a signature of bytes, hexadecimal, was made with this key."""
        return _verified(self._key.public_key(), data, signature)


class Verifier:
    """Checks seals against one public key.

    Parameters
    ----------
    path : pathlib.Path
        Public key, PEM: `openssl pkey -in PRIVATE -pubout -out FILE`.

    Raises
    ------
    UsageError
        If the file cannot be read or is not such a key.
    """

    def __init__(self, path: Path) -> None:
        key = _read_key(path, "public", UsageError)
        self._key = key
        self.public_key: str = key.public_bytes_raw().hex()

    def holds(self, seal: Seal) -> bool:
        """Return whether the seal was signed with the private half of this key."""
        return self.made(signed_bytes(seal), seal.signature) and seal.public_key == self.public_key

    def made(self, data: bytes, signature: str) -> bool:
        """Return whether a signature of bytes, hexadecimal, was made with the private half of this key."""
        return _verified(self._key, data, signature)


def _verified(key: Any, data: bytes, signature: str) -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        made = bytes.fromhex(signature)
        key.verify(made, data)
    except (InvalidSignature, ValueError):
        return False
    return made.hex() == signature  # spaces and capitals would be no part of what is signed


def _read_key(path: Path, half: Literal["private", "public"], error_kind: type[ConfigError] | type[UsageError]) -> Any:
    """Return one half of a pair of keys from its PEM file."""
    try:
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise error_kind(_MISSING) from error
    try:
        data = read_file(path, KEY_BYTES)
    except OSError as error:
        raise error_kind(f"{path}: {error.strerror or error}; expected a key") from error
    kind: type[Any] = getattr(ed25519, f"Ed25519{half.title()}Key")
    try:
        if half == "private":
            key: Any = serialization.load_pem_private_key(data, password=None)
        else:
            key = serialization.load_pem_public_key(data)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        words = _UNREADABLE["exchanged" if half == "public" and b"PRIVATE KEY" in data else half]
        raise error_kind(f"{path}: {words}") from error
    if not isinstance(key, kind):
        raise error_kind(f"{path}: {type(key).__name__}, expected an Ed25519 {half} key")
    return key
