"""What every kind of effect shares: parameters, law, place in the model file, registration.

An effect adds to the predicted deformation. A wrong gain of the DTF adds `g · y_dtf`, a delayed path adds
`y(t − d) − y(t)`, an unused channel adds its own response: every kind can be written as an addition, because the base
is linear in its drive.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar, dataclass_transform

import numpy as np

from compensator.arrays import Matrix, Vector
from compensator.errors import ModelError
from compensator.model.effects.blocks import Block, FilterBank, S
from compensator.model.effects.lateness import Lateness
from compensator.model.effects.seen import Seen
from compensator.model.effects.signals import RecordSignals, Signals
from compensator.model.table import TomlTable, shown

#: Largest number of coefficients or time constants of an effect.
MODES = 64
#: `step` or `filter` of a block.
Run = Callable[..., S]
#: What is no channel: T_Q and AT act by the paths, and measured deformation is never fed back.
REFUSED = ("t_q_degc", "at_degc", "y_um", "")


def _standard_errors(table: TomlTable, key: str) -> dict[str, Any]:
    found = TomlTable(f"{table.where}: {key}", table.table[key])
    return {
        name: list(found.numbers(name)) if isinstance(value, list) else found.number(name)
        for name, value in found.table.items()
    }


#: Keys that a diagnosis gives every effect in the model file, and how each is read.
_FOUND: Mapping[str, Callable[[TomlTable, str], Any]] = {
    "std": _standard_errors,
    "std_factor": lambda table, key: table.rows(key, empty=True),
    "explanation": lambda table, key: table.words(key),
}


def number(low: float = -math.inf, high: float = math.inf) -> Any:
    """Return a parameter that the model file holds: a number between two bounds."""
    return dataclasses.field(metadata={"read": lambda table, key: table.number(key, low, high)})


def optional_number(low: float = -math.inf, high: float = math.inf, *, default: float) -> Any:
    """Return a parameter that the model file holds or, where it is the default, leaves out: a number between bounds."""

    def read(table: TomlTable, key: str) -> float:
        return table.number(key, low, high) if key in table.table else default

    return dataclasses.field(default=default, metadata={"read": read, "optional": True})


def numbers(low: float = -math.inf, high: float = math.inf) -> Any:
    """Return a parameter that the model file holds: a list of numbers between two bounds."""
    return dataclasses.field(metadata={"read": lambda table, key: table.numbers(key, low, high, most=MODES)})


def text(*choices: str) -> Any:
    """Return a parameter that the model file holds: a string, one of the choices where there are any."""
    return dataclasses.field(metadata=_text(choices))


def channel_name() -> Any:
    """Return a parameter that the model file holds: the name of a logged channel, which is not T_Q, AT or Y."""

    def read(table: TomlTable, key: str) -> str:
        name = table.text(key)
        if name in REFUSED:
            raise ModelError(f"{table.where}: {key} = {shown(name)}, expected a logged channel, not T_Q, AT or Y")
        return name

    return dataclasses.field(metadata={"read": read})


def text_or_number(*choices: str) -> Any:
    """Return a constant that the model file holds: one of the choices, or a number; no parameter of the effect."""

    def read(table: TomlTable, key: str) -> str | float:
        value = table.table.get(key)
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return table.number(key) if is_number else table.text(key, choices)

    return dataclasses.field(metadata={"read": read, "constant": True})


def texts() -> Any:
    """Return a parameter that the model file holds: a list of strings."""
    return dataclasses.field(metadata={"read": lambda table, key: table.texts(key)})


def rows() -> Any:
    """Return a parameter that the model file holds: a list of lists of numbers."""
    return dataclasses.field(metadata={"read": lambda table, key: table.rows(key)})


def optional_rows() -> Any:
    """Return a parameter that the model file holds or leaves out: a list of lists of numbers."""
    return dataclasses.field(default=(), metadata={"read": lambda table, key: table.rows(key, needed=False)})


def only(*, default: str) -> Any:
    """Return a parameter that the model file holds and that has one value in this form of the kind."""
    return dataclasses.field(default=default, metadata=_text((default,)))


def _text(choices: tuple[str, ...]) -> dict[str, Any]:
    return {"read": lambda table, key: table.text(key, choices), "choices": choices}


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """Parameters and law of an effect; each subclass is one form of one kind.

    Parameters
    ----------
    path, channel : str
        Where it acts, if the kind needs it. Further parameters are fields of the subclass, those of the model file made
        by `number`, `numbers`, `text` and the like.
    std : mapping of str to float
        Standard error of each parameter, where a diagnosis found it.
    std_factor : tuple of tuple of float
        Rows F_r with the covariance of the numeric parameters Σ_r F_r' F_r: one number for each of them, in the order
        of the model file, or none in a row of another effect. Rows of one place in several effects belong together.
        Empty: no variance is stated.
    explanation : str
        For an engineer; empty where no diagnosis found it.
    """

    #: Kind in the model file and in `diagnosis.json`.
    kind: ClassVar[str] = ""
    #: Comment above its table in the model file.
    comment: ClassVar[str] = "Added to the base."
    #: Fields that y is linear in, solved for instead of searched.
    linear: ClassVar[tuple[str, ...]] = ()
    #: Whether it can be computed in real time from what is measured.
    deployable: ClassVar[bool] = True
    #: Whether a channel or path shows its cause; if not, nothing is known of it on other data.
    observed: ClassVar[bool] = True
    #: Whether it can absorb any change of the paths: it is named only where no other effect explains most of that.
    background: ClassVar[bool] = False
    #: Whether it gives its name to a background effect that it explains most of.
    names_background: ClassVar[bool] = False
    #: Least sum of squares that is named, as a share of what is left without it and of what the base may leave anyway.
    worth: ClassVar[float] = 0.05
    #: The same next to another effect where forms are approximate: what depends on time alone fits what they miss.
    worth_with_others: ClassVar[float] = 0.25
    #: Least share of the mean square that it removes where it is named alone and forms are approximate.
    removes_alone: ClassVar[float] = 0.0
    #: Whether it jumps at a time, and whether its unknown initial state looks like such a jump.
    jumps: ClassVar[bool] = False
    starts_anywhere: ClassVar[bool] = False
    #: Whether it acts before all of its channels were seen, each from when it is.
    acts_in_part: ClassVar[bool] = False
    #: Whether it is another on a machine that is warm: a record that begins warm must say how warm.
    counts_from_rest: ClassVar[bool] = False
    #: Whether its linear parameters are those of a filter bank that may have any form, so that they may cancel.
    has_any_form: ClassVar[bool] = False

    path: str = ""
    channel: str = ""
    std: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    std_factor: tuple[tuple[float, ...], ...] = ()
    explanation: str = ""

    @property
    def of_measurement(self) -> bool:
        """Whether it is an error of the measurement: it depends on time alone, and no model can have it."""
        return self.observed and not self.deployable

    @property
    def off_at_zero(self) -> tuple[str, ...] | None:
        """Channels at whose 0 the effect adds nothing on a machine at rest; None where it may.

        About a zero at rest, with these channels at 0, its level is the same whether it acted then or began later. A
        machine at rest has no heat.
        """
        return () if self.path in ("DTF", "TTF") else None

    @property
    def label(self) -> str:
        """Name for people: its kind with the path and channel that it acts on."""
        return label_of({"kind": self.kind, **self.to_table()})

    # ------------------------------------------------------------------ law

    def blocks(self, period_min: float) -> tuple[Block, ...]:
        """Return the blocks of the law, at rest, in the order of the snapshot."""
        return ()

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        """Return the addition to y, µm.

        Parameters
        ----------
        signals : Signals or RecordSignals
            Of one sample, or over a whole record.
        run : sequence of callable
            `step` or `filter` of each of the blocks.
        """
        raise NotImplementedError

    def columns(self, record: RecordSignals, blocks: Sequence[Block]) -> Matrix:
        """Return one column for each linear parameter (one in all where there is none), µm."""
        return np.asarray(self.law(record, filters(blocks)))[:, None]

    # ------------------------------------------------------------------ contract with search, service and reports

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that it acts by."""
        return (self.channel,) if self.channel else ()

    @property
    def measured(self) -> tuple[str, ...]:
        """Channels that must be measured for it."""
        return self.channels

    @property
    def has_variance(self) -> bool:
        """Whether it states a variance of its own."""
        return False

    def variance_um2(self, blocks: Sequence[Block]) -> float:
        """Return the variance of its addition to y after a step of its blocks, µm²; asked only if `has_variance`."""
        return 0.0

    def check_base(self, kind: str) -> None:
        """Refuse a base model of a kind that the effect was not made for.

        Raises
        ------
        ModelError
            Naming key and value.
        """

    @property
    def time_constants_min(self) -> tuple[float, ...]:
        """Time constants, min: how long its state remembers."""
        return tuple(tau for key in ("tau_min", "surface_min") for tau in _numbers(getattr(self, key, ())))

    @property
    def lateness(self) -> Lateness | None:
        """By how much T_Q is late: not added to y, but corrected in the estimate of the heat."""
        return None

    @property
    def parameters(self) -> tuple[float, ...]:
        """Every numeric parameter, in the order of the model file."""
        return tuple(number for f in _varied(type(self)) for number in _numbers(getattr(self, f.name)))

    def moved(self, row: Sequence[float]) -> Effect:
        """Return the effect with a row of `std_factor` added to its parameters.

        Raises
        ------
        ValueError
            If it is not as many numbers as there are parameters.
        """
        count = len(self.parameters)
        if len(row) != count:
            raise ValueError(f"{len(row)} numbers, expected {count}, one for each parameter")
        steps, values = iter(row), dict[str, Any]()
        for f in _varied(type(self)):
            value = getattr(self, f.name)
            numbers = tuple(number + next(steps) for number in _numbers(value))
            if numbers:
                values[f.name] = numbers if isinstance(value, tuple) else numbers[0]
        return dataclasses.replace(self, **values, std_factor=())

    def named(self, given: dict[str, float]) -> dict[str, float]:
        """Return the parameters that people read, from all that are searched or linear."""
        return given

    def explain(self, seen: Seen) -> str:
        """Return one or two sentences for an engineer: µm at the range that was seen, and then what acts."""
        raise NotImplementedError

    # ------------------------------------------------------------------ model file

    def to_table(self) -> dict[str, Any]:
        """Return its `[[effect]]` table, without the kind."""
        fields = [f for f in dataclasses.fields(self) if "read" in f.metadata]
        table = {f.name: getattr(self, f.name) for f in fields}
        for f in fields:
            if "optional" in f.metadata and table[f.name] == f.default:
                del table[f.name]
        found = {key: _as_list(value) for key, value in table.items()}
        return found | {key: _as_list(value) for key in _FOUND if (value := getattr(self, key))}


