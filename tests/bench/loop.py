"""The loop of the service over machine-weeks: what it finds, adopts and returns from, and what it must not adopt.

Each machine-week of `sim_hardware.drawn_machines.weeks` is calibrated by `identify` on a run without effects (the
published ones have the published model); the range of validity is then widened to what the shop may have, because the
run lasts a day and the service holds its offset outside. Then a week of samples goes through the service's loop with
policy `adopt` and the real diagnosis in this process. The service is killed in the middle of its second diagnosis and
right after its first adoption, and continues from its last state, six hours old at most, as from a recording.

error           true displacement since the first sample, plus the published offset.
base, best      error of the calibrated model alone over the week; the same where no effect acts.
found           within 48 h of an effect's beginning a diagnosis has a right name of it among what can be deployed.
adopted         within 48 h of its beginning another model is adopted.
removed %       of the mean square that the effects add to the error from 48 h after the beginning to the effect's end:
                100 (base² − loop²) / (base² − best²); only where they add at least 5 % to the mean square there.
own %           the same without what other effects add that began less than 48 h ago: they are not due yet, and a model
                of this one removes nothing of them. What the loop has removed of them by then counts against it.
bound           removed % with the true effect, adopted in the minute in which it is shown (`loop_bound`): nothing that
                judges by the loop's measure can remove more.
fair            for at least 36 of the 48 h nothing else was wrong, or a person had not yet seen to it: no decision is
                made while a sensor is suspected.
                Errors are those of the times in which both temperatures were right, and had been for 6 h, and no probed
                feature had moved that a person had not seen to.
worse           from an adoption to the next change of the model, or to the end, the error is more than 5 % and 0.05 µm
                above that of the model before.
reproduced      a second run, which gets the recorded results of the diagnoses, makes the same decisions with the same
                figures at the same samples.

python -m tests.bench loop                              the development set, 100 weeks, some minutes each
python -m tests.bench loop --part 3/10 --out part.json  a tenth of it
python -m tests.bench loop --resume                     leaves out what is in the file
"""

import argparse
import hashlib
import json
import math
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

import compensator as tc
from compensator.api.loop_diagnosis import diagnosis_in_process
from compensator.demo.offline import probe_of, run_alone
from compensator.errors import CompensatorError
from compensator.model.model_file import parse_model
from compensator.model.model_writer import dump_model
from compensator.service.loop.run import Diagnosed, OfflineLoop
from compensator.service.loop.weighing import failed
from sim_hardware.drawn_machines.weeks import DEVELOPMENT_WEEKS, SEALED_WEEK_RUNS, SEALED_WEEKS
from tests.bench.cases import judge
from tests.bench.figures import Figure, rows, told
from tests.bench.loop_bound import Bound
from tests.bench.loop_week import MINUTE_NS, config_of, error_of, rms, samples_of, undisturbed, whole

SETS = {"development": DEVELOPMENT_WEEKS, "sealed": SEALED_WEEKS}
WITHIN_MIN, FAIR_MIN = 48 * 60, 36 * 60
#: A state is kept this often, samples: a recording begins with one and is read from there.
STATE_EVERY = 360
#: Samples that a killed service misses.
KILLED_MIN = 3
KINDS = ("zero", "loop", "diagnosis", "adopt", "plausibility")


class Killed(BaseException):
    """The service was killed."""


class Diagnoses:
    """Runs each diagnosis once: what it gave is recorded, and is read where the run comes by again."""

    def __init__(self, diagnose, *, kill_at=()):
        self.found, self.seconds = {}, 0.0
        self._diagnose, self._kill_at, self.count = diagnose, set(kill_at), 0

    def __call__(self, outcomes, model):
        key = (outcomes[-1].sample.seq, len(outcomes), hashlib.sha256(model).hexdigest()) if outcomes else None
        if key not in self.found:
            self.count += 1
            if self.count in self._kill_at:
                raise Killed
            began = time.perf_counter()
            try:
                self.found[key] = self._diagnose(outcomes, model)
            except CompensatorError as error:  # as OfflineLoop has it
                self.found[key] = failed(str(error))
            self.seconds += time.perf_counter() - began
        return self.found[key]


