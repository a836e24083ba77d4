"""Functions of tensors whose operations are recorded once and repeated into the same memory.

A step of one trial is made of hundreds of operations on small tensors. Most of the time goes into
deciding what to call: views, and the graph of automatic differentiation. A recording keeps what was
called, below automatic differentiation, with the tensors that it was called with. Views need not be
made again, as the memory that they look at is the same. What a repetition computes is what the
function would compute, bit for bit. On a GPU, a CUDA graph launches all operations of a recording
at once: to launch them one by one takes more than ten times as long as to compute them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

Function = Callable[..., Any]
Call = tuple[Function, Sequence[Any], Mapping[str, Any]]

FILLS = {"new_zeros", "new_ones", "zeros_like", "ones_like"}
"""Operations that read the shape of a tensor alone."""

UNREPEATABLE = {
    torch.Tag.data_dependent_output,
    torch.Tag.dynamic_output_shape,
    torch.Tag.nondeterministic_seeded,
}
"""Marks of operations that give numbers to the interpreter, or draw some."""

FIRST_CALLS = 10
"""Calls with the same shapes after which a function is recorded, which takes as long as some."""

LARGEST = {"cpu": 2**26, "cuda": 2**32}
"""Bytes of results up to which a function is recorded on a kind of device: larger tensors take
longer to compute with than to call, and a recording keeps them all."""


class Recorded:
    """A function from tensors to tensors, recorded once it is called often with the same shapes.

    It may read no other tensors that change. One that looks at numbers, to decide what to call,
    that draws them, or that is too large (:data:`LARGEST`) is called as it is, and so is one that
    gives other numbers than its recording at the call after it: it computes outside of torch. What
    a recorded one returns is overwritten by its next call.

    Parameters
    ----------
    function : callable
        Takes tensors, returns tensors or nested tuples of them.
    in_place : int
        Number of its first arguments that are read where they are; the others are copied for each
        call. They are to stay in the same memory: elsewhere, the function is recorded anew.
    """

    def __init__(self, function: Function, in_place: int = 0) -> None:
        self._function, self._in_place = function, in_place
        self._kind: tuple[object, ...] = ()
        self._calls = 0
        self._recording: Recording | None = None

    def __call__(self, *arguments: Tensor) -> Any:
        places = [(one.data_ptr(), one.stride()) for one in arguments[: self._in_place]]
        kind = (*places, *[argument.shape for argument in arguments])
        if kind != self._kind:
            self._kind, self._calls, self._recording = kind, 0, None
        self._calls += 1
        if self._recording is None and self._calls > FIRST_CALLS:
            self._recording = Recording(self._function, arguments, self._in_place)
            return self._recording.result
        if self._recording is None or not self._recording.can_be_repeated:
            return self._function(*arguments)
        if self._calls == FIRST_CALLS + 2:
            return self._recording.compared(self._function, arguments)
        return self._recording.repeat(arguments)


class Recording:
    """The operations of one call.

    Attributes
    ----------
    result : tensor or nested tuples of tensors
        What the function returned, or the last repetition.
    can_be_repeated : bool
        Whether other numbers need the same operations, and these were kept.
    """

    def __init__(self, function: Function, arguments: Sequence[Tensor], in_place: int = 0) -> None:
        copies = [argument.clone() for argument in arguments[in_place:]]
        self._inputs, self._in_place = [*arguments[:in_place], *copies], in_place
        recorder = _Recorder(self._inputs)
        with recorder:
            result = function(*self._inputs)
        self.result = _detached(result)
        self._calls = recorder.calls_for(self.result)
        self.can_be_repeated = recorder.can_be_repeated
        self._graph = self._captured() if self._calls and self._inputs[0].is_cuda else None

    @torch.no_grad()
    def repeat(self, arguments: Sequence[Tensor]) -> Any:
        """Return what the function returns for other arguments of the same shapes."""
        copied = slice(self._in_place, None)
        for own, argument in zip(self._inputs[copied], arguments[copied], strict=True):
            own.copy_(argument)
        if self._graph is None:
            self._call()
        else:
            self._graph.replay()
        return self.result

    def _call(self) -> None:
        for operation, given, named in self._calls:
            operation(*given, **named)

    @torch.no_grad()
    def _captured(self) -> torch.cuda.CUDAGraph | None:
        """Return a graph that launches the operations; None where one of them waits for the GPU."""
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.graph(graph):
                self._call()
        except RuntimeError:
            return None
        return graph

    def compared(self, function: Function, arguments: Sequence[Tensor]) -> Any:
        """Return what the function returns, and give up if a repetition gives other numbers.

        The function then computes outside of torch, or changes a tensor that it did not make there.
        """
        result = _detached(function(*arguments))
        pairs = zip(tree_leaves(result), tree_leaves(self.repeat(arguments)), strict=True)
        self.can_be_repeated = all(
            torch.allclose(one, other, rtol=0.0, atol=0.0, equal_nan=True) for one, other in pairs
        )
        return result


class _Operation(NamedTuple):
    """An operation that was called, and the memory that it reads and writes."""

    call: Call
    reads: set[int]
    writes: set[int]


class _Recorder(TorchDispatchMode):
    """Keeps the operations that were called, but for views."""

    def __init__(self, inputs: Sequence[Tensor]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # of torch
        self._inputs = {_memory(one) for one in inputs}
        self._operations: list[_Operation] = []
        self._size, self._largest = 0, LARGEST[inputs[0].device.type]
        self.can_be_repeated = True

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Return False: torch would load its compiler, for a second, to keep it away from here."""
        return False

    def __torch_dispatch__(
        self,
        operation: Any,
        types: Sequence[type],
        arguments: Sequence[Any] = (),
        named: Mapping[str, Any] | None = None,
    ) -> Any:
        named = named or {}
        result = operation(*arguments, **named)
        self._size += sum(one.nbytes for one in tree_leaves(result) if isinstance(one, Tensor))
        if self._size > self._largest or UNREPEATABLE & set(operation.tags):
            self.can_be_repeated = False
            self._operations.clear()
        if not self.can_be_repeated:
            return result
        call = _again(operation, _detached(arguments), _detached(named), _detached(result))
        reads, writes = _memories((arguments, named)), _memories(result)
        if operation.overloadpacket.__name__ in FILLS:
            reads = set()
        view = writes <= reads and not operation._schema.is_mutable
        # One that changes a shape in place is one, too: later tensors have the changed shape.
        if not view and torch.Tag.inplace_view not in operation.tags:
            self._operations.append(_Operation(call, reads, writes))
        return result

    def calls_for(self, result: Any) -> list[Call]:
        """Return the calls that depend on the inputs, and on which the result depends."""
        varying, constant = set(self._inputs), []
        for one in self._operations:
            constant.append(not one.reads & varying)
            if not constant[-1]:
                varying |= one.writes
        needed, calls = _memories(result), []
        for one, fixed in zip(reversed(self._operations), reversed(constant), strict=True):
            # What is changed in place has to be made anew each time, even if it is a constant.
            if one.writes & needed and not (fixed and not one.writes & varying):
                needed |= one.reads
                calls.append(one.call)
        return calls[::-1]


