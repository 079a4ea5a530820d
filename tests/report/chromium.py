"""A page in a real browser: what its script tells in `<pre id="seen">`."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest


def seen_in(page: str, folder: Path, *options: str, budget_ms: int, otherwise: str) -> Any:
    """Return what a page tells once its scripts have had so much virtual time; without a browser it is skipped."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip(f"chromium is not installed: {otherwise}")
    harness = folder / "harness.html"
    harness.write_text(page, encoding="utf-8")
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
            harness.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=110,
        check=True,
    )
    assert not [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    found = re.search(r'<pre id="seen">(.*?)</pre>', done.stdout, re.S)
    assert found and found[1]
    return json.loads(html.unescape(found[1]))
