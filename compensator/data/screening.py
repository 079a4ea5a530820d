"""Refuses data from which no model can be made, with the reason in one line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compensator.arrays import Vector, stretches_of
from compensator.data.runs import Run, is_noise, noise_std
from compensator.errors import DataError, UsageError

#: Shortest data for a fit, min.
SHORTEST_MIN = 120.0
#: Fewest values of a deformation that was measured now and then.
LEAST_VALUES = 30
#: With fewer values no noise can be computed at all.
FEW_VALUES = 8
#: Share of samples of a column that may be missing.
MISSING_SHARE = 0.5
#: Air in a shop above this is °F, kelvin or a wrong scale, °C.
HOTTEST_AIR_DEGC = 50.0
#: Range of a machine's temperatures, °C.
MACHINE_DEGC = (-30.0, 150.0)
#: Range of a spindle's deformation, peak to peak, µm.
DEFORMATION_UM = (0.5, 3000.0)
#: Range of a machine's temperatures in kelvin.
KELVIN = (250.0, 420.0)
#: Range of what can be a temperature at all, °C.
POSSIBLE_DEGC = (-273.15, 1500.0)
#: Shortest constant stretch of a dead sensor that is noisy otherwise, samples.
DEAD_SAMPLES = 60
#: Largest standard deviation of one measured Y, µm.
LARGEST_STD_UM = 1e6
#: Outside the stretch: share of steps at which its noise reverses, and share of steps of zero.
LIVELY_TURNS, LIVELY_STILL = 0.08, 0.05
#: Correlation of T_Q − AT with the heat below which the two are exchanged.
EXCHANGED_CORRELATION = -0.3
#: K per W of a spindle at rest; far outside, the unit is wrong.
HEAT_K_PER_W = (0.0005, 20.0)


def screen(name: str, runs: Sequence[Run], period_s: float, *, needs_heat: bool) -> None:
    """Refuse bad data.

    Parameters
    ----------
    name : str
        File or files, for the message.
    runs : sequence of Run
        The data.
    period_s : float
        Sample period, s.
    needs_heat : bool
        Whether known heat is needed for a TTF.

    Raises
    ------
    DataError
        If it is too short, a sensor is dead or missing, an input never changes, or a unit is wrong.
    """
    minutes = sum(run.t_s.size for run in runs) * period_s / 60.0
    if minutes < SHORTEST_MIN:
        raise DataError(
            f"{name}: {minutes:.0f} min of complete samples, expected at least {SHORTEST_MIN:.0f} min "
            "(and better three times the slowest time constant)"
        )
    screen_temperatures(name, runs)
    for run in runs:
        _check_alive(run, "y_um", run.y_um)
    require_y_noise(name, runs)
    _check_deformation(name, runs)
    if needs_heat:
        _check_heat(name, runs)


def require_y_noise(name: str, runs: Sequence[Run]) -> None:
    """Refuse a deformation that was measured now and then, if the noise of one value is not stated.

    Parameters
    ----------
    name : str
        File or files, for the message.
    runs : sequence of Run
        The data.

    Raises
    ------
    DataError
        Asking for it in one line.
    """
    counts = {id(run): int(np.isfinite(run.y_um).sum()) for run in runs}
    # A few values beside a run that shows the noise do no harm.
    few = max(counts.values(), default=0) < FEW_VALUES
    for run in runs:
        count = counts[id(run)]
        if count and run.y_std_um is None and run.has_sparse_y and (few or count >= FEW_VALUES):
            raise DataError(y_noise_needed(name, count, run.t_s.size))


def y_noise_needed(name: str, count: int, of: int) -> str:
    """Return the question for the noise of a deformation of so many values, whose noise does not show."""
    return (
        f"{name}: y_um has {count} value(s) in {of} samples, so its noise does not show; expected "
        "--y-std UM (y_std_um in Python), the standard deviation of one measured value, such as 1.5"
    )


def check_y_std(y_std_um: float | None) -> None:
    """Refuse a standard deviation of one measured Y that is none, µm.

    Raises
    ------
    UsageError
        If it is given and no number above 0, or so large that it says nothing.
    """
    if y_std_um is None:
        return
    is_number = isinstance(y_std_um, (int, float, np.number)) and not isinstance(y_std_um, bool)
    if not is_number or not 0.0 < y_std_um <= LARGEST_STD_UM:
        shown = f"{y_std_um:g}" if is_number else repr(y_std_um)
        raise UsageError(
            f"--y-std {shown} (y_std_um in Python): expected the standard deviation of one measured Y, a number above "
            f"0 and at most {LARGEST_STD_UM:g} µm"
        )


def screen_temperatures(name: str, runs: Sequence[Run], *, quiet_air: bool = False) -> None:
    """Refuse temperatures that cannot be true.

    Parameters
    ----------
    name : str
        File or files, for the message.
    runs : sequence of Run
        The data.
    quiet_air : bool
        Whether a constant ambient is accepted: nothing is fitted to it.

    Raises
    ------
    DataError
        If a sensor is dead or given twice, values are codes of faults, or a unit is wrong.
    """
    columns = {"t_q_degc": [run.t_q_degc for run in runs], "at_degc": [run.at_degc for run in runs]}
    for column, parts in columns.items():
        for run, values in zip(runs, parts, strict=True):
            _check_possible(run, column, values)
        _check_temperature(name, column, _joined(parts), still=quiet_air and column == "at_degc")
        for run, values in zip(runs, parts, strict=True):
            _check_alive(run, column, values)
    _check_pair(name, _joined(columns["t_q_degc"]), _joined(columns["at_degc"]))


def check_scale(name: str, column: str, values: Vector) -> None:
    """Refuse temperatures in kelvin, and codes of faults among temperatures.

    Parameters
    ----------
    name, column : str
        File and column, for the message.
    values : numpy.ndarray
        °C; NaN where missing.

    Raises
    ------
    DataError
        If all values look like kelvin, or one is below absolute zero.
    """
    known = values[~np.isnan(values)]
    if known.size and known.min() >= KELVIN[0] and known.max() <= KELVIN[1]:
        raise DataError(f"{name}: {column} runs from {known.min():.1f} to {known.max():.1f}: kelvin? expected °C")
    if known.size and known.min() < POSSIBLE_DEGC[0]:
        count = int(np.sum(known < POSSIBLE_DEGC[0]))
        raise DataError(
            f"{name}: {column} = {known.min():g}, {count} sample(s) like it: a fault's code? expected °C, "
            "and an empty cell where a value is missing"
        )


def _check_possible(run: Run, column: str, values: Vector) -> None:
    """Refuse codes of faults, such as −9999, among temperatures."""
    low, high = POSSIBLE_DEGC
    wrong = (values < low) | (values > high)
    if wrong.any() and wrong.mean() < MISSING_SHARE:
        at = int(np.argmax(wrong))
        raise DataError(
            f"{run.name}: {column} = {values[at]:g} at t_s = {run.t_s[at]:g}, {int(wrong.sum())} sample(s) like it: a "
            "fault's code? expected °C, and an empty cell where a value is missing"
        )


def dead_part(values: Vector) -> slice | None:
    """Return the longest stretch of a sensor that is noisy and then constant for an hour or more; None without one."""
    steps = np.diff(values)
    first, last = max(stretches_of(steps == 0.0), key=lambda one: one[1] - one[0], default=(0, 0))
    if first == last:
        return None
    others = np.concatenate((steps[:first], steps[last:]))
    others = others[np.isfinite(others)]
    # Computed data is constant at rest before its start.
    if first == 0 or last - first < DEAD_SAMPLES or others.size < DEAD_SAMPLES:
        return None
    turns = float(np.mean(others[1:] * others[:-1] < 0.0))
    is_noisy = turns > LIVELY_TURNS and float(np.mean(others == 0.0)) < LIVELY_STILL
    return slice(first, last + 1) if is_noisy else None


def _check_alive(run: Run, column: str, values: Vector) -> None:
    """Refuse a dead sensor."""
    dead = dead_part(values)
    if dead is not None:
        t_s = run.t_s[dead]
        raise DataError(
            f"{run.name}: {column} = {values[dead.start]:g} in every sample from t_s = {t_s[0]:g} to "
            f"{t_s[-1]:g}, and noisy otherwise: a dead sensor? leave its cells empty there"
        )


def _joined(parts: object) -> Vector:
    return np.concatenate([np.asarray(part) for part in parts])  # type: ignore[attr-defined]


def _check_temperature(name: str, column: str, values: Vector, *, still: bool) -> None:
    middle = float(np.median(values))
    if np.ptp(values) == 0.0 and not still:
        raise DataError(
            f"{name}: {column} = {middle:g} in every row: a dead sensor, or a column of another meaning; expected a "
            f"temperature that moves. Name the right one with --column {column}=NAME"
        )
    low, high = float(values.min()), float(values.max())
    air = column == "at_degc"
    check_scale(name, column, values)
    if high - low > 2000.0 or abs(middle) > 1000.0:
        raise DataError(f"{name}: {column} runs from {low:g} to {high:g}: thousandths of a degree? expected °C")
    if air and middle > HOTTEST_AIR_DEGC:
        raise DataError(
            f"{name}: {column} is {middle:.1f} in the middle: °F (that would be {(middle - 32) / 1.8:.1f} °C)? "
            "expected an ambient in °C"
        )
    if air and 0.0 < np.ptp(values) < 0.2 and abs(middle) < 0.2:
        raise DataError(f"{name}: {column} is {middle:.4g} in the middle: thousands of degrees? expected °C")
    if not MACHINE_DEGC[0] <= middle <= MACHINE_DEGC[1]:
        raise DataError(
            f"{name}: {column} is {middle:.1f} in the middle, expected °C from {MACHINE_DEGC[0]:g} to "
            f"{MACHINE_DEGC[1]:g}"
        )


def _check_pair(name: str, t_q: Vector, at: Vector) -> None:
    """Refuse a pair in different units: at rest both are within a few kelvin of each other."""
    coldest = float(np.quantile(t_q - at, 0.02))
    as_celsius = float(np.quantile((t_q - 32.0) / 1.8 - at, 0.02))
    if coldest > 25.0 and abs(as_celsius) < 10.0:
        raise DataError(
            f"{name}: t_q_degc never comes closer than {coldest:.0f} K to at_degc: t_q_degc in °F? expected °C"
        )
    if abs(float(np.median(t_q))) < 0.2 and abs(float(np.median(at))) > 2.0:
        raise DataError(
            f"{name}: t_q_degc is {np.median(t_q):.4g} in the middle, at_degc {np.median(at):.4g}: "
            "thousands of degrees? expected °C"
        )
    if np.allclose(t_q, at):
        raise DataError(f"{name}: t_q_degc and at_degc are the same in every row, expected two sensors")


def _check_deformation(name: str, runs: Sequence[Run]) -> None:
    y = _joined(run.y_um for run in runs)
    known, sparse = y[~np.isnan(y)], any(run.has_sparse_y for run in runs)
    if sparse and known.size < LEAST_VALUES:
        raise DataError(f"{name}: y_um has {known.size} values, expected at least {LEAST_VALUES} for a model")
    # Of a log whose rows are further apart than the samples every row counts.
    apart = float(np.median(np.diff(np.flatnonzero(~np.isnan(y))))) if known.size > 1 else 1.0
    if not sparse and known.size * apart < (1.0 - MISSING_SHARE) * y.size:
        raise DataError(f"{name}: y_um is missing in {y.size - known.size} of {y.size} samples, expected at least half")
    check_deformation_scale(name, known)
    stated = runs[0].y_std_um
    if is_noise(known, stated):
        raise DataError(
            f"{name}: y_um moves by {np.ptp(known):.3g} µm and its noise alone is "
            f"{noise_std(known) if stated is None else stated:.2g} µm: no deformation in it to make a model from"
        )


def check_deformation_scale(name: str, values: Vector) -> None:
    """Refuse a deformation that never moves, and one in another unit.

    Parameters
    ----------
    name : str
        File or files, for the message.
    values : numpy.ndarray
        µm; NaN where missing.

    Raises
    ------
    DataError
        If all values are the same, or move by so little or so much that they are no µm.
    """
    known = values[~np.isnan(values)]
    if known.size <= 1:
        return  # too few values say that themselves
    spread = float(np.ptp(known))
    if spread == 0.0:
        raise DataError(f"{name}: y_um = {known[0]:g} in every row: a dead probe, or a column of another meaning")
    low, high = DEFORMATION_UM
    if spread < low:
        raise DataError(
            f"{name}: y_um moves by {spread:.3g} in all: millimetres? expected µm, at least {low:g} of them"
        )
    if spread > high:
        raise DataError(f"{name}: y_um moves by {spread:.4g} in all: nanometres? expected µm, at most {high:g} of them")


def _check_heat(name: str, runs: Sequence[Run]) -> None:
    heats = [run.heat_w for run in runs if run.heat_w is not None]
    if not heats:
        raise DataError(f"{name}: no column heat_w; without it only a direct model can be made (--kind direct)")
    heat = np.concatenate(heats)
    if np.ptp(heat) == 0.0:
        raise DataError(f"{name}: heat_w = {heat[0]:g} in every row, expected at least one step of the heat")
    difference = np.concatenate([run.difference_k for run in runs if run.heat_w is not None])
    ratio = float(np.ptp(difference) / np.ptp(heat))
    low, high = HEAT_K_PER_W
    if ratio > high:
        raise DataError(
            f"{name}: heat_w spans {np.ptp(heat):.3g} while T_Q - AT spans {np.ptp(difference):.3g} K: "
            "kilowatts? expected W"
        )
    if ratio < low:
        raise DataError(
            f"{name}: heat_w spans {np.ptp(heat):.4g} while T_Q - AT spans {np.ptp(difference):.3g} K: "
            "milliwatts? expected W"
        )
    if np.ptp(difference) > 0.0 and float(np.corrcoef(difference, heat)[0, 1]) < EXCHANGED_CORRELATION:
        raise DataError(
            f"{name}: T_Q - AT falls while heat_w rises: T_Q and AT exchanged? expected T_Q near the heat "
            "source; --column t_q_degc=at_degc --column at_degc=t_q_degc exchanges them"
        )
    if is_noise(difference):
        raise DataError(
            f"{name}: T_Q - AT moves by {np.ptp(difference):.2g} K while the heat changes by "
            f"{np.ptp(heat):.3g} W: is t_q_degc near the heat source?"
        )
