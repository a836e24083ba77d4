"""Users' classes, named by their path: loaded, refused, stored, run on the kernel."""

from __future__ import annotations

import hashlib
import json
import linecache
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from omegaconf import OmegaConf

from dopt.control.task import GOAL_FIELDS
from dopt.errors import SpecificationError
from dopt.learning import LEARNERS
from dopt.models import MODELS
from dopt.policies import POLICIES
from dopt.policies.base import CustomPolicy, Planner, Policy
from dopt.registry import check_importable, source_digest
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec, stored_trial, system_of
from dopt.systems import SYSTEMS, System
from dopt.systems.pendulum import Pendulum
from tests.paths import EXAMPLE


@dataclass(frozen=True, kw_only=True)
class Nameless(Policy):
    pass


TYPED = """
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import CustomPolicy, Planner


class Constant(Planner):
    def __init__(self, u):
        self._u = u

    def choose(self, view):
        return self._u


@dataclass(frozen=True, kw_only=True)
class Held(CustomPolicy):
    name: ClassVar[str] = "held"
    gain: float = parameter(0.5)

    def planner(self, system, rng):
        return Constant(np.array([self.gain * system.gamma]))
"""

DERIVED = """
@dataclass(frozen=True, kw_only=True)
class Derived(Held):
    name: ClassVar[str] = "derived"
"""


def typed(*cells: str, known: bool = True) -> Any:
    """Return the last class of some cells as a notebook leaves it: with names but without files."""
    names: dict[str, Any] = {}
    for text in cells or (TYPED,):
        cell = f"<cell {len(linecache.cache)}>"
        if known:
            linecache.cache[cell] = (len(text), None, text.splitlines(keepends=True), cell)
        exec(compile(text, cell, "exec", dont_inherit=True), names)
    return list(names.values())[-1]


@dataclass(frozen=True, kw_only=True)
class Closed(Policy):
    name = "closed"


@dataclass(frozen=True, kw_only=True)
class Short(CustomPolicy):
    name = "short"

    def planner(self, system: System) -> Planner:  # type: ignore[override]  # the fault
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Long(Pendulum):
    name = "long"

    @staticmethod
    def known(state: Any, inputs: Any, parameters: Any, more: Any) -> Any:  # type: ignore[override]
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Thief(Policy):
    name = "random"


@pytest.fixture(autouse=True)
def on_the_path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    monkeypatch.setattr(linecache, "cache", {})
    yield
    for name in ("vehicle", "batch_gauss_newton", "curiosity"):
        sys.modules.pop(name, None)


def specification(
    env: dict[str, object] | None = None, policy: dict[str, object] | None = None
) -> TrialSpec:
    boat, staircase = {"_target_": "vehicle.Boat", "horizon": 20}, {"_target_": "vehicle.Staircase"}
    return TrialSpec.from_names(env or boat, policy or staircase)


def test_a_system_and_a_policy_of_ones_own_run_and_are_stored_by_name() -> None:
    spec = specification()
    result = run_trial(spec)
    assert (spec.columns()["env"], spec.columns()["policy"]) == ("boat", "staircase")
    assert result.diverged_at is None
    assert np.abs(result.inputs).max() <= spec.system.gamma


