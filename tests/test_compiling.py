"""Compiled code: found only for the sources that it was compiled from, and compiled by one process."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import event

from izoo import compiling


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """One source file, and a folder of its own for what is compiled from it."""
    source = tmp_path / "step.py"
    source.write_text("x = 1")
    monkeypatch.setattr(compiling, "__file__", str(tmp_path / "compiling.py"))
    monkeypatch.setattr(compiling, "sources", lambda: [source])
    forget()
    yield source
    forget()


def forget() -> None:
    """Forget where compiled code lies, as a new process has."""
    compiling.folder.cache_clear()
    compiling._beside.cache_clear()


def renewed(source: Path, text: str) -> Path:
    """The folder of a new process, for sources of another content."""
    source.write_text(text)
    forget()
    return compiling.folder()


def test_what_was_compiled_from_other_sources_is_not_found(sources: Path) -> None:
    first = compiling.folder()
    assert first.is_dir() and first.parent.name == "__pycache__"
    assert renewed(sources, "x = 1") == first
    assert renewed(sources, "x = 2") != first


def test_an_environment_is_compiled_or_says_so() -> None:
    program = "from izoo.envs import EcoDrivingEnv; EcoDrivingEnv().reset()"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert "IzooError: NUMBA_DISABLE_JIT is set, and environments are compiled code; unset it." in run.stderr


def test_compiled_code_goes_once_nobody_has_used_it_for_a_day(sources: Path) -> None:
    """Not before: a process of the older sources may still load from there what it calls for the first time."""
    first = renewed(sources, "x = 1")
    kept = first / "step.nbi"
    kept.touch()
    second = renewed(sources, "x = 2")
    assert kept.is_file()
    long_ago = time.time() - 25 * 3600.0
    for folder in (first, second):
        os.utime(folder / "writable", (long_ago, long_ago))
    assert renewed(sources, "x = 2") == second and second.is_dir(), "one's own is used again, however old"
    assert not first.exists()
    third = renewed(sources, "x = 3")
    assert second.is_dir() and third.is_dir(), "it was used a moment ago"


def test_a_folder_that_cannot_be_written_is_passed_over(sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (sources.parent / "__pycache__").write_text("in the way")
    monkeypatch.setattr(compiling, "cache_root", lambda: sources.parent / "user")
    assert compiling.folder().parent == sources.parent / "user"


USE = """
import sys
from pathlib import Path
from izoo import compiling

kept, beside, package = map(Path, sys.argv[1:])
compiling.cache_root = lambda: kept
compiling._beside = lambda: beside
sys.path.insert(0, str(package))
import step

print(step.twice(21), dict(step.twice.stats.cache_hits) != {}, compiling.folder() == beside)
"""
STEP = """
from izoo.compiling import compiled

@compiled
def twice(x):
    return 2 * x
"""


class Installation:
    """A package with a compiled function, used by one process after the other."""

    def __init__(self, folder: Path) -> None:
        self.places = kept, beside, package = [folder / name for name in ("kept", "beside", "package")]
        self.kept, self.beside = kept, beside
        package.mkdir()
        (package / "step.py").write_text(STEP)

    def use(self) -> str:
        """Call the function in a new process: return what comes out, whether it was found, and whether beside."""
        settings = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
        command = [sys.executable, "-c", USE, *map(str, self.places)]
        done = subprocess.run(command, capture_output=True, text=True, env=settings)
        assert done.returncode == 0 and not done.stderr, done.stderr
        return done.stdout.strip()

    def entries(self) -> list[Path]:
        return sorted(self.beside.glob("*/*.nb?"))


@pytest.fixture
def installation(tmp_path: Path) -> Installation:
    return Installation(tmp_path)


def test_an_installation_that_cannot_be_written_is_used(installation: Installation) -> None:
    installation.use()
    (installation.beside / "writable").unlink()
    (installation.beside / "writable").symlink_to("nowhere/nothing")  # root may write everything else
    assert installation.use() == "42 True False"
    assert not list(installation.kept.glob("*/*/*.nbi"))
    for path in installation.entries():
        path.unlink()
    assert installation.use() == "42 False False" and installation.use() == "42 True False"


def test_every_compiled_module_is_a_source() -> None:
    program = """
import importlib, pathlib, izoo.envs, izoo.compiling as compiling
for name in ("izoo.envs.mdp.step", "izoo.envs.frame_copies", "izoo.envs.twin_env",
"izoo.algos.networks.compiled_mlp"): importlib.import_module(name)
known = {str(path) for path in compiling.sources()}
import sys
for name in [name for name in sys.modules if name.startswith("izoo")]:
    module = sys.modules[name]
    kernels = [value.py_func for value in vars(module).values() if hasattr(value, "py_func")]
    if any(kernel.__module__ == name for kernel in kernels):
        assert str(pathlib.Path(module.__file__)) in known, name
print(len(known))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert int(done.stdout) > 15


def test_a_function_that_only_borrows_may_not_make_an_array() -> None:
    """Nobody would ever free it."""

    def makes(n: int) -> float:
        return np.zeros(n).sum()

    def reads(values: np.ndarray) -> float:
        return values[1:].sum()

    assert compiling.compiled(reads, borrows=True, cache=False)(np.arange(4.0)) == 6.0
    with pytest.raises(numba.core.errors.NumbaError, match="passed into the function"):
        compiling.compiled(makes, borrows=True, cache=False)(3)


def test_a_constant_or_a_short_whole_number_does_not_compile_a_function_again() -> None:
    @compiling.compiled(cache=False)
    def add(x, y):  # type: ignore[no-untyped-def]
        return x + y

    @compiling.compiled(cache=False)
    def add_up(short):  # type: ignore[no-untyped-def]
        total = 0
        for k in range(short.shape[0]):
            total = add(total, short[k])
        return add(total, 1)

    with event.install_recorder("numba:compile") as recorder:
        assert add_up(np.arange(3, dtype=np.int32)) == 4
    assert sum(happening.is_start for _, happening in recorder.buffer) == 2
    assert add(1, 2) == 3, "from Python as well"
