"""Databases made once for the tests that only read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import pytest

from analysis.data.matching import Filter
from analysis.tables.variants import VariantGroup, variant_groups
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader
from tests.analysis.synthetic import fill, make_grid

SHORT = {"env": {"horizon": 60}}
WIDTHS = (4, 8, 32, 64)
RAIL = {"bounds": {"y": [-0.5, 0.5]}}
WINDOWS = (10, 20, 40, 60)


def wide(width: int, seeds: Iterable[int], **sections: Mapping[str, object]) -> list[TrialSpec]:
    """Return D-optimal trials of a width in the cartpole."""
    model = {"model": {"width": width}}
    return make_grid(("cartpole",), ("d_optimal",), seeds, **{**SHORT, **model, **sections})


def window(size: int, seeds: Iterable[int]) -> list[TrialSpec]:
    """Return trials under random inputs whose learner has a window, in the pendulum."""
    return make_grid(("pendulum",), ("random",), seeds, learner={"window": size}, **SHORT)


def controlled(seeds: Iterable[int]) -> list[TrialSpec]:
    """Return trials that are assessed after 20, 40 and all steps."""
    task = {"task": {"name": "control", "checkpoints": [20, 40]}}
    policies = ("d_optimal", "uniform", "random")
    return make_grid(("pendulum", "quadrotor"), policies, seeds, **SHORT, **task)


def limited(
    policies: Iterable[str], seeds: Iterable[int], **sections: Mapping[str, object]
) -> list[TrialSpec]:
    """Return trials in the cartpole with a rail of half a metre to each side.

    Its bounds are counted only in half of them, and enforced in the others.
    """
    return [
        spec
        for enforced in (False, True)
        for spec in make_grid(
            ("cartpole",), policies, seeds, limits={**RAIL, "enforced": enforced},
            **{**SHORT, **sections},
        )
    ]  # fmt: skip


@pytest.fixture(scope="session")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a complete grid of three systems and five policies, one trial of which diverged.

    Beside it there are other widths of the D-optimal policy in the cartpole, other windows under
    random inputs in the pendulum, and trials with a task in the pendulum and the quadrotor.
    """
    address = f"sqlite:///{tmp_path_factory.mktemp('complete')}/results.db"
    specs = make_grid(("pendulum", "cartpole", "quadrotor"), seeds=range(5), **SHORT)
    specs += [spec for width in WIDTHS for spec in wide(width, range(5))]
    specs += [spec for size in WINDOWS for spec in window(size, range(5))]
    lost = [s for s in specs if (s.system.name, s.policy.name, s.seed) == ("cartpole", "random", 2)]
    specs += controlled(range(5))
    fill(address, specs, diverged={lost[0].trial_key: 20})
    return address


@pytest.fixture
def reader(url: str) -> Iterator[Reader]:
    with Reader.open(url) as opened:
        yield opened


@pytest.fixture
def group(reader: Reader) -> VariantGroup:
    """Return the variants of the pendulum."""
    return variant_groups(reader, Filter(("pendulum",)))[0]
