"""Ed25519 signatures of a recording's hash chain; needs the package `cryptography` (extra `sign`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from compensator.errors import ConfigError, UsageError
from compensator.messages import Seal
from compensator.recording.chain import signed_bytes

_MISSING = "signatures need the package cryptography: pip install quill-compensator[sign]"


class Signer:
    """Signs seals.

    Parameters
    ----------
    path : pathlib.Path
        Private key, PEM (PKCS#8, no password): `openssl genpkey -algorithm ed25519 -out FILE`.

    Raises
    ------
    ConfigError
        If it cannot be read or is no such key.
    """

    def __init__(self, path: Path) -> None:
        try:
            from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
            from cryptography.hazmat.primitives.serialization import load_pem_private_key
        except ImportError as error:
            raise ConfigError(_MISSING) from error
        data = _read(path, ConfigError)
        try:
            key = load_pem_private_key(data, password=None)
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{path}: recording.signing_key: no PEM private key without a password") from error
        if not isinstance(key, Ed25519PrivateKey):
            raise ConfigError(f"{path}: recording.signing_key: {type(key).__name__}, expected an Ed25519 key")
        self._key = key
        self.public_key = key.public_key().public_bytes_raw().hex()

    def sign(self, seal: Seal) -> Seal:
        """Return the seal with its signature."""
        seal = msgspec.structs.replace(seal, public_key=self.public_key)
        return msgspec.structs.replace(seal, signature=self._key.sign(signed_bytes(seal)).hex())


class Verifier:
    """Checks seals against one public key.

    Parameters
    ----------
    path : pathlib.Path
        Public key, PEM: `openssl pkey -in PRIVATE -pubout -out FILE`.

    Raises
    ------
    UsageError
        If it cannot be read or is no such key.
    """

    def __init__(self, path: Path) -> None:
        try:
            from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
            from cryptography.hazmat.primitives.serialization import load_pem_public_key
        except ImportError as error:
            raise UsageError(_MISSING) from error
        data = _read(path, UsageError)
        try:
            key = load_pem_public_key(data)
        except (ValueError, TypeError) as error:
            if b"PRIVATE KEY" in data:
                words = "is a private key, which stays on its machine; expected the public one (openssl pkey -pubout)"
                raise UsageError(f"{path}: {words}") from error
            raise UsageError(f"{path}: no PEM public key, expected the machine's (openssl pkey -pubout)") from error
        if not isinstance(key, Ed25519PublicKey):
            raise UsageError(f"{path}: {type(key).__name__}, expected an Ed25519 public key")
        self._key: Any = key
        self.public_key = key.public_bytes_raw().hex()

    def holds(self, seal: Seal) -> bool:
        """Tell whether the seal was signed with the private half of this key."""
        from cryptography.exceptions import InvalidSignature

        try:
            self._key.verify(bytes.fromhex(seal.signature), signed_bytes(seal))
        except (InvalidSignature, ValueError):
            return False
        return seal.public_key == self.public_key


def _read(path: Path, error_kind: type[ConfigError] | type[UsageError]) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise error_kind(f"{path}: {error.strerror or error}; expected a key") from error
