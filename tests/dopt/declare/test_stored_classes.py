"""A stored configuration runs files that are here, unchanged, and nothing else."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dopt.errors import SpecificationError
from dopt.spec.trial import TrialSpec, stored_trial, system_of

RAN = "import pathlib\npathlib.Path(__file__).with_suffix('.ran').touch()\n"
PLUGIN = (
    RAN
    + '''
from dataclasses import dataclass
from typing import ClassVar

from dopt.systems import Pendulum


@dataclass(frozen=True, kw_only=True)
class Heavy(Pendulum):
    """A pendulum of another name."""

    name: ClassVar[str] = "heavy"
'''
)
NETWORK = (
    RAN
    + '''
import torch


class Net(torch.nn.Linear):
    """A layer."""

    def __init__(self, n_features, n_outputs):
        super().__init__(n_features, n_outputs)
'''
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield a folder of importable files; what was imported from it is forgotten."""
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("stored_"):
            del sys.modules[name]


def written(path: Path, text: str) -> str:
    """Write a file and return the digest of its text."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def stored(section: str = "env", **content: object) -> dict[str, Any]:
    """Return a stored configuration with a section of a user's class."""
    config = json.loads(TrialSpec.from_names("pendulum", "random").config_json)
    return {**config, section: content}


def ran(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.rglob("*.ran"))


READERS: list[Callable[[Any], object]] = [stored_trial, system_of]


@pytest.mark.parametrize("reader", READERS)
def test_an_unchanged_file_runs(folder: Path, reader: Callable[[Any], object]) -> None:
    source = written(folder / "stored_a.py", PLUGIN)
    assert reader(stored(_target_="stored_a.Heavy", source=source))
    assert ran(folder) == ["stored_a"]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("source", ["0" * 16, "", None, 3, [], {}])
def test_another_file_does_not_run(
    folder: Path, reader: Callable[[Any], object], source: object
) -> None:
    written(folder / "stored_b.py", PLUGIN)
    with pytest.raises(SpecificationError, match=r"env.* stored_b\.Heavy|'stored_b\.Heavy'"):
        reader(stored(_target_="stored_b.Heavy", source=source))
    assert ran(folder) == []
    assert "stored_b" not in sys.modules


def test_a_class_without_a_digest_is_refused_also_if_it_is_loaded(folder: Path) -> None:
    source = written(folder / "stored_c.py", PLUGIN)
    assert stored_trial(stored(_target_="stored_c.Heavy", source=source))
    with pytest.raises(SpecificationError, match=r"stored_c\.Heavy' without env\.source"):
        stored_trial(stored(_target_="stored_c.Heavy"))


@pytest.mark.parametrize("section", ["env", "policy", "model", "learner", "task"])
@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "subprocess.Popen",
        "builtins.exec",
        "antigravity.open",
        "__hello__.main",
        "stored_pack.hidden.Heavy",
        "stored_pack.inner.Heavy",
        "stored_pack.Heavy",
        "stored_absent.Heavy",
        "Heavy",
        "",
        ".",
        "stored_pack..inner.Heavy",
    ],
)
def test_nothing_else_runs(folder: Path, section: str, target: str) -> None:
    """Neither what is installed, nor a package whose submodule alone is meant."""
    written(folder / "stored_pack" / "__init__.py", RAN + "__path__.append(__path__[0] + '/deep')")
    written(folder / "stored_pack" / "inner.py", PLUGIN)
    written(folder / "stored_pack" / "deep" / "hidden.py", PLUGIN)
    before = set(sys.modules)
    with pytest.raises(SpecificationError):
        stored_trial(stored(section, _target_=target, source="1" * 16))
    assert ran(folder) == []
    assert not {"stored_pack", "antigravity", "__hello__"} & (set(sys.modules) - before)


def test_a_network_that_a_package_takes_from_its_file_is_found_without_running_it(
    folder: Path,
) -> None:
    pytest.importorskip("torch")
    source = written(folder / "stored_nets" / "layers.py", NETWORK)
    written(folder / "stored_nets" / "__init__.py", RAN + "from .layers import Net as Layer\n")
    with pytest.raises(SpecificationError, match="another state of its file"):
        stored_trial(stored("model", _target_="stored_nets.Layer", source="0" * 16))
    assert ran(folder) == []
    config = stored("model", _target_="stored_nets.Layer", source=source)
    spec = stored_trial({**config, "path": "reference"})
    assert spec.model.name == "Layer"


def test_files_that_take_a_class_from_each_other_end(folder: Path) -> None:
    written(folder / "stored_x.py", "from stored_y import Heavy\n")
    written(folder / "stored_y.py", "from stored_x import Heavy\n")
    with pytest.raises(SpecificationError, match="another state of its file"):
        stored_trial(stored(_target_="stored_x.Heavy", source="0" * 16))


@pytest.mark.parametrize(
    "change", [("\n", "\r\n"), ("\n", "\r"), ("import pathlib", "\ufeffimport pathlib")]
)
def test_how_lines_end_makes_no_other_trial(folder: Path, change: tuple[str, str]) -> None:
    source = written(folder / "stored_d.py", PLUGIN)
    named = {"env": {"_target_": "stored_d.Heavy"}, "policy": {"name": "random"}}
    rest = {"model": {"name": "mlp"}, "learner": {"name": "adam_window"}}
    before = TrialSpec.from_mapping({**named, **rest})
    assert json.loads(before.config_json)["env"]["source"] == source  # of the bytes as they are
    del sys.modules["stored_d"]
    (folder / "stored_d.py").write_bytes(PLUGIN.replace(*change).encode())
    after = TrialSpec.from_mapping({**named, **rest})
    assert type(after.system) is not type(before.system)
    assert after.config_key == before.config_key
    del sys.modules["stored_d"]
    assert stored_trial(json.loads(before.config_json)).config_key == before.config_key
