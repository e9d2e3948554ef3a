"""Compiled functions over tables that they reach through one pointer.

A tuple of arrays, handed to a compiled function, is copied field by field at every call, and every array's references
are counted; with some fifty arrays that costs minutes of compilation and most of the time of a step. Here compiled code
gets the address of a *directory*, a few 64-bit words per array (address, lengths), and ``state.vehicles[v].speed``
reads it there. Nothing is counted or copied: the caller keeps the arrays alive and never replaces them.

What such code sees are no numba arrays but *tables*, which know less and are faster. Indices are whole numbers from 0
on; a negative one is not counted from the end, but reads what is not there. Tables have elements, which are numbers or
records, rows (``state.tails[lane]``) and a ``shape``, and nothing else. The length of rows is mostly a constant of the
type, no two tables overlap, and those of a net do not change, which the compiler is told.
"""

from __future__ import annotations

import functools
import hashlib
import operator
from typing import Annotated, Any, get_type_hints

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils, errors
from numba.core.typing import signature
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_global
from numba.extending import (
    infer_getattr,
    lower_builtin,
    lower_getattr,
    lower_getattr_generic,
    lower_setattr_generic,
    models,
    register_model,
)

from izoo import compiling
from izoo.compiling import intrinsic
from izoo.errors import IzooError

compiled = functools.partial(compiling.compiled, nogil=True, error_model="numpy", _nrt=False)
"""Decorator of every compiled function of the MDP and of the twin. Such a function cannot allocate."""

Float1 = Annotated[np.ndarray, "float64", 1]
Float2 = Annotated[np.ndarray, "float64", 2]
Single2 = Annotated[np.ndarray, "float32", 2]
Int1 = Annotated[np.ndarray, "int32", 1]
Int2 = Annotated[np.ndarray, "int32", 2]
Int3 = Annotated[np.ndarray, "int32", 3]
Long1 = Annotated[np.ndarray, "int64", 1]
Byte1 = Annotated[np.ndarray, "uint8", 1]
"""Fields of a directory: type of the elements, and dimensions. A fourth entry is the number of columns, if it is a
constant; ``Annotated[np.ndarray, "float64", 2, 8]`` has eight. A field may also be a directory itself:
``Annotated[Any, KIND]`` with its :class:`TablesType`."""

WORDS = 4
"""Words of a directory per array: address, then the length of up to three dimensions."""
_WORD = ir.IntType(64)
_WORD_BYTES = 8


def _digest(what: Any) -> str:
    """Tell types of the same name apart: numba takes types of one name for one type."""
    return hashlib.sha256(repr(what).encode()).hexdigest()[:16]


class RecordType(types.Type):
    """Numba's type of a record of a table: a reference to it, whose fields are read and written."""

    def __init__(self, owner: str, field: str, kind: np.dtype, constant: bool) -> None:
        self.owner, self.field, self.kind, self.constant = owner, field, kind, constant
        self.fields: Any = kind.fields
        super().__init__(name=f"Record({owner}.{field}: {_digest(kind)}, {constant})")


class TableType(types.Type):
    """Numba's type of a table of one or two dimensions, or of a row of one.

    Args:
        owner: name of the directory's type. field: name in it.
        dtype: of the elements. dimensions: 1 or 2.
        columns: of a table of two dimensions, of a row its length; 0 where that is only known when it runs.
        constant: whether the elements never change.
    """

    def __init__(self, owner: str, field: str, dtype: Any, dimensions: int, columns: int, constant: bool) -> None:
        self.owner, self.field, self.kind = owner, field, np.dtype(dtype)
        self.dimensions, self.columns, self.constant = dimensions, columns, constant
        is_record = self.kind.names is not None
        self.dtype = RecordType(owner, field, self.kind, constant) if is_record else from_dtype(self.kind)
        super().__init__(name=f"Table({owner}.{field}: {self.dtype}, {dimensions}, {columns}, {constant})")

    @property
    def row(self) -> TableType:
        """Type of a row."""
        return TableType(self.owner, self.field, self.kind, 1, self.columns, self.constant)


