"""The receiver stands alone: nothing but the standard library and zenoh, here and as a copy elsewhere."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from compensator.codes import WORDS as SERVICE_WORDS
from compensator.receiver import WORDS, ReceiverError, load_settings

ROOT = Path(__file__).parents[2]
CODE = """
import sys
before = set(sys.modules)
import {name}
new = {{module.split(".")[0] for module in set(sys.modules) - before}} - set(sys.stdlib_module_names) - {{"zenoh"}}
new = {{module for module in new if not module.startswith("_")}}
inside = {{module for module in sys.modules if module.startswith("compensator")}}
print(sorted(new), sorted(inside))
"""


def imported(name: str, cwd: Path) -> tuple[str, str]:
    done = subprocess.run(
        [sys.executable, "-c", CODE.format(name=name)], cwd=cwd, capture_output=True, text=True, timeout=60, check=True
    )
    outside, inside = done.stdout.strip().split("] [")
    return outside + "]", inside


def test_importing_it_loads_zenoh_and_nothing_else() -> None:
    outside, inside = imported("compensator.receiver", ROOT)
    assert outside == "['compensator']"
    modules = [part.strip("' ]\n") for part in inside.split(", ")]
    assert all(m == "compensator" or m.startswith("compensator.receiver") for m in modules), modules


def test_a_copy_of_the_folder_works_by_another_name(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "compensator/receiver", tmp_path / "thermal_receiver")
    outside, inside = imported("thermal_receiver", tmp_path)
    assert outside == "['thermal_receiver']" and inside == "[]".lstrip("[")


def test_every_reason_has_words() -> None:
    assert all(meaning.endswith(".") and action.endswith(".") for meaning, action in WORDS.values())


GOOD = """
[receiver]
machine = "vmc-07"
prefix = "shop/vmc-07"
connect = ["tcp/127.0.0.1:7447"]
offset_max_um = 100
offset_rate_max_um_per_min = 8.0
state_file = "state.json"
[axis]
x = 1
"""


def test_settings_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "receiver.toml"
    path.write_text(GOOD)
    settings, others = load_settings(path)
    assert settings.offset_max_um == 100.0 and settings.connect == ("tcp/127.0.0.1:7447",)
    assert (
        settings.state_file == str(tmp_path / "state.json")
        and settings.zenoh_config == ""
        and others == {"axis": {"x": 1}}
    )


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("offset_max_um = 100", "", "receiver.offset_max_um: missing, expected a number"),
        ("offset_max_um = 100", "offset_max_um = -1", "receiver.offset_max_um = -1.0: expected"),
        ("offset_max_um = 100", 'offset_max_um = "100"', "receiver.offset_max_um = '100': expected a number"),
        ("offset_max_um = 100", "offset_max_um = nan", "receiver.offset_max_um = nan"),
        ("[axis]", "offset_max = 1\n[axis]", "receiver.offset_max: unknown key"),
        (
            '"state.json"',
            '"receiver.toml"',
            "receiver.toml': is the file with these settings, expected a file of its own",
        ),
        ("[axis]", 'applied_file = "x/../state.json"\n[axis]', "state.json': is receiver.state_file, expected a file"),
        ("connect =", "connected =", "unknown key"),
        ('connect = ["tcp/127.0.0.1:7447"]', "", "receiver.connect = []: expected addresses"),
        ('"shop/vmc-07"', '"shop/**"', "receiver.prefix = 'shop/**'"),
        ("[receiver]", "[reciever]", "receiver: missing"),
        ("[receiver]", "receiver", "not a TOML file"),
    ],
)
def test_bad_settings_get_one_line(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = tmp_path / "receiver.toml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ReceiverError) as caught:
        load_settings(path)
    text = str(caught.value)
    assert expected in text and str(path) in text and "\n" not in text


def test_settings_may_begin_with_the_mark_of_an_editor(tmp_path: Path) -> None:
    path = tmp_path / "receiver.toml"
    path.write_text(GOOD)
    settings = load_settings(path)
    path.write_text(GOOD, encoding="utf-8-sig")
    assert load_settings(path) == settings


def test_keys_that_take_long_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "receiver.toml"
    for text, expected in (("a" + ".a" * 100_000, "more than 32 parts"), ('"' + '\\"' * 400_000, "not a TOML file")):
        path.write_text(f"{GOOD}{text} = 1\n")
        began = time.monotonic()
        with pytest.raises(ReceiverError, match=expected):
            load_settings(path)
        assert time.monotonic() - began < 60.0


def test_a_code_has_one_meaning() -> None:
    """`compensator explain` knows the codes of service, devices and receiver."""
    assert not set(WORDS) & set(SERVICE_WORDS)
