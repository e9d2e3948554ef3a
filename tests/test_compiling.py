"""Compiled code: found only for the sources that it was compiled from, and compiled by one process."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

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


def test_a_folder_that_cannot_be_written_is_passed_over(sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (sources.parent / "__pycache__").write_text("in the way")
    monkeypatch.setattr(compiling, "cache_root", lambda: sources.parent / "user")
    assert compiling.folder().parent == sources.parent / "user"


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