def label_of(table: Mapping[str, Any]) -> str:
    """Return the name for people of the effect in a table of a model file.

    Examples
    --------
    >>> label_of({"kind": "regression", "channels": ["t1_degc", "t2_degc", "t2_degc"]})
    'regression of 2 channels'
    """
    several = {str(name) for name in table.get("channels", ())}
    parts = [str(table[key]) for key in ("kind", "path", "channel") if table.get(key)]
    return " ".join([*parts, *([f"of {len(several)} channels"] if several else [])])


def _numbers(value: Any) -> tuple[float, ...]:
    """Return the numbers of a parameter: itself, those of a list, or none of a name."""
    if isinstance(value, tuple):
        return tuple(one for one in value if isinstance(one, float))
    return (value,) if isinstance(value, float) else ()


def _as_list(value: Any) -> Any:
    return [_as_list(item) for item in value] if isinstance(value, tuple) else value


class BankEffect:
    """Law of an effect that ends in a filter bank, its last block; a base class that is listed before `Effect`."""

    __slots__ = ()

    def inputs(self, signals: Signals[S], run: Sequence[Run[S]]) -> tuple[S, ...]:
        """Return the inputs of the filter bank."""
        raise NotImplementedError

    def law(self, signals: Signals[S], run: Sequence[Run[S]]) -> S:
        """Return the weighted sum of the bank."""
        return run[-1](*self.inputs(signals, run))

    def columns(self, record: RecordSignals, blocks: Sequence[Block]) -> Matrix:
        """Return every input behind every lag."""
        bank = blocks[-1]
        assert isinstance(bank, FilterBank)
        return bank.columns(*self.inputs(record, filters(blocks)))


