"""Settings of an identification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from compensator.errors import DataError

Kind = Literal["auto", "heat", "direct"]
Method = Literal["I", "II", "III", "IV"]
Drive = Literal["ttf", "known"]

#: Largest order of a path, and number of held-out blocks: each block is a fit.
LARGEST_ORDER, MOST_FOLDS = 8, 100
#: What a given TDTF can have, of whichever sign: gain, µm/K, and time constant, min; longest record, h.
LARGEST_GAIN_UM_PER_K, TIME_CONSTANTS_MIN, LONGEST_H = 1000.0, (0.01, 100_000.0), 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings of an identification.

    Parameters
    ----------
    kind : {"auto", "heat", "direct"}
        `heat`: with a TTF; `direct`: from T_Q − AT to the deformation; `auto`: `heat` if the heat is known.
    method : {"I", "II", "III", "IV"}
        Origin of the TDTF: given, first order (I); an ETVE (II); the end of an ETVE (III); fitted with the DTF and a
        common denominator (IV). I to III subtract the ambient's share before the DTF is fitted.
    ttf : tuple of int
        nb, nf, nk of the TTF.
    order : tuple of int, optional
        nf, nb of the DTF, nb of the TDTF; by default chosen on held-out blocks.
    drive : {"ttf", "known"}
        Heat for fitting the DTF: estimated from T_Q through the TTF, as in the service, or known.
    given_tdtf : tuple of float, optional
        Gain, µm/K, and time constant, min, of method I.
    etve_end_h : float
        Length of the ETVE's end for method III, h.
    folds : int
        Number of held-out blocks.
    max_order : int
        Largest number of modes considered.
    """

    kind: Kind = "auto"
    method: Method = "IV"
    ttf: tuple[int, int, int] = (2, 2, 0)
    order: tuple[int, int, int] | None = None
    drive: Drive = "ttf"
    given_tdtf: tuple[float, float] | None = None
    etve_end_h: float = 6.0
    folds: int = 5
    max_order: int = 4

    def __post_init__(self) -> None:
        for name, choices in (("kind", get_args(Kind)), ("method", get_args(Method)), ("drive", get_args(Drive))):
            if getattr(self, name) not in choices:
                raise DataError(f"{name} {getattr(self, name)!r}, expected one of: {', '.join(choices)}")
        nb, nf, nk = self.ttf
        if nk != 0:
            raise DataError(
                f"TTF structure nb {nb}, nf {nf}, nk {nk}: nk must be 0, otherwise its inverse is not causal"
            )
        if nb < 1 or not 1 <= nf <= LARGEST_ORDER or nb > nf + 1:
            raise DataError(
                f"TTF structure nb {nb}, nf {nf}, nk {nk}: expected nf from 1 to {LARGEST_ORDER}, nb from 1 to nf + 1"
            )
        if self.order is not None and (self.order[0] < 1 or min(self.order[1:]) < 1 or max(self.order) > LARGEST_ORDER):
            raise DataError(f"order {self.order}: expected nf, nb of DTF, nb of TDTF, each from 1 to {LARGEST_ORDER}")
        if (self.method == "I") != (self.given_tdtf is not None):
            raise DataError(
                "method I, and only that, needs a given TDTF: its gain in µm/K and its time constant in min"
            )
        if self.given_tdtf is not None:
            gain, tau_min = self.given_tdtf
            low, high = TIME_CONSTANTS_MIN
            if not abs(gain) <= LARGEST_GAIN_UM_PER_K:
                raise DataError(f"given TDTF: gain {gain:g} µm/K, expected at most ±{LARGEST_GAIN_UM_PER_K:g}")
            if not low <= tau_min <= high:
                raise DataError(f"given TDTF: time constant {tau_min:g} min, expected from {low:g} to {high:g}")
        if not 2 <= self.folds <= MOST_FOLDS:
            raise DataError(f"folds {self.folds}, expected at least 2, at most {MOST_FOLDS}")
        if not 1 <= self.max_order <= LARGEST_ORDER:
            raise DataError(f"max order {self.max_order}, expected at least 1, at most {LARGEST_ORDER}")
        if not 0.0 < self.etve_end_h <= LONGEST_H:
            raise DataError(f"ETVE end {self.etve_end_h:g} h, expected more than 0, at most {LONGEST_H:g}")
