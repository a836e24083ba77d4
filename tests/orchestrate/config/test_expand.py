"""The fast expansion gives what Hydra's own sweeper gives, for every kind of override."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra import initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf

from dopt.errors import SpecificationError
from orchestrate.config import Combination
from orchestrate.config import expand as expansion

SAMPLE = Path(__file__).parent / "sample"
SECTIONS = (
    "env", "policy", "model", "seed", "width", "scale", "label", "nothing", "nested", "new",
)  # fmt: skip

OVERRIDES = {
    "env": ["env=first,second", "env=glob(*)", "env=glob([f*,s*],exclude=second)", "env=second"],
    "policy": ["policy=plain,oracle", "policy=glob(*)", "policy=oracle", "policy=cramped,free"],
    "model": ["model=mlp", "model=linear,mlp", "model=shaped,linear"],
    "seed": ["seed=range(3)", "seed=7", "seed=choice(1,5)", "seed=sort(3,1,reverse=true)"],
    "width": ["width=8,16", "width=range(4,9,2)", "width=choice(4)", "width=float(4,5)"],
    "scale": ["scale=0.5,1e-3", "scale=range(0,0.3,0.1)", "scale=inf,-1.0"],
    "env.dt": ["env.dt=0.01,0.02", "env.dt=null", "env.dt='${scale}',0.1", "env.dt=${width}"],
    "env.gamma": ["env.gamma=1,2.5", "++env.gamma=4,5", "~env.gamma"],
    "env.masses": ["env.masses=[1,2],[3]", "env.masses=[0.5,0.5]"],
    "label": ["label='a,b',\"c d\"", "label=null,x", "label='it\\'s'", "label=a-b,1.0,true"],
    "nothing": ["nothing=null,3", "nothing={a:1},{b:2}", "~nothing", "nothing=1,[2]"],
    "new": ["+new=1,2", "++new=x", "+new={a:[1,2]}"],
    "nested": [
        "nested.inner.value=1,2", "nested.inner={value:3},{value:4}", "+nested.extra=0.1,0.2",
        "nested.inner.items=[1],[2,'${seed}']", "~nested.inner.value",
    ],
}  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """Hydra over the sample configuration, and what it composes without overrides."""

    loader: ConfigLoader
    master: DictConfig


@pytest.fixture(scope="module")
def sample() -> Iterator[Sample]:
    with initialize_config_dir(str(SAMPLE), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        yield Sample(loader, loader.load_configuration("config", [], RunMode.MULTIRUN))


def expand(sample: Sample, *grids: Sequence[str], sections: Sequence[str]) -> list[Combination]:
    master = sample.master.hydra
    return expansion.expand(master, *grids, sections=sections, check=lambda _: None)


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """Draw overrides of up to three keys, in any order, with at most 30 jobs or so."""
    keys = draw(st.lists(st.sampled_from(sorted(OVERRIDES)), unique=True, max_size=3))
    return [draw(st.sampled_from(OVERRIDES[key])) for key in keys]


def by_hydra(sample: Sample, arguments: Sequence[str]) -> Counter[str]:
    """Return the resolved jobs of the stock sweeper, each with its number."""
    parsed = OverridesParser.create(config_loader=sample.loader).parse_overrides(list(arguments))
    jobs = BasicSweeper.split_arguments(parsed, None)[0]
    configs = (sample.loader.load_sweep_config(sample.master, list(job)) for job in jobs)
    return Counter(
        frozen({key: plain(one, key) for key in one if key != "hydra"}) for one in configs
    )


def plain(config: Any, key: Any) -> object:
    value = config[key]
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def by_us(sample: Sample, arguments: Sequence[str]) -> Counter[str]:
    jobs: Counter[str] = Counter()
    for combination in expand(sample, arguments, sections=SECTIONS):
        inner = combination.seeds or [combination.settings["seed"]]
        jobs.update(frozen({**combination.settings, "seed": seed}) for seed in inner)
    return jobs


def frozen(settings: dict[Any, Any]) -> str:
    """Tell 1 from 1.0 and from "1", and forget the order of keys."""
    return json.dumps(settings, sort_keys=True)


def same(sample: Sample, arguments: Sequence[str]) -> None:
    try:
        expected = by_hydra(sample, arguments)
    except Exception as error:
        with pytest.raises(type(error)):
            by_us(sample, arguments)
    else:
        assert by_us(sample, arguments) == expected


@pytest.mark.parametrize("override", [one for many in OVERRIDES.values() for one in many])
def test_each_override_is_read_as_hydra_reads_it(sample: Sample, override: str) -> None:
    same(sample, [override])


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(arguments=command_lines())
def test_any_mixture_expands_as_by_hydra(sample: Sample, arguments: list[str]) -> None:
    same(sample, arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        ["env=first,second", "policy=plain,free", "env.dt=1,2"],
        ["env=first,second", "policy=cramped"],  # which writes to the section of env too
        ["env=first,second", "policy=cramped,plain", "model=mlp,linear"],
        ["policy=plain,free", "model=shaped"],  # the defaults of which name the policy
    ],
)
def test_options_are_exchanged_where_nothing_else_depends_on_them(
    sample: Sample, arguments: list[str]
) -> None:
    assert by_us(sample, arguments) == by_hydra(sample, arguments)


@pytest.fixture
def composed(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Return a list to which each composition by Hydra adds its overrides."""
    words: list[list[str]] = []
    compose = hydra.compose

    def counted(name: str, overrides: list[str]) -> DictConfig:
        words.append(overrides)
        return compose(name, overrides)

    monkeypatch.setattr(hydra, "compose", counted)
    return words