def _detached(values: Any) -> Any:
    """Return nested values with tensors that share memory and belong to no graph."""
    return tree_map_only(Tensor, lambda one: one.detach(), values)


def _again(operation: Any, arguments: Sequence[Any], named: Mapping[str, Any], result: Any) -> Call:
    """Return the call that makes the result anew in its memory."""
    results = [one for one in tree_leaves(result) if isinstance(one, Tensor)]
    writing = _writing(operation)
    if operation._schema.is_mutable:
        return operation._op, arguments, named
    if writing is not None and len(results) == 1:
        overload, name = writing
        return overload._op, arguments, {**named, name: result}
    return functools.partial(_copy, operation, results), (arguments, named), {}


def _memories(values: Any) -> set[int]:
    """Return where the tensors in nested values have their numbers."""
    return {_memory(one) for one in tree_leaves(values) if isinstance(one, Tensor)}


def _memory(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _copy(operation: Any, results: Sequence[Tensor], arguments: Any, named: Any) -> None:
    found = tree_leaves(operation(*arguments, **named))
    for own, one in zip(results, (one for one in found if isinstance(one, Tensor)), strict=True):
        own.copy_(one)


@functools.cache
def _writing(operation: Any) -> tuple[Any, str] | None:
    """Return the overload that writes its result into a tensor, and the name of that argument."""
    asked = [(one.name, str(one.type)) for one in operation._schema.arguments]
    packet = operation.overloadpacket
    for name in packet.overloads():
        overload = getattr(packet, name)
        arguments = overload._schema.arguments
        outputs = [one.name for one in arguments if one.is_out]
        others = [(one.name, str(one.type)) for one in arguments if not one.is_out]
        if len(outputs) == 1 and others == asked:
            return overload, outputs[0]
    return None
