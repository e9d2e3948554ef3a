"""Fixtures that several rooms share, and the marker for long tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from izoo.contexts.source import ContextList
from izoo.networks.dataset import load_dataset


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: takes minutes; runs when IZOO_SLOW_TESTS is set")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
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
