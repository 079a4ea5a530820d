from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.security.shop import Plant, Shop, make_keys


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(tmp_path_factory.mktemp("shop"))


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory, keys: Path) -> Shop:
    return Shop(tmp_path_factory.mktemp("router"), keys)


@pytest.fixture(scope="module")
def plant(shop: Shop) -> Iterator[Plant]:
    with shop.router(), Plant(shop) as plant:
        yield plant
