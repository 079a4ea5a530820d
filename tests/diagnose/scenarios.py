"""Runs of the published machine with an undeclared effect, drawn by a seed, by arithmetic of their own."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from scipy.signal import lfilter

import compensator as tc
from compensator.diagnose.choice.deployment import Deployment
from compensator.diagnose.choice.held_out import HeldOut
from sim_hardware.physics import Duty
from sim_hardware.physics.published import DEFORMATION_POLES, DTF, TDTF, TTF, TTF_POLES, tustin

NAMES = ("coolant_degc", "coolant_flow_lpm", "spindle_rpm", "fan_rpm", "cabinet_degc", "hydraulic_bar")
KINDS = (
    "none",
    "input",
    "input square",
    "input delay",
    "gain DTF",
    "gain TDTF",
    "missing mode",
    "mistimed",
    "late path",
    "late sensor",
    "nonlinear",
    "scheduled",
    "play",
    "drift",
    "step",
    "periodic",
    "unobserved",
)


@dataclass
class Scenario:
    """What was drawn: the place that must be named, and how it acts on a day's signals."""

    place: tuple
    act: object
    sensor: object = None


def day(seed, hours):
    """Inputs of a working day at 60 s."""
    duty = Duty.working_day(seed, hours=hours)
    n = int(hours * 60)
    columns = {name: np.asarray(values)[: n * 6].reshape(n, 6).mean(axis=1) for name, values in duty.columns.items()}
    return n, columns


def lag(u, tau):
    """Exact first-order lag for an input that is held."""
    keep = np.exp(-1.0 / tau)
    return lfilter([0.0, 1.0 - keep], [1.0, -keep], u - u[0])


def signals(seed, hours):
    n, columns = day(seed, hours)
    heat, ambient = columns["heat_w"], columns["ambient_degc"] - columns["ambient_degc"][0]
    y_dtf = lfilter(*tustin(DTF, DEFORMATION_POLES), heat)
    y_tdtf = lfilter(*tustin(TDTF, DEFORMATION_POLES), ambient)
    return n, columns, heat, ambient, y_dtf, y_tdtf, lfilter(*tustin(TTF, TTF_POLES), heat)


def mistimed(factor):
    """The 20.92 min mode of the DTF with another time constant, gain at rest kept."""

    def act(s):
        from scipy.signal import cont2discrete

        new_tau = 20.92 * factor
        num = np.array(list(reversed([0.0001065, 0.04279, -0.00769, -0.01453])))
        den = np.poly([-1 / 1.5657, -1 / 291.85, -1 / new_tau])
        num = num * (1 / 1.5657 / 291.85 / new_tau) / 0.0001046
        b, a, _ = cont2discrete((num, den), 1.0, method="bilinear")
        return lfilter(np.squeeze(b), a, s[2]) - s[4]

    return Scenario(place=("dynamics", "DTF", ""), act=act)


