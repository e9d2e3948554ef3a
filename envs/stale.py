"""Forgets compiled kernels when any source that they were compiled from has changed.

numba's cache on disk looks at the file of the function that was called, and not at the files of the functions and
constants that were compiled into it. After an update of izoo it would go on running old code.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from pathlib import Path

import izoo.emissions.kernel
import izoo.metrics.definitions
import izoo.networks.clock
import izoo.networks.roadnet

_STAMP = "kernels.sha256"


def kernel_sources() -> list[Path]:
    """Return the files that the compiled kernels' code and constants come from."""
    here = Path(__file__).parent
    modules = (izoo.emissions.kernel, izoo.metrics.definitions, izoo.networks.clock, izoo.networks.roadnet)
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
