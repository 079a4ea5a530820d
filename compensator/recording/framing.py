"""The framing of MCAP: kinds of records, their fields, and the errors for invalid bytes."""

from __future__ import annotations

import struct
from pathlib import Path

from compensator.errors import DataError

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)


class Damaged(DataError):
    """A file that is not valid MCAP from some byte on."""

    def __init__(self, path: Path, offset: int, text: str) -> None:
        super().__init__(f"{path}: byte {offset}: {text}")
        self.offset, self.text = offset, text


class Torn(Damaged):
    """A file that ends inside a record.

    Parameters
    ----------
    rest : bytes
        The start of the incomplete record, at most 1 MiB.
    """

    def __init__(self, path: Path, offset: int, rest: bytes = b"") -> None:
        super().__init__(path, offset, "the file ends inside a record")
        self.rest = rest


class Fields:
    """Fields of one record; a length that exceeds it is damage."""

    def __init__(self, path: Path, offset: int, body: bytes, at: int = 0) -> None:
        self._path, self._offset, self._body, self._at = path, offset, body, at

    def _read(self, count: int) -> bytes:
        end = self._at + count
        if end > len(self._body):
            raise Damaged(self._path, self._offset, f"a field of {count} bytes in a record of {len(self._body)}")
        data = self._body[self._at : end]
        self._at = end
        return data

    def number(self, form: str) -> int:
        """Read a number."""
        (value,) = struct.unpack(form, self._read(struct.calcsize(form)))
        return int(value)

    def bytes4(self) -> bytes:
        """Read bytes with a short length."""
        return self._read(self.number("<I"))

    def bytes8(self) -> bytes:
        """Read bytes with a long length."""
        return self._read(self.number("<Q"))

    def text(self) -> str:
        """Read a text."""
        data = self.bytes4()
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError as error:
            raise Damaged(self._path, self._offset, f"a text that is not UTF-8: {data[:20]!r}") from error

    def table(self) -> dict[str, str]:
        """Read a table of texts."""
        inner = Fields(self._path, self._offset, self.bytes4())
        found: dict[str, str] = {}
        while inner._at < len(inner._body):
            key = inner.text()
            if key in found:
                raise Damaged(self._path, self._offset, f"key {key!r} occurs twice")
            found[key] = inner.text()
        return found

    def counts(self) -> dict[int, int]:
        """Read a table of numbers by channel."""
        data = self.bytes4()
        if len(data) % 10:
            raise Damaged(self._path, self._offset, f"a table of {len(data)} bytes, expected a multiple of 10")
        found: dict[int, int] = dict(struct.iter_unpack("<HQ", data))
        if 10 * len(found) != len(data):
            raise Damaged(self._path, self._offset, "a channel that occurs twice in a table")
        return found

    def rest(self) -> bytes:
        """Read the remaining bytes."""
        return self._read(len(self._body) - self._at)

    def done(self) -> None:
        """Check that no bytes remain."""
        if self._at != len(self._body):
            raise Damaged(self._path, self._offset, f"{len(self._body) - self._at} bytes more than the record has")
