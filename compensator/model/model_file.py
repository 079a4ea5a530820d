"""The model file: TOML that an engineer can read and edit.

The reader reads the file table by table and refuses what it does not know, naming file, table, key,
value and what was expected. The writer adds comments to the numbers.

A file of several axes has a part `[axis.NAME]` for each, and what is the same for all of them once above: the
estimation of the heat, the sample period, the validity. A file without parts is of Y.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path as FilePath
from typing import Any

from compensator.axes import FIRST, NAME, label_of
from compensator.errors import CompensatorError, ModelError
from compensator.input_file import MODEL_BYTES, parse_toml, read_file
from compensator.model.effects import Effect, EffectStream, effect_from, kinds
from compensator.model.table import TomlTable, shown
from compensator.model.thermal_model import Estimator, Path, ThermalModel
from compensator.model.transfer_function import SampledTransferFunction, TransferFunction

#: Keys of `ThermalModel.held_out_rms_um` and of every `Path.gain_std` in the provenance, where version 0.1.0 accepts
#: any key.
HELD_OUT_KEY, GAIN_STD_KEY = "folds_rms_um", "gain_std"
#: Models that ship with the package.
BUILT_IN = ("quill",)

_TOP = (
    "schema",
    "name",
    "kind",
    "sample_period_s",
    "inputs",
    "paths",
    "alternatives",
    "estimator",
    "validity",
    "uncertainty",
    "provenance",
    "effect",
    "description",
)
#: What the part of an axis may have; the rest is the machine's and stands once in the file.
AXIS_TABLES = ("paths", "alternatives", "uncertainty", "effect", "provenance")
#: Largest number of axes.
MOST_AXES = 20
#: Largest number of coefficients of a polynomial, of effects, of alternatives, and of ranges.
COEFFICIENTS, EFFECTS, ALTERNATIVES, RANGES = 20, 100, 20, 200
#: Largest sum of all delays, samples; each sample is part of the state in every recording.
DELAY_SAMPLES = 20_000
#: Temperatures that any part of a machine can have, °C.
_COLDEST, _HOTTEST = -273.15, 2000.0
#: Largest of any other quantity that a range bounds, such as W or rpm, and largest error of a model, µm.
_LARGEST, _LARGEST_UM = 1e9, 10_000.0
_ESTIMATOR = ("method", "t_q_noise_std_k", "at_noise_std_k", "at_walk_std_k")
_FORMS = {"continuous": ("numerator", "denominator"), "sampled": ("b", "a")}


def load_model(name: str | FilePath, axis: str = FIRST) -> ThermalModel:
    """Read the model of an axis.

    Parameters
    ----------
    name : str or pathlib.Path
        A TOML file, or the name of a model that ships with the package.
    axis : str
        The axis; by default Y, the only one of a file without parts.

    Returns
    -------
    ThermalModel
        With the hash of the file's bytes.

    Raises
    ------
    ModelError
        Naming file, table and key, when the file cannot be read, has no such axis, or its dynamics cannot be run.

    Examples
    --------
    >>> round(load_model("quill").dtf.in_s().dc_gain, 4)
    1.0182
    """
    return parse_model(read_model_bytes(name), source=str(name), axis=axis)


def load_axes(name: str | FilePath) -> dict[str, ThermalModel]:
    """Read the models of all axes of a file, by axis.

    Raises
    ------
    ModelError
        As `load_model`.
    """
    return parse_axes(read_model_bytes(name), source=str(name))


def read_model_bytes(name: str | FilePath) -> bytes:
    """Return the bytes of a model file or of a built-in model.

    Raises
    ------
    ModelError
        If there is no such file.
    """
    if str(name) in BUILT_IN:
        return resources.files("compensator.model").joinpath(f"{name}.toml").read_bytes()
    try:
        return read_file(FilePath(name), MODEL_BYTES)
    except OSError as error:
        known = ", ".join(BUILT_IN)
        raise ModelError(
            f"{name}: {error.strerror or error}; expected a model file or a built-in model ({known})"
        ) from error


def parse_model(data: bytes, *, source: str, axis: str = FIRST) -> ThermalModel:
    """Make the model of an axis of the bytes of its file.

    Parameters
    ----------
    data : bytes
        TOML, UTF-8.
    source : str
        Name for messages.
    axis : str
        The axis.

    Raises
    ------
    ModelError
        As `load_model`.
    """
    models = parse_axes(data, source=source)
    if axis not in models:
        has = ", ".join(map(label_of, models))
        raise ModelError(f"{source}: a model of {has}, expected one of {label_of(axis)}")
    return models[axis]


def parse_axes(data: bytes, *, source: str) -> dict[str, ThermalModel]:
    """Make the models of all axes of the bytes of their file.

    Parameters
    ----------
    data, source
        As `parse_model`.

    Raises
    ------
    ModelError
        As `load_model`.
    """
    try:
        table = parse_toml(data)
    except ValueError as error:
        raise ModelError(f"{source}: not a TOML file, expected a model: {error}") from error
    sha256 = hashlib.sha256(data).hexdigest()
    try:
        if "axis" not in table:
            models = {FIRST: _model(table, sha256)}
        else:
            models = {axis: _of_axis(axis, own, sha256) for axis, own in _parts(table).items()}
    except CompensatorError as error:
        raise ModelError(f"{source}: {error}") from error
    return {axis: replace(model, file=data) for axis, model in models.items()}


def _parts(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the table of each axis, as in a file of its own: its part, with what stands once for all axes."""
    shared = {key: value for key, value in table.items() if key != "axis"}
    for key, known in (("paths", ("TTF",)), ("provenance", None)):
        TomlTable(key, shared.get(key, {}), known)
    for key in ("alternatives", "uncertainty", "effect"):
        if key in shared:
            raise ModelError(f"{key}: expected in the part of an axis, such as axis.{next(iter(table['axis']), 'y')}")
    parts = {}
    for axis, value in TomlTable("axis", table["axis"], most=MOST_AXES).table.items():
        if NAME.fullmatch(axis) is None:
            raise ModelError(f"axis.{shown(axis)}: expected a name such as z")
        own = TomlTable(f"axis.{axis}", value, AXIS_TABLES).table
        both = {
            key: {**shared.get(key, {}), **TomlTable(f"axis.{axis}.{key}", own.get(key, {})).table}
            for key in ("paths", "provenance")
        }
        parts[axis] = {**shared, **own, **both}
    if not parts:
        raise ModelError("axis: no axis in it, expected one at least")
    return parts


