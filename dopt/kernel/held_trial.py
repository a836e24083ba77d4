"""A trial with the functions of its steps, held for compiled functions that read it by pointer.

Numba takes the structures of a trial apart at each call from Python, for half a millisecond; here
that is done once.
"""

from __future__ import annotations

from numba import types
from numba.core import cgutils
from numba.experimental import structref
from numba.extending import intrinsic

from dopt.kernel.compiler import compiled
from dopt.kernel.plain import Held, or_plain
from dopt.kernel.plain import trial_in as plain_trial_in
from dopt.kernel.struct_pointers import pointer_to
from dopt.kernel.structs import Steps, Trial
from dopt.types import NumbaType


@structref.register
class HeldTrialType(types.StructRef):  # type: ignore[misc]  # numba has no types
    """Type of :class:`HeldTrial` in compiled code."""


class HeldTrial(structref.StructRefProxy):  # type: ignore[misc]
    """A trial and the functions that its steps call."""

    trial: Trial
    steps: Steps


FIELDS = ("trial", "steps")

structref.define_proxy(HeldTrial, HeldTrialType, FIELDS)


@or_plain(Held)
@compiled
def hold(trial: Trial, steps: Steps) -> HeldTrial:
    """Return a trial and its functions as one; it writes into the same arrays."""
    return HeldTrial(trial, steps)


@or_plain(plain_trial_in)
@intrinsic
def trial_in(typing_context: NumbaType, held: NumbaType) -> NumbaType:  # noqa: ARG001  # the signature is that of Numba
    """Return a pointer to the trial that is held."""

    def generate(  # the signature is that of numba
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
