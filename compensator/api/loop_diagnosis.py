"""The diagnosis of the loop: from a record that may be used to a candidate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from compensator.api.diagnosis import DiagnosisResult, diagnose
from compensator.arrays import Vector
from compensator.clock import NS
from compensator.codes import ModelWarning
from compensator.config import Config
from compensator.data.frames import hash_of
from compensator.data.measurement import Measurement, Origin
from compensator.data.table import Table
from compensator.diagnose.choice.deployment import SHORT_H
from compensator.diagnose.choice.onset import WELL_EXPLAINED, left_part
from compensator.diagnose.residual.change import changed_at
from compensator.errors import CompensatorError, DataError
from compensator.model.effects.names import name_of
from compensator.model.model_file import parse_model
from compensator.model.model_writer import dump_model
from compensator.model.thermal_model import ThermalModel
from compensator.service.loop.record import is_probed, usable_table
from compensator.service.loop.weighing import Diagnosed
from compensator.service.outcome import Outcome

#: Effects by which measured Y moves by itself: it goes on, or happened once.
_DRIFT, _STEP = "drift", "step"

#: An end must leave less than this part of what a longer part does.
END_IS_BETTER = 0.7


def diagnosis_in_process(config: Config) -> Callable[[Sequence[Outcome], bytes], Diagnosed]:
    """Return the function by which an `OfflineLoop` of this machine diagnoses in its own process."""
    return partial(diagnosis_of_record, probe_std_um=config.probe.std_um if config.probe is not None else None)


def diagnosis_of_record(record: Sequence[Outcome], model: bytes, *, probe_std_um: float | None = None) -> Diagnosed:
    """Return what a diagnosis of a record gives; stands in for the process of the service.

    Parameters
    ----------
    record : sequence of Outcome
        Outcomes of the service in the time that is diagnosed.
    model : bytes
        File of the calibrated model.
    probe_std_um : float, optional
        Standard deviation of one probe, µm.

    Raises
    ------
    CompensatorError
        If there is too little data.
    """
    return summarised(*diagnoses_of_table(usable_table(record), model, probe_std_um=probe_std_um), model)


def diagnoses_of_table(table: Table, model: bytes, *, probe_std_um: float | None = None) -> tuple[Part, Part]:
    """Diagnose a table of `service.loop.record`: all of it, and ends of it if they explain themselves better.

    An effect that began or ended within the record explains no whole of it. Where a part is not explained well, its end
    is diagnosed, too: what is after the change of its residual, or its second half where none shows; and so on until an
    end is explained or is too short.

    Returns
    -------
    Part, Part
        The diagnosis to go by, and that of the whole.

    Raises
    ------
    CompensatorError
        If there is too little data.
    """
    base = parse_model(model, source="calibrated model")
    whole = best = last = Part.of(table, base, probe_std_um)
    while last.left > WELL_EXPLAINED:
        from_s = last.ends_from_s()
        end = _end_of(last.table, from_s)
        if end is None:
            break
        try:
            last = Part.of(end, base, probe_std_um)
        except CompensatorError:  # too little measured Y in so short an end
            break
        if last.found.diagnosis.shows_nothing:
            # An end in which little moves shows no effect either: it has ended only if the model is better without it.
            best = best if best.holds_after(from_s) else last
        elif last.left < END_IS_BETTER * best.left:
            best = last
    return best, whole


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a record, and what its diagnosis found.

    Parameters
    ----------
    table : Table
        The part; the time counts from 1970.
    found : DiagnosisResult
        Its diagnosis.
    left : float
        Which part of its error on held-out data that leaves.
    """

    table: Table
    found: DiagnosisResult
    left: float

    @classmethod
    def of(cls, table: Table, base: ThermalModel, probe_std_um: float | None) -> Part:
        """Diagnose a part."""
        found = _diagnosed(table, base, probe_std_um)
        return cls(table, found, left_part(found.diagnosis))

    def ends_from_s(self) -> float:
        """Return from when on its end is diagnosed, too, s."""
        diagnosis = self.found.diagnosis
        changed_s = changed_at(self._times_s, diagnosis.residual_before, diagnosis.noise_floor_um)
        middle_s = float(self.table.t_s.min() + self.table.t_s.max()) / 2.0
        return changed_s if changed_s is not None else middle_s

    def holds_after(self, from_s: float) -> bool:
        """Return whether what can be deployed makes the residual after a time smaller."""
        if not math.isfinite(self.left):
            return False
        diagnosis, after = self.found.diagnosis, self._times_s >= from_s
        left_um, before_um = diagnosis.residual_after[after], diagnosis.residual_before[after]
        return bool(np.nanstd(left_um) < np.nanstd(before_um))

    @property
    def y_moved_s(self) -> float:
        """When measured Y last moved by itself, s since 1970; 0 if it has not. A drift goes on to the end."""
        # A step counts from the first sample with T_Q and AT, which may be after the first row.
        begin_s, times_s = float(self._times_s[0]), [0.0]
        for effect in self.found.effects:
            if effect.kind == _DRIFT:
                times_s.append(float(self.table.t_s.max()))
            elif effect.kind == _STEP:
                times_s.append(begin_s + 60.0 * effect.named["at_min"])
        return max(times_s)

    @property
    def _times_s(self) -> Vector:
        """Times of the residuals of the diagnosis, s, as in the table."""
        runs = self.found.diagnosis.evidence.runs
        return np.asarray(self.table.t_s.min() + np.concatenate([run.t_s for run in runs]))


