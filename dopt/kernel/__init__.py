"""Compiled execution of a trial on one core.

It runs every model, policy and learner whose class declares ``compiled = True``, and every system
whose equations compile. Its oracles, in plain numpy, are in ``tests/dopt/oracles``.
"""

from __future__ import annotations

MARKS = {False: "trials of the paper", True: "everything"}
"""Marks of a cache that holds what :func:`warm_up` compiles, without and with everything."""


def warm_up(everything: bool = False) -> None:
    """See to it that the disk cache holds the kernel for all registered systems.

    Called once before worker processes start, so that they find compiled code.

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
    from dopt.kernel.cache import compile_missing
    from dopt.kernel.warming import kernel_parts

    parts = kernel_parts(everything)
    compile_missing([*parts])
    for part in parts.values():  # also what no other process could compile
        part()
    for mark in {False, everything}:
        cache.mark_complete(MARKS[mark])
