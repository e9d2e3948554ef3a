"""Worlds by their addresses, so that one compiled call can walk through those of many environments."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic

from izoo.compiling import compiled
from izoo.envs.mdp.state import parts_of


def _typed_address(typing_context, world):  # type: ignore[no-untyped-def]
    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        box = cgutils.create_struct_proxy(signature.args[0])(context, builder, value=args[0])
        return builder.ptrtoint(box.meminfo, ir.IntType(64))

    return types.int64(world), lower


def _typed_world(typing_context, address, like):  # type: ignore[no-untyped-def]

    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        box = cgutils.create_struct_proxy(signature.return_type)(context, builder)
        box.meminfo = builder.inttoptr(args[0], box.meminfo.type)
        return impl_ret_borrowed(context, builder, signature.return_type, box._getvalue())

    return like(types.int64, like), lower


_address: Any = intrinsic(_typed_address)
world_at: Any = intrinsic(_typed_world)
"""``world_at(address, like)``: the :class:`~izoo.envs.mdp.state.World` at an address, of the same type as ``like``."""


def _typed_parts(typing_context, world):  # type: ignore[no-untyped-def]
    pair = types.UniTuple(types.int64, 2)

    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = signature.args[0]
        size = context.get_abi_sizeof(context.data_model_manager[kind.get_data_type()].get_value_type())
        address = builder.ptrtoint(parts_of(context, builder, kind, args[0])._getpointer(), ir.IntType(64))
        return context.make_tuple(builder, pair, [address, ir.Constant(ir.IntType(64), size)])

    return pair(world), lower


_parts: Any = intrinsic(_typed_parts)


@compiled
def parts_at(world):  # type: ignore[no-untyped-def]
    """Return address and size of what a :class:`~izoo.envs.mdp.state.World` consists of: where its arrays are."""
    return _parts(world)


@compiled
def address_of(world):  # type: ignore[no-untyped-def]
    """Return the address of a :class:`~izoo.envs.mdp.state.World`, for as long as somebody holds it."""
    return _address(world)
