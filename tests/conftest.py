"""Fixtures that several rooms share, and the order of the tests."""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.context import Context
from izoo.contexts.procedural import ProceduralSource
from izoo.contexts.source import ContextList
from izoo.envs.config import EnvConfig
from izoo.networks.dataset.intersections import load_dataset
from izoo.networks.net import netconvert
from izoo.networks.net.net_cache import CACHE_ENV
from izoo.networks.road import RoadNet, read_road
from tests.networks.handmade import write_handmade

Refused = Callable[..., str]
SHORT = EnvConfig(horizon_s=120.0, warmup_s=20.0, drain_s=60.0, num_agents=32)
LONGEST = (
    # These two compile the twin and the environment on SUMO where they are not compiled yet: each in its own process.
    *("tests/training/test_simulators.py", "tests/test_train.py"),
    *("tests/docs/test_blocks.py", "tests/training/test_ray.py", "tests/benchmarks/test_campaign.py"),
    *("tests/test_packaging.py", "tests/envs/test_worker_failures.py", "tests/training/"),
    *("tests/test_cli.py", "tests/envs/", "tests/results/", "tests/benchmarks/", "tests/docs/", "tests/test_"),
)
"""Files and folders whose tests begin first, longest first: none of them goes on alone while other workers are idle."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def place(item: pytest.Item) -> int:
        return next((k for k, path in enumerate(LONGEST) if item.nodeid.startswith(path)), len(LONGEST))

    items.sort(key=place)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of the test data, which are no part of the project; without it the test is skipped."""
    root = os.environ.get("IZOO_TEST_DATA")
    if not root:
        pytest.skip("IZOO_TEST_DATA is unset; it names the folder with the test data")
    return Path(root)


@pytest.fixture(scope="session")
def faults(data: Path) -> Path:
    """The folder of small inputs, each with one feature that real files have and that is easily misread."""
    return data / "faults"


@pytest.fixture(scope="session")
def published(data: Path) -> Path:
    """The sample of the published dataset: 60 intersections of Salt Lake City."""
    return data / "salt-lake-city-60"


@pytest.fixture(scope="session")
def dataset(published: Path) -> ContextList:
    """One context per approach of the published dataset's sample, with the default adoption of 1/3."""
    return load_dataset(published)


@pytest.fixture(scope="session")
def busy(dataset: ContextList) -> list[Context]:
    """The same, those with the most demand first."""
    return sorted(dataset, key=lambda context: -context.flow_vph_per_lane(context.approach or "A"))


@pytest.fixture(scope="session")
def road(tmp_path_factory: pytest.TempPathFactory) -> RoadNet:
    """The net that is written by hand."""
    return read_road(write_handmade(tmp_path_factory.mktemp("net")))


@pytest.fixture(scope="session")
def contexts() -> list[Context]:
    """Two contexts with demand from one approach, for :data:`SHORT` episodes."""
    base = {"lane_count": 1, "phase_count": 1, "green_s": 25}
    sources = [ProceduralSource({**base, "inflow_vph_per_lane": inflow}) for inflow in (500, 600)]
    return [source.sample(np.random.default_rng(0)) for source in sources]


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what the tests build out of the user's cache; processes that tests start inherit the setting.

    Workers of pytest-xdist share one folder: what one has built, the others need not build again.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_ENV, str(folder))
        patch.setenv("XDG_DATA_HOME", str(folder / "data"))
        yield


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names for which netconvert is called in this process."""
    made: list[str] = []
    run = netconvert._run
    monkeypatch.setattr(netconvert, "_run", lambda name, *rest: made.append(name) or run(name, *rest))
    return made


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C raises, here and in processes that begin here, even where the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """``refused(main, words, message)``: a command answers with one sentence, and no traceback; return the sentence."""

    def check(main: Callable[[list[str]], int], words: Sequence[str], message: str = "", code: int = 2) -> str:
        capsys.readouterr()
        assert main(list(words)) == code
        error = capsys.readouterr().err
        assert message in error and "Traceback" not in error and error.count("\n") == 1, error
        return error

    return check
