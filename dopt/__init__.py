"""D-optimal neural exploration of nonlinear physical systems.

The science, as functions of their arguments: no files, no database, no command line. A
:class:`~dopt.spec.TrialSpec` says everything that a trial depends on, and
:func:`dopt.exploration.run_trial` turns it into a :class:`~dopt.result.TrialResult`.
"""
