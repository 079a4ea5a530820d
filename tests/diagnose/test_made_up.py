"""What is deployed must not be worse than the base model on its own data: an effect that makes up for a source is."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import compensator as tc
from compensator.codes import ModelWarning
from compensator.data.measurement import measurements, runs_in
from compensator.diagnose.choice import deployment
from compensator.diagnose.choice.deployment import CONTRADICTS, _by_channels, _decided
from compensator.diagnose.diagnosis import _evidence
from compensator.diagnose.search import findings as module
from compensator.diagnose.search.findings import Findings, by_channels, findings_of, in_free_run
from compensator.diagnose.words.summary import verdict
from compensator.diagnose.words.warning_words import warnings_on
from sim_hardware.drawn_machines.cases import _cases
from tests.diagnose.scenarios import chosen, errors_on_another_day, held_out_errors
from tests.diagnose.test_standing import found as diagnosed

#: Seeds of machines, and the orders that `identify` finds for them: given to it, as finding them takes longest here.
ORDERS = {
    50_037: (1, 1, 1),
    170_011: (4, 4, 4),
    270_020: (4, 4, 4),
    280_006: (4, 4, 3),
    290_006: (4, 4, 4),
    300_021: (4, 4, 2),
    450_008: (4, 4, 4),
}
HEAT, SOURCE = np.sin(np.arange(400) / 30.0), np.sin(np.arange(400) / 11.0)


def drawn(family: str, seed: int) -> tuple[Any, Any]:
    """A machine and its calibrated model."""
    machine = next(c for c in _cases(seed // 1000 * 1000) if (c.family, c.seed) == (family, seed)).draw()
    return machine, tc.identify(machine.calibration.columns, order=ORDERS[seed]).model


def found_on(machine: Any, base: Any) -> Findings:
    """What a search finds in its record."""
    runs, _ = runs_in(measurements(machine.record.columns, "data", None), base.period_s)
    return findings_of(_evidence(base, runs))


def of(effects: list[tuple[str, np.ndarray]], residual: np.ndarray, *, deploys_names: bool = True) -> Any:
    """Findings with given effects, what they add, and a residual without nuisances."""
    kinds = {
        "hidden": SimpleNamespace(observed=False, deployable=False),
        "drift": SimpleNamespace(observed=True, deployable=False),
        "gain": SimpleNamespace(observed=True, deployable=True),
    }
    evidence = SimpleNamespace(
        residual=residual,
        used=np.ones(residual.size, dtype=bool),
        left=lambda added, at_rest: residual - added,
        free_paths=False,
        is_sparse=False,
        signals=[SimpleNamespace(y_dtf_um=7.0 * HEAT, y_tdtf_um=HEAT, initial_um=None)],
    )
    return SimpleNamespace(
        search=SimpleNamespace(evidence=evidence),
        terms=[SimpleNamespace(effect=kinds[kind]) for kind, _ in effects],
        responses=[added for _, added in effects],
        whole=np.sum([added for _, added in effects], axis=0),
        deploys_names=deploys_names,
    )


def test_an_effect_that_makes_up_for_a_source_is_worse_alone() -> None:
    before_um, after_um = in_free_run(of([("hidden", 20.0 * HEAT), ("gain", -19.0 * HEAT)], HEAT))
    assert before_um == pytest.approx(np.sqrt(np.mean(HEAT**2)))
    assert after_um == pytest.approx(20.0 * before_um)


def test_an_effect_beside_a_source_of_its_own_is_not() -> None:
    residual = 20.0 * SOURCE + 5.0 * HEAT
    before_um, after_um = in_free_run(of([("hidden", 20.0 * SOURCE), ("gain", 5.0 * HEAT)], residual))
    assert after_um == pytest.approx(20.0 * np.sqrt(np.mean(SOURCE**2))) and after_um < before_um


def test_a_drift_counts_neither_way() -> None:
    # With the drift in the data the effect would seem to increase the error.
    drift = -6.0 * HEAT
    before_um, after_um = in_free_run(of([("gain", 5.0 * HEAT), ("drift", drift)], 5.0 * HEAT + drift))
    assert before_um == pytest.approx(5.0 * np.sqrt(np.mean(HEAT**2))) and after_um == pytest.approx(0.0, abs=1e-12)


def test_a_remainder_in_the_place_of_effects_is_for_the_drift_too() -> None:
    found = of([("gain", 3.0 * HEAT), ("drift", -6.0 * SOURCE)], 5.0 * HEAT - 6.0 * SOURCE, deploys_names=False)
    found.whole = 5.0 * HEAT - 6.0 * SOURCE
    assert in_free_run(found)[1] == pytest.approx(0.0, abs=1e-12)


def test_where_paths_are_free_the_base_model_is_taken_as_it_is() -> None:
    # y is 9 HEAT, the base says 8 of it.
    found = of([("gain", 9.0 * HEAT)], 9.0 * HEAT)
    found.search.evidence.free_paths = True
    before_um, _ = in_free_run(found)
    assert before_um == pytest.approx(np.sqrt(np.mean(HEAT**2)))


def test_channels_that_explain_it_alone_take_the_place_of_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    # y grows with the square of the path. With a source of two switchings changed paths explain it, too; alone they
    # leave more of the record than nothing, and of another day 25 instead of 14.5 µm.
    searched = []
    once = module._findings_of

    def noted(search: Any, **asked: Any) -> Any:
        searched.append(once(search, **asked))
        return searched[-1]

    monkeypatch.setattr(module, "_findings_of", noted)
    found = found_on(*drawn("transfer", 50_037))
    first, second = searched
    assert found is second
    before_um, after_um = in_free_run(first)
    assert after_um > before_um and in_free_run(second)[1] < 0.5 * before_um
    assert any(not term.effect.observed for term in first.terms)
    assert [term.hypothesis.place for term in found.terms] == [("nonlinear", "DTF", "")]


@pytest.mark.parametrize(
    ("seed", "why"),
    [
        (280_006, "a source of its own for each switching of the heat leaves more of y"),
        (290_006, "a dead time that is too small beside it does not come back in its place"),
    ],
)
def test_a_loose_couple_is_a_gain(seed: int, why: str) -> None:
    machine, base = drawn("lumped", seed)
    assert machine.truth.effect == "loose_couple"
    assert [term.hypothesis.place for term in found_on(machine, base).terms] == [("gain", "DTF", "")], why


@pytest.fixture(scope="module")
def called_late() -> Findings:
    """A T_Q that is called late by 4 min, in 6 h: what the engine cannot foretell of it is more than the effect."""
    return found_on(*drawn("conduction", 170_011))


def test_all_channels_may_be_better_where_the_engine_is_worse_with_the_names(called_late: Findings) -> None:
    before_um, after_um = in_free_run(called_late)
    assert called_late.deploys_names and after_um > before_um
    instead = by_channels(called_late, names_are_useless=False)
    assert instead is not None and not instead.deploys_names and instead.terms == called_late.terms
    assert in_free_run(instead)[1] < 0.5 * before_um


@pytest.mark.parametrize(
    ("channels_um", "named_um", "is_confirmed"), [(0.7, 2.0, True), (0.8, 2.0, False), (0.7, 0.6, False)]
)
def test_all_channels_take_their_place_where_held_out_data_confirm_it_clearly(
    called_late: Findings,
    channels_um: float,
    named_um: float,
    is_confirmed: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(deployment, "SHORT_H", 5.0)
    ones = np.ones(called_late.ceiling.size)
    named = named_um * ones
    held_out = held_out_errors(ones, named=named, whole=named, ceiling=channels_um * ones)
    # Where an own error beside the names was confirmed in part, all of the channels are deployed.
    called_late = dataclasses.replace(called_late, confirmed=0.4)
    instead = _by_channels(_decided(called_late, (), held_out, CONTRADICTS), CONTRADICTS)
    assert (instead is not None) is is_confirmed
    if instead:
        assert instead.found.confirmed == 1.0 and not instead.found.deploys_names
        assert instead.held_out.whole[0] == channels_um


@pytest.mark.parametrize(("channels_um", "is_confirmed"), [(0.4, True), (0.5, False)])
def test_all_channels_take_the_place_of_a_late_t_q_where_they_gain_far_more(
    called_late: Findings, channels_um: float, is_confirmed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What its correction gains in time, speed and load may gain before T_Q moves."""
    monkeypatch.setattr(deployment, "SHORT_H", 5.0)
    monkeypatch.setattr(deployment, "in_free_run", lambda _: (1.0, 0.7))
    ones = np.ones(called_late.ceiling.size)
    held_out = held_out_errors(ones, named=0.6 * ones, whole=0.6 * ones, ceiling=channels_um * ones)
    assert (_by_channels(_decided(called_late, (), held_out, CONTRADICTS), CONTRADICTS) is not None) is is_confirmed