def _of_axis(axis: str, table: Mapping[str, Any], sha256: str) -> ThermalModel:
    try:
        return replace(_model(table, sha256), axis=axis)
    except CompensatorError as error:
        raise ModelError(f"axis.{axis}: {error}") from error


def _model(table: Mapping[str, Any], sha256: str) -> ThermalModel:
    top = TomlTable("model", table, _TOP)
    if table.get("schema") != 1:
        raise ModelError(f"schema = {shown(table.get('schema'))}, expected 1")
    kind = top.text("kind", ("heat", "direct"))
    period_s = top.number("sample_period_s", low=0.1, high=3600.0)
    names = ("TTF", "DTF", "TDTF") if kind == "heat" else ("DTF", "TDTF")
    paths_table = TomlTable("paths", table.get("paths", {}), names)
    held_out, stds, provenance = _provenance(table.get("provenance", {}))
    paths = {name: _path(f"paths.{name}", value, period_s) for name, value in paths_table.table.items()}
    paths |= {name: replace(path, gain_std=stds[name]) for name, path in paths.items() if name in stds}
    for name in names[:-1]:
        if name not in paths:
            raise ModelError(f"paths.{name} is missing; a model of kind {kind!r} needs it")
    return ThermalModel(
        name=top.text("name"),
        kind=kind,  # type: ignore[arg-type]
        period_s=period_s,
        ttf=paths.get("TTF"),
        dtf=paths["DTF"],
        tdtf=paths.get("TDTF"),
        estimator=_estimator(table.get("estimator"), kind),
        inputs=top.text("inputs", ("changes", "absolute"), "changes"),  # type: ignore[arg-type]
        validity=_validity(table.get("validity", {})),
        y_std_um=_uncertainty(table.get("uncertainty", {"y_std_um": 0.0})),
        effects=_effects(top.text("name"), table.get("effect", []), period_s),
        alternatives=_alternatives(table.get("alternatives", {}), names, period_s),
        provenance=provenance,
        held_out_rms_um=held_out,
        sha256=sha256,
    )


def _path(where: str, value: object, period_s: float, extra: Sequence[str] = ()) -> Path:
    table = TomlTable(where, value)
    form = table.text("form", tuple(_FORMS))
    upper, lower = _FORMS[form]
    table = TomlTable(where, value, ("unit", "form", upper, lower, "covariance", *extra))
    unit = table.text("unit")
    top, bottom = table.numbers(upper, most=COEFFICIENTS), table.numbers(lower, most=COEFFICIENTS)
    try:
        if form == "continuous":
            return Path.from_continuous(TransferFunction(numerator=top, denominator=bottom, unit=unit), period_s)
        sampled = SampledTransferFunction(b=top, a=bottom, period_s=period_s)
    except CompensatorError as error:
        raise ModelError(f"{where}: {error}") from error
    return Path(sampled=sampled, unit=unit, covariance=_covariance(table, len(top) + len(bottom) - 1))


