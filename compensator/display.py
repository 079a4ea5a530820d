"""Content of results: tables and lists of sentences, rendered by terminal, notebook and page."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from compensator.codes import Remark, explained_by

#: Cells of a column of numbers: digits, signs, errors, percent, and dashes for missing values.
_NUMBER = re.compile(
    r"[-+−±–]?\s*\d[\d.,\s]*([eE][-+−]?\d+)?(\s*±\s*\d[\d.,eE+−-]*)?\s*%?(\s*\(.*\))?|nan|[-+−]?(inf|∞)|[-–—]"
)


@dataclass(frozen=True, slots=True)
class CodeLink:
    """A state, reason, quality or warning, such as `hold`, or `outside_validity:t_q_degc`.

    On a page it links to its meaning and action at the end.
    """

    code: str

    @property
    def word(self) -> str:
        """The code whose words explain it."""
        return explained_by(self.code)


@dataclass(frozen=True, slots=True)
class Link:
    """A link to another page: its text and a relative address."""

    text: str
    href: str


#: Content of a cell or line: text, codes and links.
Cell = str | CodeLink | Link | tuple[str | CodeLink | Link, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table; on a page it scrolls in its own box if it is too wide.

    Parameters
    ----------
    title : str
        A heading; may be empty.
    head : sequence of str
        Names of the columns, with units; if all are empty, there is no header row.
    rows : sequence of sequence of Cell
        The first cell names the row. Columns of numbers are aligned right, others left.
    note : str
        A sentence below, on a page.
    """

    title: str = ""
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""

    def numeric(self) -> list[bool]:
        """Return which columns hold numbers; the first never does."""
        columns = ([text_of(row[i]) for row in self.rows if i < len(row)] for i in range(self.width))
        return [i > 0 and _is_numeric([cell for cell in cells if cell]) for i, cells in enumerate(columns)]

    @property
    def width(self) -> int:
        """Number of columns."""
        return max(map(len, [self.head, *self.rows]))

    def text(self) -> str:
        """Return the table as aligned text.

        Examples
        --------
        >>> print(Table(title="Errors", head=["data", "rms µm"], rows=[["a", "10.25"], ["b", "3"]]).text())
        Errors
        data  rms µm
        a      10.25
        b          3
        """
        rows = [[text_of(cell) for cell in row] for row in ([self.head] if any(self.head) else []) + list(self.rows)]
        widths = [max(len(row[i]) for row in rows) for i in range(self.width)]
        form = [f"{'>' if right else '<'}{width}" for right, width in zip(self.numeric(), widths, strict=True)]
        lines = ["  ".join(map(format, row, form)).rstrip() for row in rows]
        return "\n".join([self.title, *lines] if self.title else lines)

    def html(self) -> str:
        """Return the table as HTML without style, for a notebook.

        Examples
        --------
        >>> Table(head=["a"], rows=[["<1"]]).html()
        '<table><tr><th>a</th></tr><tr><td>&lt;1</td></tr></table>'
        """

        def line(tag: str, cells: Sequence[Cell]) -> str:
            return "<tr>" + "".join(f"<{tag}>{html.escape(text_of(cell))}</{tag}>" for cell in cells) + "</tr>"

        title = f"<caption>{html.escape(self.title)}</caption>" if self.title else ""
        head = line("th", self.head) if any(self.head) else ""
        return f"<table>{title}{head}{''.join(line('td', row) for row in self.rows)}</table>"


@dataclass(frozen=True, slots=True, kw_only=True)
class Words:
    """A list of sentences, plain or as a warning."""

    title: str
    lines: Sequence[Cell]
    kind: Literal["warning", "plain"] = "plain"

    def text(self) -> str:
        """Return the list as lines of text."""
        return "\n".join([f"{self.title}:", *(f"- {text_of(line)}" for line in self.lines)])

    def html(self) -> str:
        """Return the table as HTML without style, for a notebook."""
        lines = "".join(f"<li>{html.escape(text_of(line))}</li>" for line in self.lines)
        return f"<p>{html.escape(self.title)}</p><ul>{lines}</ul>"


