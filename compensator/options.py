"""Options of the verbs that have another type than they can have: a slip in a notebook, named as the commands do."""

from __future__ import annotations

from numbers import Integral, Real

from compensator.errors import UsageError

_NUMBER = (Real, "a number")
_EXPECTED: dict[str, tuple[type, str]] = {
    "fit_until_h": _NUMBER,
    "from_h": _NUMBER,
    "etve_end_h": _NUMBER,
    "folds": (Integral, "an integer"),
    "name": (str, "a text"),
}


def check_types(**options: object) -> None:
    """Refuse options of another type; None is an option that is not given.

    Raises
    ------
    UsageError
        Naming option and value.

    Examples
    --------
    >>> check_types(fit_until_h="x")
    Traceback (most recent call last):
    compensator.errors.UsageError: fit_until_h = 'x', expected a number
    """
    for name, value in options.items():
        kind, words = _EXPECTED[name]
        if value is not None and (not isinstance(value, kind) or isinstance(value, bool)):
            raise UsageError(f"{name} = {repr(value)[:60]}, expected {words}")
