"""A drawn machine: its runs as tables, and the truth about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_hardware.drawn_machines.catalogue import Place

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A run as a logger has it, one row a minute.

    Parameters
    ----------
    columns : dict of str to array, shape (n,)
        `t_s`, `t_q_degc`, `at_degc`, `y_um`, in some calibrations `heat_w`, and every logged channel; NaN is missing.
    true_um : array, shape (n,)
        The machine's displacement without noise and without errors of Y's measurement.
    part_um : array, shape (n,)
        What the effect alone adds to `y_um`; 0 where it acts on T_Q.
    """

    columns: dict[str, Array]
    true_um: Array
    part_um: Array

    @property
    def hours(self) -> float:
        """Length."""
        return self.true_um.size / 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """The undeclared effect.

    Parameters
    ----------
    effect : str
        Name in the catalogue.
    places : tuple of (kind, path, channel)
        What a diagnosis may call it; empty where there is none.
    inherent : tuple of (kind, path, channel)
        What the machine has apart from the effect, on every run, and a linear model lacks: naming it is not wrong.
    deployable : bool
        Whether a model can be given it.
    strength : float
        Its parameter, in `unit`.
    unit : str
        Unit of that.
    size_um : float
        Standard deviation of the error that it makes on the record in a prediction from T_Q and AT, µm.
    """

    effect: str
    places: tuple[Place, ...]
    inherent: tuple[Place, ...]
    deployable: bool
    strength: float
    unit: str
    size_um: float

    @property
    def kind(self) -> str:
        """Its usual kind, or none."""
        return self.places[0][0] if self.places else ""

    @property
    def channel(self) -> str:
        """Its usual channel, or none."""
        return self.places[0][2] if self.places else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """A machine with three runs.

    Parameters
    ----------
    family : str
        Family of physics.
    seed : int
        What it was drawn by.
    published : bool
        Whether its paths are exactly the published ones, so that the published model is its calibration.
    shop_floor : bool
        Whether its data have gaps, outliers, slow noise and a sensor that steps.
    calibration : Table
        Without the effect.
    record, fresh : Table
        With the effect, another duty each. An error of Y's measurement acts on `record` only.
    healthy : Table
        The run `fresh` without the effect, with the same noise: what a calibration meets where nothing is wrong.
    truth : Truth
        What acts.
    noise_um, noise_k : float
        White noise of Y and T_Q.
    """

    family: str
    seed: int
    published: bool
    shop_floor: bool
    calibration: Table
    record: Table
    fresh: Table
    healthy: Table
    truth: Truth
    noise_um: float
    noise_k: float
