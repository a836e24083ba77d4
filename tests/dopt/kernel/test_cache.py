"""Cache of compiled code: damaged files, refusals of the system, and warming."""

from __future__ import annotations

import errno
import fcntl
import os
import pwd
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import llvmlite.binding
import numpy as np
import pytest
from numba import float64, void
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext
from numba.core.dispatcher import Dispatcher

from dopt.errors import UnusableEnvironmentError
from dopt.kernel import cache, compiler, equations, warm_up, warming
from dopt.kernel.compiler import compiled
from dopt.kernel.warming import leave_callees_out
from dopt.systems import SYSTEMS
from dopt.types import Vector
from tests.paths import ROOT, loaded

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


def code_and_mark(folder: Path) -> tuple[Path, Path]:
    [code], [mark] = folder.rglob("*.nbi"), folder.glob("*.complete")
    return code, mark


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
    path = code_and_mark(folder)[which]
    damage(path)
    caplog.clear()
    code_lost = which == 0
    assert found(triple) is not code_lost
    assert caplog.messages
    assert caplog.text.count("is damaged") == (damage is not Path.unlink or code_lost)
    caplog.clear()
    assert found(triple)
    assert not caplog.messages


@pytest.mark.usefixtures("folder")
def test_a_changed_constant_makes_other_code(triple: FunctionType, tmp_path: Path) -> None:
    """The function itself stays the same, and so does what it returns."""
    assert not found(triple)
    assert found(triple)
    assert not found(written(tmp_path / "own_triple.py", MODULE.replace("1.0, 2.0", "2.0, 1.0")))


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
    done = subprocess.run(
        [sys.executable, "-c", "import dopt.kernel.compiler"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
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


@pytest.fixture
def as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let Numba be as it is when the test has ended."""
    for owner, name in (
        (CPUCodeLibrary, "_optimize_final_module"),
        (CPUCodeLibrary, "_finalize_final_module"),
        (CPUContext, "get_executable"),
    ):
        monkeypatch.setattr(owner, name, getattr(owner, name))


def test_callees_have_no_code_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """And callees are optimized in their callers alone."""
    optimized: list[str] = []

    def optimize(library: CPUCodeLibrary) -> None:
        optimized.append(library.name)
        whole(library)

    whole = warming._optimize
    monkeypatch.setattr(warming, "_optimize", optimize)

    @compiled
    def total(values: Vector) -> float:
        result = 0.0
        for value in values:
            if value < 0.0:
                raise ValueError("a value is below zero")
            result += value
        return result

    @compiled
    def mean(values: Vector) -> float:
        return total(values) / len(values)

    leave_callees_out()
    assert mean(np.array([1.0, 2.0, 6.0])) == 3.0
    with pytest.raises(ValueError, match="below zero"):
        mean(np.array([1.0, -2.0]))
    for function, count in ((mean, 1), (total, 0)):
        [result] = function.overloads.values()  # has the compiler's back end made code of it?
        assert (result.library._compiled_object is not None) == count
        assert sum(function.__name__ in name for name in optimized) == count
