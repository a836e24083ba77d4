"""Expansion of overrides to the combinations of a grid.

Hydra composes each distinct choice of groups once, with the first value of every other sweep; the
other values of scalar sweeps are then set in the composed configuration. An override that is
neither a choice nor a scalar is composed by Hydra for each of its values. The result equals that
of Hydra's basic sweeper wherever that one succeeds, but for the values of some sweeps
(:mod:`orchestrate.config.sweep_axes`).

The basic sweeper fails if an override sets a key that only some of the choices have, such as
``policy.regularization=1e-2`` with every policy. Here the override applies to the choices that have
the key; it is an error only if no choice of any grid has it.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence

from hydra.core.config_loader import ConfigLoader
from omegaconf import DictConfig

from orchestrate.config.fast_compose import Composer
from orchestrate.config.grid import TRIAL_SECTIONS, Combination
from orchestrate.config.scalar_overrides import ScalarOverrides, has_key
from orchestrate.config.sweep_axes import Axis, read_axes
from orchestrate.config.unknown_keys import UnusedKeys

Check = Callable[[DictConfig], None]


def expand(
    loader: ConfigLoader,
    config: DictConfig,
    *grids: Sequence[str],
    sections: Sequence[str] = TRIAL_SECTIONS,
    grouped: str = "seed",
    check: Check = lambda _: None,
) -> list[Combination]:
    """Return the combinations of one or several grids, of which ``build_grid`` makes trials.

    Parameters
    ----------
    loader, config
        Hydra's loader, and the configuration of the launch as Hydra composed it without sweeps.
    grids
        Overrides that span each grid (:func:`orchestrate.config.sweep_axes.read_axes`).
    sections
        Top-level keys that the settings of a combination hold.
    grouped
        Scalar whose values stay together in one combination, if nothing else depends on it.
    check
        Called with each composed configuration; raises if that is invalid.

    Raises
    ------
    SpecificationError
        If an override sets a key that no choice of any grid has.
    """
    expansion = _Expansion(Composer(loader, config), sections, grouped, check)
    result: list[Combination] = []
    for arguments in grids:
        axes = read_axes(loader, arguments)
        fixed = [axis for axis in axes if not (axis.kind == "scalar" and axis.swept)]
        for picks in itertools.product(*(range(len(axis.texts)) for axis in fixed)):
            result.extend(expansion.combinations(axes, _arguments(fixed, picks)))
    expansion.keys.check_all_used()
    return result


@dataclasses.dataclass
class _Expansion:
    """State shared by the combinations of all choices."""

    composer: Composer
    sections: Sequence[str]
    grouped: str
    check: Check
    keys: UnusedKeys = dataclasses.field(default_factory=UnusedKeys)

    def combinations(self, axes: Sequence[Axis], fixed: Mapping[int, str]) -> Iterator[Combination]:
        """Yield the combinations of one choice of all overrides except swept scalars."""
        first, lacking = self._compose(axes, fixed)
        self.check(first)
        unused = tuple(axis.key for axis in lacking)
        kept = [axis for axis in axes if axis not in lacking]
        used = tuple(axis.key for axis in kept if axis.replaces)
        self.keys.note(first, used, unused)
        scalars = [axis for axis in kept if axis.kind == "scalar" and axis.swept]
        overrides = tuple(fixed[axis.place] for axis in kept if axis.swept and axis.place in fixed)
        overlay = ScalarOverrides(first, [axis.key for axis in scalars], self.sections)
        if overlay.applicable:
            found = _overlaid(overlay, scalars, overrides, self.grouped)
        else:
            found = self._one_by_one(kept, fixed, scalars)
        yield from (dataclasses.replace(one, used=used, unused=unused) for one in found)

    def _compose(
        self, axes: Sequence[Axis], fixed: Mapping[int, str]
    ) -> tuple[DictConfig, list[Axis]]:
        """Return the configuration, and the axes whose key this choice lacks."""
        overrides = _in_order(axes, fixed)
        composed = self.composer.attempt(overrides)
        lacking = [] if composed is not None else self._lacking(axes, fixed)
        if lacking:
            kept = [axis for axis in axes if axis not in lacking]
            composed = self.composer.compose(_in_order(kept, fixed))
        return composed or self.composer.like_hydra(overrides), lacking

    def _lacking(self, axes: Sequence[Axis], fixed: Mapping[int, str]) -> list[Axis]:
        replacing = [axis for axis in axes if axis.replaces]
        others = [axis for axis in axes if axis not in replacing]
        bare = self.composer.attempt(_in_order(others, fixed))
        return [axis for axis in replacing if bare and not has_key(bare, axis.key)]

    def _one_by_one(
        self, axes: Sequence[Axis], fixed: Mapping[int, str], scalars: Sequence[Axis]
    ) -> Iterator[Combination]:
        """Compose each combination with Hydra: a swept key holds a typed or structured value."""
        for picks in itertools.product(*(range(len(axis.texts)) for axis in scalars)):
            every = {**fixed, **_arguments(scalars, picks)}
            composed = self.composer.compose(_in_order(axes, every))
            overrides = tuple(every[axis.place] for axis in axes if axis.swept)
            yield Combination(
                ScalarOverrides(composed, [], self.sections).settings([]), None, overrides
            )


def _arguments(axes: Sequence[Axis], picks: Sequence[int]) -> dict[int, str]:
    return {axis.place: axis.argument(pick) for axis, pick in zip(axes, picks, strict=True)}


def _in_order(axes: Sequence[Axis], fixed: Mapping[int, str]) -> list[str]:
    """Return an override for each axis: the one in ``fixed``, or the first value."""
    return [fixed.get(axis.place) or axis.argument(0) for axis in axes]


def _overlaid(
    overlay: ScalarOverrides, scalars: Sequence[Axis], overrides: tuple[str, ...], grouped: str
) -> Iterator[Combination]:
    """Yield a combination for each set of values but those of ``grouped``."""
    together = [axis for axis in scalars if axis.key == grouped and overlay.free(grouped)]
    ranges = [range(1 if axis in together else len(axis.texts)) for axis in scalars]
    for picks in itertools.product(*ranges):
        chosen = list(zip(scalars, picks, strict=True))
        yield Combination(
            settings=overlay.settings([axis.values[pick] for axis, pick in chosen]),
            seeds=together[0].values if together else None,
            overrides=overrides
            + tuple(axis.argument(pick) for axis, pick in chosen if axis not in together),
        )
