"""The import is light, changes nothing, and its verbs stay verbs."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import types

import pytest

import compensator as tc


def python(code: str) -> str:
    # What another test's import has set in this process must not hide that ours sets it.
    environment = {name: value for name, value in os.environ.items() if name != "KMP_DUPLICATE_LIB_OK"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60.0, env=environment
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_import_loads_no_numbers_and_changes_no_environment_variable() -> None:
    code = "import os; before = dict(os.environ); import sys, compensator; assert dict(os.environ) == before; "
    assert python(code + "print({'numpy', 'scipy', 'pandas', 'matplotlib', 'zenoh'} & sys.modules.keys())") == "set()"


def test_the_import_takes_less_than_a_third_of_a_second() -> None:
    code = "import time; t = time.perf_counter(); import compensator; print(time.perf_counter() - t)"
    assert min(float(python(code)) for _ in range(3)) < 0.3


def test_a_verb_changes_no_environment_variable_and_imports_neither_pandas_nor_matplotlib() -> None:
    code = (
        "import os, sys; before = dict(os.environ); import compensator as tc; "
        "tc.simulate('quill', {'t_s': [0, 60], 't_q_degc': [20, 21], 'at_degc': [20, 20]}); "
        "assert dict(os.environ) == before; print({'pandas', 'matplotlib'} & sys.modules.keys())"
    )
    assert python(code) == "set()"


@pytest.mark.parametrize("name", tc.__all__)
def test_every_name_is_there(name: str) -> None:
    assert callable(getattr(tc, name)) and not isinstance(getattr(tc, name), types.ModuleType)
    assert name in dir(tc)


def test_a_room_of_a_verb_s_name_does_not_take_its_place() -> None:
    code = (
        "import compensator.identify.settings, compensator.diagnose.choice.outcome, compensator as tc; "
        "from compensator.identify.settings import Settings; print(tc.identify.__name__, tc.diagnose.__name__)"
    )
    assert python(code) == "identify diagnose"
    assert importlib.import_module("compensator.identify").__name__ == "compensator.identify"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = tc.nothing
