"""Text of a result for a terminal: sentences wrap at words, tables and lines to copy stay as they are."""

from __future__ import annotations

import re
import textwrap

#: What a table or a line to copy has and no sentence: columns, or a key with its value.
_AS_IT_IS = re.compile(r"\S {2,}\S|^\S+ = |^\[")
#: Narrowest terminal for which text is wrapped, characters.
_NARROWEST = 20


def wrapped(text: str, width: int) -> str:
    r"""Wrap the sentences of a text at words.

    Parameters
    ----------
    text : str
        Sentences, lists (`- …`) and tables.
    width : int
        Width of the terminal, characters.

    Examples
    --------
    >>> print(wrapped("- one two three four five\na  b", 20))
    - one two three four
      five
    a  b
    """
    if width < _NARROWEST:
        return text
    return "\n".join(_line(line, width) for line in text.split("\n"))


def _line(line: str, width: int) -> str:
    if len(line) <= width or _AS_IT_IS.search(line.strip()):
        return line
    indent = re.match(r" *(- |• )?", line)
    assert indent is not None
    return textwrap.fill(
        line, width, subsequent_indent=" " * indent.end(), break_long_words=False, break_on_hyphens=False
    )
