"""Records that begin on a warm machine: effects that are not linear in a path, or that a channel schedules.

Drawn published machines (`sim_hardware.drawn_machines`) whose record begins after 6 to 12 h of work; the errors are as
in `drawn.py`, on a fresh run that begins at rest.
"""

import dataclasses
from unittest.mock import patch

import numpy as np

import compensator as tc
from sim_hardware.drawn_machines import drawing
from sim_hardware.drawn_machines.drawing import ATTEMPTS, Draw, UnfairError
from sim_hardware.drawn_machines.duty import PER_H, draw_duty
from sim_hardware.drawn_machines.plant import minutes
from sim_hardware.drawn_machines.transfer import TransferMachine
from tests.bench.drawn import free_run
from tests.bench.figures import Figure, rows, told

#: Effect of the catalogue, and how it acts.
KINDS = (("nonlinear", "share"), ("fan", "share"), ("nonlinear", "drive"), ("fan", "drive"))
SEEDS = range(60_000, 60_008)
LONGEST_H = 36.0


def begun_warm(rng, habits, hours, *, kind, use="record"):
    """Draw a duty; a record begins at rest, 6 to 12 h before its first row."""
    if use != "record":
        return draw_duty(rng, habits, hours, kind=kind, use=use)
    before = float(np.random.default_rng(int(hours * 1000) + int(habits.start_h * 1e6)).uniform(6.0, 12.0))
    duty = draw_duty(rng, habits, min(hours, LONGEST_H) + before, kind=kind, use="fresh")
    return dataclasses.replace(duty, before=duty.before + int(before * 60) * (PER_H // 60))


def acting(form):
    """Return what an effect adds in one of the forms, in place of `TransferMachine._part`."""
    own = TransferMachine._part

    def part(self, duty, habits, effect, strength, y_dtf, y_tdtf, on):
        heat, fan = minutes(duty.columns["power_w"]), minutes(duty.share("fan_rpm", habits))
        if effect == "fan":
            return strength * (fan * y_dtf if form == "share" else self.dtf(fan * heat))
        if form == "drive":
            return strength * self.dtf(heat * np.abs(heat) / 100.0)
        return own(self, duty, habits, effect, strength, y_dtf, y_tdtf, on)

    return patch.object(TransferMachine, "_part", part)


def machine(seed, effect, form, *, shop_floor, published=True):
    """Return the first fair machine of a seed."""
    with patch.object(drawing, "draw_duty", begun_warm), acting(form):
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng([0, seed, attempt])
            try:
                return Draw(rng, "transfer", effect, shop_floor=shop_floor, published=published).machine(seed)
            except UnfairError:
                continue
    raise ValueError(f"no fair machine of seed {seed}")


def report():
    """Yield a figure for each effect; every case is printed."""
    body, groups = [], {}
    for i, seed in enumerate(SEEDS):
        for k, (effect, form) in enumerate(KINDS):
            drawn = machine(seed, effect, form, shop_floor=(i + k) % 2 == 1)
            why = tc.diagnose("quill", drawn.record.columns)
            named = [effect["kind"] + " " + effect["form"] for effect in why.to_dict()["effects"]]
            places = [tuple(e[key] or "" for key in ("kind", "path", "channel")) for e in why.to_dict()["effects"]]
            quill = tc.load_model("quill")
            errors = [free_run(m, run)[0] for m, run in ((quill, drawn.healthy), (quill, drawn.fresh))]
            errors.append(free_run(why.model, drawn.fresh)[0])
            best, before, after = errors
            removed = 100.0 * (before**2 - after**2) / (before**2 - best**2)
            right = any(place in drawn.truth.places for place in places)
            groups.setdefault(effect, []).append((right and len(places) == 1, right, removed, after > 1.05 * before))
            first_k = float(np.nanmean((drawn.record.columns["t_q_degc"] - drawn.record.columns["at_degc"])[:5]))
            cells = [f"{drawn.record.hours:.0f}", f"{first_k:.1f}", f"{removed:.1f}", *(f"{e:.2f}" for e in errors)]
            body.append([f"{effect}, {form}", str(seed), " + ".join(named) or "nothing", *cells])
    head = ["effect", "seed", "found", "h", "T_Q - AT, K", "removed %", "best", "before", "after, um"]
    rows("records that begin warm", head, body)
    for effect, found in groups.items():
        alone, right, removed, worse = zip(*found, strict=True)
        text = f"named alone {sum(alone)}, at all {sum(right)} of {len(found)}; made worse {sum(worse)}; "
        text += f"removed {np.median(removed):.1f} % (median), {np.quantile(removed, 0.1):.1f} % (one in ten)"
        yield told(Figure(what=f"records that begin warm, {effect}", found=text))