class TablesType(types.Type):
    """Numba's type of a directory: which arrays, of what type, in which order.

    Attributes:
        dtypes: of the elements of each table.
        inner: types of the directories that are fields, by name.
    """

    def __init__(self, owner: str, fields: tuple[tuple[str, Any, int, int], ...], constant: bool) -> None:
        self.owner, self.fields, self.constant = owner, fields, constant
        self.inner = {name: dtype for name, dtype, *_ in fields if isinstance(dtype, TablesType)}
        self.dtypes = {name: np.dtype(dtype) for name, dtype, *_ in fields if name not in self.inner}
        super().__init__(name=f"Tables({owner}: {_digest(fields)}, {constant})")

    def table_type(self, name: str) -> TablesType | TableType | RecordType | None:
        """Return the type of the table ``name``; those of three dimensions are not for compiled code."""
        for field, dtype, dimensions, columns in self.fields:
            if field == name and isinstance(dtype, TablesType):
                return dtype
            if field == name and dimensions == 0:
                return RecordType(self.owner, field, dtype, self.constant)
            if field == name and dimensions < 3:
                return TableType(self.owner, field, dtype, dimensions, columns, self.constant)
        return None


def tables_type(owner: type, constant: bool = False) -> TablesType:
    """Return the type of a directory of the arrays of ``owner``, a NamedTuple annotated with the names above.

    Args:
        constant: whether no array changes for as long as the directory is used.
    """
    fields = []
    for name, hint in get_type_hints(owner, include_extras=True).items():
        dtype, dimensions, columns = (*hint.__metadata__, 0, 0)[:3]
        fields.append((name, dtype, dimensions, columns))
    return TablesType(owner.__name__, tuple(fields), constant)


def directory(tables: Any, kind: TablesType) -> np.ndarray:
    """Return the directory, ``[fields * WORDS]`` int64 and more, of a NamedTuple of arrays, for as long as these live.

    Raises:
        IzooError: an array has another type or shape than ``kind`` says, or is not contiguous.
    """
    words = np.empty(_count_words(kind), np.int64)
    words[:] = _words(tables, kind, words.ctypes.data)
    return words


def _count_words(kind: TablesType) -> int:
    return len(kind.fields) * WORDS + sum(map(_count_words, kind.inner.values()))


def _words(tables: Any, kind: TablesType, address: int) -> list[int]:
    """Return the words of a directory that is to lie at ``address``; behind its own come those of its inner ones."""
    own: list[int] = []
    inner: list[int] = []
    behind = address + len(kind.fields) * WORDS * _WORD_BYTES
    for name, _, dimensions, columns in kind.fields:
        array = getattr(tables, name)
        if name in kind.inner:
            own += (behind + len(inner) * _WORD_BYTES, 0, 0, 0)
            inner += _words(array, kind.inner[name], own[-WORDS])
            continue
        shape, dtype = array.shape, kind.dtypes[name]
        wide = columns == 0 or shape[-1] == columns
        if array.dtype != dtype or len(shape) != dimensions or not wide or not array.flags.c_contiguous:
            raise IzooError(
                f"{kind.owner}.{name} is {array.dtype} of shape {shape}; compiled code needs {dtype} with "
                f"{dimensions} dimensions{f' and {columns} columns' if columns else ''}, contiguous."
            )
        own += (array.ctypes.data, *shape, *(0,) * (WORDS - 1 - dimensions))
    return own + inner


@register_model(TablesType)
class _TablesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: TablesType) -> None:
        super().__init__(manager, kind, _WORD.as_pointer())


@register_model(RecordType)
class _RecordModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: RecordType) -> None:
        super().__init__(manager, kind, ir.IntType(8).as_pointer())


