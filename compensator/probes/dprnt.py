"""The agreed line that a control prints with DPRNT.

    TPROBE YUM    3.200 CUM-   3.200 OUM-  12.300 F   1 T  99 D20251120 H134500 A   2 S  20 END

| word | | |
| --- | --- | --- |
| `YUM`, `YMM`, `YIN` | required | reading: where the feature was found minus where it belongs; the word has the unit |
| `CUM`, `CMM`, `CIN` | required | the same with the opposite sign, as a check of the line |
| `OUM`, `OMM`, `OIN` | | the offset that was applied |
| `F`, `T` | | feature and probe: a number or a name |
| `D`, `H` | both or none | date and time of the print: #3011 and #3012 |
| `A` | | seconds from the touch to the print |
| `S` | | seconds for which the spindle had been standing |

Controls print blanks instead of leading zeros, also between a sign and its digits, and a point without decimals.
"""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from decimal import Decimal

from compensator.probes.probe import LARGEST_UM

#: Word at the begin of a line for us; other lines on the same port are somebody else's.
MARK = "TPROBE"
#: Largest difference between the reading and its check, µm: both are rounded.
CHECK_UM = 0.3
#: Longest time from touch to print, and longest stand of the spindle, s.
LONGEST_AGE_S, LONGEST_STAND_S = 3600.0, 1e7
_UNITS_UM = {"UM": 1.0, "MM": 1000.0, "IN": 25400.0}
_NUMBER = re.compile(r"([+-]?) *(\d{1,9}(?:\.\d{0,9})?|\.\d{1,9})")
_NAME = re.compile(r"[A-Z0-9][A-Z0-9./-]{0,31}")
_WORDS = re.compile(r" +([YCO](?:UM|MM|IN)|[FTDHAS])(?: *)((?:[+-] *)?[A-Z0-9.][A-Z0-9./-]*)", re.ASCII)


class Unusable(ValueError):
    """A line that does not have the agreed form; says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Printed:
    """What a line says.

    Parameters
    ----------
    reading_um : float
        Where the feature was found minus where it belongs, in the control's direction, µm.
    offset_um, stopped_s : float or None
        None where the line does not say it.
    feature, tool : str
        Empty where the line does not say it.
    printed_at : datetime.datetime or None
        Date and time of the print by the control's clock, without a zone.
    age_s : float
        From the touch to the print, s.
    """

    reading_um: float
    offset_um: float | None
    feature: str
    tool: str
    printed_at: datetime.datetime | None
    age_s: float
    stopped_s: float | None


def parse(text: str) -> Printed | None:
    """Read a line; None if it does not begin with the mark, so that it is not for us.

    Raises
    ------
    Unusable
        If it begins with the mark and has not the agreed form.

    Examples
    --------
    >>> parse("TPROBE YUM    3.200 CUM-   3.200 F   1. END").feature
    '1'
    >>> parse("TPROBE YUM    3.200 CUM-   3.2")
    Traceback (most recent call last):
    ...
    compensator.probes.dprnt.Unusable: no END
    """
    text = text.strip(" ")
    if not text.startswith(MARK):
        return None
    body = text[len(MARK) :]
    if not body.endswith(" END"):
        raise Unusable("no END")
    words = _split(body.removesuffix("END").rstrip(" "))
    reading_um, check_um, offset_um = (_length(words, letter) for letter in "YCO")
    if reading_um is None or check_um is None:
        raise Unusable(f"no {'Y' if reading_um is None else 'C'}")
    if abs(reading_um + check_um) > CHECK_UM:
        raise Unusable(f"Y is {reading_um:g} µm and C is {check_um:g} µm, expected the opposite")
    stopped_s, age_s = _seconds(words, "S", LONGEST_STAND_S), _seconds(words, "A", LONGEST_AGE_S)
    return Printed(
        reading_um=reading_um,
        offset_um=offset_um,
        feature=_name(words, "F"),
        tool=_name(words, "T"),
        printed_at=_printed_at(words),
        age_s=age_s or 0.0,
        stopped_s=stopped_s,
    )


def _split(body: str) -> dict[str, str]:
    words: dict[str, str] = {}
    at = 0
    while at < len(body):
        found = _WORDS.match(body, at)
        if found is None:
            raise Unusable(f"not understood from {body[at : at + 20].strip()!r}")
        word, value = found.groups()
        if word[0] in {key[0] for key in words}:
            raise Unusable(f"{word[0]} twice")
        words[word] = value
        at = found.end()
    return words


def _number(word: str, text: str) -> float:
    found = _NUMBER.fullmatch(text)
    if found is None:
        raise Unusable(f"{word} = {text!r}, expected a number")
    return float("".join(found.groups()))


def _length(words: dict[str, str], letter: str) -> float | None:
    word = next((word for word in words if word[0] == letter), None)
    if word is None:
        return None
    value_um = _number(word, words[word]) * _UNITS_UM[word[1:]]
    if abs(value_um) > LARGEST_UM:
        raise Unusable(f"{word} = {words[word]}, expected at most {LARGEST_UM / 1000.0:g} mm")
    return value_um


def _seconds(words: dict[str, str], word: str, longest_s: float) -> float | None:
    if word not in words:
        return None
    value = _number(word, words[word])
    if not 0.0 <= value <= longest_s:
        raise Unusable(f"{word} = {words[word]}, expected 0 to {longest_s:g} s")
    return value


def _name(words: dict[str, str], word: str) -> str:
    """Return a name; a number, which controls print in many forms (`1.`, `01`, `1.000`), as a plain one, exactly.

    Two features with the same name would share a zero.
    """
    if word not in words:
        return ""
    text = words[word]
    number = _NUMBER.fullmatch(text)
    if number is not None:
        exact = Decimal("".join(number.groups()))
        # Below this a number has so few digits that none is lost.
        return f"{float(exact):g}" if abs(exact) < Decimal("1e-4") else f"{exact.normalize():f}"
    if not _NAME.fullmatch(text):
        raise Unusable(f"{word} = {text!r}, expected a number or a name")
    return text


def _printed_at(words: dict[str, str]) -> datetime.datetime | None:
    if ("D" in words) != ("H" in words):
        raise Unusable("D and H belong together")
    if "D" not in words:
        return None
    date, time = (int(_number(word, words[word])) for word in "DH")
    if date < 1_000_000:  # some controls have a year of two digits
        date += 20_000_000
    try:
        return datetime.datetime.strptime(f"{date:08d} {time:06d}", "%Y%m%d %H%M%S")
    except ValueError:
        raise Unusable(f"D = {date}, H = {time}, expected a date and a time") from None
