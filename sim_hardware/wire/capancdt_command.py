"""Commands of the capaNCDT 6200's Telnet port.

Source: Micro-Epsilon capaNCDT 6200 operating instructions, "Ethernet Interface", section "Commands".
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

SAMPLE_TIMES_US = (256, 480, 960, 1920, 9600, 16000, 19200, 32000, 48000, 96000, 192000, 400000)
"""Sample times, µs. The ends and 960 are documented; those between are usual in the family."""
UNKNOWN = "$UNKNOWN COMMAND"
WRONG = "$WRONG PARAMETER"
_LIMITS = {"AVT": (0, 4), "AVN": (2, 8), "TRG": (0, 3)}


@dataclass(slots=True, kw_only=True)
class Controller:
    """State of the controller that commands read and set.

    Parameters
    ----------
    ranges_um : Mapping[int, float]
        Measuring range of each channel, µm; channels count from 1.
    data_port : int
        Number of the data port.
    sample_time_us : int
        Present sample time, µs.
    """

    ranges_um: Mapping[int, float]
    data_port: int = 0
    sample_time_us: int = 960
    settings: dict[str, int] = field(default_factory=lambda: {"AVT": 0, "AVN": 2, "TRG": 0})
    single_requests: int = 0

    @property
    def streaming(self) -> bool:
        """Whether values are sent without a trigger."""
        return self.settings["TRG"] == 0

    def answer(self, command: str) -> str:
        """Return the answer that follows the echo of a command, without CR LF.

        Parameters
        ----------
        command : str
            The command without `$`, as received.
        """
        name, rest = command[:3], command[3:]
        if name in _LIMITS:
            return self._setting(name, rest)
        if name == "STI":
            return self._sample_time(rest)
        if name == "CHI":
            return self._channel_info(rest)
        if rest:
            return UNKNOWN if name not in {"CHS", "GMD", "VER", "STS", "GDP", "COI"} else WRONG
        return self._plain(name)

    def _plain(self, name: str) -> str:
        if name == "GMD":
            self.single_requests += 1
            return "OK"
        if name == "CHS":
            return ",".join("1" if n in self.ranges_um else "0" for n in range(1, 5)) + "OK"
        if name == "GDP":
            return f"{self.data_port}OK"
        if name == "VER":
            return "DT6222;V1.2a;1.0OK"
        if name == "COI":
            return "ANO2412058,NAMDT6222,SNO20061,OPT0,VER1.2aOK"
        if name == "STS":
            settings = ";".join(f"{key}{value}" for key, value in self.settings.items())
            return f"STI{self.sample_time_us};{settings}OK"
        return UNKNOWN

    def _setting(self, name: str, rest: str) -> str:
        if rest == "?":
            return f"{self.settings[name]}OK"
        low, high = _LIMITS[name]
        if not re.fullmatch(r"\d", rest) or not low <= int(rest) <= high:
            return WRONG
        self.settings[name] = int(rest)
        return "OK"

    def _sample_time(self, rest: str) -> str:
        if rest == "?":
            return f"{self.sample_time_us}OK"
        if not re.fullmatch(r"\d{1,7}", rest):
            return WRONG
        wanted = int(rest)
        self.sample_time_us = min(SAMPLE_TIMES_US, key=lambda time: abs(time - wanted))
        return f",{self.sample_time_us}OK"

    def _channel_info(self, rest: str) -> str:
        if not re.fullmatch(r"\d", rest) or int(rest) not in self.ranges_um:
            return WRONG
        range_um = self.ranges_um[int(rest)]
        return f":ANO2303024,NAMDL6222,SNO{1000 + int(rest)},OFS0,RNG{range_um:g},UNTumOK"
