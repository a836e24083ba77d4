"""Compiled execution of a trial on one core.

It computes what :mod:`dopt.reference` defines, for every model, policy and learner whose class
declares ``compiled = True`` and every system whose equations compile.
"""

from __future__ import annotations

EVERYTHING = "everything"
"""Mark of a cache that holds all that :func:`warm_up` compiles."""


def warm_up() -> None:
    """See to it that the disk cache holds the kernel for all registered systems.

    Called once before worker processes start, so that they find compiled code.
    """
    from dopt.kernel.cache import is_complete, mark_complete

    if is_complete(EVERYTHING):
        return
    from dopt.kernel.equations import compiled_equations
    from dopt.kernel.run import run_trial_in_kernel
    from dopt.kernel.warming import compile_in_two_processes
    from dopt.spec.trial import TrialSpec
    from dopt.systems import SYSTEMS

    compile_in_two_processes()
    for system in SYSTEMS.values():
        compiled_equations(system())
    section = {"name": "pendulum", "horizon": 2, "grid_points": [2, 2]}
    names = {"policy": "d_optimal", "model": "mlp", "learner": "adam_window"}
    sections = {key: {"name": name} for key, name in names.items()}
    run_trial_in_kernel(TrialSpec.from_mapping({"env": section, **sections, "seed": 0}))
    mark_complete(EVERYTHING)
