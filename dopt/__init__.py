"""D-optimal neural exploration of nonlinear physical systems.

The science, as functions of their arguments: no files, no database, no command line. A
:class:`TrialSpec` describes everything that a trial depends on, and :func:`run_trial` turns it into
a :class:`TrialResult`:

>>> import dopt
>>> spec = dopt.TrialSpec.from_names(env="pendulum", policy="d_optimal", seed=0)
>>> result = dopt.run_trial(spec)
>>> result.loss[-1]  # L2 model error over the evaluation grid [rad/s²]
>>> result.states  # (501, 2): angle [rad] and angular rate [rad/s]

The four registries map the names of a specification to its classes; ``help(dopt.SYSTEMS["arm"])``
shows the equations, units and defaults of one.

======================  ========================================================================
``run_trial``           run one trial, in compiled code where there is some for its parts
``Explorer``            explore a plant that is measured: which input next, and what followed
``Plant``               names, units, bounds and the known part of such a plant
``unknown``             a constant, delay or lag of a plant that a fit estimates
``encoder``             how an angle of a plant is measured
``Log``                 a recorded run of a plant, in pieces without gaps
``fit``                 fit a plant's unknown constants and a network to recorded logs
``choose``              which recorded segments, or input signals, tell most of a plant
``fit_offline``         fit the model of a trial to samples, all at once
``TrialSpec``           one trial: system, policy, model, learner and seed
``TrialResult``         losses, states, inputs and model parameters of one trial
``SYSTEMS``             systems with equations by name
``POLICIES``            exploration policies by name
``MODELS``              models of the learned accelerations by name
``LEARNERS``            learning rules by name
``DoptError``           base of all errors that say what was given, expected, and what to do
======================  ========================================================================

Each name is imported when it is first used: ``import dopt`` alone loads none of the libraries.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dopt.errors import DoptError as DoptError
    from dopt.explorer import Explorer as Explorer
    from dopt.fitting.choice import choose as choose
    from dopt.fitting.fit import fit as fit
    from dopt.learning import LEARNERS as LEARNERS
    from dopt.log import Log as Log
    from dopt.models import MODELS as MODELS
    from dopt.offline_fit import fit_offline as fit_offline
    from dopt.policies import POLICIES as POLICIES
    from dopt.result import TrialResult as TrialResult
    from dopt.run import run_trial as run_trial
    from dopt.spec.trial import TrialSpec as TrialSpec
    from dopt.systems import SYSTEMS as SYSTEMS
    from dopt.systems.plant import Plant as Plant
    from dopt.systems.plant import encoder as encoder
    from dopt.systems.plant import unknown as unknown

__version__ = "0.1.0"  # also where nothing is installed, as beside PYTHONPATH in the image

_MODULES = {
    "DoptError": "dopt.errors",
    "Explorer": "dopt.explorer",
    "LEARNERS": "dopt.learning",
    "Log": "dopt.log",
    "MODELS": "dopt.models",
    "POLICIES": "dopt.policies",
    "Plant": "dopt.systems.plant",
    "SYSTEMS": "dopt.systems",
    "TrialResult": "dopt.result",
    "TrialSpec": "dopt.spec.trial",
    "choose": "dopt.fitting.choice",
    "encoder": "dopt.systems.plant",
    "fit": "dopt.fitting.fit",
    "fit_offline": "dopt.offline_fit",
    "run_trial": "dopt.run",
    "unknown": "dopt.systems.plant",
}

__all__ = [*_MODULES, "__version__"]


def _load(name: str) -> object:
    """Import a public name on its first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


if not TYPE_CHECKING:  # a type checker would take every name for one that there is
    __getattr__ = _load  # PEP 562


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
