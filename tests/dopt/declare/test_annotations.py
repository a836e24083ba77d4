"""Fields of a class whose module keeps its annotations as types, and not as text.

No ``from __future__ import annotations`` here: that is the point.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Optional, Union

import pytest

from dopt.errors import SpecificationError
from dopt.fields import Validated, parameter


@dataclass(frozen=True, kw_only=True)
class Typed(Validated):
    section: ClassVar[str] = "policy"

    count: int = parameter(3, bound="positive")
    share: float = 0.5
    mode: str = parameter("fast", choices=("fast", "slow"))
    sizes: tuple[int, ...] = (1, 2)
    words: tuple[str, ...] = ()
    pair: tuple[float, float] = parameter((0.0, 1.0), size=2)
    limit: float | None = None
    start: Optional[int] = None  # noqa: UP045  # the older form of the same
    either: Union[int, float] = 1  # noqa: UP007


@dataclass(frozen=True, kw_only=True)
class Quoted(Validated):
    section: ClassVar[str] = "policy"

    count: "int" = parameter(3, bound="positive")  # noqa: RUF009  # immutable
    share: "float" = 0.5
    mode: "str" = parameter("fast", choices=("fast", "slow"))  # noqa: RUF009  # immutable
    sizes: "tuple[int, ...]" = (1, 2)
    words: "tuple[str, ...]" = ()
    pair: "tuple[float, float]" = parameter((0.0, 1.0), size=2)  # noqa: RUF009  # immutable
    limit: "float | None" = None
    start: "int | None" = None
    either: "int | float" = 1


FORMS = pytest.mark.parametrize("form", [Typed, Quoted])


@FORMS
def test_a_value_keeps_the_type_of_its_field(form: type[Any]) -> None:
    item = form(count=4, share=1, mode="slow", sizes=[5], words=["a"], pair=[1, 2], start=7)
    assert item.count == 4
    assert type(item.count) is int
    assert type(item.share) is float
    assert item.mode == "slow"
    assert item.sizes == (5,)
    assert type(item.sizes[0]) is int
    assert item.words == ("a",)
    assert [type(entry) for entry in item.pair] == [float, float]
    assert item.limit is None
    assert type(item.start) is int
    assert type(item.either) is float


@FORMS
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"count": 1.5}, "policy.count is 1.5 (float), but a whole number is expected"),
        ({"count": 0}, "policy.count is 0, but it has to be from 1 to 2147483647"),
        ({"count": None}, "policy.count is null, but a whole number is expected"),
        ({"share": "half"}, "policy.share is 'half' (str), but a number is expected"),
        ({"mode": 1}, "policy.mode is 1 (int), but a text is expected"),
        ({"mode": "fats"}, "fast"),
        ({"sizes": (1.5,)}, "policy.sizes[0] is 1.5 (float), but a whole number is expected"),
        ({"words": (1,)}, "policy.words[0] is 1 (int), but a text is expected"),
        ({"pair": (1.0,)}, "but a list of 2 numbers is expected"),
        ({"start": 1.5}, "policy.start is 1.5 (float), but a whole number is expected"),
    ],
)
def test_another_type_is_refused(form: type[Any], given: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecificationError) as caught:
        form(**given)
    assert words in str(caught.value)


@dataclass(frozen=True, kw_only=True)
class Held(Validated):
    section: ClassVar[str] = "policy"

    table: dict[str, float] = parameter(None)  # noqa: RUF009  # immutable


@dataclass(frozen=True, kw_only=True)
class Misspelt(Validated):
    section: ClassVar[str] = "policy"

    count: "itn" = 3  # type: ignore[name-defined]  # noqa: F821


@pytest.mark.parametrize(
    ("cls", "shown"), [(Held, "annotated as dict[str, float]"), (Misspelt, "annotated as itn")]
)
def test_an_annotation_of_another_type_is_refused(cls: type[Validated], shown: str) -> None:
    with pytest.raises(SpecificationError, match="change the annotation") as caught:
        cls()
    assert shown in str(caught.value)
    assert cls.__name__ in str(caught.value)
