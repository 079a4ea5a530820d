"""`compensator replay`: audit recordings, or compute what another model would have done."""

from __future__ import annotations

import argparse
import csv
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from compensator.atomic_write import atomic_write
from compensator.audit.machine_audit import audit, summary
from compensator.audit.other_model import COLUMNS, compare
from compensator.commands import Answer
from compensator.commands.progress_bar import progress_bar
from compensator.commands.workers import workers
from compensator.errors import UsageError
from compensator.input_file import resolved
from compensator.model.model_file import load_model, read_model_bytes
from compensator.recording.reading import recordings_in

if TYPE_CHECKING:
    from compensator.report.page import Page

#: Exit code where an audit found a difference.
FOUND = 3
#: Bytes up to which an audit runs in this process; starting others takes as long.
ALONE = 8_000_000


def run(arguments: argparse.Namespace) -> Answer:
    """Run the command."""
    paths, page = recordings_in(arguments.recording), arguments.page
    if arguments.model is not None:
        if arguments.public_key is not None:
            raise UsageError("--public-key: is for the audit, which is not made with --model")
        if arguments.head is not None:
            raise UsageError("--head: is for the audit, which is not made with --model")
        return _compare(paths, arguments.model, arguments.out, page)
    if arguments.out is not None:
        raise UsageError("--out: is for --model, which is not given")
    public_key, head = arguments.public_key, arguments.head
    if head is not None and public_key is None:
        raise UsageError("--head: is checked with --public-key, which is not given")
    if arguments.scheduler is not None:
        # Workers may run in other folders, so paths must be absolute.
        paths, public_key = [path.absolute() for path in paths], public_key and resolved(public_key)
    named = {path.absolute() if arguments.scheduler is not None else path for path in arguments.recording}
    worth = len(paths) if sum(path.stat().st_size for path in paths if path.exists()) > ALONE else 1
    with progress_bar("auditing") as progress, workers(worth, arguments.scheduler) as executor:
        found = audit(paths, public_key=public_key, head=head, progress=progress, executor=executor, named=named)
    answer = Answer(found.as_json(), summary(found), 0 if found.clean else FOUND)
    if page is None:
        return answer
    from compensator.audit.pages import audit_page

    return _with_page(answer, page, audit_page(found))


def _compare(paths: list[Path], name: str, out: Path | None, page: Path | None) -> Answer:
    model, data = load_model(name), read_model_bytes(name)
    curves = None
    if page is not None:
        from compensator.audit.pages import Curves

        curves = Curves()
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar("comparing") as progress, atomic_write(out, may_stream=True) if out else nullcontext() as file:
        row = None
        if file is not None:
            row = csv.writer(file, lineterminator="\n").writerow
            row(COLUMNS)
        point = curves.add if curves is not None else None
        found = compare(paths, model, progress=progress, row=row, point=point, data=data)
    text = found.text() + (f"\nboth offsets: {out}" if out else "")
    answer = Answer(found.as_json() | ({"out": str(out)} if out else {}), text)
    if page is None or curves is None:
        return answer
    from compensator.audit.pages import comparison_page

    return _with_page(answer, page, comparison_page(found, curves))


def _with_page(answer: Answer, path: Path, page: Page) -> Answer:
    from compensator.report.formats import write

    write(path, page)
    return Answer(answer.result | {"report": str(path)}, f"{answer.text}\npage: {path}", answer.code)
