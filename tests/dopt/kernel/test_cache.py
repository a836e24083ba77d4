"""Cache of compiled code: damage, refusals of the system, warming, one writer, users' functions."""

from __future__ import annotations

import errno
import fcntl
import os
import pwd
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

import llvmlite.binding
import numpy as np
import pytest
from numba import float64, void
from numba.core.dispatcher import Dispatcher

from dopt.errors import UnusableEnvironmentError
from dopt.fields import IN_NUMPY
from dopt.kernel import cache, compiler, equations, pointers, warm_up
from dopt.kernel.compiler import content_digest
from dopt.kernel.information import FORMS
from dopt.kernel.run import trial_in_kernel
from dopt.kernel.warming import choices, kernel_parts, needed_parts
from dopt.learning import LEARNERS
from dopt.policies import POLICIES
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt import trials
from tests.paths import ROOT, loaded, printed, ran
from tests.waiting import PATIENCE_SECONDS

MODULE = "A, B = 1.0, 2.0\n\ndef triple(x, out):\n    out[0] = (A + B) * x\n"
SIGNATURE = void(float64, float64[::1])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty cache, as a process finds it that has not used it yet."""
    for name, value in {
        "CACHE_FOLDER": tmp_path / "dopt" / "kernel",
        "_dropped": [],
        "_not_stored": [],
        "_temporaries": {},
    }.items():
        monkeypatch.setattr(cache, name, value)
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path))
    cache.CACHE_FOLDER.mkdir(parents=True)
    return cache.CACHE_FOLDER


@pytest.fixture
def triple(tmp_path: Path) -> FunctionType:
    """Return a function of a user's file."""
    return written(tmp_path / "own_triple.py", MODULE)


def written(path: Path, text: str) -> FunctionType:
    path.write_text(text)
    function: FunctionType = loaded(path).triple
    return function


def found(function: FunctionType) -> bool:
    """Return whether a new process finds the code of a function, which gives the right number."""
    compiler._dispatcher.cache_clear()
    cache._intact.clear()
    compiled = compiler.compiled_own(function, SIGNATURE)
    out = np.zeros(1)
    compiled(2.0, out)
    assert out[0] == 6.0
    return bool(compiled.stats.cache_hits)