@register_model(TableType)
class _TableModel(models.StructModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: TableType) -> None:
        member = types.uint8 if isinstance(kind.dtype, RecordType) else kind.dtype
        members = [("data", types.CPointer(member)), ("rows", types.intp), ("columns", types.intp)]
        super().__init__(manager, kind, members)


@infer_getattr
class _TablesAttribute(AttributeTemplate):  # type: ignore[misc]
    key = TablesType

    def generic_resolve(self, kind: TablesType, name: str) -> types.Type | None:  # type: ignore[override]
        return kind.table_type(name)


@infer_getattr
class _RecordAttribute(AttributeTemplate):  # type: ignore[misc]
    key = RecordType

    def generic_resolve(self, kind: RecordType, name: str) -> types.Type | None:  # type: ignore[override]
        return from_dtype(kind.fields[name][0]) if name in kind.fields else None


@infer_getattr
class _TableAttribute(AttributeTemplate):  # type: ignore[misc]
    key = TableType

    def resolve_shape(self, kind: TableType) -> types.UniTuple:
        return types.UniTuple(types.intp, kind.dimensions)


@lower_getattr_generic(TablesType)
def _read_table(context: Any, builder: Any, kind: TablesType, value: Any, name: str) -> Any:
    table_type: Any = kind.table_type(name)
    number = [field for field, *_ in kind.fields].index(name)
    constant = builder.module.add_metadata([])

    def word(k: int) -> Any:
        load = builder.load(builder.gep(value, [ir.Constant(_WORD, number * WORDS + k)]))
        load.set_metadata("invariant.load", constant)
        return load

    if isinstance(table_type, RecordType):
        return builder.inttoptr(word(0), ir.IntType(8).as_pointer())
    if isinstance(table_type, TablesType):
        return builder.inttoptr(word(0), _WORD.as_pointer())
    table = cgutils.create_struct_proxy(table_type)(context, builder)
    table.data = builder.inttoptr(word(0), table.data.type)
    table.rows = word(1)
    table.columns = ir.Constant(_WORD, table_type.columns) if table_type.columns else word(2)
    return table._getvalue()


@lower_getattr(TableType, "shape")
def _read_shape(context: Any, builder: Any, kind: TableType, value: Any) -> Any:
    table = cgutils.create_struct_proxy(kind)(context, builder, value=value)
    lengths = [table.rows, table.columns][: kind.dimensions]
    return context.make_tuple(builder, types.UniTuple(types.intp, kind.dimensions), lengths)


def _index_type(kind: Any, index: Any) -> types.Type | None:
    """Return as what an index of a table is taken, ``None`` if it is none."""
    if not isinstance(kind, TableType):
        return None
    if isinstance(index, types.Integer):
        return types.intp
    pair = isinstance(index, types.BaseTuple) and len(index) == kind.dimensions == 2
    return types.UniTuple(types.intp, 2) if pair and all(isinstance(k, types.Integer) for k in index) else None


