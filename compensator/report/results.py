"""An overview of the pages of demo, identify and diagnose, with their results from the files next to them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from compensator.axes import label_of
from compensator.diagnose.words.summary import headline
from compensator.identify.summary import verdict as calibration_verdict
from compensator.input_file import MODEL_BYTES, RESULT_BYTES, parse_toml, read_file, resolved
from compensator.model.model_file import HELD_OUT_KEY
from compensator.report.axes import worst
from compensator.report.diagnosis import tone_of as diagnosis_tone
from compensator.report.identification import tone_of
from compensator.report.page import Block, Cell, Link, Page, Table, Tone

#: End of the name of the page of a calibration, after the name of its model.
_CALIBRATION = "-calibration.html"


@dataclass(frozen=True, slots=True, kw_only=True)
class PageFile:
    """A page and its result; if no result is found, the title is the folder's name and there is no verdict."""

    path: Path
    title: str
    verdict: str = ""
    tone: Tone = "good"


def calibration_page(model: Path) -> Path:
    """Return the path of the page of a calibration, from that of its model file.

    Examples
    --------
    >>> calibration_page(Path("machine-model.toml")).name
    'machine-model-calibration.html'
    """
    return model.with_name(f"{model.name.removesuffix('.toml')}{_CALIBRATION}")


def pages_in(folder: Path) -> list[PageFile]:
    """Return the pages of results in a folder and its subfolders, the topmost first."""
    found = {*folder.rglob("report.html"), *folder.rglob(f"*{_CALIBRATION}")}
    paths = sorted(found, key=lambda path: (len(path.parts), path))
    return [_diagnosis(path) or _calibration(path) or PageFile(path=path, title=path.parent.name) for path in paths]


def _diagnosis(page: Path) -> PageFile | None:
    """Return the page of a diagnosis, from its `diagnosis.json`."""
    if page.name.endswith(_CALIBRATION):
        return None
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        found = json.loads(read_file(page.with_name("diagnosis.json"), RESULT_BYTES))
        axes = found.get("axes", {})
        tone = worst(diagnosis_tone(one) for one in axes.values() or [found])
        words = " ".join(one["sentence"] for one in found.get("machine", ()))
        each = " ".join(f"{label_of(axis)}: {headline(one)}" for axis, one in axes.items()) or headline(found)
        return PageFile(path=page, title="Diagnosis", verdict=words or each, tone=tone)
    return None


def _calibration(page: Path) -> PageFile | None:
    """Return the page of a calibration, from the model file with its errors."""
    own = page.with_name(f"{page.name.removesuffix(_CALIBRATION)}.toml")
    for path in [own] if page.name.endswith(_CALIBRATION) else sorted(page.parent.glob("*.toml")):
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError, IndexError):
            model = parse_toml(read_file(path, MODEL_BYTES))
            parts = {axis: part["provenance"] for axis, part in model.get("axis", {}).items()}
            each = {axis: _errors(origin) for axis, origin in (parts or {"": model["provenance"]}).items()}
            words = " ".join(
                f"{label_of(axis)}: {calibration_verdict(one)}" if axis else calibration_verdict(one)
                for axis, one in each.items()
            )
            title = f"Calibration: {model['name']}"
            return PageFile(path=page, title=title, verdict=words, tone=worst(map(tone_of, each.values())))
    return None


def _errors(origin: Mapping[str, Any]) -> dict[str, Any]:
    """Return the errors that the provenance of a model states."""
    errors = {name: origin[name] for name in ("free_run", "parts") if name in origin}
    return errors | {"folds_rms_um": origin[HELD_OUT_KEY]}


def overview(folder: Path, pages: Sequence[PageFile], *, relative_to: Path) -> Page:
    """Make a page that links to others and lists folders of recordings.

    Parameters
    ----------
    folder : pathlib.Path
        The folder of the results.
    pages : sequence of PageFile
        The pages, the most important first.
    relative_to : pathlib.Path
        Folder of the overview itself: links are relative to it.
    """

    def link(path: Path) -> Link:
        return Link(str(path.relative_to(folder)), quote(Path(os.path.relpath(path, relative_to)).as_posix()))

    first = next((page for page in pages if page.verdict), pages[0])
    rows: list[list[Cell]] = [[link(page.path), page.title, page.verdict] for page in pages]
    blocks: list[Block] = [Table(title="Pages", head=["page", "subject", "result"], rows=rows)]
    folders = sorted({path.parent for path in folder.rglob("*.mcap")})
    if folders:
        blocks.append(
            Table(
                title="Recordings",
                head=["folder", "files"],
                rows=[[str(path.relative_to(folder)), str(len(list(path.glob("*.mcap"))))] for path in folders],
                note="`compensator report FOLDER` makes a page from one of them.",
            )
        )
    title = f"{resolved(folder).name}: {first.title}"
    return Page(title=title, verdict=first.verdict or f"{len(pages)} page(s).", tone=first.tone, blocks=blocks)
