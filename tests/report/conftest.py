"""One real evaluation and its page, shared by the tests of the report."""

from __future__ import annotations

from pathlib import Path

import pytest

from izoo.evaluation import evaluate_policy
from izoo.report import main
from tests.evaluation.conftest import SHORT, contexts

__all__ = ["contexts"]


@pytest.fixture(scope="session")
def evaluation(contexts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of glide's evaluation on two contexts and two seeds; not to be changed."""
    folder = tmp_path_factory.mktemp("results") / "a <script>alert(1)</script> & more".replace("/", "")
    cache = tmp_path_factory.mktemp("baselines")
    evaluate_policy("glide", contexts, [1, 2], SHORT, 0, folder, False, cache=cache)
    return folder


@pytest.fixture(scope="session")
def page(evaluation: Path) -> Path:
    """Its page, with replays."""
    assert main([str(evaluation)]) == 0
    return evaluation / "report.html"
