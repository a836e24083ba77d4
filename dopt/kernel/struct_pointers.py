"""Pointers to structures, through which compiled functions read a trial.

Numba hands a named tuple to a function by value, and counts the references to each of its arrays;
a trial has more than a hundred. A pointer is one word, and what a function does not read costs
nothing.
"""

from __future__ import annotations

import functools
import hashlib

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, lower_getattr_generic, models, register_model

from dopt.types import NumbaType


class StructPointer(types.Type):  # type: ignore[misc]  # numba has no types
    """Type of a pointer to a named tuple, whose fields it has.

    A field that is a named tuple is a pointer itself. An array is borrowed: compiled code does not
    count references to it, so that whoever holds the structure has to hold it until the function
    returns, and the function may not return it.
    """

    def __init__(self, struct: NumbaType) -> None:
        self.struct = struct
        digest = hashlib.sha256(str(struct).encode()).hexdigest()[:16]
        super().__init__(f"pointer({struct.instance_class.__name__}, {digest})")

    def field(self, name: str) -> NumbaType:
        """Return the type of a field."""
        kind = self.struct.types[self.struct.fields.index(name)]
        return pointer_to(kind) if isinstance(kind, types.NamedTuple) else kind


@functools.cache
def pointer_to(struct: NumbaType) -> StructPointer:
    """Return the type of a pointer to a named tuple of a type."""
    return StructPointer(struct)


def field_address(
    context: NumbaType, builder: NumbaType, struct: NumbaType, address: NumbaType, name: str
) -> NumbaType:
    """Generate the address of a field of a named tuple at an address."""
    start = builder.bitcast(address, context.get_value_type(struct).as_pointer())
    return cgutils.gep_inbounds(builder, start, 0, struct.fields.index(name))


@register_model(StructPointer)
class _Address(models.OpaqueModel):  # type: ignore[misc]
    """A pointer in machine code."""


@infer_getattr
class _Fields(AttributeTemplate):  # type: ignore[misc]
    key = StructPointer

    def generic_resolve(self, kind: StructPointer, name: str) -> NumbaType:
        return kind.field(name) if name in kind.struct.fields else None


@lower_getattr_generic(StructPointer)
def _read_field(
    context: NumbaType, builder: NumbaType, kind: StructPointer, value: NumbaType, name: str
) -> NumbaType:
    address = field_address(context, builder, kind.struct, value, name)
    field = kind.field(name)
    if isinstance(field, StructPointer):
        return builder.bitcast(address, cgutils.voidptr_t)
    loaded = builder.load(address)
    if not isinstance(field, types.Array):
        return loaded
    array = context.make_helper(builder, field, value=loaded)
    array.meminfo = ir.Constant(array.meminfo.type, None)
    return array._getvalue()
