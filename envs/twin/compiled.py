"""Compiled functions over tables that they reach through one pointer.

A tuple of arrays, handed to a compiled function, is copied field by field at every call, and every array's references
are counted; with some fifty arrays that costs minutes of compilation and most of the time of a step. Here compiled code
gets the address of a *directory*, three 64-bit words per array (address, rows, columns), and ``state.floats[v, SPEED]``
reads it there. Nothing is counted or copied: whoever calls keeps the arrays alive and never replaces them.
"""

from __future__ import annotations

import functools
from typing import Annotated, Any, get_type_hints

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, errors
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model
from numba.np.arrayobj import make_array, populate_array

from izoo import compiling
from izoo.errors import IzooError

compiled = functools.partial(compiling.compiled, nogil=True, error_model="numpy", _nrt=False)
"""Decorator of every compiled function of the twin. Such a function cannot allocate."""

Float1 = Annotated[np.ndarray, "float64", 1]
Float2 = Annotated[np.ndarray, "float64", 2]
Int1 = Annotated[np.ndarray, "int32", 1]
Int2 = Annotated[np.ndarray, "int32", 2]
Int3 = Annotated[np.ndarray, "int32", 3]
Long1 = Annotated[np.ndarray, "int64", 1]
Long2 = Annotated[np.ndarray, "int64", 2]
Byte1 = Annotated[np.ndarray, "uint8", 1]
Byte2 = Annotated[np.ndarray, "uint8", 2]

WORDS = 4
"""Words of a directory per array: address, then the length of up to three dimensions."""


class TablesType(types.Type):
    """Numba's type of a directory: which arrays, of what type, in which order."""

    def __init__(self, owner: str, fields: tuple[tuple[str, str, int], ...]) -> None:
        self.owner, self.fields = owner, fields
        super().__init__(name=f"Tables({owner}: {fields})")

    def array_type(self, name: str) -> types.Array | None:
        """Return the type of the array ``name``."""
        for field, dtype, dimensions in self.fields:
            if field == name:
                return types.Array(getattr(types, dtype), dimensions, "C")
        return None


def tables_type(owner: type) -> TablesType:
    """Return the type of a directory of the arrays of ``owner``, a NamedTuple annotated with the names above."""
    fields = []
    for name, hint in get_type_hints(owner, include_extras=True).items():
        dtype, dimensions = hint.__metadata__
        fields.append((name, dtype, dimensions))
    return TablesType(owner.__name__, tuple(fields))


def directory(tables: Any, kind: TablesType) -> np.ndarray:
    """Return the directory ``[fields * WORDS]`` int64 of a NamedTuple of arrays, for as long as these live.

    Raises:
        IzooError: an array has another type or number of dimensions than ``kind`` says, or is not contiguous.
    """
    words = np.zeros((len(kind.fields), WORDS), np.int64)
    for row, (name, dtype, dimensions) in zip(words, kind.fields, strict=True):
        array = getattr(tables, name)
        if array.dtype != np.dtype(dtype) or array.ndim != dimensions or not array.flags.c_contiguous:
            raise IzooError(
                f"{kind.owner}.{name} is {array.dtype} with {array.ndim} dimensions; compiled code needs {dtype} with "
                f"{dimensions}, contiguous."
            )
        row[0] = array.ctypes.data
        row[1 : 1 + dimensions] = array.shape
    return words.ravel()


@register_model(TablesType)
class _TablesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: TablesType) -> None:
        super().__init__(manager, kind, ir.IntType(64).as_pointer())


@infer_getattr
class _TablesAttribute(AttributeTemplate):  # type: ignore[misc]
    key = TablesType

    def generic_resolve(self, kind: TablesType, name: str) -> types.Array | None:  # type: ignore[override]
        return kind.array_type(name)


@lower_getattr_generic(TablesType)
def _read_array(context: Any, builder: Any, kind: TablesType, value: Any, name: str) -> Any:
    array_type: Any = kind.array_type(name)
    number = [field for field, *_ in kind.fields].index(name)
    constant = builder.module.add_metadata([])

    def word(k: int) -> Any:
        load = builder.load(builder.gep(value, [ir.Constant(ir.IntType(64), number * WORDS + k)]))
        load.set_metadata("invariant.load", constant)
        return load

    array = make_array(array_type)(context, builder)
    data_type = context.get_data_type(array_type.dtype)
    itemsize = context.get_abi_sizeof(data_type)
    shape = [word(1 + k) for k in range(array_type.ndim)]
    strides = [ir.Constant(ir.IntType(64), itemsize)]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    populate_array(
        array,
        data=builder.inttoptr(word(0), data_type.as_pointer()),
        shape=cgutils.pack_array(builder, shape),
        strides=cgutils.pack_array(builder, strides),
        itemsize=ir.Constant(ir.IntType(64), itemsize),
        meminfo=None,
    )
    return array._getvalue()


def opener(kind: TablesType) -> Any:
    """Return a compiled function that takes the address of a directory as the tables of ``kind``."""

    @intrinsic
    def open_tables(typing_context, address):  # type: ignore[no-untyped-def]
        if not isinstance(address, types.Integer):
            raise errors.NumbaTypeError("the address of a directory is an integer")

        def lower(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return builder.inttoptr(args[0], ir.IntType(64).as_pointer())

        return kind(types.int64), lower

    return open_tables
