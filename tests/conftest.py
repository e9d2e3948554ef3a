"""Fixtures that several rooms share, and the marker for long tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from izoo.contexts.source import ContextList
from izoo.networks.dataset.intersections import load_dataset
from izoo.networks.net.net_cache import CACHE_ENV


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: takes minutes; runs when IZOO_SLOW_TESTS is set")


LONGEST = tuple(
    f"tests/{path}"
    for path in ("docs/test_blocks.py", "test_train.py", "training/", "test_packaging.py", "evaluation/", "benchmarks/")
)
"""Of tests that run side by side, these begin first, so that none of them goes on alone at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))
    if os.environ.get("IZOO_SLOW_TESTS"):
        return
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="takes minutes; set IZOO_SLOW_TESTS=1 to run it"))


@pytest.fixture(scope="session")
def dataset() -> ContextList:
    """One context per approach of the published dataset's sample, with the default adoption of 1/3."""
    root = os.environ.get("IZOO_TEST_DATA")
    if not root:
        pytest.skip("IZOO_TEST_DATA is unset; it names the folder with the published dataset's sample")
    return load_dataset(Path(root) / "salt-lake-city-60")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what the tests build out of the user's cache; processes that tests start inherit the setting."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_ENV, str(tmp_path_factory.mktemp("cache")))
        yield