class Service:
    """A machine's service and loop that is killed and continues from its last state."""

    def __init__(self, config, model, diagnoses):
        self._made = lambda: OfflineLoop(config, model, diagnoses)
        self.run = self._made()
        #: Every model that was in force, by hash.
        self.steps, self.models = [], {}
        self._kept, self._state = 0, self.run.state()

    def process(self, sample, probe, is_visit):
        # No state has the result of a diagnosis that counts from the next sample on.
        if len(self.steps) - self._kept >= STATE_EVERY and self.run._found is None:
            self._kept, self._state = len(self.steps), self.run.state()
        step = advance(self.run, self.steps[-1][0].seq if self.steps else None, sample, probe, is_visit)
        self.steps.append((sample, probe, step, is_visit))
        self.models.setdefault(step.model_sha256, self.run.compensation.model)
        return step

    def restart(self):
        """Continue from the last state and what is recorded since; return whether every step came out the same."""
        self.run = self._made()
        self.run.restore(self._state)
        last = self.steps[self._kept - 1][0].seq if self._kept else None
        same = True
        for sample, probe, step, is_visit in self.steps[self._kept :]:
            again = advance(self.run, last, sample, probe, is_visit)
            same = same and seen(again) == seen(step) and again.outcome.offset == step.outcome.offset
            last = sample.seq
        return same

    @property
    def last(self):
        return self.steps[-1][2].outcome.offset if self.steps else None


def advance(run, last, sample, probe, is_visit):
    """Process a sample after the pause before it, and after a person has acknowledged a trouble."""
    if last is not None and sample.seq > last + 1:
        run.pause(sample.seq - last - 1)
    if is_visit:
        run.resume()
        run.compensation.zero("warm")
    return run.process(sample, [probe] if probe is not None else [])


def seen(step):
    """Return the events of a step as they are compared; NaN is like NaN."""
    return json.dumps([[note.kind, note.text, dict(note.data)] for note in step.events], default=str, sort_keys=True)


