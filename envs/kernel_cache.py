"""What numba's cache on disk leaves to its users: to forget stale kernels, and to compile by one process at a time.

The cache looks at the file of the function that was called, and not at the files of the functions and constants that
were compiled into it: after an update of izoo it would go on running old code. Workers that start at the same time
would all compile the same.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock

import izoo.emissions.kernel
import izoo.metrics.definitions
import izoo.networks.clock
import izoo.networks.road

_STAMP = "kernels.sha256"
_PATIENCE_S = 120.0
MESSAGE = "Compiling the environment's kernels: ten to thirty seconds, once per installation."


def kernel_sources() -> list[Path]:
    """Return the files that the compiled kernels' code and constants come from."""
    here = Path(__file__).parent
    modules = (izoo.emissions.kernel, izoo.metrics.definitions, izoo.networks.clock, izoo.networks.road)
    own = [here / f"{name}.py" for name in ("accounting", "config", "fused", "kernels", "layout")]
    return [*own, *(Path(str(module.__file__)) for module in modules)]


def digest(sources: list[Path]) -> str:
    """Return the SHA-256 over the content of ``sources``."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def forget_stale_kernels(sources: list[Path] | None = None) -> None:
    """Remove compiled kernels beside their ``sources`` unless they were compiled from the present ones.

    Without ``sources``, those of the environment. A stamp is left beside the first of them. A cache that
    ``NUMBA_CACHE_DIR`` puts elsewhere is left to whoever set it.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    beside = Path(__file__) if sources is None else sources[0]
    sources = kernel_sources() if sources is None else sources
    stamp = beside.parent / "__pycache__" / f"{beside.stem}-{_STAMP}"
    current = digest(sources)
    # Where the folder cannot be written, numba does not cache there either.
    with contextlib.suppress(OSError):
        if stamp.exists() and stamp.read_text() == current:
            return
        for source in sources:
            for compiled in (source.parent / "__pycache__").glob(f"{source.stem}.*.nb[ic]"):
                compiled.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(current)


@contextlib.contextmanager
def compiling_once(kernel: Any) -> Iterator[None]:
    """Where ``kernel`` is not compiled yet, say that it takes a while, and let one process compile it; others wait.

    Where files cannot be locked, everybody compiles. A compiled kernel that numba will not use, as it is of another
    machine or of older code, goes unnoticed.

    Args:
        kernel: numba's dispatcher, called for the first time within the context.
    """
    folder, function = Path(kernel.stats.cache_path), kernel.py_func
    name, code = function.__qualname__, function.__code__
    version = "".join(map(str, sys.version_info[:2]))
    pattern = f"{Path(code.co_filename).stem}.{name}-{code.co_firstlineno}.py{version}*.nbi"

    def is_there() -> bool:
        return bool(kernel.signatures) or any(folder.glob(pattern))

    if is_there():
        yield
        return
    lock = filelock.FileLock(folder / f"{name}.lock")
    with contextlib.suppress(OSError, NotImplementedError, filelock.Timeout):
        lock.acquire(_PATIENCE_S)
    try:
        if is_there():
            lock.release()
        else:
            with contextlib.suppress(OSError):  # nobody may read it
                print(MESSAGE, file=sys.stderr)
        yield
    finally:
        lock.release()
