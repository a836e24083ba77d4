"""Structures that are passed to compiled functions as one word.

Numba hands a named tuple to a function by value, and counts the references to each of its arrays; a
trial has more than a hundred. A pointer is one word, and what a function does not read costs
nothing. A trial, or a plant, is taken apart once and held; each call from Python would otherwise
cost half a millisecond.
"""

from __future__ import annotations

import functools
import hashlib
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.experimental import structref
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model

from dopt.kernel.compiler import compiled
from dopt.kernel.plain import Held, or_plain
from dopt.kernel.plain import trial_in as plain_trial_in
from dopt.kernel.structs import Plant, Steps, Trial
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
    start = builder.bitcast(value, context.get_value_type(kind.struct).as_pointer())
    address = cgutils.gep_inbounds(builder, start, 0, kind.struct.fields.index(name))
    field = kind.field(name)
    if isinstance(field, StructPointer):
        return builder.bitcast(address, cgutils.voidptr_t)
    loaded = builder.load(address)
    if not isinstance(field, types.Array):
        return loaded
    array = context.make_helper(builder, field, value=loaded)
    array.meminfo = ir.Constant(array.meminfo.type, None)
    return array._getvalue()


@structref.register
class HeldTrialType(types.StructRef):  # type: ignore[misc]  # numba has no types
    """Type of :class:`HeldTrial` in compiled code."""


class HeldTrial(structref.StructRefProxy):  # type: ignore[misc]
    """A trial and the functions that its steps call; or a plant."""

    trial: Any  # Trial or Plant
    steps: Steps


FIELDS = ("trial", "steps")

structref.define_proxy(HeldTrial, HeldTrialType, FIELDS)


@or_plain(Held)
@compiled
def hold(trial: Trial | Plant, steps: Steps | int) -> HeldTrial:
    """Return a trial, or a plant, and its functions as one; it writes into the same arrays."""
    return HeldTrial(trial, steps)


@or_plain(plain_trial_in)
@intrinsic
def trial_in(typing_context: NumbaType, held: NumbaType) -> NumbaType:  # noqa: ARG001  # Numba's signature
    """Return a pointer to the trial, or plant, that is held."""

    def generate(  # Numba's signature
        context: NumbaType,
        builder: NumbaType,
        signature: NumbaType,  # noqa: ARG001
        arguments: NumbaType,
    ) -> NumbaType:
        kept = context.make_helper(builder, held, value=arguments[0])
        start = context.nrt.meminfo_data(builder, kept.meminfo)
        fields = context.get_value_type(held.get_data_type())
        place = [*held.field_dict].index("trial")
        start = builder.bitcast(start, fields.as_pointer())
        address = cgutils.gep_inbounds(builder, start, 0, place)
        return builder.bitcast(address, cgutils.voidptr_t)

    return pointer_to(held.field_dict["trial"])(held), generate
