"""The fast expansion gives what Hydra's own sweeper gives, for every kind of override."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra import initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob
from hydra.errors import HydraException
from hydra.types import RunMode
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf

from dopt.errors import SpecificationError
from orchestrate.config import Combination
from orchestrate.config.expand import expand
from orchestrate.config.options import parsed_overrides, read_axes

SAMPLE = Path(__file__).parent / "sample"
SECTIONS = (
    "env", "policy", "model", "seed", "width", "scale", "label", "nothing", "nested", "new",
)  # fmt: skip

OVERRIDES = {
    "env": ["env=first,second", "env=glob(*)", "env=glob([f*,s*],exclude=second)", "env=second"],
    "policy": ["policy=plain,oracle", "policy=glob(*)", "policy=oracle", "policy=cramped,free"],
    "model": ["model=mlp", "model=linear,mlp", "model=shaped,linear"],
    "seed": ["seed=range(3)", "seed=7", "seed=choice(1,5)", "seed=sort(3,1,reverse=true)"],
    "forced": ["++seed=4,5", "++seed=6"],
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


def expanded(sample: Sample, *grids: Sequence[str], sections: Sequence[str]) -> list[Combination]:
    master = sample.master.hydra
    return expand(master, *grids, sections=sections, check=lambda _: None)


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
    for combination in expanded(sample, arguments, sections=SECTIONS):
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


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    apart = expanded(sample, ["seed=range(4)"], sections=SECTIONS)
    together = expanded(sample, ["seed=range(4)", "model=linear"], sections=("policy", "seed"))
    assert [one.seeds for one in apart] == [None] * 4
    assert [one.seeds for one in together] == [(0, 1, 2, 3)]


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
    combinations = expanded(sample, arguments, sections=SECTIONS)
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
        ("dt=1", "setting 'dt' is unknown: did you mean 'env.dt'"),
        ("order=1", "setting 'order' is unknown: did you mean 'model.order'"),
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
        expanded(sample, ["model=linear,mlp", override], sections=SECTIONS)


def test_a_key_has_to_be_known_to_one_of_several_grids(sample: Sample) -> None:
    grids = [["model=linear", "model.order=3"], ["model=mlp", "model.order=3"]]
    together = expanded(sample, *grids, sections=SECTIONS)
    found = [(one.used, one.unused) for one in together]
    assert found == [(("model.order",), ()), ((), ("model.order",))]
    with pytest.raises(SpecificationError, match="did you mean 'order'"):
        expanded(sample, *grids, ["model=linear", "model.oder=3"], sections=SECTIONS)


@pytest.fixture
def loader(sample: Sample) -> ConfigLoader:
    return sample.loader


@pytest.fixture
def hydra_settings(loader: ConfigLoader) -> DictConfig:
    return loader.load_configuration("config", [], RunMode.RUN).hydra


def swept(loader: ConfigLoader, word: str) -> list[object]:
    """Return the values of an override; what is set is what is shown."""
    (axis,) = read_axes(loader, [f"scale={word}"])
    shown = [parsed_overrides([f"scale={text}"])[0].value() for text in axis.texts]
    assert shown == list(axis.values)
    assert [type(value) for value in shown] == [type(value) for value in axis.values]
    return shown


def decimals(start: str, stop: str, step: str) -> list[float]:
    """Return the values of a range by school arithmetic."""
    first, last, by = Decimal(start), Decimal(stop), Decimal(step)
    values = []
    while (first < last) if by > 0 else (first > last):
        values.append(float(first))
        first += by
    return values


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("sort(range(0,5,2),reverse=true)", [4, 2, 0]),
        ("sort(range(10,31,7),reverse=true)", [24, 17, 10]),
        ("sort(range(10,0,-3))", [1, 4, 7, 10]),
        ("sort(range(10,0,-3),reverse=true)", [10, 7, 4, 1]),
        ("sort(sweep=range(0,5,2),reverse=true)", [4, 2, 0]),
        ("sort(shuffle(range(0,5,2)))", [0, 2, 4]),
        ("sort(tag(a,range(0,5,2)),reverse=true)", [4, 2, 0]),
        ("float(sort(range(3),reverse=true))", [2.0, 1.0, 0.0]),
        ("sort(3,1,2,reverse=true)", [3, 2, 1]),
        ("range(10,0,-3)", [10, 7, 4, 1]),
        ("range(0,0.9,0.3)", [0.0, 0.3, 0.6]),
        ("range(1e-3,5e-3,1e-3)", [0.001, 0.002, 0.003, 0.004]),
        ("range(1e20,1e20,1)", []),
        ("range(3.0)", [0.0, 1.0, 2.0]),
        ("float(range(3))", [0.0, 1.0, 2.0]),
        ("int(range(0.5,3.5))", [0, 1, 2]),
        ("range(stop=3,start=1)", [1, 2]),
        ("range(3),5", [0, 1, 2, 5]),
        ("5,range(0,0.2,0.1)", [5, 0.0, 0.1]),
        ("shuffle(range(4))", [0, 1, 2, 3]),
        ("shuffle(3,1,2)", [3, 1, 2]),
        ("shuffle(choice(b,a))", ["b", "a"]),
        ("str(1,2)", ["1", "2"]),
        ("str(1,a,true,'it is')", ["1", "a", "true", "it is"]),
        ("tag(a,b,choice(2,1))", [2, 1]),
        ("choice(1,1)", [1, 1]),  # which the grid runs once
    ],
)
def test_the_values_are_those_of_the_words(
    loader: ConfigLoader, word: str, expected: list[object]
) -> None:
    if not expected:
        with pytest.raises(HydraException, match="has no values"):
            swept(loader, word)
        return
    found = swept(loader, word)
    assert found == expected
    assert [type(value) for value in found] == [type(value) for value in expected]


TENTHS = st.integers(-400, 400).map(lambda k: f"{Decimal(k).scaleb(-2)}")


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(start=TENTHS, stop=TENTHS, step=TENTHS)
def test_a_range_has_the_nearest_decimals(
    loader: ConfigLoader, start: str, stop: str, step: str
) -> None:
    assume(Decimal(step) != 0)
    expected = decimals(start, stop, step)
    assume(expected)
    assert swept(loader, f"range({start},{stop},{step})") == expected
    for reverse in ("true", "false"):
        word = f"sort(range({start},{stop},{step}),reverse={reverse})"
        assert swept(loader, word) == sorted(expected, reverse=reverse == "true")


@pytest.mark.parametrize(
    ("word", "words"),
    [
        ("scale=interval(0,1)", "no finite list"),
        ("scale=range(0,5,0)", "a step other than 0"),
        ("scale=range(0,1,0.0)", "a step other than 0"),
        ("scale=int(range(0,3,0.5))", "a step other than 0"),
        ("scale=range(0,inf)", "no finite list"),
        ("scale=range(nan,1)", "no finite list"),
        ("scale=sort(range(0,inf))", "no finite list"),
        ("scale=range(0,1e9)", "more than 1,000,000"),
        ("scale=str(range(3))", "int or float"),
        ("scale=shuffle([1,2,3])", "another value each time"),
        ("scale=shuffle(list=[1,2,3])", "another value each time"),
        ("scale=[range(3)]", "within a list or a mapping"),
        ("nested={value:[shuffle(1,2)]}", "within a list or a mapping"),
    ],
)
def test_what_has_no_such_values_is_refused(loader: ConfigLoader, word: str, words: str) -> None:
    with pytest.raises(HydraException, match=words):
        read_axes(loader, [word])


@pytest.mark.parametrize(
    "words",
    [
        ["nested.inner={value:3}", "nested.inner={items:[4]}"],
        ["nested={inner:{value:3,items:[4]}}", "nested={inner:{items:[5]}}"],
        ["nested.inner={value:3}", "nested.inner.value=4", "nested.inner={items:[5]}"],
        ["nested.inner={value:3}", "nested.inner.value=4", "nested.inner={value:5}"],
        ["nothing={a:1}", "nothing=3", "nothing={b:2}"],
        ["++nothing={a:1}", "++nothing={b:2}", "++nothing=null"],
        ["++nothing={a:{b:1,c:[1]}}", "++nothing={a:{c:[2]}}"],
        ["++nothing={a:'x,y'}", '++nothing={b:"it is"}'],
        ["+new={a:1}", "+new={b:2}"],
        ["++new={a:1}", "++new={a:2,b:2}"],
        ["scale=1.0", "nested={inner:{value:1}}", "scale=2.0"],
    ],
)
def test_repeated_overrides_hold_as_in_a_single_trial(
    loader: ConfigLoader, hydra_settings: DictConfig, words: list[str]
) -> None:
    single = loader.load_configuration("config", words, RunMode.RUN)
    expected = {key: single[key] for key in SECTIONS if key in single}
    (one,) = expand(hydra_settings, words, sections=SECTIONS, check=lambda _: None)
    plain: dict[Any, Any] = {
        key: OmegaConf.to_container(part, resolve=True) if OmegaConf.is_config(part) else part
        for key, part in expected.items()
    }
    assert one.settings == plain


def test_repeated_mappings_are_swept_together(hydra_settings: DictConfig) -> None:
    words = ["++new={a:1},{a:2}", "++new={b:3},{b:4}"]
    found = expand(hydra_settings, words, sections=SECTIONS, check=lambda _: None)
    assert [one.settings["new"] for one in found] == [
        {"a": a, "b": b} for a in (1, 2) for b in (3, 4)
    ]
    shown = [one.overrides for one in found][:2]
    assert shown == [("++new={a:1}", "++new={b:3}"), ("++new={a:1}", "++new={b:4}")]


NAMES = ("plain", "random", "far/exact", "far/random", "far/trace", "near/plain")


@pytest.fixture
def loader_globs(tmp_path: Path) -> Iterator[ConfigLoader]:
    for name in NAMES:
        path = tmp_path / f"choice_of/{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("value: 1\n")
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()
    GlobalHydra.instance().hydra = before


def found(loader_globs: ConfigLoader, glob: str) -> tuple[str, ...]:
    return read_axes(loader_globs, [f"choice_of={glob}"])[0].texts


@pytest.mark.parametrize(
    "glob", ["glob(*)", "glob(p*)", "glob([r*,p*])", "glob(*,exclude=p*)", "glob(*,exclude=[p*,z])"]
)
def test_without_a_folder_it_is_that_of_hydra(loader_globs: ConfigLoader, glob: str) -> None:
    parser = OverridesParser.create(config_loader=loader_globs)
    (override,) = parser.parse_overrides([f"choice_of={glob}"])
    assert isinstance(override.value(), Glob)
    assert found(loader_globs, glob) == tuple(override.sweep_string_iterator())


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
    loader_globs: ConfigLoader, glob: str, names: tuple[str, ...]
) -> None:
    assert found(loader_globs, glob) == names


def test_one_that_matches_nothing_names_what_is_near(loader_globs: ConfigLoader) -> None:
    with pytest.raises(SpecificationError, match=r"did you mean 'far/exact'.* near/plain"):
        found(loader_globs, "glob(far/exakt)")
    assert loader_globs.get_group_options("choice_of", ObjectType.GROUP) == ["far", "near"]