def test_a_grid_of_plain_options_is_composed_once(
    sample: Sample, composed: list[list[str]]
) -> None:
    jobs = by_us(sample, ["env=glob(*)", "model=mlp,linear", "scale=range(50)", "seed=range(9)"])
    assert len(composed) == 1
    assert sum(jobs.values()) == 4 * 50 * 9


def test_an_option_is_exchanged_although_another_is_not_alone_in_its_section(
    sample: Sample, composed: list[list[str]]
) -> None:
    arguments = ["policy=cramped", "env=first,second", "model=mlp,linear"]
    assert by_us(sample, arguments) == by_hydra(sample, arguments)
    assert len(composed) == 3  # one to find this out, and one for each env


def test_seeds_stay_together_unless_something_follows_them(sample: Sample) -> None:
    apart = expand(sample, ["seed=range(4)"], sections=SECTIONS)
    together = expand(sample, ["seed=range(4)", "model=linear"], sections=("policy", "seed"))
    assert [one.seeds for one in apart] == [None] * 4
    assert [one.seeds for one in together] == [(0, 1, 2, 3)]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("env=glob(frist)", "no name of env matches the pattern 'frist': did you mean 'first'"),
        ("seed=range(5,5)", "has no values"),
        ("seed=range(5,1)", "has no values"),
        ("scale=interval(0,1)", "no finite list"),
        ("width=glob(*)", "is not a group"),
        ("launch.workers=1,2", "setting of the launch"),
    ],
)
def test_sweeps_without_values_are_errors(sample: Sample, override: str, words: str) -> None:
    with pytest.raises((SpecificationError, HydraException), match=words):
        expand(sample, [override], sections=SECTIONS)


MIXED: list[tuple[list[str], list[list[str]]]] = [
    (
        ["model=linear,mlp", "model.order=2,3", "seed=range(2)"],
        [["model=linear", "model.order=2,3", "seed=range(2)"], ["model=mlp", "seed=range(2)"]],
    ),
    (
        ["policy=plain,oracle", "model.half=4", "width=8,9"],
        [["policy=plain", "model.half=4", "width=8,9"], ["policy=oracle", "width=8,9"]],
    ),
    (
        ["model.order=[1,2]", "env=glob(*)", "model=mlp,linear"],
        [["model.order=[1,2]", "env=glob(*)", "model=linear"], ["env=glob(*)", "model=mlp"]],
    ),
    (
        ["model=linear,mlp", "model.order=2", "env.masses.1=7"],
        [["model=linear", "model.order=2", "env.masses.1=7"], ["model=mlp", "env.masses.1=7"]],
    ),
]


@pytest.mark.parametrize(("arguments", "parts"), MIXED)
def test_a_key_that_some_choices_lack_holds_for_the_others(
    sample: Sample, arguments: list[str], parts: list[list[str]]
) -> None:
    """Where stock Hydra refuses the whole, the result is what it gives for each part."""
    with pytest.raises(HydraException):
        by_hydra(sample, arguments)
    expected: Counter[str] = sum((by_hydra(sample, part) for part in parts), Counter())
    assert by_us(sample, arguments) == expected
    combinations = expand(sample, arguments, sections=SECTIONS)
    assert {one.unused for one in combinations} >= {()}
    assert len({one.unused for one in combinations}) == 2


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        (
            "model.ordr=2,3",
            "setting of model 'ordr' is unknown: did you mean 'order'.* half, order, ",
        ),
        (
            "nothere=1",
            "setting 'nothere' is unknown: did you mean 'nothing'\\? Choose one of env, ",
        ),
        ("env.dtt=[1]", "setting of env 'dtt' is .*: did you mean 'dt'"),
        ("env.dtt.x=1", "setting of env 'dtt' is .*: did you mean 'dt'"),
        ("env.dt.x=1", "'x' is unknown, no setting of env.dt exists: remove it"),
    ],
)
def test_a_key_that_every_choice_lacks_is_answered_with_the_names_of_all(
    sample: Sample, override: str, sentence: str
) -> None:
    with pytest.raises(HydraException):
        by_hydra(sample, ["model=linear,mlp", override])
    with pytest.raises(SpecificationError, match=sentence):
        expand(sample, ["model=linear,mlp", override], sections=SECTIONS)


def test_a_key_has_to_be_known_to_one_of_several_grids(sample: Sample) -> None:
    grids = [["model=linear", "model.order=3"], ["model=mlp", "model.order=3"]]
    together = expand(sample, *grids, sections=SECTIONS)
    assert [(one.used, one.unused) for one in together] == [
        (("model.order",), ()),
        ((), ("model.order",)),
    ]
    with pytest.raises(SpecificationError, match="did you mean 'order'"):
        expand(sample, *grids, ["model=linear", "model.oder=3"], sections=SECTIONS)
