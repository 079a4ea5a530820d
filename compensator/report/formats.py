"""Writes a page as HTML, as PDF or as PNG; PDF and PNG are printed by an installed browser.

The browser opens one file in a temporary folder, with a separate profile and no network, for at most `TIMEOUT_S`; the
page has no script then, and its content security policy forbids any. The printed file replaces the target only when it
is complete.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path

from compensator.errors import CompensatorError, UsageError
from compensator.input_file import open_file, resolved
from compensator.report.local_time import today
from compensator.report.page import GENERATOR, Figure, Page, Row, html_of, write_page

SUFFIXES = (".html", ".pdf", ".png")
#: Browsers that print from the command line, all of the Chromium family, in the order in which they are tried.
BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "microsoft-edge",
    "microsoft-edge-stable",
    "brave-browser",
)
#: Longest time that a browser may take, s.
TIMEOUT_S = 180.0
#: First bytes of what is printed.
_SIGNATURES = {".pdf": b"%PDF-", ".png": b"\x89PNG\r\n"}
#: What says that a page is ours, whatever its version, within its first bytes.
_MARKS = {
    ".html": b'<meta name="generator" content="quill-compensator ',
    ".pdf": b"/Creator (quill-compensator ",
    ".png": b"Software\0quill-compensator ",
}
_MARK_BYTES = 4096
_OPTIONS = (
    "--headless",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--no-first-run",
    "--no-default-browser-check",
    "--password-store=basic",
    # No network: neither for the page nor for the browser's own services.
    "--no-proxy-server",
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-crash-reporter",
    "--disable-breakpad",
    # Stands in a PDF as what made it.
    f"--user-agent={GENERATOR}",
    # On paper and in a picture the light colours, whatever the desktop is set to.
    "--blink-settings=preferredColorScheme=1",
)
#: Width of a PNG and room for its title and verdict, CSS pixels; pixels of the PNG per CSS pixel.
_PNG_WIDTH, _PNG_HEAD, _PNG_SCALE = 1000, 900, 2


def checked(path: Path, *, option: str) -> Path:
    """Return the path of a page, or refuse it before any work is done.

    Parameters
    ----------
    path : pathlib.Path
        File of the page.
    option : str
        The option that named it.

    Raises
    ------
    UsageError
        If its suffix is not in `SUFFIXES`, its folder does not exist, it needs a browser and none is installed, or what
        is there is no page.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{option} {path}: expected a name that ends in .html, .pdf or .png")
    if not path.parent.is_dir():
        raise UsageError(f"{option} {path}: no such folder")
    if path.suffix.lower() != ".html" and _browser() is None:
        raise UsageError(
            f"{option} {path}: no browser found for printing (Chromium, Chrome, Edge or Brave on PATH); "
            "expected a name that ends in .html, which any browser can print"
        )
    check_replaced(path, option=option)
    return path


def check_replaced(path: Path, *, option: str) -> None:
    """Refuse to replace what is no page of this program; an empty file may become one.

    Parameters
    ----------
    path, option
        As :func:`checked`.

    Raises
    ------
    UsageError
        If there is such a file.
    """
    try:
        with open_file(path) as file:
            beginning = file.read(_MARK_BYTES)
    except FileNotFoundError:
        return
    except OSError as error:
        raise UsageError(f"{option} {path}: {error.strerror}, expected the name of a file") from error
    if beginning and _MARKS[path.suffix.lower()] not in beginning:
        raise UsageError(f"{option} {path}: exists and is no page of this program, expected another name")


def write(path: Path, page: Page) -> Path:
    """Write a page in the format of its suffix.

    Parameters
    ----------
    path : pathlib.Path
        `.html`; `.pdf`: the page as its print style shows it, details open; `.png`: title, verdict and first figure.
    page : Page
        Its content.

    Raises
    ------
    CompensatorError
        If there is no browser, or it does not print the page in time; an existing file is then not changed.
    OSError
        If the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix == ".html":
        return write_page(path, page)
    path = resolved(path)
    # In the target's folder: sandboxed browsers (snap) cannot read /tmp, and the last step is a rename.
    with tempfile.TemporaryDirectory(
        dir=path.parent, prefix=f"{path.stem}-printing-", ignore_cleanup_errors=True
    ) as name:
        source, printed = Path(name) / "page.html", Path(name) / f"page{suffix}"
        if suffix == ".pdf":
            # Older browsers ignore the rule of the print style that opens details.
            source.write_text(
                html_of(page, date=today(), can_zoom=False).replace("<details>", "<details open>"),
                encoding="utf-8",
                errors="backslashreplace",
            )
            options = ["--no-pdf-header-footer", "--print-to-pdf-no-header", f"--print-to-pdf={printed}"]
        else:
            first = _first_figure(page)
            source.write_text(
                html_of(_excerpt(page, first), date=today(), can_zoom=False),
                encoding="utf-8",
                errors="backslashreplace",
            )
            height = _PNG_HEAD + round(_PNG_WIDTH / 9.0 * (first.full_height if first else 0.0))
            options = [f"--window-size={_PNG_WIDTH},{height}", f"--force-device-scale-factor={_PNG_SCALE}"]
            options += ["--hide-scrollbars", f"--screenshot={printed}"]
        _print(path, source, printed, options)
        if suffix == ".png":
            _crop(printed)
        printed.chmod(0o644)
        printed.replace(path)
    return path


def _browser() -> str | None:
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def _print(path: Path, source: Path, printed: Path, options: list[str]) -> None:
    """Print a file with the browser; end all of its processes."""
    browser = _browser()
    if browser is None:
        raise CompensatorError(f"{path}: no browser found for printing; write .html and print it from any browser")
    command = [browser, *_OPTIONS, f"--user-data-dir={source.parent / 'profile'}", *options]
    # The browser's sandbox refuses to run as root.
    command += ["--no-sandbox"] if os.geteuid() == 0 else []
    log = source.with_name("browser.log")
    with log.open("wb") as output:
        process = subprocess.Popen(
            [*command, source.as_uri()],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            process.wait(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise CompensatorError(f"{path}: {browser} did not print the page within {TIMEOUT_S:.0f} s") from None
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if not printed.is_file() or not printed.read_bytes().startswith(_SIGNATURES[printed.suffix]):
        lines = log.read_text(encoding="utf-8", errors="replace").strip().split("\n")
        # Without a desktop there is no D-Bus; browsers report that as an error but do not need it.
        last = next((line for line in reversed(lines) if line and "dbus" not in line), "no reason given")
        raise CompensatorError(f"{path}: {browser} could not print the page: {last[:200]}")


def _first_figure(page: Page) -> Figure | None:
    figures = (block.figures[0] if isinstance(block, Row) else block for block in page.blocks)
    return next((figure for figure in figures if isinstance(figure, Figure)), None)


def _excerpt(page: Page, figure: Figure | None) -> Page:
    return Page(title=page.title, verdict=page.verdict, tone=page.tone, blocks=[figure] if figure else [])


def _crop(path: Path) -> None:
    """Cut off the empty part of the window below the figure."""
    import numpy as np
    from matplotlib.image import imread, imsave

    pixels = imread(path)
    used = np.flatnonzero((pixels != pixels[-1, -1]).any(axis=(1, 2)))
    end = used[-1] + 16 * _PNG_SCALE if used.size else len(pixels)
    imsave(path, pixels[:end], metadata={"Software": GENERATOR})
