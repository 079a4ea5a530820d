"""What a command writes, checked before any computation against all that it reads.

An argument says by its type whether it names what is read (`Reads`) or what is written (`Writes`); `check_outputs` then
knows both, whatever the command is. What is read is never overwritten: a recording is evidence, and a measured table
cannot be reproduced. A page replaces an older page, and nothing else.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compensator.atomic_write import is_stream
from compensator.errors import UsageError
from compensator.input_file import RESULT_BYTES, read_file, resolved

#: Suffixes that are probably mistakes.
_ENDINGS = {".csv", ".html", ".json", ".mcap", ".pdf", ".png", ".toml", ".xlsx"}
#: Ending of pages; a page that is asked for may have another.
_PAGE = ".html"
#: Ending of tables, the only results that may go to a pipe or a device as `/dev/stdout` and `/dev/null` are.
_TABLE = ".csv"
#: In place of an ending: of what the command reads.
_INPUT = "input"


@dataclass(frozen=True, slots=True)
class Reads:
    """Type of an argument that names what the command reads: a file, or a folder of recordings.

    Parameters
    ----------
    kind : type
        Of its value: a path; text where a file or the name of a model may stand.
    """

    kind: Callable[[str], Any] = Path

    def __call__(self, text: str) -> Any:
        """Return the value; an empty word, as of a variable that is not set, would be the present folder."""
        return self.kind(_named(text))


@dataclass(frozen=True, slots=True)
class Writes:
    """Type of an argument that names what the command writes.

    Parameters
    ----------
    ending : str
        Ending of such a file, `.csv` or `.toml`; `.html` for a page in any format; empty for a folder.
    also : callable
        Return what is written beside it, or in it, under names of their own.
    check : callable
        Refuse a path, which is given with its option, for a reason of its own.
    default : callable, optional
        Return the path from all arguments where it is not given; without, nothing is written then.
    """

    ending: str
    also: Callable[[Path], Iterable[Path]] = lambda path: ()
    check: Callable[[Path, str], None] = lambda path, option: None
    default: Callable[[argparse.Namespace], Path] | None = None

    def __call__(self, text: str) -> Path:
        """Return the value."""
        return Path(_named(text))


def _named(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError("'': expected a name")
    return text


def check_outputs(arguments: argparse.Namespace) -> None:
    """Check all that a command writes, before it is called; fill in names that have a default.

    Raises
    ------
    UsageError
        If something is read by the command, too, is what another option names, is a folder instead of a file, no
        regular file or no page of this program, has another ending, or cannot be written.
    """
    written = [action for action in arguments.parser._actions if isinstance(action.type, Writes)]
    for action in written:
        if getattr(arguments, action.dest) is None and action.type.default is not None:
            setattr(arguments, action.dest, action.type.default(arguments))
    given = [(getattr(arguments, action.dest), action.option_strings[0], action.type) for action in written]
    given = [one for one in given if one[0] is not None]
    taken: dict[Hashable, tuple[str, str]] = {}
    if given:
        taken = {_identity(file): (_INPUT, "") for file in _read(arguments)}
    for path, option, kind in given:
        if kind.ending == "":
            _check_folder(path, option)
        else:
            _check_apart(path, option, kind.ending, taken)
            _check_file(path, option, kind.ending, is_asked=True)
        for file in kind.also(path):
            _check_apart(file, f"{option} {path}:", file.suffix, taken)
            _check_file(file, f"{option} {path}:", file.suffix)
        kind.check(path, option)


def takes_stdout(arguments: argparse.Namespace) -> bool:
    """Return whether something that a command writes goes to standard output, where nothing else belongs then."""
    for action in arguments.parser._actions:
        path = getattr(arguments, action.dest, None) if isinstance(action.type, Writes) else None
        with suppress(OSError, ValueError):
            if path is not None and os.path.samestat(found := path.stat(), os.fstat(1)):
                return not os.path.samestat(found, Path(os.devnull).stat())
    return False


def pages_text(page: Path, also: Path | None) -> str:
    """Return a line for each page that was written."""
    return "\n".join(f"page: {path}" for path in (page, also) if path is not None)


def page_of_calibration(model: Path) -> list[Path]:
    """Return what `identify` writes beside a model file: its page."""
    from compensator.report.results import calibration_page

    return [calibration_page(model)]


def files_of_diagnosis(folder: Path) -> list[Path]:
    """Return what `diagnose` writes into a folder."""
    from compensator.api.diagnosis import FILES

    # Of several axes each has curves of its own.
    return [*(folder / name for name in FILES), *folder.glob("series-*.csv")]


def check_diagnosis(folder: Path, option: str) -> None:
    """Refuse a folder that has files of these names, and neither page nor result of a diagnosis."""
    from compensator.api.diagnosis import FILES

    there = [name for name in FILES if (folder / name).exists()]
    if not there or "report.html" in there:
        return
    with suppress(OSError, UsageError):
        if b'"verdict"' in read_file(folder / "diagnosis.json", RESULT_BYTES):
            return
    raise UsageError(f"{option} {folder}: has {there[0]}, which no diagnosis wrote; expected another folder")


def pages_of_demo(folder: Path) -> list[Path]:
    """Return the pages that `demo` writes into a folder."""
    return [folder / "report.html", folder / "loop.html"]


def page_of_report(arguments: argparse.Namespace) -> Path:
    """Return the page of `report`, in the current folder: named after its first file or folder."""
    whole = resolved(arguments.what[0])
    return Path(f"{whole.stem if whole.suffix == '.mcap' else whole.name or 'all'}-report.html")


def _read(arguments: argparse.Namespace) -> Iterator[Path]:
    """Yield the files that the command reads; of a folder its recordings, and those in folders in it."""
    for action in arguments.parser._actions:
        given = getattr(arguments, action.dest, None) if isinstance(action.type, Reads) else None
        for one in given if isinstance(given, list) else [given]:
            if one is not None:
                path = Path(one)
                yield path
                yield from path.rglob("*.mcap") if path.is_dir() else ()


def _identity(path: Path) -> Hashable:
    """Return what is the same for all names of a file; where there is none, its path without links."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return resolved(path)
    return found.st_dev, found.st_ino