def test_another_state_of_the_file_is_another_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = specification()
    assert before.to_mapping()["env"]["_target_"] == "vehicle.Boat"  # type: ignore[index]
    assert TrialSpec.from_mapping(before.to_mapping()).trial_key == before.trial_key
    text = (EXAMPLE / "vehicle.py").read_text()
    (tmp_path / "vehicle.py").write_text(text + "\n# changed\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("vehicle")
    after = specification()
    assert after.trial_key != before.trial_key
    with pytest.raises(SpecificationError, match="another state of its file"):
        TrialSpec.from_mapping(before.to_mapping())


LEFT_OUT = "physical state_labels input_labels learned_rows features phase_plane grid_indices known"


@pytest.mark.parametrize("left_out", LEFT_OUT.split())
def test_a_system_that_leaves_out_a_declaration_is_told_which(
    left_out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (EXAMPLE / "vehicle.py").read_text()
    renamed = text.replace(f"def {left_out}(", "def other(")
    without = re.sub(rf"(?m)^    {left_out}: ClassVar.*\n", "", renamed, count=1)
    assert without != text
    (tmp_path / "vehicle.py").write_text(without)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(SpecificationError, match=rf"a class that defines {left_out} is expected"):
        specification()


HERE = __name__


@pytest.mark.parametrize(
    ("section", "path", "more", "sentence"),
    [
        ("env", "nowhere.Boat", {}, r"env\._target_.* cannot be imported"),
        ("env", "vehicle.Bota", {}, r"env\._target_.* cannot be imported"),
        ("env", "Boat", {}, r"env\._target_.* cannot be imported"),
        ("env", "vehicle.np", {}, r"env\._target_.* a dataclass derived from dopt's System"),
        ("env", "vehicle.Staircase", {}, r"env\._target_.* derived from dopt's System"),
        ("env", "dopt.systems.base.System", {}, r"env\._target_.* defines accelerations, known"),
        ("env", "vehicle.Boat", {"name": "ship"}, "is called 'boat'"),
        ("env", "vehicle.Boat", {"mas": 3.0}, r"env\.boat field"),
        ("policy", f"{HERE}.Nameless", {}, "a class with a 'name' of its own"),
        ("policy", f"{HERE}.Thief", {}, "a class with a 'name' of its own"),
        ("policy", f"{HERE}.Short", {}, r"but a class with planner\(system, rng\) is expected"),
        ("env", f"{HERE}.Long", {}, r"but a class with known\(state, inputs, parameters\) is exp"),
        ("policy", f"{HERE}.Closed", {}, "derive it from OpenLoop or CustomPolicy"),
        ("policy", "tests.dopt.custom_plugins.InTorch", {}, r"numpy, .* from CompiledPolicy\.$"),
        ("policy", "__main__.Nowhere", {}, r"policy is of the class .*into a file"),
    ],
)
def test_a_wrong_class_is_refused_in_a_sentence(
    section: str, path: str, more: dict[str, object], sentence: str
) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        specification(**{section: {"_target_": path, **more}})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("x = 1\ny = x / 0\n", r"fails in line 2 \(ZeroDivisionError: division by zero\)"),
        ("def f(:\n", r"fails in line 1 \(SyntaxError: invalid syntax\)"),
        ("import nowhere_else\n", r"fails in line 1 \(ModuleNotFoundError: .*nowhere_else'"),
    ],
)
def test_a_file_that_fails_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, sentence: str
) -> None:
    file = tmp_path / "failing.py"
    file.write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    expected = rf"^env\._target_ is 'failing\.Boat', but the file {file} {sentence}"
    with pytest.raises(SpecificationError, match=expected):
        specification({"_target_": "failing.Boat"})


def option(group: str, name: str) -> dict[str, object]:
    """Return what an option of the tutorial sets."""
    content = OmegaConf.to_container(OmegaConf.load(EXAMPLE / f"conf/{group}/{name}.yaml"))
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def test_a_learner_of_ones_own_learns() -> None:
    mapping = specification(policy={"name": "random"}).to_mapping()
    del mapping["path"]
    env = {**option("env", "boat"), "horizon": 100}
    learner = option("learner", "batch_gauss_newton")
    spec = TrialSpec.from_mapping({**mapping, "env": env, "learner": learner})
    assert spec.columns()["learner"] == "batch_gauss_newton"
    loss = run_trial(spec).loss
    assert loss[-1] < 0.7 * loss[0]
    np.testing.assert_array_equal(run_trial(spec).loss, loss)


def test_a_control_task_for_a_system_of_ones_own_can_be_solved() -> None:
    """Its nine keys are those that a system without a task of its own has to be given."""
    mapping = specification(option("env", "boat"), {"name": "random"}).to_mapping()
    task = option("task", "harbour")
    spec = TrialSpec.from_mapping({**mapping, "task": task})
    assert set(GOAL_FIELDS) < set(task)
    rows = {(row.t, row.measure): row.value for row in run_trial(spec).assessments}
    assert rows[0, "true_model_success"] == 1
    assert rows[200, "free_run_error"] < 0.5 * rows[0, "free_run_error"]
    assert rows[200, "coverage"] > rows[50, "coverage"] > 0


# Objects in the place of names


