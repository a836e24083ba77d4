"""A glob without a folder is Hydra's own; one with a folder finds what is in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hydra import initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob

from dopt.errors import SpecificationError
from orchestrate.config.sweeps import read_axes

NAMES = ("plain", "random", "far/exact", "far/random", "far/trace", "near/plain")


@pytest.fixture
def loader(tmp_path: Path) -> Iterator[ConfigLoader]:
    for name in NAMES:
        path = tmp_path / f"choice_of/{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("value: 1\n")
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def found(loader: ConfigLoader, glob: str) -> tuple[str, ...]:
    return read_axes(loader, [f"choice_of={glob}"])[0].texts


@pytest.mark.parametrize(
    "glob", ["glob(*)", "glob(p*)", "glob([r*,p*])", "glob(*,exclude=p*)", "glob(*,exclude=[p*,z])"]
)
def test_without_a_folder_it_is_that_of_hydra(loader: ConfigLoader, glob: str) -> None:
    parser = OverridesParser.create(config_loader=loader)
    (override,) = parser.parse_overrides([f"choice_of={glob}"])
    assert isinstance(override.value(), Glob)
    assert found(loader, glob) == tuple(override.sweep_string_iterator())


@pytest.mark.parametrize(
    ("glob", "names"),
    [
        ("glob(far/*)", ("far/exact", "far/random", "far/trace")),
        ("glob([*,far/*])", ("plain", "random", "far/exact", "far/random", "far/trace")),
        ("glob([far/*,near/*],exclude=*)", ("far/exact", "far/random", "far/trace", "near/plain")),
        ("glob([*,far/*],exclude=[p*,far/r*])", ("random", "far/exact", "far/trace")),
    ],
)
def test_with_a_folder_it_is_what_is_in_there(
    loader: ConfigLoader, glob: str, names: tuple[str, ...]
) -> None:
    assert found(loader, glob) == names


def test_one_that_matches_nothing_names_what_is_near(loader: ConfigLoader) -> None:
    with pytest.raises(SpecificationError, match=r"did you mean 'far/exact'.* near/plain"):
        found(loader, "glob(far/exakt)")
    assert loader.get_group_options("choice_of", ObjectType.GROUP) == ["far", "near"]