def _covariance(table: TomlTable, size: int) -> tuple[tuple[float, ...], ...] | None:
    rows = table.table.get("covariance")
    if rows is None:
        return None
    if not isinstance(rows, list) or len(rows) != size:
        raise ModelError(f"{table.where}: covariance, expected {size} rows of {size} numbers")
    return tuple(TomlTable(table.where, {"covariance": row}).numbers("covariance", length=size) for row in rows)


def _estimator(value: object, kind: str) -> Estimator:
    walk = "heat_walk_std_w" if kind == "heat" else "difference_walk_std_k"
    table = TomlTable("estimator", value if value is not None else {}, (*_ESTIMATOR, walk))
    return Estimator(
        method=table.text("method", ("kalman", "inverse")),  # type: ignore[arg-type]
        t_q_noise_std_k=table.number("t_q_noise_std_k"),
        at_noise_std_k=table.number("at_noise_std_k"),
        drive_walk_std=table.number(walk),
        at_walk_std_k=table.number("at_walk_std_k"),
    )


def _uncertainty(value: object) -> float:
    return TomlTable("uncertainty", value, ("y_std_um",)).number("y_std_um", low=0.0, high=_LARGEST_UM)


def _provenance(value: object) -> tuple[float | None, dict[str, float], dict[str, Any]]:
    """Return the calibration's error and the standard errors of its gains, which the file keeps there, and the rest."""
    rest = dict(TomlTable("provenance", value).table)
    _check_figures(rest)
    held_out, stds = rest.pop(HELD_OUT_KEY, None), rest.pop(GAIN_STD_KEY, None)
    if held_out is not None and not isinstance(held_out, float):
        rest[HELD_OUT_KEY], held_out = held_out, None
    known = isinstance(stds, dict) and all(isinstance(std, float) and 0.0 <= std < math.inf for std in stds.values())
    if stds is not None and not known:
        rest[GAIN_STD_KEY], stds = stds, None
    return held_out, stds or {}, rest


def _check_figures(table: Mapping[str, Any]) -> None:
    """Refuse a number that is none, wherever it stands: pages and summaries state these figures."""
    inside: list[tuple[str, Any]] = [("", table)]
    while inside:
        where, value = inside.pop()
        if isinstance(value, dict):
            inside += [(f"{where}.{key}".lstrip("."), one) for key, one in value.items()]
        elif isinstance(value, list):
            inside += [(f"{where}[{i}]", one) for i, one in enumerate(value)]
        elif isinstance(value, (int, float)) and not abs(value) <= sys.float_info.max:
            raise ModelError(f"provenance: {where} = {shown(value)}, expected a finite number")


def _validity(value: object) -> dict[str, tuple[float, float]]:
    table = TomlTable("validity", value, most=RANGES)
    ranges: dict[str, tuple[float, float]] = {}
    for key in table.table:
        bounds = (_COLDEST, _HOTTEST) if key.endswith("_degc") else (-_LARGEST, _LARGEST)
        low, high = table.numbers(key, *bounds, length=2)
        if low >= high:
            raise ModelError(f"validity: {key} = [{low:g}, {high:g}], expected the lower bound first")
        ranges[key] = (low, high)
    return ranges


def _effects(model_name: str, value: object, period_s: float) -> tuple[Effect, ...]:
    if not isinstance(value, list):
        raise ModelError("effect: expected a list of tables, [[effect]]")
    if len(value) > EFFECTS:
        raise ModelError(f"effect: {len(value)} effects, expected at most {EFFECTS}")
    result = []
    for i, entry in enumerate(value, start=1):
        table = TomlTable(f"effect {i}", entry)
        kind = table.text("kind")
        if kind not in kinds():
            known = ", ".join(sorted(kinds()))
            raise ModelError(f"model {model_name}: effect {i} has kind {kind!r}, expected one of: {known}")
        result.append(effect_from(kind, {key: value for key, value in table.table.items() if key != "kind"}))
    delays = sum(getattr(effect, "delay_min", 0.0) for effect in result) * 60.0 / period_s
    if delays > DELAY_SAMPLES:
        raise ModelError(f"effect: delays of {delays:.0f} samples in all, expected at most {DELAY_SAMPLES}")
    for i, effect in enumerate(result, start=1):
        try:
            EffectStream(effect, period_s / 60.0)
        except ModelError as error:
            raise ModelError(f"effect {i}: {effect.kind}: {error}") from error
    return tuple(result)


def _alternatives(value: object, names: Sequence[str], period_s: float) -> dict[str, tuple[str, Path]]:
    result = {}
    for name, entry in TomlTable("alternatives", value, most=ALTERNATIVES).table.items():
        where = f"alternatives.{name}"
        replaces = TomlTable(where, entry).text("replaces", names)
        result[name] = (replaces, _path(where, entry, period_s, ("replaces",)))
    return result
