"""quill-compensator: thermal error compensation for machine tools.

    import compensator as tc

    run = tc.read("run.csv", columns={"t_q_degc": "t5"})
    found = tc.identify([run])
    why = tc.diagnose(found.model, run)
    tc.compare({"first": found.model, "extended": why.model}, run)

The functions are imported when they are first used.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from compensator.api.comparison import compare
    from compensator.api.diagnosis import diagnose
    from compensator.api.identification import identify
    from compensator.api.simulation import simulate
    from compensator.data.export import export
    from compensator.data.measurement import read
    from compensator.errors import CompensatorError
    from compensator.model.model_file import load_model

__version__ = "0.1.0"

__all__ = [
    "CompensatorError",
    "compare",
    "diagnose",
    "export",
    "identify",
    "load_model",
    "read",
    "simulate",
]

#: Where each name is defined.
_MODULES = {
    "CompensatorError": "compensator.errors",
    "compare": "compensator.api.comparison",
    "diagnose": "compensator.api.diagnosis",
    "export": "compensator.data.export",
    "identify": "compensator.api.identification",
    "load_model": "compensator.model.model_file",
    "read": "compensator.data.measurement",
    "simulate": "compensator.api.simulation",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found = getattr(importlib.import_module(_MODULES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__"})


class _Package(ModuleType):
    """The package: `identify` and `diagnose` are functions, although two subpackages have the same names."""

    def __setattr__(self, name: str, value: object) -> None:
        # An import of `compensator.identify.…` would otherwise replace the function by the subpackage.
        if not (name in _MODULES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