def filters(blocks: Sequence[Block]) -> list[Run[Vector]]:
    """Return what blocks do with a whole record."""
    return [block.filter for block in blocks]


# ---------------------------------------------------------------------- registration

_E = TypeVar("_E", bound=Effect)
_FORMS: list[type[Effect]] = []
_loaded = False


@dataclass_transform(
    frozen_default=True,
    kw_only_default=True,
    field_specifiers=(
        number,
        optional_number,
        numbers,
        rows,
        optional_rows,
        text,
        channel_name,
        text_or_number,
        texts,
        only,
    ),
)
def register(form: type[_E]) -> type[_E]:
    """Make a form of a kind of effect a frozen dataclass, and register it (class decorator)."""
    made = dataclass(frozen=True, slots=True, kw_only=True)(form)
    _FORMS.append(made)
    return made


def forms() -> Sequence[type[Effect]]:
    """Return every form of every kind, importing the modules of the package on the first call."""
    global _loaded  # noqa: PLW0603  the imports below register themselves once
    if not _loaded:
        package = importlib.import_module("compensator.model.effects")
        for module in pkgutil.iter_modules(package.__path__):
            importlib.import_module(f"{package.__name__}.{module.name}")
        _loaded = True
    return _FORMS


def kinds() -> Mapping[str, Sequence[type[Effect]]]:
    """Return the forms that the engine runs, by kind."""
    found: dict[str, list[type[Effect]]] = {}
    for form in forms():
        if form.deployable:
            found.setdefault(form.kind, []).append(form)
    return found


