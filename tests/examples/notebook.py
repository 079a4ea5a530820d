"""Runs a notebook cell by cell without Jupyter, and shows results as it would."""

from __future__ import annotations

import ast
import contextlib
import io
import json
from pathlib import Path
from typing import Any


def run_notebook(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Run all cells in the current folder.

    Returns
    -------
    (dict, list of str)
        The names that are left, and for each cell of code what it prints and shows: HTML, `PNG`, or text.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    outputs = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                shown = _run(ast.parse("".join(cell["source"])), names)
            outputs.append(printed.getvalue() + shown)
    return names, outputs


def _run(cell: ast.Module, names: dict[str, Any]) -> str:
    last = cell.body.pop() if cell.body and isinstance(cell.body[-1], ast.Expr) else None
    exec(compile(cell, "cell", "exec"), names)
    if last is None:
        return ""
    value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    if value is None:
        return ""
    if hasattr(value, "_repr_png_"):
        assert value._repr_png_().startswith(b"\x89PNG")
        return "PNG"
    return value._repr_html_() if hasattr(value, "_repr_html_") else repr(value)