def draw(kind, seed, size_um=None):
    """Draw an effect of a kind."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    size = rng.uniform(1.0, 6.0) if size_um is None else size_um
    sign = rng.choice([-1.0, 1.0])
    scaled = lambda e: e if np.std(e) == 0 else e * sign * size / np.std(e)  # noqa: E731
    channel = str(rng.choice(["coolant_degc", "spindle_rpm", "fan_rpm", "cabinet_degc"]))
    tau, delay = rng.uniform(5.0, 120.0), int(rng.integers(5, 25))
    ref = {}

    def fixed(key, e):
        """The same strength on every day: set by the first one."""
        if key not in ref:
            ref[key] = 1.0 if np.std(e) == 0 else sign * size / np.std(e)
        return ref[key] * e

    late = lambda u, k: np.concatenate((np.full(k, u[0]), u[: u.size - k]))  # noqa: E731
    t_step, period, phase = rng.uniform(0.25, 0.75), rng.uniform(20.0, 180.0), rng.uniform(0, 6.28)
    switch = np.cumsum(rng.uniform(60.0, 240.0, 40))
    width = size * rng.uniform(1.0, 2.0)
    changed = rng.choice([0.7, 1.4])

    def play(y):
        at, out = 0.0, []
        for v in y:
            at = min(max(at, v - width), v + width)
            out.append(at)
        return np.array(out) - y

    cycles = lambda n: np.sin(2 * np.pi * np.arange(n) / period + phase) * size * 2**0.5  # noqa: E731
    hidden = lambda n: lag(np.searchsorted(switch, np.arange(n)) % 2.0, tau)  # noqa: E731
    table = {
        "none": ((), lambda s: np.zeros(s[0])),
        "input": (("input", "", channel), lambda s: fixed("a", lag(s[1][channel], tau))),
        "input square": (
            ("input", "", "spindle_rpm"),
            lambda s: fixed("a", lag((s[1]["spindle_rpm"] / 8e3) ** 2, tau)),
        ),
        "input delay": (("input", "", channel), lambda s: fixed("a", late(lag(s[1][channel], tau), delay))),
        "gain DTF": (("gain", "DTF", ""), lambda s: fixed("a", s[4])),
        "gain TDTF": (("gain", "TDTF", ""), lambda s: fixed("a", s[5])),
        "missing mode": (("dynamics", "DTF", ""), lambda s: fixed("a", lag(s[2], tau))),
        "mistimed": (("dynamics", "DTF", ""), mistimed(changed).act),
        "late path": (("delay", "DTF", ""), lambda s: late(s[4], max(2, delay // 4)) - s[4]),
        "late sensor": (("delay", "TTF", ""), lambda s: np.zeros(s[0])),
        "nonlinear": (("nonlinear", "DTF", ""), lambda s: fixed("a", s[4] ** 2)),
        "scheduled": (("scheduled", "DTF", "fan_rpm"), lambda s: fixed("a", s[4] * s[1]["fan_rpm"] / 3000.0)),
        "play": (("hysteresis", "DTF", ""), lambda s: play(s[4])),
        "drift": (("drift", "", ""), lambda s: scaled(np.arange(s[0]) / s[0])),
        "step": (("step", "", ""), lambda s: sign * 2 * size * (np.arange(s[0]) >= t_step * s[0])),
        "periodic": (("periodic", "", ""), lambda s: cycles(s[0])),
        "unobserved": (("unobserved", "", ""), lambda s: fixed("a", hidden(s[0]))),
    }
    place, act = table[kind]
    sensor = (lambda d: late(d, max(1, delay // 4))) if kind == "late sensor" else None
    return Scenario(place=place, act=act, sensor=sensor)


def record(scenarios, seed, hours=36.0, *, noise_k=0.02, noise_um=0.3):
    """Measured columns of a run, and the true y and the effect's part."""
    s = signals(seed, hours)
    rng = np.random.default_rng([seed, 99])
    n, columns, _, _, y_dtf, y_tdtf, difference = s
    effect = sum((sc.act(s) for sc in scenarios), np.zeros(n))
    for sc in scenarios:
        if sc.sensor is not None:
            difference = sc.sensor(difference)
    true = y_dtf + y_tdtf + effect
    at = columns["ambient_degc"]
    measured = {
        "t_q_degc": at + difference + rng.normal(0, noise_k, n),
        "at_degc": at + rng.normal(0, noise_k, n),
        "y_um": true + rng.normal(0, noise_um, n),
        **{name: columns[name] + rng.normal(0, 0.02 if "degc" in name else 0.0, n) for name in NAMES},
    }
    return measured, true, effect


def held_out_errors(nothing: np.ndarray, *, named: np.ndarray, whole: np.ndarray, ceiling: np.ndarray) -> HeldOut:
    """Errors on held-out blocks that are made up: the base is as it was."""
    return HeldOut(nothing=nothing, named=named, whole=whole, ceiling=ceiling, steps=())


def chosen(effects: tuple, *, left: float, worse_um: tuple[float, float] | None = None) -> Deployment:
    """What is chosen of effects in many values, which leave so many times the error on held-out blocks."""
    errors = left * np.ones(9)
    evidence = SimpleNamespace(start_k=0.0, is_sparse=False)
    return Deployment(
        found=SimpleNamespace(search=SimpleNamespace(evidence=evidence)),
        effects=effects,
        held_out=held_out_errors(np.ones(9), named=errors, whole=errors, ceiling=errors),
        contradicted=False,
        worse_um=worse_um,
        too_short_h=None,
    )


def errors_on_another_day(machine, *models):
    """Return what models leave of a drawn machine's fresh run, µm, about its mean."""
    day = machine.fresh
    return [np.std(day.true_um - tc.simulate(model, day.columns)["y_pred_um"]) for model in models]
