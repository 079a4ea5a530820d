"""Errors of the compensator.

```
CompensatorError            one line: file, row or key, value, and what was expected
├── UsageError              the command was called wrongly                   exit code 2
├── ConfigError             the configuration cannot be used                 exit code 2
├── ModelError              a model file or its dynamics cannot be used      exit code 2
├── DataError               a table or recording cannot be used              exit code 2
└── ServiceError            the service cannot continue                      exit code 1
```

Errors of devices are `drivers.DriverError`; the sampler turns them into qualities.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any


class CompensatorError(Exception):
    """Base of all errors of the compensator."""

    exit_code = 1


class UsageError(CompensatorError):
    """The command was called wrongly."""

    exit_code = 2


class ConfigError(CompensatorError):
    """The configuration cannot be used."""

    exit_code = 2


class ModelError(CompensatorError):
    """A model file, or the dynamics that it describes, cannot be used."""

    exit_code = 2


class DataError(CompensatorError):
    """A table or recording cannot be used."""

    exit_code = 2


class ServiceError(CompensatorError):
    """The service cannot continue, or refuses; `result` is what it says for programs, as for `--json`."""

    def __init__(self, text: str, result: Mapping[str, Any] | None = None) -> None:
        super().__init__(text)
        self.result = result


def in_words(error: Exception) -> str:
    """Return an error as one line: "FILE: No such file or directory", not "[Errno 2] …"."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename2 or error.filename}: {error.strerror or error}"
    return str(error)


@contextmanager
def of_files() -> Iterator[None]:
    """Turn what the operating system refuses into an error of ours, with the words of the commands; also a decorator.

    Examples
    --------
    >>> with of_files():
    ...     open("/proc/absent")
    Traceback (most recent call last):
    compensator.errors.CompensatorError: /proc/absent: No such file or directory
    """
    try:
        yield
    except OSError as error:
        raise CompensatorError(in_words(error)) from error


def one_line(text: str) -> str:
    r"""Return a text with line ends, control characters and marks of the direction escaped.

    It may cite a name or a value of a stranger, who could otherwise write lines of his own on a terminal.

    Examples
    --------
    >>> one_line("name\n\x1b[2J✓ Proven")
    'name\\n\\x1b[2J✓ Proven'
    """
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)