def looped(config, model, samples, diagnoses, *, kills=True):
    """Return the service after the week, and how many of its restarts came out the same, of how many."""
    service, restarts, killed_adoption, skip_to = Service(config, model, diagnoses), [], not kills, -1
    for sample, shown_um, is_visit in samples:
        if sample.seq < skip_to:
            continue
        probe = None
        if math.isfinite(shown_um):
            probe = probe_of(shown_um, service.last, sample.time_utc_ns - MINUTE_NS // 2)
        before = service.steps[-1][2].model_sha256 if service.steps else None
        try:
            step = service.process(sample, probe, is_visit)
        except Killed:
            restarts.append(service.restart())
            skip_to = sample.seq + KILLED_MIN
            continue
        if not killed_adoption and before not in (None, step.model_sha256):
            killed_adoption = True
            restarts.append(service.restart())
    return service, restarts


def judged(case):
    """Return the figures of a machine-week as one dict that JSON can hold, in a list."""
    began = time.perf_counter()
    result = asdict(case)
    try:
        return [result | _figures(case.draw()) | {"seconds": time.perf_counter() - began}]
    except Exception as error:  # noqa: BLE001  a week that ends in an error is a wrong one, and the others go on
        return [result | {"failed": f"{type(error).__name__}: {error}", "seconds": time.perf_counter() - began}]


def _figures(week):
    base = tc.load_model("quill") if week.published else tc.identify(week.calibration.columns).model
    base = replace(base, validity={}, sha256="")  # that of the configuration holds
    file = dump_model(base).encode()
    config = config_of(week, file)
    samples = samples_of(week, week.columns, week.true_um)
    diagnoses = Diagnoses(diagnosis_in_process(config), kill_at=(2,))
    service, restarts = looped(config, file, samples, diagnoses)
    steps = [step for _, _, step, _ in service.steps]
    again, last, same = OfflineLoop(config, file, _recorded(diagnoses)), None, True
    for sample, probe, step, is_visit in service.steps:
        same = same and seen(advance(again, last, sample, probe, is_visit)) == seen(step)
        last = sample.seq
    bound = Bound(week, config, parse_model(file, source="base"))
    errors = {
        "loop": error_of([step.outcome for step in steps], week.true_um),
        "best": bound.best,
        "bound": bound.error,
    }
    for sha, model in service.models.items():
        errors[sha] = error_of(run_alone(config, model, samples), week.true_um)
    base_sha = steps[0].model_sha256
    for error in errors.values():
        error[~whole(week)] = math.nan
    return {
        "whole": {
            "base": rms(errors[base_sha]),
            **{name: rms(errors[name]) for name in ("loop", "best", "bound")},
        },
        "troubles": [asdict(trouble) for trouble in week.troubles],
        "spells": [
            _spell(week, number, diagnoses, steps, errors, base_sha, bound) for number in range(len(week.spells))
        ],
        "changes": _changes(steps, errors),
        "diagnoses": [[key[0], one.verdict, list(one.effects), one.text] for key, one in diagnoses.found.items()],
        "events": [[s.outcome.sample.seq, n.kind, n.text] for s in steps for n in s.events if n.kind in KINDS],
        "reproduced": same,
        "restarts": restarts,
        "diagnose_s": diagnoses.seconds,
    }


def _recorded(diagnoses):
    """Return diagnoses that are only read."""
    recorded = Diagnoses(lambda *_: Diagnosed("failed", (), None, "the first run did not ask for this diagnosis"))
    recorded.found = dict(diagnoses.found)
    return recorded


def _changes(steps, errors):
    """Return each change of the model: when, to what, and how the error compares with that of the model before."""
    at = [i for i in range(1, len(steps)) if steps[i].model_sha256 != steps[i - 1].model_sha256]
    found = []
    for i, end in zip(at, [*at[1:], len(steps)][: len(at)], strict=True):
        minutes = [step.outcome.sample.seq for step in steps[i:end]]
        new, old = rms(errors["loop"][minutes]), rms(errors[steps[i - 1].model_sha256][minutes])
        first = steps[0].model_sha256
        found.append(
            {
                "minute": minutes[0],
                "hours": len(minutes) / 60.0,
                "to_calibrated": steps[i].model_sha256 == first,
                "new_um": new,
                "old_um": old,
                "worse": new > 1.05 * old and new > old + 0.05,
            }
        )
    return found


def _spell(week, number, diagnoses, steps, errors, base_sha, bound):
    spell = week.spells[number]
    begin, until = spell.from_min, spell.from_min + WITHIN_MIN
    right = {":".join(filter(None, place)) for place in spell.places}
    right |= {name.replace("TTF", "DTF") for name in right}
    # An effect of two channels, such as a flow and its temperature, is named by the first.
    named = [
        key[0]
        for key, one in diagnoses.found.items()
        if begin <= key[0] <= until and any(effect.partition("+")[0] in right for effect in one.effects)
    ]
    changed = [
        steps[i].outcome.sample.seq
        for i in range(1, len(steps))
        if steps[i].model_sha256 != steps[i - 1].model_sha256 and begin <= steps[i].outcome.sample.seq <= until
    ]
    after = slice(until, spell.to_min)
    base, loop, best, reached = (rms(errors[name][after]) for name in (base_sha, "loop", "best", "bound"))
    young = _young(week, number, bound)
    own_base, own_loop = (rms((errors[name] - young)[after]) for name in (base_sha, "loop"))

    def removed(base, left):
        added = base**2 - best**2
        return 100.0 * (base**2 - left**2) / added if spell.deployable and added > 0.05 * base**2 else None

    return asdict(spell) | {
        "shown_h": bound.shown_h[number],
        "found_h": (named[0] - begin) / 60.0 if named else None,
        "adopted_h": (changed[0] - begin) / 60.0 if changed else None,
        "fair": int(np.sum(undisturbed(week)[begin:until])) >= FAIR_MIN,
        "base_um": base,
        "loop_um": loop,
        "best_um": best,
        "bound_um": reached,
        "removed_pct": removed(base, loop),
        "own_pct": removed(own_base, own_loop),
        "bound_pct": removed(base, reached),
    }


def _young(week, number, bound):
    """Return by minute what other effects add to the error that have begun less than 48 h ago, µm."""
    found = np.zeros(week.minutes)
    for other, (spell, part) in enumerate(zip(week.spells, bound.parts, strict=True)):
        if other != number:
            due = slice(spell.from_min, spell.from_min + WITHIN_MIN)
            found[due] += part[due]
    return found


def run(cases, out, *, workers, resume=False):
    """Judge weeks in parallel, and print each."""
    results = []
    for result in judge(cases, judged, out, workers=workers, resume=resume):
        results.append(result)
        for cells in lines(result):
            sys.stdout.write(" | ".join(cells) + "\n")
        sys.stdout.flush()
    return sorted(results, key=lambda r: r["seed"])


HEAD = (
    *("machine", "effect", "days", "shown h", "found h", "adopted h", "removed %", "own %", "bound %"),
    *("base, loop, best, bound µm", "changes", "s"),
)


def lines(r):
    """Yield a week as rows of cells, one for each effect."""
    what = f"{r['family']} {r['seed']}{' probed' if r['probed'] else ''}"
    if "failed" in r:
        yield [what, r["failed"], *[""] * (len(HEAD) - 3), f"{r['seconds']:.0f}"]
        return
    changes = " ".join(
        f"{c['minute'] / 1440:.1f}{'←' if c['to_calibrated'] else '→'}{'WORSE' if c['worse'] else ''}"
        for c in r["changes"]
    )
    flags = ("" if r["reproduced"] else " NOT REPRODUCED") + ("" if all(r["restarts"]) else " RESTART DIFFERS")
    figures = ("shown_h", "found_h", "adopted_h", "removed_pct", "own_pct", "bound_pct")
    blank = {"effect": "none", "from_min": 0, "to_min": 0} | dict.fromkeys(figures)
    blank |= {"size_um": 0.0, "fair": True, "deployable": False}
    blank |= {f"{name}_um": value for name, value in r["whole"].items()}
    for spell in r["spells"] or [blank]:
        numbers = [f"{spell[key]:.0f}" if spell[key] is not None else "–" for key in figures]
        size = f"{spell['effect']} {spell['size_um']:.1f} µm" + ("" if spell["fair"] else " (unfair)")
        days = f"{spell['from_min'] / 1440:.1f}–{spell['to_min'] / 1440:.1f}"
        errors = " ".join(f"{spell[f'{name}_um']:.2f}" for name in ("base", "loop", "best", "bound"))
        yield [what, size, days, *numbers, errors, changes + flags, f"{r['seconds']:.0f}"]


def summary(results):
    """Yield the figures of the set."""
    good = [r for r in results if "failed" not in r]
    spells = [spell for r in good for spell in r["spells"] if spell["deployable"]]
    changes = [change for r in good for change in r["changes"]]
    for name, group in (("all", spells), ("sensors whole for 36 of the 48 h", [s for s in spells if s["fair"]])):
        counted, own = ([s for s in group if s[key] is not None] for key in ("removed_pct", "own_pct"))
        found = (
            f"{len(group)}: found {sum(s['found_h'] is not None for s in group)}, "
            f"model adopted {sum(s['adopted_h'] is not None for s in group)}; of {len(counted)} that add to the error "
            f"80 % removed {sum(s['removed_pct'] >= 80.0 for s in counted)}, 50 % "
            f"{sum(s['removed_pct'] >= 50.0 for s in counted)}; of the own error of {len(own)} 80 % "
            f"{sum(s['own_pct'] >= 80.0 for s in own)}; the true effect, adopted when it is shown, removes "
            f"80 % of {sum(s['bound_pct'] >= 80.0 for s in counted)}"
        )
        yield told(Figure(what=f"loop, deployable effects within 48 h, {name}", found=found, wanted="90 %"))
    adoptions = [c for c in changes if not c["to_calibrated"]]
    found = (
        f"{len(adoptions)} in {len(good)} weeks, {len(changes) - len(adoptions)} back to the calibrated model; "
        f"{sum(c['worse'] for c in changes)} made it worse by more than 5 %"
    )
    yield told(Figure(what="loop, adoptions", found=found, wanted="none worse"))
    restarts = [same for r in good for same in r["restarts"]]
    found = (
        f"{sum(r['reproduced'] for r in good)} of {len(good)} weeks; {sum(restarts)} of {len(restarts)} restarts after "
        f"a kill; failed {len(results) - len(good)}"
    )
    yield told(Figure(what="loop, decisions reproduced", found=found, wanted="all"))


def report(cases=DEVELOPMENT_WEEKS, out=Path("loop-development.json"), *, workers=None, resume=True):
    """Yield the figures; every week is printed."""
    results = run(cases, out, workers=workers, resume=resume)
    rows("machine-weeks, one by one", HEAD, [cells for r in results for cells in lines(r)])
    yield from summary(results)


def main(words):
    """Run what the options say."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench loop", description=__doc__.splitlines()[0])
    parser.add_argument("--set", choices=SETS, default="development")
    parser.add_argument("--part", default="1/1", help="such as 3/10: the third tenth")
    parser.add_argument("--seed", type=int, help="only this week of the development set")
    parser.add_argument("--out", type=Path, help="JSON with what is known so far; loop-SET.json")
    parser.add_argument("--resume", action="store_true", help="leave out what is in that file")
    parser.add_argument("--workers", type=int)
    asked = parser.parse_args(words)
    part, parts = (int(word) for word in asked.part.split("/"))
    cases = [case for case in SETS[asked.set] if asked.seed in (None, case.seed)][part - 1 :: parts]
    if asked.set == "sealed":
        if asked.seed is not None:
            parser.error("no single week of the sealed set is run")
        seeds = [case.seed for case in cases]
        for run_before, when in SEALED_WEEK_RUNS:
            if set(run_before) & set(seeds):
                parser.error(f"some of these sealed weeks have been run: {when}")
        sys.stdout.write(f"Enter {seeds} in SEALED_WEEK_RUNS of sim_hardware/drawn_machines/weeks.py.\n")
    out = asked.out or Path(f"loop-{asked.set}.json")
    list(report(cases, out, workers=asked.workers, resume=asked.resume))
