"""`compensator report`: make a page from recordings, or an overview of a folder of results."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from compensator.commands import Answer
from compensator.commands.progress_bar import progress_bar
from compensator.errors import UsageError
from compensator.input_file import resolved


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    from compensator.recording.reading import recordings_in

    given: list[Path] = arguments.what
    if len(given) == 1 and given[0].is_dir() and not any(given[0].glob("*.mcap")):
        return _results(given[0], arguments.out)
    return _recordings(recordings_in(given), arguments.out)


def _recordings(paths: Sequence[Path], out: Path) -> Answer:
    from compensator.report.formats import write
    from compensator.report.gathering import read_history
    from compensator.report.recordings import figures, page_of, verdict

    with progress_bar("reading") as progress:
        history = read_history(paths, progress=progress)
    write(out, page_of(history))
    return Answer({**figures(history), "report": str(out)}, f"{verdict(history)}\npage: {out}")


def _results(folder: Path, out: Path) -> Answer:
    from compensator.report.formats import write
    from compensator.report.results import overview, pages_in

    pages = [page for page in pages_in(folder) if resolved(page.path) != resolved(out)]
    if not pages:
        raise UsageError(f"{folder}: contains neither recordings (*.mcap) nor pages (report.html)")
    write(out, overview(folder, pages, relative_to=out.parent))
    result = {
        "report": str(out),
        "pages": [{"page": str(p.path), "title": p.title, "verdict": p.verdict} for p in pages],
    }
    lines = [f"{page.path}\n  {page.verdict}" for page in pages]
    return Answer(result, "\n".join([*lines, f"page: {out}"]))
