"""Writes a model file that an engineer can read: exact numbers, and comments on what they mean."""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from compensator.atomic_write import atomic_write
from compensator.axes import FIRST, label_of
from compensator.errors import ModelError
from compensator.model.model_file import GAIN_STD_KEY, HELD_OUT_KEY, load_axes, parse_axes
from compensator.model.thermal_model import Estimator, Path, ThermalModel

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
#: What all axes of a machine have in common.
_SHARED = ("name", "kind", "period_s", "inputs", "ttf", "estimator", "validity")


def write_model(path: FilePath, model: ThermalModel) -> ThermalModel:
    """Write a model file atomically; a model as it was read, with the bytes of its own file.

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
        If the model holds something that a file cannot; an existing file stays as it is.

    Examples
    --------
    >>> import tempfile
    >>> from compensator.model.model_file import load_model
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     len(write_model(FilePath(folder) / "copy.toml", load_model("quill")).sha256)
    64
    """
    return write_axes(path, {model.axis: model})[model.axis]


def write_axes(path: FilePath, models: Mapping[str, ThermalModel]) -> dict[str, ThermalModel]:
    """Write the models of all axes into one file; as `write_model`."""
    data = bytes_of(models)
    # Before the old file is replaced: the reader knows bounds that the model does not.
    parse_axes(data, source=str(path))
    with atomic_write(path) as file:
        file.write(data.decode("utf-8"))
    return load_axes(path.absolute())  # a bare "quill" is the name of a built-in model


def bytes_of(models: Mapping[str, ThermalModel]) -> bytes:
    """Return the bytes of the file of the models of all axes.

    Of models as they were read, their own file: its hash is known, and its comments are somebody's.

    Raises
    ------
    ModelError
        As `dump_axes`.
    """
    own = next(iter(models.values())).file
    if own and parse_axes(own, source="model") == dict(models):
        return own
    return dump_axes(models).encode("utf-8")


def dump_model(model: ThermalModel) -> str:
    """Return the text of a model file.

    Parameters
    ----------
    model : ThermalModel
        What to write. A covariance belongs to sampled coefficients: a path in s is written without it.

    Returns
    -------
    str
        TOML that `parse_model` reads back to the same numbers.

    Raises
    ------
    ModelError
        If a number is not finite or a value has no form in TOML, naming its key.

    Examples
    --------
    >>> from compensator.model.model_file import load_model
    >>> model = load_model("quill")
    >>> parse_axes(dump_model(model).encode(), source="copy")["y"].dtf == model.dtf
    True
    """
    return "\n".join(_lines(model)) + "\n"


def dump_axes(models: Mapping[str, ThermalModel]) -> str:
    """Return the text of a model file of several axes; of Y alone, that of `dump_model`.

    Parameters
    ----------
    models : mapping of str to ThermalModel
        By axis. The estimation of the heat, the sample period and the validity are those of the machine.

    Returns
    -------
    str
        TOML that `parse_axes` reads back to the same numbers.

    Raises
    ------
    ModelError
        As `dump_model`, and if the models differ in what is the machine's.
    """
    first, *others = models.values()
    for axis, model in models.items():
        if model.axis != axis:
            raise ModelError(f"axis.{axis}: a model of {label_of(model.axis)}, expected one of {label_of(axis)}")
    if not others:
        return dump_model(first)
    for model in others:
        for key in _SHARED:
            if getattr(model, key) != getattr(first, key):
                raise ModelError(
                    f"axis.{model.axis}: its {key} differs from that of axis {first.axis}, expected one of the machine"
                )
    return "\n".join(_lines_of_axes(models)) + "\n"


def _lines(model: ThermalModel) -> Iterator[str]:
    if model.axis != FIRST:
        yield from _lines_of_axes({model.axis: model})
        return
    yield from _head(model)
    yield from _paths(model, ("TTF", "DTF", "TDTF"), "")
    yield from _alternatives(model, "")
    yield from _estimator(model.kind, model.estimator)
    yield from _validity(model)
    yield from _own_error(model, "")
    yield from _effects(model, "")
    yield from _provenance({**_kept(model), **model.provenance}, "")


