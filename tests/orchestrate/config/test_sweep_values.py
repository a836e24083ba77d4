"""A sweep has exactly the values that its words say, by a plain reading of them, or is refused."""

from __future__ import annotations

import math
from collections.abc import Iterator
from decimal import Decimal
from typing import Any

import pytest
from hydra import initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.types import RunMode
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf

from orchestrate.config.expand import expand
from orchestrate.config.sweeps import parsed_overrides, read_axes
from tests.orchestrate.config.test_expand import SAMPLE, SECTIONS


@pytest.fixture(scope="module")
def loader() -> Iterator[ConfigLoader]:
    with initialize_config_dir(str(SAMPLE), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


@pytest.fixture(scope="module")
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
        ("sort(range(0,1,0.3),reverse=true)", [0.9, 0.6, 0.3, 0.0]),
        ("float(sort(range(3),reverse=true))", [2.0, 1.0, 0.0]),
        ("sort(3,1,2,reverse=true)", [3, 2, 1]),
        ("range(10,0,-3)", [10, 7, 4, 1]),
        ("range(1,0,-0.3)", [1.0, 0.7, 0.4, 0.1]),
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


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
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


def test_the_digits_are_those_that_a_person_writes(loader: ConfigLoader) -> None:
    values = swept(loader, "range(0,1,0.1)")
    assert [repr(value) for value in values] == [f"0.{k}" for k in range(10)]
    assert not any(math.isclose(value, 1.0) for value in values if isinstance(value, float))


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
    assert [one.overrides for one in found][:2] == [
        ("++new={a:1}", "++new={b:3}"),
        ("++new={a:1}", "++new={b:4}"),
    ]