def _end_of(table: Table, from_s: float) -> Table | None:
    """Return the end of a table, not too short to be deployed from; None if it is all of it."""
    kept = table.t_s >= min(from_s, table.t_s.max() - 3600.0 * SHORT_H)
    columns = {name: values[kept] for name, values in table.columns.items()}
    if kept.all():
        return None
    return replace(table, t_s=table.t_s[kept], columns=columns, rows=range(2, int(kept.sum()) + 2))


def _diagnosed(table: Table, base: ThermalModel, probe_std_um: float | None) -> DiagnosisResult:
    if not np.isfinite(table.columns["y_um"]).any():
        raise DataError(f"{table.name}: no measured Y that may be used")
    columns = {name: values for name, values in table.columns.items() if np.isfinite(values).any()}
    table = replace(table, columns=columns)
    origin = Origin(name=table.name, sha256=hash_of(table), size=(table.t_s.size, tuple(table.columns)))
    measured = Measurement(table=table, label=table.name, origins=(origin,))
    y_std_um = probe_std_um if is_probed(table) else None
    # Of other paths a person decides: the loop only adds effects to the calibrated ones.
    found = diagnose(base, [measured], y_std_um=y_std_um, keep_paths=True, all_data=True)
    assert isinstance(found, DiagnosisResult)  # a base is of one axis
    return found


def summarised(part: Part, whole: Part, model: bytes) -> Diagnosed:
    """Return the result of a diagnosis of a model as the loop needs it; what a person has to do also by the whole."""
    found = part.found
    base = parse_model(model, source="calibrated model")
    effects = tuple(name_of(effect) for effect in found.model.effects[len(base.effects) :])
    text = f"diagnosis: {found.verdict}, {', '.join(effects) or 'nothing to deploy'}"
    before, after = found.diagnosis.before.rms_um, found.diagnosis.after.rms_um
    text += f"; held-out error {before:.2f} µm rms before, {after:.2f} after"
    extended = dump_model(found.model).encode() if effects else None
    # Where an effect begins within the record the whole of it may take that for a step; its end, explained, does not.
    go_by = (part,) if found.verdict == "explained" else (part, whole)
    y_moved_utc_ns = round(max(one.y_moved_s for one in go_by) * NS)
    return Diagnosed(found.verdict, effects, extended, text, _needs(found) or _needs(whole.found), y_moved_utc_ns)


def _needs(found: DiagnosisResult) -> str:
    """Return what a person has to do: effects that cannot be compensated, a poor calibration, a missing sensor."""
    left = [one for one in found.effects if not (one.deployable or one.replaced or one.is_refused)]
    needs = [f"{effect.kind}: {effect.explanation}" for effect in left]
    needs += [one for one in found.diagnosis.warnings if one.code == ModelWarning.PATHS_KEPT]
    advice = found.diagnosis.advice
    return " ".join([*needs, *([advice.sensor] if advice is not None and advice.sensor else [])])
