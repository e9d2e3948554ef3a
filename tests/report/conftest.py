"""One real evaluation and its page, shared by the tests of replays and of the browser."""

from pathlib import Path

import pytest

from izoo.contexts.context import Context
from izoo.report.__main__ import main
from izoo.results.rollout import evaluate_policy
from tests.conftest import SHORT


@pytest.fixture(scope="session")
def evaluation(contexts: list[Context], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of glide's evaluation on two contexts and two seeds; not to be changed."""
    folder = tmp_path_factory.mktemp("results") / "a <script>alert(1)<script> & more"
    cache = tmp_path_factory.mktemp("baselines")
    evaluate_policy("glide", contexts, [1, 2], SHORT, workers=0, out=folder, cache=cache)
    return folder


@pytest.fixture(scope="session")
def page(evaluation: Path) -> Path:
    """Its page, with replays."""
    assert main([str(evaluation)]) == 0
    return evaluation / "report.html"
