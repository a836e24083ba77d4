"""Compiled execution of a trial on one core.

It runs every model, policy and learner whose class declares ``compiled = True``, and every system
whose equations compile. Its oracles, in plain numpy, are in ``tests/dopt/oracles``.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dopt.spec.config import TrialConfig

MARKS = {False: "trials of the paper", True: "everything"}
"""Marks of a cache that holds what :func:`warm_up` compiles, without and with everything."""


def warm_up(everything: bool = False) -> None:
    """Compile the kernel for all registered systems into the disk cache.

    Parameters
    ----------
    everything : bool
        Whether to compile every policy, learner and form of the information matrix, which
        otherwise happens when a trial first needs it.

    Raises
    ------
    UnusableEnvironmentError
        If nothing can be compiled here.
    """
    from dopt.kernel import cache
    from dopt.kernel.plain import PLAIN

    cache.check_environment()
    if PLAIN or cache.is_complete(MARKS[everything]):
        return
    from dopt.kernel.warming import kernel_parts

    parts = kernel_parts(everything)
    cache.compile_missing([*parts])
    for part in parts.values():  # also what no other process could compile
        part()
    for mark in {False, everything}:
        cache.mark_complete(MARKS[mark])


def kinds_of(configs: Iterable[TrialConfig]) -> dict[str, TrialConfig]:
    """Return the first configuration of each kind: its trials call the same compiled code.

    Networks of other widths can need another form of M, which is compiled when a trial first does.
    """
    kinds: dict[str, TrialConfig] = {}
    for config in configs:
        system, policy, measured = config.system, config.policy, bool(config.system.n_measured)
        classes = [type(part) for part in (system, policy, config.model, config.learner)]
        held = getattr(policy, "information", ""), getattr(policy, "form", "")
        other = system.n_states, system.integrator, measured, config.limits is None
        kinds.setdefault(str((classes, held, other)), config)
    return kinds


@contextlib.contextmanager
def compiling(configs: Iterable[TrialConfig]) -> Iterator[None]:
    """Compile what the trials need in other processes while the block runs; wait at its end.

    What is in the cache already, or is the user's, is not compiled; and what could not be compiled
    is left to the trials.

    Raises
    ------
    UnusableEnvironmentError
        If nothing can be compiled here.
    """
    from dopt.kernel import cache
    from dopt.kernel.plain import PLAIN

    cache.check_environment()
    kinds = kinds_of(configs)
    mark = f"kinds-{hashlib.sha256(str(sorted(kinds)).encode()).hexdigest()[:16]}"
    if PLAIN or not kinds or cache.is_complete(mark):  # seen without the compiler, which takes time
        yield
        return
    from dopt.kernel.warming import needed_parts

    parts = needed_parts(kinds.values())
    with cache.compiling(parts):
        yield
    if not cache.missing(parts):
        cache.mark_complete(mark, cache.files_of(parts))