def _lines_of_axes(models: Mapping[str, ThermalModel]) -> Iterator[str]:
    first = next(iter(models.values()))
    yield from _head(first)
    yield from _paths(first, ("TTF",), "")
    yield from _estimator(first.kind, first.estimator)
    yield from _validity(first)
    shared = {
        key: value
        for key, value in first.provenance.items()
        if all(model.provenance.get(key) == value for model in models.values())
    }
    yield from _provenance(shared, "")
    for axis, model in models.items():
        where = f"axis.{axis}."
        yield from ("", _comment(f"Axis {label_of(axis)}."))
        yield from _paths(model, ("DTF", "TDTF"), where)
        yield from _alternatives(model, where)
        yield from _own_error(model, where)
        yield from _effects(model, where)
        own = {key: value for key, value in model.provenance.items() if key not in shared}
        yield from _provenance({**_kept(model), **own}, where)


def _head(model: ThermalModel) -> Iterator[str]:
    drive = "heat, W" if model.kind == "heat" else "T_Q - AT, K (the heat was not measured, so there is no TTF)"
    yield _comment(f"Thermal model {model.name}. The DTF is driven by {drive}; the deformation is in um.")
    yield "# Functions of s: ascending powers, time in minutes. b and a: powers of 1/z at the sample period."
    yield "schema = 1"
    yield from _pairs(
        "",
        {
            "name": model.name,
            "kind": model.kind,
            "sample_period_s": model.period_s,
            "inputs": model.inputs,
        },
    )


def _paths(model: ThermalModel, names: Sequence[str], where: str) -> Iterator[str]:
    purposes = {
        "TTF": "Heat to T_Q - AT; its inverse gives the heat",
        "DTF": f"{'Heat' if model.kind == 'heat' else 'T_Q - AT'} to deformation",
        "TDTF": "Change of the ambient to deformation",
    }
    for name in names:
        path: Path | None = getattr(model, name.lower())
        if path is not None:
            yield from _path(f"{where}paths.{name}", path, purposes[name], {})


def _alternatives(model: ThermalModel, where: str) -> Iterator[str]:
    for name, (replaces, path) in model.alternatives.items():
        place = f"{where}alternatives.{_key(name)}"
        yield from _path(place, path, f"Stands in for {replaces}", {"replaces": replaces})


def _validity(model: ThermalModel) -> Iterator[str]:
    if model.validity:
        yield from (
            "",
            "# Ranges that the model is trusted in; outside them the service holds. The key ends in the unit.",
        )
        yield from ("[validity]", *_pairs("validity", {key: list(bounds) for key, bounds in model.validity.items()}))


def _own_error(model: ThermalModel, where: str) -> Iterator[str]:
    yield from ("", "# Standard deviation of the model's own error in y, um.", f"[{where}uncertainty]")
    yield from _pairs(f"{where}uncertainty", {"y_std_um": model.y_std_um})


def _effects(model: ThermalModel, where: str) -> Iterator[str]:
    for number, effect in enumerate(model.effects, start=1):
        yield from ("", _comment(effect.comment), f"[[{where}effect]]")
        yield from _pairs(f"effect {number}", {"kind": effect.kind, **effect.to_table()})


def _kept(model: ThermalModel) -> dict[str, Any]:
    """Return what the file keeps in the provenance: the calibration's error and the standard errors of its gains."""
    kept: dict[str, Any] = {} if model.held_out_rms_um is None else {HELD_OUT_KEY: model.held_out_rms_um}
    paths = {"TTF": model.ttf, "DTF": model.dtf, "TDTF": model.tdtf}
    stds = {name: path.gain_std for name, path in paths.items() if path is not None and path.gain_std is not None}
    return kept | {GAIN_STD_KEY: stds} if stds else kept


def _provenance(provenance: Mapping[str, Any], where: str) -> Iterator[str]:
    if provenance:
        place = f"{where}provenance"
        yield from ("", "# Where the model comes from.", f"[{place}]", *_pairs(place, provenance))