@pytest.mark.parametrize(("limit", "is_shown"), [(0.1, False), (0.6, True)])
def test_all_channels_take_the_place_of_names_that_held_out_data_refute(
    called_late: Findings, limit: float, is_shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a cause acts in each block for the first time, held-out data refute everything: free run decides."""
    monkeypatch.setattr(deployment, "SHOWS_HIDDEN", limit)
    monkeypatch.setattr(deployment, "DAY_H", 5.0)
    monkeypatch.setattr(deployment, "SHORT_H", 5.0)
    ones = np.ones(called_late.ceiling.size)
    held_out = held_out_errors(ones, named=3.0 * ones, whole=3.0 * ones, ceiling=2.0 * ones)
    decided = _decided(called_late, (), held_out, CONTRADICTS)
    assert decided.contradicted and decided.is_refused
    instead = _by_channels(decided, CONTRADICTS)
    assert (instead is not None) is is_shown
    if instead:
        assert not instead.is_refused and not instead.found.deploys_names
        # What is refused itself takes no place.
        monkeypatch.setattr(deployment, "SHORT_H", 8.0)
        assert _by_channels(decided, CONTRADICTS) is None


def test_a_name_that_no_part_of_a_record_shows_is_deployed_and_not_called_confirmed() -> None:
    """The floor in 16 h: a search without a block gives it another name, and predicts that block far worse."""
    machine, base = drawn("lumped", 270_020)
    why = tc.diagnose(base, machine.record.columns)
    assert ("input", "floor_degc") in [(effect.kind, effect.place[2]) for effect in why.effects]
    assert why.diagnosis.after.rms_um > why.diagnosis.before.rms_um and why.verdict == "partly_explained"
    assert ModelWarning.NOT_CONFIRMED in [remark.code for remark in why.diagnosis.warnings]
    before_um, after_um = errors_on_another_day(machine, base, why.model)
    assert after_um < 0.5 * before_um


def test_channels_that_show_a_source_together_make_up_for_it() -> None:
    """A source in the column: no channel shows it alone, and each of its few switchings is foretold by no other one."""
    machine, base = drawn("conduction", 450_008)
    why = tc.diagnose(base, machine.record.columns)
    assert why.verdict == "unexplained" and [effect.kind for effect in why.effects] == ["unobserved"]
    assert [effect.kind for effect in why.model.effects] == ["regression"]
    before_um, after_um = errors_on_another_day(machine, base, why.model)
    assert after_um < 0.6 * before_um
    # Held-out blocks say otherwise: so do text, warning and what the model states.
    assert why.diagnosis.after.rms_um > why.diagnosis.before.rms_um
    assert ModelWarning.NOT_CONFIRMED in [remark.code for remark in why.diagnosis.warnings]
    assert "that no channel shows by itself" in why.summary() and why.model.y_std_um > after_um


def test_it_is_said_why_nothing_is_deployed() -> None:
    [remark] = warnings_on(chosen((), left=0.5, worse_um=(0.91, 9.4)), deployed=False)
    assert remark.code == ModelWarning.WORSE_IN_FREE_RUN and "(9.40 against 0.91 µm rms)" in remark
    words = verdict(diagnosed(verdict="partly_explained", warning_codes=[str(remark.code)]))
    assert "increases the error in free run" in words and "were found" not in words


def test_paths_fitted_anew_beside_nothing_are_not_deployed() -> None:
    """Six hours of a machine whose T_Q lies; the gains of the two paths change their sign, and nothing has a name."""
    machine, base = drawn("conduction", 300_021)
    base = dataclasses.replace(base, held_out_rms_um=3.0)  # so much is far off: nothing is known of the paths
    why = tc.diagnose(base, machine.record.columns)
    assert why.verdict == "unexplained" and why.effects == ()
    assert (why.model.dtf, why.model.tdtf, why.model.effects) == (base.dtf, base.tdtf, base.effects)
    assert "paths_kept" in why.to_dict()["warning_codes"] and "fitted_anew" not in why.to_dict()["warning_codes"]
    # What the base leaves of this record is said.
    error = np.asarray(machine.record.columns["y_um"]) - tc.simulate(base, machine.record.columns)["y_pred_um"]
    assert dataclasses.replace(why.model, sha256=base.sha256) == base
    said = str(next(one for one in why.diagnosis.warnings if one.code == ModelWarning.DEVIATION_CONTRADICTED))
    assert float(said.partition("these data show ")[2].split()[0]) > 0.7 * np.nanstd(error)
