"""The head of the chain: what a recorder has written last, kept outside the folder of the recordings and signed.

A file that a kill has left without its end can be changed before the next start. The head tells the next start what
the end must be. It is written before each sync, because a kill after the sync would otherwise leave a recording that
is ahead of its head: `synced` is the value that is on disk, `pending` are the values of the records that the sync
adds, of which a kill may leave any number.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import msgspec

from compensator.atomic_write import replace_file
from compensator.errors import DataError, UsageError
from compensator.input_file import read_file
from compensator.messages import UNREADABLE
from compensator.recording.naming import order_of
from compensator.recording.reading import has_begun, last_value, recordings, values_of
from compensator.recording.signature import Signer, Verifier

#: Number of files whose ends are kept: the live one, and eight before whose recovery kills have interrupted.
KEPT = 9
#: Longest file that is read, bytes.
LONGEST = 2**20


class End(msgspec.Struct, frozen=True, kw_only=True):
    """End of one recording.

    Parameters
    ----------
    file : str
        Name of the recording.
    synced : str
        Value of the chain at the last record that is on disk, hexadecimal; empty if there is none yet.
    pending : list of str
        Values at the records of the next sync.
    """

    file: str
    synced: str
    pending: list[str]

    @property
    def accepted(self) -> frozenset[str]:
        """Values with which a recording may end that nobody changed."""
        return frozenset(filter(None, (self.synced, *self.pending)))


class Head(msgspec.Struct, frozen=True, kw_only=True):
    """The file of the head.

    Parameters
    ----------
    chain_head : int
        Version of the format. A signed seal has no such field, so neither can stand for the other.
    machine : str
        Name of the machine.
    time_utc_ns : int
        Time of the records, ns since 1970 UTC.
    ends : list of End
        The newest last.
    public_key, signature : str
        Ed25519, hexadecimal. Signed is this message with an empty signature.
    """

    chain_head: int
    machine: str
    time_utc_ns: int
    ends: list[End]
    public_key: str
    signature: str

    def signed_bytes(self) -> bytes:
        """Return the signed bytes."""
        return msgspec.json.encode(msgspec.structs.replace(self, signature=""))


class HeadKeeper:
    """Keeps the head of one machine.

    Parameters
    ----------
    path : pathlib.Path
        The file; its folder must exist when it is written.
    machine : str
        Name of the machine.
    signer : Signer
        Key of the machine; a head that was signed by another one is not used.
    """

    def __init__(self, path: Path, machine: str, signer: Signer) -> None:
        self.path, self._machine, self._signer = path, machine, signer
        #: Ends known, the newest last; replaced as a whole, so that another thread may read it.
        self.ends: tuple[End, ...] = ()
        #: Time of the newest records that are covered, ns since 1970 UTC; 0 without a head.
        self.time_utc_ns = 0
        #: Why there is no head; empty if there is one, or if none was written before.
        self.unusable = ""
        try:
            head = read_head(path)
            if head.machine != machine:
                self.unusable = f"{path}: of machine {head.machine!r}"
            elif not signer.made(head.signed_bytes(), head.signature):
                self.unusable = f"{path}: not signed with the key of this machine"
            else:
                self.ends, self.time_utc_ns = tuple(head.ends), head.time_utc_ns
        except UsageError as error:
            self.unusable = str(error) if os.path.lexists(path) else ""

    def accepted(self, file: str) -> frozenset[str]:
        """Return the values with which a recording may end that nobody changed; empty if its end is not known."""
        return next((end.accepted for end in self.ends if end.file == file), frozenset())

    def expect(self, file: str, synced: bytes, pending: list[bytes], time_utc_ns: int) -> None:
        """Note what is on disk and what the next sync adds.

        Raises
        ------
        OSError
            If it cannot be written; the old file is kept.
        """
        end = End(file=file, synced=synced.hex(), pending=[value.hex() for value in pending])
        ends = (*(one for one in self.ends if one.file != file), end)[-KEPT:]
        head = Head(
            chain_head=1,
            machine=self._machine,
            time_utc_ns=time_utc_ns,
            ends=list(ends),
            public_key=self._signer.public_key,
            signature="",
        )
        head = msgspec.structs.replace(head, signature=self._signer.sign_bytes(head.signed_bytes()))
        self.ends, self.time_utc_ns = ends, time_utc_ns
        replace_file(self.path, msgspec.json.encode(head), mode=0o640)

    def forget(self, file: str) -> None:
        """Forget a file that never came to disk, as on a full one: many of them must not displace what a kill left."""
        self.ends = tuple(one for one in self.ends if one.file != file)


def read_head(path: Path, verifier: Verifier | None = None) -> Head:
    """Return the head in a file.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    verifier : Verifier, optional
        Key with which it must be signed.

    Raises
    ------
    UsageError
        If it cannot be read, is no head, or is not signed with the key.
    """
    try:
        data = read_file(path, LONGEST)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UsageError(f"{path}: {why}; expected the head of a chain") from error
    try:
        head = msgspec.json.decode(data, type=Head)
        for end in head.ends:
            for value in end.accepted:
                bytes.fromhex(value)
    except (*UNREADABLE, ValueError) as error:
        raise UsageError(f"{path}: no head of a chain: {error}") from error
    if verifier is not None and not verifier.made(head.signed_bytes(), head.signature):
        raise UsageError(f"{path}: not signed with the given key")
    return head


class Previous(NamedTuple):
    """The recording from which the next one continues.

    Parameters
    ----------
    file : str
        Its name; empty if there is none.
    value : bytes
        Value of the chain from which the next one continues; empty if there is none.
    differs : str
        What is wrong with the recording by the head; empty if nothing is.
    """

    file: str
    value: bytes
    differs: str = ""


def previous_end(folder: Path, machine: str, keeper: HeadKeeper | None) -> Previous:
    """Return the recording from which the next one continues.

    By the head if there is one: a recording that was removed, cut off or rewritten since is not continued as it is
    found, but as it was written, so that an audit reports it.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the recordings.
    machine : str
        Name of the machine.
    keeper : HeadKeeper, optional
        The head.
    """
    there = recordings(folder, machine)
    # A kill before the first sync leaves a file without a record, which nothing continues; damage is another matter.
    newest = next((path for path in reversed(there) if not _is_empty(path)), there[-1] if there else None)
    for end in reversed(keeper.ends if keeper is not None else ()):
        path = folder / end.file
        if not path.exists():
            if not end.synced:  # a kill before its first sync
                continue
            return Previous(end.file, bytes.fromhex(end.synced), "is missing")
        if newest is not None and order_of(newest.stem) > order_of(path.stem):
            return Previous(newest.name, _value(newest), f"is newer than {end.file}, the last recording of the head")
        values = values_of(path)
        if not values:
            if not end.synced:
                continue
            return Previous(end.file, bytes.fromhex(end.synced), "has no chain")
        last = last_value(path)
        if last.hex() in end.accepted:
            return Previous(end.file, last)
        if bytes.fromhex(end.synced) in values:
            return Previous(end.file, last, "goes on after the head")
        return Previous(end.file, bytes.fromhex(end.synced), "does not contain the head: it was cut off or rewritten")
    return Previous(newest.name, _value(newest)) if newest is not None else Previous("", b"")


def _is_empty(path: Path) -> bool:
    """Return whether a recording has no chain yet; one that is no MCAP file is not empty."""
    try:
        return path.stat().st_size == 0 or not has_begun(path)
    except (DataError, OSError):
        return False


def _value(path: Path) -> bytes:
    """Return the last value of a recording; empty if it is none, which an audit reports and no start depends on."""
    try:
        return last_value(path)
    except DataError:
        return b""