def _path(where: str, path: Path, purpose: str, extra: Mapping[str, Any]) -> Iterator[str]:
    table: dict[str, Any] = {**extra, "unit": path.unit}
    if path.continuous is not None:
        table |= {
            "form": "continuous",
            "numerator": path.continuous.numerator,
            "denominator": path.continuous.denominator,
        }
    else:
        table |= {"form": "sampled", "b": path.sampled.b, "a": path.sampled.a}
        if path.covariance is not None:
            table["covariance"] = path.covariance
    lines = list(_pairs(where, table))
    yield from ("", _comment(f"{purpose}. {_gain(where, path)}."), _comment(_dynamics(path)), f"[{where}]", *lines)


def _gain(where: str, path: Path) -> str:
    """Write the gain at rest, with its standard error where that is known."""
    n = len(path.sampled.b) + len(path.sampled.a) - 1
    if path.covariance is not None and (len(path.covariance) != n or any(len(row) != n for row in path.covariance)):
        raise ModelError(f"{where}.covariance: expected {n} rows of {n} numbers")
    gain, std = path.gain_with_std()
    if math.isinf(gain):
        return "No gain at rest: it integrates"
    if math.isnan(std):
        return f"Gain at rest {gain:.5g} {path.unit}"
    return f"Gain at rest {gain:.5g} +- {std:.2g} {path.unit} (one standard error)"


def _dynamics(path: Path) -> str:
    """Write the time constants and zeros, in s where the file has s: a pole faster than 2/T is negative in z."""
    function = path.continuous or path.sampled
    taus = ", ".join(f"{tau:.4g}" for tau in function.time_constants_min() if tau != 0.0)
    if path.continuous is not None:
        zeros, at = path.continuous.zeros_per_min(), "s = {} 1/min"
    else:
        zeros, at = path.sampled.zeros(), "z = {}"
    places = ", ".join(f"{z.real:.4g}" if z.imag == 0.0 else f"{z:.4g}" for z in zeros)
    return f"Time constants: {f'{taus} min' if taus else 'none'}. Zeros: {at.format(places) if places else 'none'}."


def _estimator(kind: str, estimator: Estimator) -> Iterator[str]:
    key, drive = ("heat_walk_std_w", "the heat, W") if kind == "heat" else ("difference_walk_std_k", "T_Q - AT, K")
    yield ""
    yield '# "kalman": drive and path states together. "inverse": the drive from the reversed TTF or as measured.'
    yield "# t_q_noise, at_noise: standard deviation of the noise of one sample, K."
    yield f"# {key}: standard deviation of the change of {drive}, in one sample; at_walk: of the ambient, K."
    yield "[estimator]"
    yield from _pairs(
        "estimator",
        {
            "method": estimator.method,
            "t_q_noise_std_k": estimator.t_q_noise_std_k,
            "at_noise_std_k": estimator.at_noise_std_k,
            key: estimator.drive_walk_std,
            "at_walk_std_k": estimator.at_walk_std_k,
        },
    )


def _comment(text: str) -> str:
    return "# " + _CONTROL.sub(" ", _encodable(text))


def _pairs(where: str, table: Mapping[str, Any]) -> Iterator[str]:
    for key, value in table.items():
        yield f"{_key(str(key))} = {_value(f'{where}.{key}' if where else str(key), value)}"


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _encodable(text: str) -> str:
    return text.encode("utf-8", "replace").decode("utf-8")  # a lone surrogate, as in a damaged file name, has no UTF-8


def _string(text: str) -> str:
    # JSON's escapes are TOML's, but for DEL, which TOML wants escaped.
    return json.dumps(_encodable(text), ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(key: str, value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (float, np.floating)):
        if not math.isfinite(value):
            raise ModelError(f"{key} = {value}: a model file holds finite numbers only")
        return repr(float(value))
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, (datetime.date, datetime.time)):
        return value.isoformat()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(str(k))} = {_value(f'{key}.{k}', v)}" for k, v in value.items()) + " }"
    if isinstance(value, Sequence):
        items = [_value(key, item) for item in value]
        if items and isinstance(value[0], (Mapping, Sequence)) and not isinstance(value[0], str):
            return "[\n" + "".join(f"  {item},\n" for item in items) + "]"
        return "[" + ", ".join(items) + "]"
    raise ModelError(f"{key} = {value!r}: expected a number, text, date, list or table")
