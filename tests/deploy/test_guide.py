"""Commissioning guide and operator's page: commands exist, tables match the code, links lead somewhere."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
from types import ModuleType

import pytest

from compensator.cli import _parser
from compensator.codes import WORDS
from compensator.commands.catalog import COMMANDS
from tests.deploy.guide import GUIDE, LAST, OPERATING, commands, with_table
from tests.deploy.test_install import load

CODES = OPERATING.read_text(encoding="utf-8")
TEXT = GUIDE.read_text(encoding="utf-8") + CODES
LINES = commands(TEXT)
OF_OTHERS = {"systemctl", "journalctl", "rsync", "sh", "openssl", "chgrp", "chmod"}


def refusal(parser: argparse.ArgumentParser, words: list[str]) -> str:
    """Return why a parser refuses a command line, empty where it takes it."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            parser.parse_args(words)
    except SystemExit:
        return said.getvalue()
    return ""


def test_the_pages_have_commands_at_all() -> None:
    names = {words[1] for words in LINES if words[0] == "compensator"}
    assert {"check", "probe", "zero", "identify", "replay", "diagnose", "adopt", "back", "explain"} <= names


@pytest.mark.parametrize("words", LINES, ids=" ".join)
def test_every_command_exists_with_its_options(words: list[str]) -> None:
    install: ModuleType = load()
    if words[0] == "compensator":
        assert refusal(_parser(), words[1:]) == ""
    elif words[0] == "python3":
        assert words[1].endswith("install.py")
        assert refusal(install._parser(), words[2:]) == ""
    else:
        assert words[0] in OF_OTHERS


def test_commands_in_the_text_exist() -> None:
    known = {command.name for command in COMMANDS}
    named = set(re.findall(r"`(?:sudo -u compensator )?compensator ([a-z]+)", TEXT))
    assert named and named <= known, named - known
    with pytest.raises(SystemExit), contextlib.redirect_stderr(io.StringIO()):
        _parser().parse_args(["calibrate", "day.mcap"])  # this very check can fail


def test_states_and_reasons_are_those_of_the_service() -> None:
    assert with_table(CODES) == CODES, "out of step with compensator/codes.py: python -m tests.deploy.guide"
    assert CODES.count("\n| `") > list(WORDS).index(LAST) > 30


def test_keys_of_the_limits_are_keys_of_the_configuration() -> None:
    from compensator.config import Channel, Config, Guards, Limits, Loss, Recording, Sampling, Validity

    tables = {
        "limits": Limits,
        "limits.validity": Validity,
        "loss": Loss,
        "guards": Guards,
        "channel": Channel,
        "sampling": Sampling,
        "recording": Recording,
    }
    section = TEXT.split("## 7. Limits")[1].split("## 8.")[0]
    named = re.findall(r"^\| `([a-z_.]+)\.([a-z_*]+)`", section, re.MULTILINE)
    assert len(named) >= 9
    for table, key in named:
        assert key == "*" or key in tables[table].__struct_fields__, (table, key)
    # And the other way round: a limit without a default is one that the guide helps to choose.
    for name in ("limits", "loss", "guards"):
        for field in tables[name].__struct_fields__:
            assert field == "validity" or (name, field) in named, (name, field)
    assert {"limits", "loss", "guards", "sampling", "recording"} <= set(Config.__struct_fields__)


def test_links_lead_somewhere() -> None:
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", TEXT):
        assert (GUIDE.parent / link).exists(), link
    headings = {
        re.sub(r"[^\w -]", "", line.lstrip("# ").lower()).replace(" ", "-")
        for line in TEXT.splitlines()
        if line.startswith("#")
    }
    for anchor in re.findall(r"\]\(#([^)]+)\)", TEXT):
        assert anchor in headings, anchor