@dataclass(frozen=True, slots=True, kw_only=True)
class Listing:
    """Lines to copy, such as those of a configuration.

    Parameters
    ----------
    title : str
        A sentence above.
    lines : str
        The lines, as they are pasted.
    """

    title: str
    lines: str

    def text(self) -> str:
        """Return the sentence and the lines."""
        return f"{self.title}:\n{self.lines}"

    def html(self) -> str:
        """Return the listing as HTML without style, for a notebook."""
        return f"<p>{html.escape(self.title)}</p><pre>{html.escape(self.lines)}</pre>"


class Shown:
    """A result with a display: text by `summary()` and `repr`, HTML in a notebook."""

    __slots__ = ()

    def contents(self) -> Sequence[str | Table | Words | Listing]:
        """Return the content: sentences, tables, lists of sentences, and lines to copy, in order."""
        raise NotImplementedError

    def tables(self) -> list[Table]:
        """Return the tables of the content."""
        return [part for part in self.contents() if isinstance(part, Table)]

    def summary(self) -> str:
        """Return the content as text, as printed by the command of the same name."""
        return text_of_all(self.contents())

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        return "".join(
            f"<p>{html.escape(part)}</p>" if isinstance(part, str) else part.html() for part in self.contents()
        )


def text_of_all(parts: Iterable[str | Table | Words | Listing]) -> str:
    """Return sentences, tables and lists as text, an empty line between them."""
    return "\n\n".join(part if isinstance(part, str) else part.text() for part in parts)


def text_of(cell: Cell) -> str:
    """Return the text of a cell; a code within a line is in brackets."""
    if isinstance(cell, tuple):
        return "".join(f"[{part.code}]" if isinstance(part, CodeLink) else text_of(part) for part in cell)
    return cell if isinstance(cell, str) else cell.code if isinstance(cell, CodeLink) else cell.text


def warnings_of(warnings: Iterable[Remark], title: str = "Warnings") -> list[Words]:
    """Return warnings or remarks as a list with their codes; empty if there are none."""
    lines = [sentence_of(warning) for warning in warnings]
    return [Words(title=title, lines=lines, kind="warning")] if lines else []


def sentence_of(remark: Remark) -> Cell:
    """Return a warning or remark as a line with its code."""
    return (str(remark), " ", CodeLink(remark.code))


def listed(words: Sequence[str]) -> str:
    """Return words in a row.

    Examples
    --------
    >>> listed(["X", "Y", "Z"])
    'X, Y and Z'
    """
    *first, last = words or [""]
    return f"{', '.join(first)} and {last}" if first else last


def _is_numeric(cells: Sequence[str]) -> bool:
    return 2 * sum(bool(_NUMBER.fullmatch(cell)) for cell in cells) >= len(cells)


def is_determined(value: float, std: float) -> bool:
    """Whether a standard error is meaningful: a number, and at most ten times the value."""
    return math.isfinite(std) and std <= 10.0 * abs(value)


def with_std(value: float, std: float) -> str:
    """Return a value with its standard error, to two digits of the error; without one, the value alone.

    Examples
    --------
    >>> with_std(1.0182, 0.0021), with_std(10.0, 0.0), with_std(169.0, 3e5)
    ('1.0182 ± 0.0021', '10', '169 (not determined)')
    >>> with_std(133.5, 26.1), with_std(1203.0, 1980.0), with_std(-2.147e-6, 1.6e-7)
    ('134 ± 26', '1200 ± 2000', '-2.15e-06 ± 0.16e-06')
    """
    if std == 0.0:
        return f"{value:.4g}"
    if not is_determined(value, std):
        return f"{value:.3g} (not determined)"
    decimals = 1 - int(f"{std:.1e}".partition("e")[2])
    power = int(f"{max(abs(value), std):.1e}".partition("e")[2])
    if -4 < power < 6:
        places = max(decimals, 0)
        return f"{round(value, decimals):.{places}f} ± {round(std, decimals):.{places}f}"
    places = max(decimals + power, 0)
    return f"{value / 10.0**power:.{places}f}e{power:+03d} ± {std / 10.0**power:.{places}f}e{power:+03d}"
