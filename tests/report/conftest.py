"""Pages of every kind, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.report import gallery


@pytest.fixture(scope="session")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return gallery.make(tmp_path_factory.mktemp("pages"))
