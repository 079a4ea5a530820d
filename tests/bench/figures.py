"""Figures of one run of the benchmarks, and the one table that they end in."""

import os
import platform
import statistics
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("numpy", "scipy", "pymodbus", "pyserial", "eclipse-zenoh", "mcap", "msgspec")


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One line of the table.

    Parameters
    ----------
    what : str
        What was measured.
    found : str
        The figure: median (smallest to largest, number of runs), or what stands in its place.
    wanted : str
        The aim, empty where there is none.
    beside : str
        The alternative in the same run, or a ratio to it.
    """

    what: str
    found: str
    wanted: str = ""
    beside: str = ""


def spread(what, values, unit, *, wanted="", beside=""):
    """Return a figure of several runs, and print it."""
    low, middle, high = min(values), statistics.median(values), max(values)
    found = f"{shown(middle)} {unit} ({shown(low)} to {shown(high)}, n={len(values)})"
    return told(Figure(what=what, found=found, wanted=wanted, beside=beside))


def shown(value):
    """Return a number with three digits that count."""
    if value == 0.0:
        return "0"
    digits = 2 - int(f"{abs(value):e}".split("e")[1])
    return f"{value:,.{max(digits, 0)}f}"


def told(figure):
    """Print a figure as soon as it is known; return it."""
    sys.stdout.write(f"{figure.what}: {figure.found}" + (f"; {figure.beside}" if figure.beside else "") + "\n")
    sys.stdout.flush()
    return figure


def rows(title, head, body):
    """Print the details of some figures as a table."""
    widths = [max(len(row[i]) for row in (head, *body)) for i in range(len(head))]
    lines = [
        "  " + "  ".join(f"{cell:{'<' if i < 2 else '>'}{widths[i]}}" for i, cell in enumerate(row))
        for row in (head, *body)
    ]
    sys.stdout.write("\n".join(["", title, *lines, ""]))
    sys.stdout.flush()


def surroundings():
    """Return machine and versions in one line each."""
    cpu = next(
        (
            line.split(":")[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ),
        "unknown processor",
    )
    load = os.getloadavg()[0]
    packages = []
    for name in PACKAGES:
        try:
            packages.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            packages.append(f"{name} not installed")
    return (
        f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, {cpu}, load {load:.1f} at the start; "
        f"Python {platform.python_version()}\n{', '.join(packages)}"
    )


def table(figures):
    """Return all figures as one Markdown table."""
    lines = [
        "| what | median (smallest to largest, runs) | wanted | beside it in the same run |",
        "| --- | --- | --- | --- |",
    ]
    return "\n".join(lines + [f"| {f.what} | {f.found} | {f.wanted} | {f.beside} |" for f in figures])
