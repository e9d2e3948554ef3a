"""Every code block of the documentation works: Python runs, commands are understood by those they call."""

import os
import re
import subprocess
import sys
import traceback
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, Block, blocks_of, command_lines, pages
from tests.docs.run_page import check_command, run_page

Result = subprocess.CompletedProcess[str]
NOT_RUN = 10
"""Blocks that are marked as not run; each gives its reason where it stands."""


def start(page: Path, folder: Path) -> Result:
    command = [sys.executable, "-m", "tests.docs.run_page", str(page)]
    settings = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    return subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True, timeout=500)


def runnable(page: Path) -> list[Block]:
    return [block for block in blocks_of(page) if block.language in ("python", "bash") and block.not_run is None]


def runs_something(page: Path) -> bool:
    """Whether a page needs a process: commands that are only checked leave nothing behind."""
    return any(block.language == "python" or block.run for block in runnable(page))


RUNNING = sorted(filter(runs_something, pages()), key=lambda page: page.name != "tutorial.md")  # the longest one first


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[Path, Future[Result]]]:
    """Every page that runs something, in a process and an empty folder of its own; two at a time."""
    with ThreadPoolExecutor(2) as pool:
        yield {page: pool.submit(start, page, tmp_path_factory.mktemp(page.stem)) for page in RUNNING}


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", RUNNING, ids=lambda page: page.stem)
def test_page(page: Path, results: dict[Path, Future[Result]]) -> None:
    result = results[page].result()
    assert result.returncode == 0, result.stderr[-3000:]
    assert result.stdout.splitlines()[-1] == f"{len(runnable(page))} blocks"


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_code_of_a_page_is_sound(page: Path) -> None:
    """What can be said without running it: commands are understood by those they call, Python compiles."""
    for block in runnable(page):
        if block.language == "python":
            compile(block.code, f"{page}:{block.line}", "exec")
        else:
            for words in command_lines(block):
                check_command(words)


def test_no_block_escapes() -> None:
    """As many blocks are found as lines that open or close one, in half; those not run are counted."""
    unrun = []
    for page in pages():
        fences = re.findall(r"^\s*(?:```|~~~)", page.read_text(), re.MULTILINE)
        blocks = blocks_of(page)
        assert len(fences) == 2 * len(blocks), page
        unrun += [block for block in blocks if block.not_run is not None]
    assert len(unrun) == NOT_RUN, [f"{block.page.name}:{block.line} {block.not_run}" for block in unrun]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("```python\nx = 1\n```\nThen:\n```python\nassert x == 2\n```\n", "AssertionError"),
        ("```bash\npython -m izoo.train algo=sarsa\n```\n", "page.md:2.*unknown algo 'sarsa'"),
        ("```bash\npython -m izoo.train -m algo=ppo,sarsa\n```\n", "unknown algo 'sarsa'"),
        ("```bash\npython -m izoo.contexts paint 3\n```\n", "invalid choice: 'paint'"),
        ("```bash\nmake coffee\n```\n", "no target 'coffee'"),
        ("```bash\npip install 'izoo[magic]'\n```\n", "no extra 'magic'"),
        ("```bash\nrm -r runs\n```\n", "nobody knows how to check this"),
        ("<!-- run: frames=0 -->\n```bash\npython -m izoo.collect\n```\n", "returned non-zero exit status 2"),
        ("```\nx = 1\n```\n", "language ''"),
        ("    x = 1\n", "an indented block"),
        ("<!-- not run: -->\n\n```python\nx\n```\n", "gives no reason"),
    ],
)
def test_a_broken_page_fails(text: str, message: str, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(Exception) as failure:
        run_page(page)
    assert re.search(message, "".join(traceback.format_exception_only(failure.value)), re.DOTALL)
