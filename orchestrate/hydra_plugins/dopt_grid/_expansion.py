"""From overrides to the combinations of a grid.

Hydra composes each distinct choice of groups once, with the first value of every other sweep; the
remaining values of scalar sweeps are overlaid. An override that is neither a choice nor a scalar
is composed by Hydra for each of its values. The result equals that of Hydra's own sweeper.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

from hydra.core.config_loader import ConfigLoader
from omegaconf import DictConfig

from orchestrate.grid import TRIAL_SECTIONS, Combination
from orchestrate.hydra_plugins.dopt_grid._axes import Axis, read_axes
from orchestrate.hydra_plugins.dopt_grid._composer import Composer
from orchestrate.hydra_plugins.dopt_grid._overlay import Overlay


def expand(
    loader: ConfigLoader,
    config: DictConfig,
    arguments: Sequence[str],
    *,
    sections: Sequence[str] = TRIAL_SECTIONS,
    inner: str = "seed",
) -> list[Combination]:
    """Return the combinations of the grid that ``arguments`` span.

    Parameters
    ----------
    loader, config
        Hydra's loader, and the configuration of the launch as Hydra composed it without sweeps.
    arguments
        Overrides; a later one replaces an earlier one of the same key.
    sections
        Top-level keys that the settings of a combination hold.
    inner
        Scalar whose values stay together in one combination, if nothing else depends on it.
    """
    axes = read_axes(loader, arguments)
    scalars = [axis for axis in axes if axis.kind == "scalar" and axis.swept]
    composed = [axis for axis in axes if not (axis.kind == "scalar" and axis.swept)]
    composer = Composer(loader, config)
    result: list[Combination] = []
    for picks in itertools.product(*(range(len(axis.texts)) for axis in composed)):
        fixed = _arguments(composed, picks)
        words = tuple(fixed[axis.key] for axis in composed if axis.swept)
        first = composer.compose(_in_order(axes, fixed))
        overlay = Overlay(first, [axis.key for axis in scalars], sections)
        if overlay.applicable:
            result.extend(_overlaid(overlay, scalars, words, inner))
        else:
            result.extend(_one_by_one(composer, axes, fixed, scalars, sections))
    return result


def _arguments(axes: Sequence[Axis], picks: Sequence[int]) -> dict[str, str]:
    return {axis.key: axis.argument(pick) for axis, pick in zip(axes, picks, strict=True)}


def _in_order(axes: Sequence[Axis], fixed: dict[str, str]) -> list[str]:
    """Return an override for each axis: the one in ``fixed``, or the first value."""
    return [fixed.get(axis.key) or axis.argument(0) for axis in axes]


def _overlaid(
    overlay: Overlay, scalars: Sequence[Axis], words: tuple[str, ...], inner: str
) -> Iterator[Combination]:
    """Yield a combination for each set of values but those of ``inner``."""
    together = [axis for axis in scalars if axis.key == inner and overlay.free(inner)]
    ranges = [range(1 if axis in together else len(axis.texts)) for axis in scalars]
    for picks in itertools.product(*ranges):
        chosen = list(zip(scalars, picks, strict=True))
        yield Combination(
            settings=overlay.settings([axis.values[pick] for axis, pick in chosen]),
            inner=together[0].values if together else None,
            words=words
            + tuple(axis.argument(pick) for axis, pick in chosen if axis not in together),
        )


def _one_by_one(
    composer: Composer,
    axes: Sequence[Axis],
    fixed: dict[str, str],
    scalars: Sequence[Axis],
    sections: Sequence[str],
) -> Iterator[Combination]:
    """Let Hydra compose every combination: a typed or structured value stands where one varies."""
    for picks in itertools.product(*(range(len(axis.texts)) for axis in scalars)):
        every = fixed | _arguments(scalars, picks)
        composed = composer.compose(_in_order(axes, every))
        words = tuple(every[axis.key] for axis in axes if axis.swept)
        yield Combination(Overlay(composed, [], sections).settings([]), None, words)