def _check_apart(path: Path, option: str, ending: str, taken: dict[Hashable, tuple[str, str]]) -> None:
    """Refuse a file that is read, or that another option names; the same page twice is one page."""
    there = taken.setdefault(_identity(path), (ending, option))
    if there[0] == _INPUT:
        raise UsageError(
            f"{option} {path}: is an input of this command and would be overwritten, expected another name"
        )
    if there[0] != ending:
        raise UsageError(f"{option} {path}: is what {there[1]} names, too, expected another name")


def _check_file(path: Path, option: str, ending: str, *, is_asked: bool = False) -> None:
    """Refuse a file that cannot be written, or that is probably not meant; the folder of a page is to be there."""
    if path.is_dir():
        raise UsageError(f"{option} {path}: is a folder, expected the name of a file in it")
    if path.is_symlink() and not resolved(path).parent.is_dir():
        raise UsageError(f"{option} {path}: is a link into a folder that is not there, expected the name of a file")
    streams = ending == _TABLE and is_stream(path)
    if path.exists() and not (path.is_file() or streams):
        raise UsageError(f"{option} {path}: is not a regular file, expected the name of a file")
    if ending == _PAGE:
        from compensator.report.formats import check_replaced, checked

        check = checked if is_asked else check_replaced
        check(path, option=option)
    elif path.suffix.lower() in _ENDINGS - {ending}:
        raise UsageError(f"{option} {path}: expected a name that ends in {ending}")
    if streams:
        return
    _check_parent(path, option)
    if path.exists() and not os.access(path, os.W_OK):
        raise UsageError(f"{option} {path}: no permission to write it")


def _check_folder(path: Path, option: str) -> None:
    """Refuse a folder that is a file, or cannot be made."""
    if path.exists() and not path.is_dir():
        raise UsageError(f"{option} {path}: is a file, expected a folder")
    _check_parent(path / "file", option)


def _check_parent(path: Path, option: str) -> None:
    """Refuse a file whose folder does not exist and cannot be made."""
    there = path.absolute().parent
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise UsageError(f"{option} {path}: {there} is a file, expected a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise UsageError(f"{option} {path}: no permission to write in {there}")
