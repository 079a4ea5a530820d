"""All texts that users read, on one page: `python -m tests.manual.texts texts.html` makes it.

Codes with meaning and action, help of the commands, texts of the live page, and every sentence in the sources: titles,
headlines and notes of pages, answers, errors. A sentence is a string of at least three words outside docstrings; `…`
stands for its values.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from compensator.cli import _parser
from compensator.codes import DOMAINS, SUFFIX_WORDS
from compensator.report.page import Page, Section, Table, write_page

TOP = Path(__file__).resolve().parents[2]
#: Files with words of users that are not Python.
PLAIN = ("compensator/watch/live.html", "compensator/watch/live.js", "compensator/watch/live_plots.js")
_WORDS = 3
#: What has three words but is read by programs: schemas, styles, paths.
_CODE = re.compile(r"[{}<>;]|^\s*[A-Z ]+\s*$|--\w+=|\w+\(|https?:")


def codes() -> Iterator[tuple[str, str]]:
    """Yield each code, and its meaning and action."""
    for domain in DOMAINS:
        for code in domain:
            yield f"{domain.__name__} {code}", f"{code.meaning} → {code.action}"
    for code, (meaning, action) in SUFFIX_WORDS.items():
        yield code, f"{meaning} → {action}"


def helps(parser: argparse.ArgumentParser | None = None) -> Iterator[tuple[str, str]]:
    """Yield each command and option, and its help."""
    parser = parser or _parser()
    yield parser.prog, " ".join(filter(None, (parser.description, parser.epilog)))
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from helps(sub)
        elif action.help not in (None, argparse.SUPPRESS):
            yield f"{parser.prog} {'/'.join(action.option_strings) or action.dest}", str(action.help)


def sentences(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of each sentence in a source."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(node.value)
        if isinstance(node, ast.JoinedStr):
            skipped.update(part for part in ast.walk(node) if part is not node and isinstance(part, ast.Constant))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in skipped:
            text = node.value
        elif isinstance(node, ast.JoinedStr):
            text = "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
        else:
            continue
        if len(re.findall(r"[A-Za-z]{2,}", text)) >= _WORDS and not _CODE.search(text):
            yield node.lineno, " ".join(text.split())


def in_sources() -> Iterator[tuple[str, str]]:
    """Yield place and text of each sentence in the product, without the codes."""
    for room in ("compensator", "drivers"):
        for path in sorted((TOP / room).rglob("*.py")):
            if path.name != "codes.py":
                name = path.relative_to(TOP)
                yield from ((f"{name}:{line}", text) for line, text in sorted(set(sentences(path))))


def in_live_page() -> Iterator[tuple[str, str]]:
    """Yield place and text of each sentence of the live page."""
    for name in PLAIN:
        lines = (TOP / name).read_text(encoding="utf-8").splitlines()
        for number, line in enumerate(lines, start=1):
            for text in re.findall(r'"([^"]*)"|`([^`]*)`|>([^<>]+)<', re.sub(r"\$\{[^}]*\}", "…", line)):
                words = "".join(text)
                if len(re.findall(r"[A-Za-z]{2,}", words)) >= _WORDS - 1 and not re.search(r"[{};=]", words):
                    yield f"{name}:{number}", words


def page() -> Page:
    """Return the page of all texts."""
    parts = {
        "Codes: meaning → action": list(codes()),
        "Help of the commands": list(helps()),
        "The live page": list(in_live_page()),
        "Sentences in the sources": list(in_sources()),
    }
    return Page(
        title="All texts that users read",
        verdict=f"{sum(map(len, parts.values()))} texts.",
        blocks=[
            Section(title=title, blocks=[Table(head=["where", "text"], rows=[list(row) for row in rows])])
            for title, rows in parts.items()
        ],
    )


if __name__ == "__main__":
    write_page(Path(sys.argv[1]), page())
