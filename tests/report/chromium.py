"""A page in a real browser: as it is drawn, and what its script tells in `<pre id="seen">`."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest


def drawn(
    address: str, folder: Path, *options: str, budget_ms: int, otherwise: str = "", zone: str = ""
) -> tuple[str, str]:
    """Return a page once its scripts have had so much virtual time, and what its console said.

    Without a browser the test is skipped; `otherwise` says what that leaves open.
    """
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip(": ".join(filter(None, ("chromium is not installed", otherwise))))
    done = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={folder / 'profile'}",
            "--dump-dom",
            f"--virtual-time-budget={budget_ms}",
            "--enable-logging=stderr",
            *options,
            address,
        ],
        capture_output=True,
        text=True,
        timeout=110,
        check=True,
        env={**os.environ, "TZ": zone} if zone else None,
    )
    return done.stdout, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


def seen_in(page: str, folder: Path, *options: str, budget_ms: int, otherwise: str) -> Any:
    """Return what the script of a page tells, whose console says nothing."""
    harness = folder / "harness.html"
    harness.write_text(page, encoding="utf-8")
    text, console = drawn(harness.as_uri(), folder, *options, budget_ms=budget_ms, otherwise=otherwise)
    assert console == ""
    found = re.search(r'<pre id="seen">(.*?)</pre>', text, re.S)
    assert found and found[1]
    return json.loads(html.unescape(found[1]))
