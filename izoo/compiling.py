"""How functions are compiled: once per version of the sources, by one process at a time.

numba's cache looks at the file of the function that was called, not at those of the functions and constants that were
compiled into it. So compiled code lies in a folder that is named by a digest of all these sources: what was compiled
from others is never found.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import filelock
import numba
from llvmlite import ir
from numba import extending
from numba.core import caching, cgutils, event, types
from numba.np.arrayobj import make_array, populate_array

from izoo.console import Progress
from izoo.errors import IzooError
from izoo.files import cache_root

SOURCES = {
    "izoo": ("compiling.py",),
    "izoo.algos": ("networks/censored_normal.py", "networks/compiled_mlp.py"),
    "izoo.contexts": ("features.py",),
    "izoo.emissions": ("*.py",),
    "izoo.envs": ("config.py", "frame_copies.py", "tables.py", "mdp/*.py", "twin/**/*.py"),
    "izoo.networks": ("clock.py", "road.py"),
}
"""Files whose functions are compiled, or whose constants are compiled into them, by their package."""
_PATIENCE_S = 1200.0
_KEPT_S = 24 * 3600.0
"""For so long compiled code of older sources is kept after a process last began to use it: it may still run."""
_MARK = "writable"
MESSAGE = "Compiling the environment, once per installation."


def sources() -> list[Path]:
    """Return the files that compiled code and its constants come from."""
    found = []
    for package, patterns in SOURCES.items():
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            found += [path for pattern in patterns for path in sorted(Path(folder).glob(pattern))]
    return found


@functools.cache
def _beside() -> Path:
    """Return the folder beside this file for compiled code of the present sources."""
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources())).hexdigest()[:16]
    return Path(__file__).parent / "__pycache__" / f"compiled-{digest}"


@functools.cache
def folder() -> Path:
    """Return where code is compiled to: beside this file, or else in the user's cache.

    Folders of other sources beside this file are removed once no process has begun to use them for a day: a process
    loads a function from there when it first calls it.
    """
    here = _beside()
    try:
        here.mkdir(parents=True, exist_ok=True)
        (here / _MARK).touch()
    except OSError:
        return cache_root() / here.name
    for old in here.parent.glob("compiled-*"):
        if old != here and _last_begun_s(old) < time.time() - _KEPT_S:
            shutil.rmtree(old, ignore_errors=True)
    return here


def _last_begun_s(compiled_folder: Path) -> float:
    """Return when a process last began to use a folder: now, if it is not known."""
    try:
        return (compiled_folder / _MARK).stat().st_mtime
    except OSError:  # another process has just made it, or removes it
        return time.time()


_told, *_others = caching.CompileResultCacheImpl._locator_classes


class _Locator(_told):  # type: ignore
    """numba's locator of the folder that it is told, also of one that cannot be written."""

    def ensure_cache_path(self) -> None:
        with contextlib.suppress(OSError):
            super().ensure_cache_path()


class _Implementation(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes: Any = (_Locator, *_others)


class _Cache(caching.FunctionCache):  # type: ignore[misc]
    """numba's cache of a function. What cannot be read is compiled anew, what cannot be written is not kept.

    What lies beside the package is read as well where other code is kept elsewhere: it may have been compiled at
    installation.
    """

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any], suffix: str = "") -> None:
        super().__init__(function)
        kept = Path(self.cache_path)
        about = self._impl.filename_base + suffix, self._impl.locator.get_source_stamp()
        self._places = [
            caching.IndexDataCacheFile(str(place), *about) for place in dict.fromkeys((kept, _beside() / kept.name))
        ]
        self._cache_file = self._places[0]

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = None
        for place in reversed(self._places):
            self._cache_file = place
            try:
                found = super().load_overload(sig, target_context) if found is None else found
            except Exception:  # of an interrupted installation; what unpickling raises depends on the bytes
                with contextlib.suppress(OSError):
                    self.flush()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)


def _handed_on(kind: Any) -> Any:
    """Return as what type compiled code hands a value of type ``kind`` on to a function.

    A constant is handed on as any value of its type, and a whole number of 32 bits as one of 64. numba would compile
    the function, and all that it calls, again for each.
    """
    kind = types.unliteral(kind)
    return types.int64 if kind == types.int32 else kind


def _inner(function: Callable[..., Any], cache: bool, options: dict[str, Any]) -> Any:
    """Compile a function for calls from compiled code alone; the entry from Python would be more work."""
    inner = numba.njit(**options | {"no_cpython_wrapper": True})(function)
    if cache:
        inner._cache = _Cache(function, ".inner")
    return inner


def compiled(
    function: Callable[..., Any] | None = None, *, borrows: bool = False, cache: bool = True, **options: Any
) -> Any:
    """``numba.njit`` with a cache on disk, in :func:`folder` unless ``NUMBA_CACHE_DIR`` says where; without one where
    nothing can be written.

    Args:
        function: what to compile.
        borrows: the function makes no array and returns none. numba then does not count references to those that it is
            given, which takes most of the time of functions that hand tuples of arrays on (a tenfold difference, when
            measured for the observation). One that makes an array after all is refused by numba when it is compiled.
        cache: keep it on disk, which needs a function with a file.
        options: of ``numba.njit``.
    """
    if function is None:
        return functools.partial(compiled, borrows=borrows, cache=cache, **options)
    if borrows:
        options["_nrt"] = False
    options["no_cfunc_wrapper"] = True
    settings: Any = numba.config
    if settings.DISABLE_JIT:  # :func:`compiling_once` says so
        return function
    before = settings.CACHE_DIR
    settings.CACHE_DIR = before or str(folder())
    try:
        dispatcher = numba.njit(**options)(function)
        if cache:
            dispatcher._cache = _Cache(function)
        inner = _inner(function, cache, options)
        dispatcher.get_call_template = lambda args, kws: inner.get_call_template(
            tuple(map(_handed_on, args)), {name: _handed_on(kind) for name, kind in kws.items()}
        )
        dispatcher.get_overload = inner.get_overload
        return dispatcher
    finally:
        settings.CACHE_DIR = before