def beginning(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def one_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def other_program(path: Path) -> None:
    """Put in whole what no class of this program can be read from."""
    cache.write(str(path.relative_to(cache.CACHE_FOLDER)), b"c__main__\nAbsent\n.")


DAMAGES = [lambda path: path.write_bytes(b""), beginning, zeros, one_bit]


@pytest.mark.parametrize("which", [0, 1], ids=["code", "mark"])
@pytest.mark.parametrize("damage", [*DAMAGES, other_program, Path.unlink])
def test_what_is_damaged_is_compiled_again_and_said(
    folder: Path,
    triple: FunctionType,
    damage: Callable[[Path], object],
    which: int,
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert not found(triple)
    assert found(triple)
    path = [*folder.rglob("*.nbi"), *folder.glob("*.complete")][which]
    damage(path)
    caplog.clear()
    code_lost = which == 0
    assert found(triple) is not code_lost
    assert caplog.messages
    assert caplog.text.count("is damaged") == (damage is not Path.unlink or code_lost)
    caplog.clear()
    assert found(triple)
    assert not caplog.messages


def test_a_damaged_part_is_missing_before_a_trial_asks_for_it(folder: Path) -> None:
    """And a mark of many parts holds while each is whole."""
    with cache.one_compiler_at_a_time("loop-1"):
        cache.write("code.nbi", b"code")
    with cache.one_compiler_at_a_time("equations"):
        pass
    cache.mark_complete("everything")
    assert cache.is_complete("everything")
    assert cache.missing(["loop", "equations", "plan"]) == ["plan"]
    zeros(folder / "code.nbi")
    cache._intact.clear()
    assert cache.missing(["loop", "equations", "plan"]) == ["loop", "plan"]
    assert not cache.is_complete("everything")


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_will_do(
    folder: Path, triple: FunctionType, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with cache.one_compiler_at_a_time("loop-1"), cache.one_compiler_at_a_time("loop-1"):
        cache.write("code.nbi", b"code")
    assert not found(triple)
    assert found(triple)
    assert not list(folder.rglob("*.partial"))


def no_space(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_sends_the_code_to_a_temporary_folder(
    folder: Path, triple: FunctionType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where those that the process starts find it, beside what the full one holds."""
    cache.write("before.nbi", b"before")
    replace = cache._replace
    monkeypatch.setattr(
        cache,
        "_replace",
        lambda path, content: (no_space if path.is_relative_to(folder) else replace)(path, content),
    )
    assert not found(triple)
    assert found(triple)
    assert folder != cache.CACHE_FOLDER
    assert cache.CACHE_FOLDER.parents[1] == Path(os.environ[cache.CACHE_VARIABLE])
    assert cache.read("before.nbi") == b"before"


def test_without_any_room_code_is_in_memory_and_that_is_said_once(
    folder: Path,
    triple: FunctionType,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(cache, "_replace", no_space)
    assert not found(triple)
    assert not found(triple)
    assert not list(folder.rglob("*.complete"))
    assert [line for line in caplog.messages if "No space left" in line] == [
        "compiled code is not kept for other processes: [Errno 28] No space left on device"
    ]
    assert not cache.can_be_filled()


@pytest.fixture
def read_only(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of this state of the sources, with a file, where nothing can be written."""
    here = folder.with_name(f"kernel-{cache._source_digest()}")
    monkeypatch.setattr(cache, "CACHE_FOLDER", here)
    cache.write("some/code.nbi", b"code")
    access = os.access
    monkeypatch.setattr(
        os,
        "access",
        lambda path, mode: access(path, mode) and not (path == here and mode & os.W_OK),
    )
    return here


def test_a_read_only_cache_is_used(read_only: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is missing goes beside links to what is there, also for other processes."""
    monkeypatch.setattr(cache, "CACHE_FOLDER", cache._cache_folder())
    assert read_only != cache.CACHE_FOLDER
    assert cache.CACHE_FOLDER.parents[1] == Path(os.environ[cache.CACHE_VARIABLE])
    assert (cache.CACHE_FOLDER / "some/code.nbi").resolve() == read_only / "some/code.nbi"
    assert cache.read("some/code.nbi") == b"code"
    cache.write("some/code.nbi", b"other")
    assert cache.read("some/code.nbi") == b"other"
    assert "for this command alone" in cache.for_whom()
    assert (read_only / "some/code.nbi").read_bytes().endswith(b"code")


def test_no_temporary_folder_is_needed_to_read(
    read_only: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "mkdtemp", no_space)
    assert cache._cache_folder() == read_only
    monkeypatch.setenv(cache.CACHE_VARIABLE, "/dev/null/cache")
    monkeypatch.setattr(cache, "CACHE_FOLDER", cache._cache_folder())
    monkeypatch.setattr(cache, "_replace", no_space)
    assert cache.read("some/code.nbi") is None
    assert cache.missing(["loop"]) == ["loop"]
    with cache.one_compiler_at_a_time("loop"):
        cache.write("code.nbi", b"code")


@pytest.mark.parametrize("home", [None, "", "/dev/null"])
def test_without_a_home_the_one_of_the_user_is_taken(
    folder: Path, monkeypatch: pytest.MonkeyPatch, home: str | None, tmp_path: Path
) -> None:
    for variable in (cache.CACHE_VARIABLE, "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(variable, raising=False)
    if home is not None:
        monkeypatch.setenv("HOME", home)
    monkeypatch.setattr(pwd, "getpwuid", lambda _: SimpleNamespace(pw_dir=str(tmp_path)))
    assert cache._cache_folder().parents[1] == tmp_path / ".cache"

    def unknown(_: int) -> None:
        raise KeyError

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    assert cache._cache_folder().is_relative_to(tempfile.gettempdir())
    assert folder.is_dir()


SETTINGS = [
    *((setting, True) for setting in ("OPT=1", "BOUNDSCHECK=1", "SLP_VECTORIZE=1", "NEW=1")),
    *((setting, True) for setting in ("CPU_NAME=generic", "CPU_FEATURES=")),
    *((f"{name}=1", False) for name in ("NUM_THREADS", "CACHE_DIR", "THREADING_LAYER")),
    ("CUDA_DRIVER=1", False),
    (f"CPU_NAME={llvmlite.binding.get_host_cpu_name()}", False),
]


class TestDigest:
    """The name of the folder, which everything changes that changes the code."""

    @pytest.fixture(autouse=True)
    def _bare(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.chdir(tmp_path)
        for name in [name for name in os.environ if name.startswith("NUMBA_")]:
            monkeypatch.delenv(name)

    @pytest.mark.parametrize(("setting", "changes_the_code"), SETTINGS)
    def test_settings(
        self, monkeypatch: pytest.MonkeyPatch, setting: str, changes_the_code: bool
    ) -> None:
        usual = cache._source_digest()
        name, _, value = setting.partition("=")
        monkeypatch.setenv(f"NUMBA_{name}", value)
        assert (cache._source_digest() != usual) is changes_the_code

    def test_unlike_processors_share_no_code_but_generic(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Two of the same name may offer different parts of it, as in a virtual machine."""
        own, less = cache._source_digest(), SimpleNamespace(flatten=lambda: "-avx2")
        monkeypatch.setattr(llvmlite.binding, "get_host_cpu_features", lambda: less)
        assert cache._source_digest() != own
        monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
        here = cache._source_digest()
        monkeypatch.setattr(llvmlite.binding, "get_host_cpu_name", lambda: "another")
        monkeypatch.setattr(llvmlite.binding, "get_host_cpu_features", lambda: None)
        assert cache._source_digest() == here

    def test_another_python_and_a_file_of_settings(self, monkeypatch: pytest.MonkeyPatch) -> None:
        digests = [cache._source_digest()]
        for attribute in ("version_info", "abiflags"):
            with monkeypatch.context() as patched:
                patched.setattr(sys, attribute, (3, 99))
                digests.append(cache._source_digest())
        Path(".numba_config.yaml").write_text("opt: 1\n")
        assert len({*digests, cache._source_digest()}) == 4


@pytest.mark.parametrize("value", ["1", "2", "true"])
def test_a_disabled_compiler_is_refused(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", value)
    for refused in (cache.check_environment, warm_up):
        with pytest.raises(UnusableEnvironmentError, match=r"NUMBA_DISABLE_JIT is .*: unset it"):
            refused()
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    cache.check_environment()


def test_a_compiler_that_a_file_disables_is_refused(tmp_path: Path) -> None:
    (tmp_path / ".numba_config.yaml").write_text("disable_jit: 1\n")
    done = ran("-c", "import dopt.kernel.compiler", folder=tmp_path, PYTHONPATH=str(ROOT))
    last = done.stderr.splitlines()[-1]
    assert last.startswith("dopt.errors.UnusableEnvironmentError: NUMBA_DISABLE_JIT is 1")


@pytest.mark.parametrize(
    "error", [OSError(errno.EMFILE, "Too many open files"), MemoryError("needs more")]
)
def test_an_error_of_the_system_is_not_one_of_the_equations(
    folder: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def compile_nothing(*_: object) -> None:
        raise error

    monkeypatch.setattr(Dispatcher, "compile", compile_nothing)
    equations._compiled_functions.cache_clear()
    expected = MemoryError if isinstance(error, MemoryError) else UnusableEnvironmentError
    with pytest.raises(expected, match=r"Too many open files|needs more"):
        equations.compiled_equations(SYSTEMS["pendulum"]())
    assert not list(folder.glob("*.complete"))


class Compilers:
    """Processes that compile for some minutes, by a clock that each look at them advances."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, minutes: float) -> None:
        self.seconds, self._end = 0.0, 60 * minutes
        clock = SimpleNamespace(perf_counter=lambda: self.seconds, sleep=lambda _: None)
        monkeypatch.setattr(cache, "time", clock)
        monkeypatch.setattr(cache, "_started", lambda *_: self)

    def poll(self) -> int | None:
        self.seconds += 0.5
        return None if self.seconds < self._end else 0

    def kill(self) -> None: ...
    def wait(self) -> None: ...


@pytest.mark.usefixtures("folder")
class TestReports:
    """Messages while other processes compile."""

    def test_a_log_holds_a_few_lines(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        Compilers(monkeypatch, minutes=5)
        cache.compile_missing(["loop", "plan"])
        assert len(caplog.messages) <= 12
        assert caplog.messages[0] == "compiling the kernel, once per machine: 0 of 2 parts, 0 s"
        assert caplog.messages[-1].endswith("0 of 2 parts, 300 s")

    def test_a_terminal_shows_one_line(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        Compilers(monkeypatch, minutes=5)
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
        monkeypatch.setattr(cache._log, "propagate", False)
        cache.compile_missing(["loop", "plan"])
        shown = capsys.readouterr().err
        assert shown.count("\n") == 1
        assert shown.count("\r") > 100
        assert shown.endswith("s\x1b[K\n")

    def test_one_process_speaks_where_several_have_one_standard_error(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
    ) -> None:
        program = (
            "import fcntl, sys\n"
            "fcntl.lockf(sys.stderr, fcntl.LOCK_EX)\n"
            "print('held', flush=True)\n"
            "sys.stdin.read()\n"
        )
        with (tmp_path / "log").open("w") as log, monkeypatch.context() as patched:
            pipe: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
            other = subprocess.Popen([sys.executable, "-c", program], stderr=log, **pipe)
            assert other.stdout is not None
            other.stdout.readline()
            patched.setattr(sys, "stderr", log)
            Compilers(patched, minutes=1)
            cache.compile_missing(["loop"])
            assert not caplog.messages
            other.communicate()
            Compilers(patched, minutes=1)
            cache.compile_missing(["loop"])
            assert caplog.messages


def cache_without(folder: Path, *names: str) -> str:
    """Return a folder in which the cache is the warm one without some files."""
    warm_up()
    copy, without = folder / "dopt" / cache.CACHE_FOLDER.name, shutil.ignore_patterns(*names)
    shutil.copytree(cache.CACHE_FOLDER, copy, copy_function=os.symlink, ignore=without)
    return str(folder)


@pytest.mark.usefixtures("folder")
def test_a_second_compiler_of_a_function_waits_for_the_first() -> None:
    first_ended, second_entered = threading.Event(), threading.Event()
    after_first = []

    def second() -> None:
        with cache.one_compiler_at_a_time("loop-second"):
            after_first.append(first_ended.is_set())
            second_entered.set()

    with cache.one_compiler_at_a_time("loop-first"):
        thread = threading.Thread(target=second)
        thread.start()
        assert not second_entered.wait(0.2)
        with cache.one_compiler_at_a_time("equations"):
            first_ended.set()
    thread.join(PATIENCE_SECONDS)
    assert after_first == [True]


def test_what_is_in_the_cache_is_read_by_all_at_once_and_what_failed_is_not(folder: Path) -> None:
    with pytest.raises(KeyError), cache.one_compiler_at_a_time("loop"):
        raise KeyError
    assert not (folder / "loop.complete").exists()
    with cache.one_compiler_at_a_time("loop"):
        pass
    with cache.one_compiler_at_a_time("other"), cache.one_compiler_at_a_time("loop"):
        assert (folder / "loop.complete").exists()


def test_a_warm_cache_is_seen_without_the_compiler_and_a_trial_runs_without_its_rules() -> None:
    """Numba would load the rules first, for a tenth of a second in every process."""
    warm_up()
    printed(
        "import sys; from dopt.kernel import warm_up; warm_up(); "
        "assert 'numba' not in sys.modules; from dopt import TrialSpec, run_trial; "
        "run_trial(TrialSpec.from_names('pendulum', 'd_optimal')); "
        "assert not {'numba.np.arraymath', 'numba.typed.typeddict'} & {*sys.modules}"
    )


def test_everything_is_what_any_shipped_choice_calls() -> None:
    """Beside them stand the functions that call users' parts in numpy."""
    chosen = choices(everything=True)
    plans = {one.kernel_function for one in POLICIES.values() if one.compiled}
    learns = {one.kernel_function for one in LEARNERS.values() if one.compiled}
    assert plans - {IN_NUMPY} == set(chosen.plans)
    assert learns - {IN_NUMPY} == set(chosen.learns)
    assert chosen.forms == FORMS
    few = choices(everything=False)
    assert set(few.plans) < set(chosen.plans)


def test_a_trial_loads_what_other_processes_compile(tmp_path: Path) -> None:
    """Where a trial compiles a part itself, its numbers can differ from later trials."""
    program = """
from dopt.kernel.cache import compile_missing, missing
from dopt.kernel.information import add_nothing
from dopt.kernel.pointers import compile_form
from dopt.kernel.run import KernelTrial
from dopt.spec.trial import TrialSpec
part = "dopt.kernel.information.add_nothing"
assert missing([part]) == [part]
compile_missing([part])
trial = KernelTrial(TrialSpec.from_names("pendulum", "random")).trial
compile_form(trial, "add_rows", add_nothing)
print(sum(add_nothing.stats.cache_hits.values()), sum(add_nothing.stats.cache_misses.values()))
"""
    assert printed(program, DOPT_CACHE=cache_without(tmp_path, "*add_nothing*")) == "1 0\n"


GRID = {
    "paper": [("pendulum", policy) for policy in ("d_optimal", "random", "periodic", "uniform")],
    "search": [("cartpole", "lookahead"), ("arm", "icem")],
    "numpy": [("pendulum", "max")],
    "measured": [
        ({"name": "pendulum", "measured_states": [0], "measurement_noise": [0.01]}, "random")
    ],
}


@pytest.mark.parametrize("name", GRID)
def test_a_grid_compiles_what_its_trials_ask_for(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A part that were missing would be compiled while the workers wait for it."""
    specs = [TrialSpec.from_names(system, policy) for system, policy in GRID[name]]
    asked: list[str] = []
    monkeypatch.setattr(pointers, "compile_missing", asked.extend)
    monkeypatch.setattr(pointers, "_trials", {})
    for spec in specs:
        trial_in_kernel(spec).advance(1)
    systems = {equations.name_of_equations(spec.system) for spec in specs}
    assert {*needed_parts(spec.config for spec in specs)} == {*asked} | systems
    assert {*asked} <= {*kernel_parts(everything=True)}


def test_a_second_grid_of_the_same_kinds_is_seen_without_the_compiler(tmp_path: Path) -> None:
    program = """
import sys
from dopt.kernel import compiling
from dopt.spec.trial import TrialSpec
system = {"name": "mass_spring", "horizon": int(sys.argv[1])}
with compiling([TrialSpec.from_names(system, "random").config]):
    print("numba" in sys.modules)
"""
    folder = cache_without(tmp_path, "kinds-*")
    answers = [printed(program, horizon, DOPT_CACHE=folder) for horizon in ("100", "200")]
    assert answers == ["True\n", "False\n"]


def test_another_checkout_finds_what_is_compiled(tmp_path: Path) -> None:
    """The same sources in another folder: nothing is compiled, and the numbers are the same."""
    program = """
import numpy as np
from dopt.kernel.equations import compiled_equations
from dopt.systems import SYSTEMS
function = compiled_equations(SYSTEMS["pendulum"]()).accelerations
out = np.empty(1)
function(np.ones(2), np.array(SYSTEMS["pendulum"]().parameters), out)
print(sum(function.stats.cache_misses.values()), out[0].hex())
"""
    shutil.copytree(ROOT / "dopt", tmp_path / "elsewhere/dopt")
    folder = str(tmp_path / "cache")
    (missed, number), (again, same) = (
        printed(program, folder=one, DOPT_CACHE=folder, PYTHONPATH=str(one)).split()
        for one in (ROOT, tmp_path / "elsewhere")
    )
    assert (missed, again) == ("1", "0")
    assert number == same


def test_a_function_compiled_for_another_or_called_with_one_is_not_stored(tmp_path: Path) -> None:
    """Whoever opened the second would compile its argument, without what its module prepares."""
    (tmp_path / "pair.py").write_text(
        """
from pathlib import Path
from dopt.kernel import compiler
compiler._PACKAGE = Path(__file__).parent
from dopt.kernel.compiler import compiled
@compiled
def inner(x):
    return x + 1.0
@compiled
def outer(x):
    return 2.0 * inner(x)
@compiled
def applied(functions, x):
    return 2.0 * functions[0](x)
assert outer(1.0) == applied((inner,), 1.0) == 4.0
"""
    )
    printed("import pair", folder=tmp_path, DOPT_CACHE=str(tmp_path / "cache"))
    found = [path.name.partition("-")[0] for path in tmp_path.rglob("*.nbi")]
    assert found == ["pair.outer"]


def test_a_cache_that_cannot_be_written_is_one_folder_for_all_processes(tmp_path: Path) -> None:
    """And is gone with the process that made it."""
    program = """
import subprocess, sys
from dopt.kernel.cache import CACHE_FOLDER
print(CACHE_FOLDER, flush=True)
if len(sys.argv) < 3:
    subprocess.run([sys.executable, "-c", sys.argv[1], sys.argv[1], "child"], check=True)
print(CACHE_FOLDER.is_dir())
"""
    (tmp_path / "file").touch()
    said = printed(program, program, DOPT_CACHE=str(tmp_path / "file" / "cache"))
    made, used, there, still_there = said.split()
    assert (made, there, still_there) == (used, "True", "True")
    assert not Path(made).exists()


CONSTANTS = """
import math
import numpy as np
from dopt.kernel.vectors import inner

FACTOR = {factor}
TABLE = np.array([1.0, 2.0])

def half(x):
    return FACTOR * x

def plan(x, out):
    out[0] = half(x) + TABLE[1] + math.sqrt(4.0) + 0.0 * inner(out, out)
"""


def function_with(folder: Path, **values: object) -> FunctionType:
    """Return the plan of a module in which names have other values than its file says."""
    path = folder / "own.py"
    path.write_text(CONSTANTS.format(factor=0.5))
    module = ModuleType("own")
    exec(compile(path.read_text(), str(path), "exec"), module.__dict__)
    module.__dict__.update(values)
    function: FunctionType = module.plan
    return function


@pytest.mark.usefixtures("folder")
def test_a_constant_from_elsewhere_is_part_of_the_content(
    triple: FunctionType, tmp_path: Path
) -> None:
    usual = content_digest(function_with(tmp_path))
    assert usual is not None
    assert content_digest(function_with(tmp_path)) == usual
    for value in (0.25, True, (1.0, 2.0), "text", np.array([3.0])):
        other = content_digest(function_with(tmp_path, FACTOR=value))
        assert other not in (None, usual)
    assert not found(triple)
    assert found(triple)
    same_sum = MODULE.replace("1.0, 2.0", "2.0, 1.0")
    assert not found(written(tmp_path / "own_triple.py", same_sum)), "other code"


def test_what_cannot_be_told_or_has_no_file_is_not_kept(tmp_path: Path) -> None:
    for value in ([1.0], {"a": 1}, trials, trials.trial, object()):
        assert content_digest(function_with(tmp_path, FACTOR=value)) is None
    names: dict[str, FunctionType] = {}
    exec("def plan(x, out):\n    out[0] = x\n", names)
    assert content_digest(names["plan"]) is None
