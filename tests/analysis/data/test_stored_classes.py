"""The analysis runs no class of a database but files that are here, unchanged."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from analysis.data.samples import learned_model, simulated_trial
from analysis.data.selection import is_possible
from dopt.errors import SpecificationError
from dopt.spec.trial import TrialSpec
from orchestrate.store import ConfigRow, Reader

Use = Callable[[ConfigRow], object]


def config(section: str, **content: object) -> ConfigRow:
    stored = json.loads(TrialSpec.from_names("pendulum", "random").config_json)
    values = dict.fromkeys((field.name for field in dataclasses.fields(ConfigRow)), 0)
    return ConfigRow(**cast(dict[str, Any], {**values, "config": {**stored, section: content}}))


@pytest.mark.parametrize("section", ["env", "policy", "model", "learner"])
@pytest.mark.parametrize("source", [{}, {"source": "0" * 16}])
@pytest.mark.parametrize(
    "use",
    [lambda row: simulated_trial(row, 0), lambda row: learned_model(cast(Reader, None), row, 0)],
)
def test_a_stranger_s_class_does_not_run(
    use: Use,
    source: dict[str, str],
    section: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "never_run.py").write_text("raise SystemExit('it has run')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    row = config(section, _target_="never_run.Thing", **source)
    with pytest.raises(SpecificationError, match=r"never_run\.Thing"):
        use(row)
    assert is_possible(row, row), "nothing speaks against it, for all that is known"