def line_writer(values: Sequence[Callable[..., float]], scales: Sequence[float], arguments: str) -> Any:
    """Compile ``write(ARGUMENTS, line, first)``, which writes values, each divided by its scale, from ``first`` on."""
    names = {
        f"value_{k}": compiled(value, borrows=True, cache=False, inline="always") for k, value in enumerate(values)
    }
    return _writer(arguments, [f"value_{k}({arguments}) / {scale}" for k, scale in enumerate(scales)], names)


def field_writer(fields: Sequence[str]) -> Any:
    """Compile ``write(record, line, first)``, which writes fields of a record from place ``first`` of the line on."""
    return _writer("record", [f"record.{field}" for field in fields], {})


def _writer(arguments: str, values: Sequence[str], names: dict[str, Any]) -> Any:
    lines = [f"    line[first + {k}] = {value}" for k, value in enumerate(values)]
    exec("\n".join([f"def write({arguments}, line, first):", *lines, "    return"]), names)
    return compiled(names["write"], borrows=True, cache=False)


intrinsic: Any = extending.intrinsic
"""Numba's decorator. Its callers leave out the first parameter, which type checkers do not know."""


@intrinsic
def local_floats(typing_context, count):  # type: ignore[no-untyped-def]
    """Return an array of ``count`` float32, a constant, on the stack of the compiled function that calls it.

    It must not leave that function. The compiler knows that nothing else is in that memory, and keeps it in registers.
    """
    if not isinstance(count, types.IntegerLiteral):
        return None
    array_type, length = types.Array(types.float32, 1, "C"), count.literal_value

    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        memory = cgutils.alloca_once(builder, ir.ArrayType(ir.FloatType(), length))
        array = make_array(array_type)(context, builder)
        word = ir.IntType(64)
        populate_array(
            array,
            data=builder.bitcast(memory, ir.FloatType().as_pointer()),
            shape=[ir.Constant(word, length)],
            strides=[ir.Constant(word, 4)],
            itemsize=ir.Constant(word, 4),
            meminfo=None,
        )
        return array._getvalue()

    return array_type(count), lower


@contextlib.contextmanager
def compiling_once(kernel: Any) -> Iterator[None]:
    """Where ``kernel`` is not compiled yet, say that it takes a while, and let one process compile at a time.

    Kernels share most of what they call, so a process that waited for another finds most of its own compiled. Within
    the context nothing may be waited for that another process compiles for. Where files cannot be locked, every process
    compiles. A kernel from another machine, which numba will not use, is not recognised as such.

    Args:
        kernel: numba's dispatcher, called for the first time within the context.

    Raises:
        IzooError: numba is told not to compile.
    """
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        raise IzooError("NUMBA_DISABLE_JIT is set, and environments are compiled code; unset it.")
    where, name = Path(kernel.stats.cache_path), kernel.py_func.__qualname__
    version = "".join(map(str, sys.version_info[:2]))

    def is_there() -> bool:
        places = where, _beside() / where.name
        return bool(kernel.signatures) or any(any(p.glob(f"*.{name}-*.py{version}*.nbi")) for p in places)

    if is_there():
        yield
        return
    lock = filelock.FileLock(where.parent / "compiling.lock")
    with contextlib.suppress(OSError, NotImplementedError, filelock.Timeout):
        lock.acquire(_PATIENCE_S)
    try:
        if is_there():
            lock.release()
        else:
            with _shown(kernel):
                yield
            return
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def _shown(kernel: Any) -> Iterator[None]:
    """Show on standard error which of the functions that ``kernel`` calls are compiled."""
    functions = _reached(kernel)
    total = len(functions)

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, happening: Any) -> None: ...

        def on_end(self, happening: Any) -> None:
            function = happening.data["dispatcher"].py_func
            if function in functions:
                functions.remove(function)
                with contextlib.suppress(OSError):  # the output may be lost
                    bar.update(total - len(functions), (function.__module__ or function.__name__).removeprefix("izoo."))

    with contextlib.suppress(OSError):
        print(MESSAGE, file=sys.stderr)
    bar = Progress(total, unit="functions", file=sys.stderr)
    with bar, event.install_listener("numba:compile", Listener()):
        yield


def _reached(kernel: Any) -> set[Callable[..., Any]]:
    """Return the functions that are compiled for ``kernel``: its own and all that it calls, unless inlined."""
    found: dict[Callable[..., Any], Any] = {}
    left = [kernel]
    while left:
        dispatcher = left.pop()
        function = dispatcher.py_func
        if function not in found:
            found[function] = dispatcher
            called = (function.__globals__.get(name) for name in function.__code__.co_names)
            left += [value for value in called if hasattr(value, "py_func")]
    options = {function: getattr(dispatcher, "targetoptions", {}) for function, dispatcher in found.items()}
    return {function for function, given in options.items() if given.get("inline") != "always"}
