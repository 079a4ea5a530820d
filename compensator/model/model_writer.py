"""Writes a model file that an engineer can read: the numbers exactly, and beside them what they mean."""

from __future__ import annotations

import json
import math
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from compensator.errors import ModelError
from compensator.model.model_file import load_model
from compensator.model.thermal_model import Path, ThermalModel

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_PURPOSE = {
    "TTF": "heat to T_Q - AT; its inverse gives the heat",
    "TDTF": "change of the ambient to deformation",
}


def write_model(path: FilePath, model: ThermalModel) -> ThermalModel:
    """Write a model file, whole or not at all.

    Parameters
    ----------
    path : pathlib.Path
        The TOML file.
    model : ThermalModel
        What to write.

    Returns
    -------
    ThermalModel
        As read back, with the hash of the file.

    Raises
    ------
    ModelError
        If the model holds something that a file cannot.
    """
    text = dump_model(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    temporary = FilePath(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return load_model(path)


def dump_model(model: ThermalModel) -> str:
    """Return the text of a model file.

    Parameters
    ----------
    model : ThermalModel
        What to write.

    Returns
    -------
    str
        TOML that `parse_model` reads back to the same numbers.

    Raises
    ------
    ModelError
        If a number is not finite, naming its key.

    Examples
    --------
    >>> from compensator.model.model_file import parse_model
    >>> model = load_model("quill")
    >>> parse_model(dump_model(model).encode(), source="copy").dtf == model.dtf
    True
    """
    return "\n".join(_lines(model)) + "\n"


def _lines(model: ThermalModel) -> Iterator[str]:
    drive = "heat, W" if model.kind == "heat" else "T_Q - AT, K (nobody measured the heat, so there is no TTF)"
    yield f"# Thermal model {_comment(model.name)}. The DTF is driven by {drive}."
    yield "# Time is in minutes in functions of s; b and a are in powers of 1/z at the sample period."
    yield "schema = 1"
    yield from _pairs({
        "name": model.name, "kind": model.kind, "sample_period_s": model.period_s, "inputs": model.inputs,
    })  # fmt: skip
    for name in ("TTF", "DTF", "TDTF"):
        path: Path | None = getattr(model, name.lower())
        if path is not None:
            yield ""
            yield from _path(f"paths.{name}", path, _PURPOSE.get(name, "what drives it to deformation"), {})
    for name, (replaces, path) in model.alternatives.items():
        yield ""
        yield from _path(f"alternatives.{_key(name)}", path, f"stands in for {replaces}", {"replaces": replaces})
    estimator = model.estimator
    walk = "heat_walk_std_w" if model.kind == "heat" else "difference_walk_std_k"
    yield from (
        "", "# Noise of a sample of each thermocouple, K, and how much drive and ambient change in one sample.",
        "[estimator]",
    )  # fmt: skip
    yield from _pairs({
        "method": estimator.method, "t_q_noise_std_k": estimator.t_q_noise_std_k,
        "at_noise_std_k": estimator.at_noise_std_k, walk: estimator.drive_walk_std,
        "at_walk_std_k": estimator.at_walk_std_k,
    })  # fmt: skip
    if model.validity:
        yield from ("", "# Ranges that the model is trusted in; outside them the service holds.", "[validity]")
        yield from _pairs({key: list(bounds) for key, bounds in model.validity.items()})
    yield from ("", "# Standard deviation of the model's own error in y.", "[uncertainty]")
    yield from _pairs({"y_std_um": model.y_std_um})
    for effect in model.effects:
        yield from ("", "[[effect]]", *_pairs({"kind": effect.kind, **effect.table}))
    if model.provenance:
        yield from ("", "[provenance]", *_pairs(model.provenance))


def _path(where: str, path: Path, purpose: str, extra: Mapping[str, Any]) -> Iterator[str]:
    function = path.sampled
    gain = f"{function.dc_gain:.5g}"
    std = _gain_std(path)
    if std is not None:
        gain += f" +- {std:.2g}"
    taus = ", ".join(f"{tau:.4g}" for tau in function.time_constants_min() if tau > 0.0)
    yield f"# {purpose}. Gain at rest {gain} {path.unit}; time constants {taus or 'none'} min."
    yield f"[{where}]"
    table: dict[str, Any] = {**extra, "unit": path.unit}
    if path.continuous is not None:
        table |= {"form": "continuous", "numerator": list(path.continuous.numerator),
                  "denominator": list(path.continuous.denominator)}  # fmt: skip
    else:
        table |= {"form": "sampled", "b": list(function.b), "a": list(function.a)}
        if path.covariance is not None:
            table["covariance"] = [list(row) for row in path.covariance]
    yield from _pairs(table)


def _gain_std(path: Path) -> float | None:
    """Return the standard error of Σb / Σa from the covariance of b and a_1 …."""
    if path.covariance is None:
        return None
    b, a = path.sampled.b, path.sampled.a
    total = math.fsum(a)
    gradient = np.array([1.0 / total] * len(b) + [-path.sampled.dc_gain / total] * (len(a) - 1))
    return float(np.sqrt(max(gradient @ np.array(path.covariance) @ gradient, 0.0)))


def _comment(text: str) -> str:
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)


def _pairs(table: Mapping[str, Any]) -> Iterator[str]:
    for key, value in table.items():
        yield f"{_key(str(key))} = {_value(str(key), value)}"


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _string(text: str) -> str:
    # JSON's escapes are TOML's, but for DEL, which TOML wants escaped; lone surrogates have no UTF-8.
    return json.dumps(text.encode("utf-8", "replace").decode("utf-8"), ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(key: str, value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (float, np.floating)):
        if not math.isfinite(value):
            raise ModelError(f"{key} = {value}: a model file holds finite numbers only")
        return repr(float(value))
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(str(k))} = {_value(f'{key}.{k}', v)}" for k, v in value.items()) + " }"
    if isinstance(value, Sequence):
        items = [_value(key, item) for item in value]
        if items and isinstance(value[0], (Mapping, Sequence)) and not isinstance(value[0], str):
            return "[\n" + "".join(f"  {item},\n" for item in items) + "]"
        return "[" + ", ".join(items) + "]"
    raise ModelError(f"{key} = {value!r}: expected a number, text, list or table")
