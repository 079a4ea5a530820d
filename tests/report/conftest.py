"""Pages of every kind, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.report import gallery
from tests.shared_folder import made_once


@pytest.fixture(scope="session")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return gallery.paths(made_once(tmp_path_factory, "pages", gallery.make))
