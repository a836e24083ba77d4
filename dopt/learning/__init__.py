"""Learners of the model's parameters, and the registry that names them."""

from __future__ import annotations

from dopt.learning.base import InformationLearner as InformationLearner
from dopt.learning.base import Learner as Learner
from dopt.learning.online import Adam as Adam
from dopt.learning.online import AdamReplay as AdamReplay
from dopt.learning.online import AdamRule as AdamRule
from dopt.learning.online import AdamWindow as AdamWindow
from dopt.learning.online import Conditioning as Conditioning
from dopt.learning.online import ExtendedKalman as ExtendedKalman
from dopt.learning.online import GaussNewton as GaussNewton
from dopt.learning.online import JointKalman as JointKalman
from dopt.learning.online import RecursiveLeastSquares as RecursiveLeastSquares
from dopt.learning.online import SimulationError as SimulationError

LEARNERS: dict[str, type[Learner]] = {
    learner.name: learner
    for learner in (
        Adam,
        AdamWindow,
        AdamReplay,
        RecursiveLeastSquares,
        ExtendedKalman,
        GaussNewton,
        JointKalman,
        Conditioning,
        SimulationError,
    )
}
