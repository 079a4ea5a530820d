"""The machine as a shop runs it: hourly probes through the real service help, a chip does not; the demo shows both."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from compensator.clock import NS
from compensator.codes import ProbeCode
from compensator.config import load_config
from compensator.demo.day import START_NS, Day, Running, run_day
from compensator.demo.figures import shop_day
from compensator.demo.machine import TOUCH_STD_UM
from compensator.demo.shop import CHIP_UM, LOOK_AFTER_S, HourlyProbes, SentProbe, run_shop_day
from compensator.messages import Offset, number
from compensator.recording.reading import messages, recordings
from compensator.report.page import Page, html_of
from compensator.report.shop import ShopDay, probe_words, shop_section, shop_table
from sim_hardware.physics.effects.mechanical import SizeDependent
from tests.demo.made import SHOP_DAY

HOURS, SEED = 5.0, 3
CASES = ("without", "probe", "model", "model_and_probe")


class NotAtTheChip(HourlyProbes):
    """Does not probe while the chip lies on the feature, nor four minutes later."""

    async def _probe(self, t_s: float, running: Running, offset: Offset, chip_um: float, why: str) -> None:
        if chip_um:
            self._rng.normal()
        else:
            await super()._probe(t_s, running, offset, chip_um, why)


class Made(NamedTuple):
    folder: Path
    alone: Day
    probed: Day
    without_chip: Day
    sent: list[SentProbe]
    shown: ShopDay


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The published machine, whose strength depends on its size as its model does not know."""
    folder = tmp_path_factory.mktemp("shop")
    effect = SizeDependent(per_100_um=0.15)
    alone = run_day(folder / "alone", machine="published", hours=HOURS, seed=SEED, effects=[effect])
    probed_day, sent = run_shop_day(
        folder / "shop", machine="published", hours=HOURS, seed=SEED, model="quill", effects=[effect]
    )
    without_chip = run_day(
        folder / "without-chip",
        machine="published",
        hours=HOURS,
        seed=SEED,
        effects=[effect],
        probe=NotAtTheChip(hours=HOURS, seed=SEED).visit,
    )
    return Made(folder, alone, probed_day, without_chip, sent, shop_day(alone, probed_day, sent))


def offsets(day: Day) -> np.ndarray:
    return np.array([number(outcome.offset.y_offset_um) for outcome in day.outcomes])


def test_model_and_probe_leave_the_least_and_probe_alone_more_than_the_model(made: Made) -> None:
    rms = [made.shown.figures[name]["rms_um"] for name in CASES]
    assert rms == sorted(rms, reverse=True)
    assert rms[3] < 0.7 * rms[2] and rms[1] > 2.0 * rms[2]
    # The figures are those of the curves.
    assert rms == pytest.approx([np.sqrt(np.mean(made.shown.errors[name] ** 2)) for name in CASES])


