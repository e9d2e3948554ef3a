"""Compiled kernels are forgotten when what they were compiled from changes, and only then; one process compiles."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from izoo.envs import kernel_cache


def test_compiled_kernels_go_when_a_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "kernels.py"
    source.write_text("x = 1")
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    compiled, foreign = cache / "kernels.place-1.py311.nbi", cache / "other.f-1.py311.nbi"
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(kernel_cache, "__file__", str(tmp_path / "kernel_cache.py"))
    monkeypatch.setattr(kernel_cache, "kernel_sources", lambda: [source])
    kernel_cache.forget_stale_kernels()
    compiled.touch()
    foreign.touch()
    kernel_cache.forget_stale_kernels()
    assert compiled.exists()
    source.write_text("x = 2")
    kernel_cache.forget_stale_kernels()
    assert not compiled.exists()
    assert foreign.exists()


def test_every_source_exists() -> None:
    assert all(path.is_file() for path in kernel_cache.kernel_sources())


def kernel(folder: Path, compiled: bool = False) -> SimpleNamespace:
    def drive() -> None: ...

    if compiled:
        line, version = drive.__code__.co_firstlineno, "".join(map(str, sys.version_info[:2]))
        (folder / f"{Path(__file__).stem}.{drive.__qualname__}-{line}.py{version}.nbi").touch()
    return SimpleNamespace(py_func=drive, signatures=[], stats=SimpleNamespace(cache_path=str(folder)))


def test_who_compiles_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with kernel_cache.compiling_once(kernel(tmp_path)):
        pass
    assert "Compiling" in capsys.readouterr().err
    with kernel_cache.compiling_once(kernel(tmp_path, compiled=True)):
        pass
    assert capsys.readouterr().err == ""


def test_others_wait_for_the_one_that_compiles_and_not_for_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = kernel(tmp_path)
    waited, together = [], threading.Barrier(3, timeout=20.0)

    def wait() -> None:
        with kernel_cache.compiling_once(first):
            waited.append(bool(list(tmp_path.glob("*.nbi"))))
            together.wait()

    threads = [threading.Thread(target=wait) for _ in range(2)]
    with kernel_cache.compiling_once(first):
        for thread in threads:
            thread.start()
        time.sleep(0.2)
        assert waited == []
        kernel(tmp_path, compiled=True)
    together.wait()
    for thread in threads:
        thread.join()
    assert waited == [True, True]
    assert capsys.readouterr().err.count("Compiling") == 1


def test_a_failure_while_compiling_frees_the_others(tmp_path: Path) -> None:
    with pytest.raises(KeyError), kernel_cache.compiling_once(kernel(tmp_path)):
        raise KeyError
    with kernel_cache.compiling_once(kernel(tmp_path)):
        pass


def test_nobody_has_to_read_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: str) -> int:
        raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", SimpleNamespace(write=broken))
    with kernel_cache.compiling_once(kernel(tmp_path)):
        pass


def test_files_that_cannot_be_locked_stop_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(kernel_cache.filelock.FileLock, "acquire", refuse)
    with kernel_cache.compiling_once(kernel(tmp_path)):
        pass