def test_objects_of_shipped_classes_are_the_trial_of_their_sections() -> None:
    system = SYSTEMS["pendulum"](horizon=5)
    policy = POLICIES["d_optimal"](regularization=0.1)  # type: ignore[call-arg]
    objects = TrialSpec.of_system(
        system, policy, model=MODELS["mlp"](width=8), learner=LEARNERS["adam"]()
    )
    sections = {"name": "d_optimal", "regularization": 0.1}, {"name": "mlp", "width": 8}
    named = TrialSpec.of_system(system, sections[0], model=sections[1], learner="adam")
    assert objects.trial_key == named.trial_key


def test_an_object_of_a_class_in_a_file_is_the_trial_of_its_path() -> None:
    from curiosity import Curiosity

    system = SYSTEMS["pendulum"]()
    spec = TrialSpec.of_system(system, Curiosity(candidates=4))
    path = {"_target_": "curiosity.Curiosity", "candidates": 4}
    assert spec.trial_key == TrialSpec.of_system(system, path).trial_key
    check_importable("policy", spec.to_mapping()["policy"])


def test_an_object_of_a_typed_class_runs_with_its_values() -> None:
    system = SYSTEMS["pendulum"](horizon=5)
    half, whole = (TrialSpec.of_system(system, typed()(gain=gain)) for gain in (0.5, 1.0))
    assert half.trial_key != whole.trial_key
    for spec, size in ((half, 0.5), (whole, 1.0)):
        result = run_trial(spec, path="reference")
        np.testing.assert_allclose(result.inputs[1:], size * system.gamma)


def test_its_cell_and_those_of_its_bases_are_its_identity() -> None:
    """Also where it has no function, which would name its cell."""
    assert source_digest(typed()) == source_digest(typed())
    texts = (
        (TYPED,),
        (TYPED.replace("* system", "* 0.9 * system"),),
        (TYPED, DERIVED),
        (TYPED.replace("* system", "* 0.9 * system"), DERIVED),
        (TYPED, f"{DERIVED}    gain: float = parameter(0.1)"),
    )
    assert len({source_digest(typed(*cells)) for cells in texts}) == len(texts)


def test_a_typed_class_is_refused_where_others_have_to_import_it() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Local(CustomPolicy):
        name: ClassVar[str] = "local"

        def planner(self, system: System, rng: np.random.Generator) -> Planner:
            raise NotImplementedError

    for policy in (typed()(), Local()):
        section = TrialSpec.of_system(SYSTEMS["pendulum"](), policy).to_mapping()["policy"]
        with pytest.raises(SpecificationError, match=r"policy is of the class .*into a file"):
            check_importable("policy", section)


@pytest.mark.parametrize(
    ("policy", "sentence"),
    [
        (
            Nameless,
            r"'policy' is the class Nameless, .*, such as Nameless\(\), to TrialSpec.of_system",
        ),
        (Nameless(), "a class with a 'name' of its own"),
        (SYSTEMS["arm"](), "a dataclass derived from dopt's Policy"),
        (typed(known=False)(), r"the class Held, .* cannot be read: put it into"),
    ],
)
def test_another_object_is_refused_in_a_sentence(policy: Any, sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        TrialSpec.of_system(SYSTEMS["pendulum"](), policy)


RAN = "import pathlib\npathlib.Path(__file__).with_suffix('.ran').touch()\n"
PLUGIN = f'''{RAN}
from dataclasses import dataclass
from typing import ClassVar

from dopt.systems import Pendulum


@dataclass(frozen=True, kw_only=True)
class Heavy(Pendulum):
    """A pendulum of another name."""

    name: ClassVar[str] = "heavy"
'''
NETWORK = f"{RAN}\nimport torch\n\n\nclass Net(torch.nn.Linear):\n    pass\n"


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
def test_nothing_else_runs(folder: Path, target: str) -> None:
    """Neither what is installed, nor a package whose submodule alone is meant."""
    written(folder / "stored_pack" / "__init__.py", RAN + "__path__.append(__path__[0] + '/deep')")
    written(folder / "stored_pack" / "inner.py", PLUGIN)
    written(folder / "stored_pack" / "deep" / "hidden.py", PLUGIN)
    before = set(sys.modules)
    for section in ("env", "policy", "model", "learner", "task"):
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