def test_only_the_probes_tell_the_two_days_apart(made: Made) -> None:
    """Same machine, same noise of the temperatures, and no displacement sensor where it is probed."""
    assert np.array_equal(made.alone.truth["y_um"], made.probed.truth["y_um"])
    first = int((made.sent[0].time_utc_ns - START_NS) / NS // 60)
    assert np.array_equal(offsets(made.alone)[:first], offsets(made.probed)[:first])
    assert not np.array_equal(offsets(made.alone)[first:], offsets(made.probed)[first:])
    assert all("y_um" not in outcome.sample.channels for outcome in made.probed.outcomes)
    settings = load_config(made.folder / "shop" / "config.toml").config
    assert settings.probe is not None and settings.probe.std_um == TOUCH_STD_UM
    assert load_config(made.folder / "alone" / "config.toml").config.probe is None


def test_probes_go_through_the_service_and_are_in_its_recording(made: Made) -> None:
    recorded = [
        probe
        for path in recordings(made.folder / "shop" / "recordings", "sim-published")
        for probe in messages(path, ("probe",))
    ]
    assert [probe.time_utc_ns for probe in recorded] == [probe.time_utc_ns for probe in made.sent]
    assert [probe.code for probe in recorded] == ["", "", ProbeCode.OUTLIER, "", ""]
    # What a probe shows is the truth of that moment, with the noise of the probe.
    t, y = made.probed.truth["t_s"], made.probed.truth["y_um"]
    when = [np.searchsorted(t, (probe.time_utc_ns - START_NS) / NS) for probe in recorded]
    noise = np.array([number(p.deformation_um) - s.chip_um for p, s in zip(recorded, made.sent, strict=True)])
    noise -= y[when] - y[np.searchsorted(t, 60.0)]
    assert 0.1 * TOUCH_STD_UM < np.std(noise) < 2.0 * TOUCH_STD_UM and np.abs(noise).max() < 4.0 * TOUCH_STD_UM


def test_the_chip_is_refused_another_probe_is_asked_for_and_the_offset_stays(made: Made) -> None:
    chip = next(i for i, probe in enumerate(made.sent) if probe.chip_um)
    again = made.sent[chip + 1]
    assert made.sent[chip].chip_um == CHIP_UM and again.asked_because == ProbeCode.OUTLIER
    assert again.time_utc_ns - made.sent[chip].time_utc_ns == LOOK_AFTER_S * NS
    assert [probe.asked_because for probe in made.sent].count("") == len(made.sent) - 1
    # Until that, the offsets are those of a day on which nobody probed at the chip.
    first, last = ((one.time_utc_ns - START_NS) // (60 * NS) for one in (made.sent[chip], again))
    assert np.array_equal(offsets(made.probed)[:first], offsets(made.without_chip)[:first])
    assert np.abs(offsets(made.probed) - offsets(made.without_chip))[first:last].max() < 0.3


def test_probe_alone_holds_what_the_last_probe_showed(made: Made) -> None:
    errors, probes = made.shown.errors, made.shown.figures["probes"]
    held = errors["without"] - errors["probe"]
    t = errors["t_h"]
    assert not held[t < probes[0]["time_h"]].any()
    for probe, until in zip(probes, [*(later["time_h"] for later in probes[1:]), HOURS], strict=True):
        assert np.ptp(held[(t > probe["time_h"] + 1e-6) & (t < until - 1e-6)]) < 1e-9
    assert len(set(np.round(held, 9))) == 1 + len(probes)


def test_table_and_words(made: Made) -> None:
    table = shop_table(made.shown).text()
    for name in CASES:
        figures = made.shown.figures[name]
        assert re.search(rf"{figures['rms_um']:.2f} +{figures['peak_to_peak_um']:.2f}", table)
    words = probe_words(made.shown).text().splitlines()
    assert words[1] == "- 5 probes with a noise of 1.5 µm; 1 refused."
    assert words[2].startswith("- 3.01 h: a chip of 20 µm lay on the feature; probe refused")
    assert words[2].endswith("[probe_outlier]")
    assert words[3].startswith("- 3.08 h: asked for by the service [probe_outlier]; probe taken")
    assert len(words) == 4


def test_a_chip_that_was_taken_is_not_passed_over() -> None:
    probes = [{**probe, "taken": True, "code": "", "text": "probe taken"} for probe in SHOP_DAY.figures["probes"]]
    words = probe_words(ShopDay(figures={**SHOP_DAY.figures, "probes": probes}, errors=SHOP_DAY.errors)).text()
    assert "; 0 refused." in words and "2.00 h: a chip of 20 µm lay on the feature; probe taken" in words


def test_the_page_shows_curves_probes_and_table() -> None:
    page = html_of(Page(title="demo", verdict="", blocks=[shop_section(SHOP_DAY)]))
    for words in ("no compensation", "probe alone, last value held", "model alone", "model and probe"):
        assert page.count(words) >= 2  # in a figure and in the table
    assert "probe taken" in page and "probe refused" in page and "a chip of 20 µm" in page


def test_a_day_shorter_than_an_hour_has_no_probe(tmp_path: Path) -> None:
    day, sent = run_shop_day(tmp_path, machine="published", hours=0.2, seed=SEED, model="quill", effects=[])
    shown = shop_day(day, day, sent)
    assert sent == [] and shown.figures["probes"] == []
    assert np.array_equal(shown.errors["probe"], shown.errors["without"])
    page = html_of(Page(title="demo", verdict="", blocks=[shop_section(shown)]))
    assert "0 probes with a noise of 1.5 µm; 0 refused." in page and "probe taken" not in page