def effect_from(kind: str, table: Mapping[str, Any]) -> Effect:
    """Read an effect of one of the `kinds` from its table in the model file.

    Raises
    ------
    ModelError
        Naming key and value where the table is wrong.
    """
    candidates = kinds()[kind]
    known = dict.fromkeys([f.name for form in candidates for f in _read(form)] + ["form", *_FOUND])
    keys = TomlTable(f"effect {kind}", table, tuple(known))
    choices = {choice: form for form in reversed(candidates) for choice in _choices(form)}
    plain = [form for form in candidates if not _choices(form)]
    named = not plain or (choices and "form" in table)
    form = choices[keys.text("form", tuple(choices))] if named else plain[0]
    # A key of another form would be lost when the model is written.
    keys = TomlTable(keys.where, table, tuple(dict.fromkeys([*(f.name for f in _read(form)), *_FOUND])))
    read = {f.name: f.metadata["read"](keys, f.name) for f in _read(form)}
    found = {key: _FOUND[key](keys, key) for key in _FOUND if key in table and key not in read}
    effect = form(**read, **found)
    if not effect.has_variance:
        _check_moved(effect)
    return effect


def _check_moved(effect: Effect) -> None:
    """Refuse rows of `std_factor` that lead out of what the parameters may be."""
    if len(effect.std_factor) > MODES:
        raise ModelError(f"effect {effect.kind}: std_factor of {len(effect.std_factor)} rows, expected at most {MODES}")
    for number, row in enumerate(effect.std_factor, start=1):
        if row:
            try:
                effect_from(effect.kind, dataclasses.replace(effect.moved(row), std={}, explanation="").to_table())
            except (ModelError, ValueError) as error:
                raise ModelError(f"effect {effect.kind}: std_factor, row {number}: {error}") from error


def _read(form: type[Effect]) -> list[dataclasses.Field[Any]]:
    return [f for f in dataclasses.fields(form) if "read" in f.metadata]


def _varied(form: type[Effect]) -> list[dataclasses.Field[Any]]:
    return [f for f in _read(form) if "constant" not in f.metadata]


def _choices(form: type[Effect]) -> tuple[str, ...]:
    return next((f.metadata["choices"] for f in _read(form) if f.name == "form"), ())