@infer_global(operator.getitem)
class _GetItem(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        kind, index = args
        taken = _index_type(kind, index)
        if taken is None:
            return None
        whole = isinstance(taken, types.UniTuple) or kind.dimensions == 1
        return signature(kind.dtype if whole else kind.row, kind, taken)


@infer_global(operator.setitem)
class _SetItem(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        kind, index, _ = args
        taken = _index_type(kind, index)
        if taken is None or (kind.dimensions == 2 and not isinstance(taken, types.UniTuple)):
            return None
        return signature(types.none, kind, taken, kind.dtype)


def _place(context: Any, builder: Any, kind: TableType, value: Any, index_type: Any, index: Any) -> Any:
    """Return the pointer to an element, or to the first one of a row."""
    table = cgutils.create_struct_proxy(kind)(context, builder, value=value)
    at = index
    if isinstance(index_type, types.UniTuple):
        row, column = cgutils.unpack_tuple(builder, index)
        at = builder.add(builder.mul(row, table.columns), column)
    elif kind.dimensions == 2:
        at = builder.mul(index, table.columns)
    if isinstance(kind.dtype, RecordType):
        at = builder.mul(at, ir.Constant(_WORD, kind.kind.itemsize))
    return builder.gep(table.data, [at])


def _mark(builder: Any, kind: Any, access: Any, field: str = "") -> None:
    """Tell the compiler which table, and which field, is read or written: others then need not be read again."""
    module = builder.module
    root = module.add_metadata(["tables"])
    own = module.add_metadata([f"{kind.owner}.{kind.field}{field}", root, ir.Constant(_WORD, 0)])
    access.set_metadata("tbaa", module.add_metadata([own, own, ir.Constant(_WORD, 0)]))


@lower_builtin(operator.getitem, TableType, types.Any)
def _get(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, index_type = sig.args
    place = _place(context, builder, kind, args[0], index_type, args[1])
    if isinstance(sig.return_type, TableType):
        row = cgutils.create_struct_proxy(sig.return_type)(context, builder)
        table = cgutils.create_struct_proxy(kind)(context, builder, value=args[0])
        row.data, row.rows, row.columns = place, table.columns, table.columns
        return row._getvalue()
    if isinstance(sig.return_type, RecordType):
        return place
    return _load(builder, kind, place)


def _load(builder: Any, kind: Any, place: Any, field: str = "") -> Any:
    load = builder.load(place)
    _mark(builder, kind, load, field)
    if kind.constant:
        load.set_metadata("invariant.load", builder.module.add_metadata([]))
    return load


def _field_place(context: Any, builder: Any, kind: RecordType, value: Any, name: str) -> Any:
    dtype, offset = kind.fields[name][:2]
    place = builder.gep(value, [ir.Constant(_WORD, offset)])
    return builder.bitcast(place, context.get_data_type(from_dtype(dtype)).as_pointer())


@lower_getattr_generic(RecordType)
def _get_field(context: Any, builder: Any, kind: RecordType, value: Any, name: str) -> Any:
    return _load(builder, kind, _field_place(context, builder, kind, value, name), f".{name}")


@lower_setattr_generic(RecordType)
def _set_field(context: Any, builder: Any, sig: Any, args: Any, name: str) -> None:
    kind = sig.args[0]
    _mark(builder, kind, builder.store(args[1], _field_place(context, builder, kind, args[0], name)), f".{name}")


@lower_builtin(operator.setitem, TableType, types.Any, types.Any)
def _set(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, index_type, _ = sig.args
    _mark(builder, kind, builder.store(args[2], _place(context, builder, kind, args[0], index_type, args[1])))
    return context.get_dummy_value()


LINE_BYTES = 64
"""Of the processor's cache."""


@intrinsic
def place_of(typing_context, table):  # type: ignore[no-untyped-def]
    """Return the address of the first element of a table."""
    if not isinstance(table, TableType | RecordType):
        raise errors.NumbaTypeError("only tables have a place")

    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = args[0]
        if not isinstance(signature.args[0], RecordType):
            place = cgutils.create_struct_proxy(signature.args[0])(context, builder, value=place).data
        return builder.ptrtoint(place, _WORD)

    return types.int64(table), lower


@intrinsic
def fused(typing_context, x, y, z):  # type: ignore[no-untyped-def]
    """Return ``x * y + z``, rounded once."""
    if not {x, y, z} <= {types.float64}:
        raise errors.NumbaTypeError("only float64 is multiplied and added at once")

    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fma(*args)

    return types.float64(x, y, z), lower


def opener(kind: TablesType) -> Any:
    """Return a compiled function that takes the address of a directory as the tables of ``kind``."""

    @intrinsic
    def open_tables(typing_context, address):  # type: ignore[no-untyped-def]
        if not isinstance(address, types.Integer):
            raise errors.NumbaTypeError("the address of a directory is an integer")

        def lower(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return builder.inttoptr(args[0], _WORD.as_pointer())

        return kind(types.int64), lower

    return open_tables
