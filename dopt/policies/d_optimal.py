"""D-optimal exploration (Algorithm 2), for all learned components, and as an oracle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import InformationPolicy
from dopt.systems.base import System
from dopt.types import Buckets, Signs

SMALL_PRIMAL = 600
LARGE_DUAL = 4000
_SKETCH_SEED = 1_406_2


@dataclass(frozen=True, kw_only=True)
class DOptimal(InformationPolicy):
    """Maximise the linearised one-step information gain of one learned component (equation 7).

    The component k is drawn uniformly among the learned ones at each step.

    M is held in one of three forms. ``primal`` keeps M⁻¹, q × q. ``dual`` keeps the Gram matrix of
    the N rows seen and never builds a q × q matrix; it chooses the same inputs. ``sketch`` projects
    the gradients to ``sketch_size`` random dimensions: bounded memory for wide networks over long
    horizons, an approximation. ``auto`` takes the cheapest exact form, and the sketch when neither
    fits.

    Parameters
    ----------
    regularization : float
        λ.
    form : {"auto", "primal", "dual", "sketch"}
        Representation of the information matrix.
    sketch_size : int
        Dimensions of the sketch.
    """

    name: ClassVar[str] = "d_optimal"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.policies.d_optimal.plan"
    reads_inputs: ClassVar[bool] = True

    form: str = parameter("auto", choices=("auto", "primal", "dual", "sketch"))
    sketch_size: int = parameter(256, "dimensions", "positive")

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # of a component drawn at each step
        return (0.0,)

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:
        """Return the form for q parameters and N rows in the whole trial.

        Primal costs about q² a step, dual about N²/3 on average over the trial.
        """
        if self.form != "auto":
            return self.form
        if self.information == "fresh":
            return "primal"
        if n_parameters <= max(SMALL_PRIMAL, n_rows / 3**0.5):
            return "primal"
        return "dual" if n_rows <= LARGE_DUAL else "sketch"


def count_sketch(n_parameters: int, size: int) -> tuple[Buckets, Signs]:
    """Return the bucket, (q,), and the sign, (q,), of every parameter; the same for all trials."""
    rng = np.random.default_rng(_SKETCH_SEED)
    buckets = rng.integers(size, size=n_parameters).astype(np.uint32)
    return buckets, rng.choice([-1.0, 1.0], size=n_parameters).astype(np.int8)


@dataclass(frozen=True, kw_only=True)
class TraceLinearized(DOptimal):
    """Maximise the sum over all components k of equation 7's objective on the sphere.

    The quadratic problems of the components add up to one of the same kind, so that nothing has to
    be drawn and nothing but the linearisation is approximate.
    """

    name: ClassVar[str] = "trace_linearized"
    compiled: ClassVar[bool] = True

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # of all components
        return (1.0,)


@dataclass(frozen=True, kw_only=True)
class Oracle(DOptimal):
    """D-optimal inputs for the physical parametrisation, learned by least squares (section 3).

    It goes with ``model=linear`` and ``learner=recursive_least_squares``.

    Parameters
    ----------
    regularization : float
        λ, the ridge of the least squares as well.
    """

    name: ClassVar[str] = "oracle"
    compiled: ClassVar[bool] = True

    regularization: float = parameter(1e-6, bound="positive")

    def check(self, system: System) -> None:
        if not system.linear_parameters:
            raise IncompatibleError(
                f"policy 'oracle' needs dynamics that are linear in unknown parameters, but env "
                f"'{system.name}' declares none: choose another policy."
            )
