"""From the bytes of a line to text lines: parity, control characters, line ends, and which lines are of unknown age."""

from __future__ import annotations

from typing import Literal, NamedTuple

#: Longest line, characters.
LONGEST = 240
#: Longest time from the first character of a line to its end, s; at 1200 baud a line takes 1 s.
SLOWEST_S = 10.0
#: What a control sends around the text: XON and XOFF, punch on and off (POPEN, PCLOS), and filling characters.
_IGNORED = frozenset({0x00, 0x11, 0x12, 0x13, 0x14, 0x7F})
_ENDS = frozenset({0x0A, 0x0D})

#: `8N`: 8 bits without parity. `7E`: 7 bits and even parity, which is also what ISO code looks like.
Bits = Literal["8N", "7E"]


class Line(NamedTuple):
    """A line.

    Parameters
    ----------
    text : str
        Without line end and control characters.
    late : bool
        Whether a part of it was waiting for an unknown time.
    broken : str
        Why it cannot be used; empty if it can.
    """

    text: str
    late: bool = False
    broken: str = ""


class Lines:
    """Collects the bytes of one connection.

    Parity is checked here, not by the port: most ports pass wrong characters on, and a converter to TCP always does.

    Parameters
    ----------
    bits : {"8N", "7E"}
        Form of a character.
    """

    def __init__(self, bits: Bits = "8N") -> None:
        self._even = bits == "7E"
        self._text = bytearray()
        self._late = False
        self._broken = ""
        self._begun_s = 0.0

    def feed(self, data: bytes, now_s: float, *, late: bool = False) -> list[Line]:
        """Return the lines that end in these bytes.

        Parameters
        ----------
        data : bytes
            Bytes as received.
        now_s : float
            Monotonic clock, s.
        late : bool
            Whether they may have been waiting before they were read.
        """
        found = []
        for byte in data:
            if self._even and byte.bit_count() % 2:
                self._begin(now_s, late)
                self._broken = "wrong parity"
                continue
            character = byte & 0x7F if self._even else byte
            if character in _ENDS:
                if self._text or self._broken:
                    found.append(self._end(now_s))
            elif character not in _IGNORED:
                self._begin(now_s, late)
                self._append(character)
        return found

    def lost(self) -> Line | None:
        """Return the rest of a connection that has ended, which is never used; None if there is none."""
        if not self._text and not self._broken:
            return None
        self._broken = "the connection was lost in the line"
        return self._end(self._begun_s)

    def _begin(self, now_s: float, late: bool) -> None:
        if not self._text and not self._broken:
            self._begun_s, self._late = now_s, False
        self._late = self._late or late

    def _append(self, character: int) -> None:
        if not 0x20 <= character <= 0x7E:
            self._broken = f"the character {character:#04x}"
        elif len(self._text) >= LONGEST:
            self._broken = f"longer than {LONGEST} characters"
        else:
            self._text.append(character)

    def _end(self, now_s: float) -> Line:
        late = self._late or now_s - self._begun_s > SLOWEST_S
        line = Line(self._text.decode("ascii"), late, self._broken)
        self._text.clear()
        self._broken = ""
        return line
