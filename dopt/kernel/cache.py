"""Disk cache of compiled code: its folder, its files, and the processes that fill it.

Each part of the kernel is compiled by itself and called through a pointer, so that any process can
put it into the cache, from which the others load it in seconds. The process that needs a part loads
it, too: in the process that compiles a part the linker may take a function that it calls from an
earlier compilation, which can round differently.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding

from dopt.errors import UnusableEnvironmentError, given_path
from dopt.kernel.plain import PLAIN
from dopt.process import lock_file, lock_stream, usable_cores

CACHE_VARIABLE = "DOPT_CACHE"
_PACKAGE = Path(__file__).resolve().parent.parent
COMPILED_SOURCES = ("algorithm.py", "kernel", "systems", "sphere.py")

OTHER_SETTINGS = tuple(
    f"NUMBA_{name}" for name in ("CACHE", "CPU", "CUDA", "NUM_THREADS", "THREAD")
)
"""Beginnings of Numba's variables that do not change the code, and of the processor's."""


def check_environment(disabled: object = None) -> None:
    """Raise UnusableEnvironmentError if Numba is disabled, by default by its variable."""
    given = os.environ.get("NUMBA_DISABLE_JIT") if disabled is None else disabled
    if str(given or 0).strip() != "0":
        raise UnusableEnvironmentError(
            f"NUMBA_DISABLE_JIT is {given}, with which Numba compiles nothing, but trials run as "
            f"compiled code: unset it, also in .numba_config.yaml, and set DOPT_PLAIN=1 for "
            f"breakpoints; then run the same command again."
        )


@contextlib.contextmanager
def errors_of_the_system() -> Iterator[None]:
    """Turn errors of the operating system into UnusableEnvironmentError."""
    try:
        yield
    except OSError as error:
        raise UnusableEnvironmentError(
            f"The kernel can be neither loaded nor compiled here ({error}): mend what the system "
            f"says, or set {CACHE_VARIABLE} to another folder, and run the same command again."
        ) from error


def _source_digest() -> str:
    """Return a digest of every source that ends up in compiled code, and of what compiles it.

    Numba checks only the file of the outermost function of what it finds in its cache, so a change
    in a file further in would go unnoticed: each state of the sources, and each kind of processor,
    gets a folder of its own.
    """
    libraries = [version(library) for library in ("numba", "llvmlite", "numpy")]
    names = sorted(name for name in os.environ if name.startswith("NUMBA_"))
    settings = [(n, os.environ[n]) for n in names if not n.startswith(OTHER_SETTINGS)]
    name, features = os.environ.get("NUMBA_CPU_NAME"), os.environ.get("NUMBA_CPU_FEATURES")
    if features is None and str(name).lower() != "generic":
        # Two virtual machines may name one processor and offer different parts of it.
        features = llvmlite.binding.get_host_cpu_features().flatten()
    if name is None:
        name = llvmlite.binding.get_host_cpu_name()
    facts = (sys.version_info[:2], sys.abiflags, libraries, settings, name, features or "")
    digest = hashlib.sha256(str(facts).encode())
    for source in COMPILED_SOURCES:
        top = _PACKAGE / source
        for path in [top] if top.is_file() else sorted(top.rglob("*.py")):
            digest.update(path.read_bytes())
    with contextlib.suppress(OSError):  # settings of Numba, too
        digest.update(Path(".numba_config.yaml").read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Return the folder of compiled code: a temporary one where the cache cannot be written."""
    name = f"kernel-{_source_digest()}"
    for root in _roots():
        folder = root / "dopt" / name
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
        if os.access(folder, os.R_OK):
            return _temporary(folder) or folder
    nowhere = Path(os.devnull, "dopt", name)
    return _temporary(nowhere) or nowhere


def _roots() -> list[Path]:
    """Return the folders in which the cache may be: the one given, or one in each home."""
    given = os.environ.get(CACHE_VARIABLE) or os.environ.get("XDG_CACHE_HOME")
    if given:
        return [given_path(given, CACHE_VARIABLE).absolute()]
    homes = [os.environ.get("HOME")]
    with contextlib.suppress(KeyError, ImportError):  # a number without a name, or no such users
        import pwd

        homes.append(pwd.getpwuid(os.getuid()).pw_dir)
    return [Path(home, ".cache") for home in homes if home]


def _temporary(other: Path) -> Path | None:
    """Return a folder of this process and those it starts, with links to what another one holds."""
    for place in (None, "/dev/shm"):  # a container may have no other
        with contextlib.suppress(OSError):
            root = Path(tempfile.mkdtemp(prefix="dopt-", dir=place))
            atexit.register(_remove, root, os.getpid())
            folder = root / "dopt" / other.name
            folder.mkdir(parents=True)
            for path in (*other.rglob("*.nbi"), *other.rglob("*.complete")):
                link = folder / path.relative_to(other)
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(path)
            os.environ[CACHE_VARIABLE] = str(root)
            _temporaries[folder] = other
            return folder
    return None


def _remove(folder: Path, maker: int) -> None:
    """Remove a temporary folder at the end of the process that made it, not of its forks."""
    if os.getpid() == maker:
        shutil.rmtree(folder, ignore_errors=True)


_temporaries: dict[Path, Path] = {}  # with the folders in whose place they are
CACHE_FOLDER = _cache_folder()
_used: list[str] = []  # names of files that were read or written, in their order
_intact: set[Path] = set()  # marks whose files were checked
_dropped: list[str] = []  # names of damaged files
_not_stored: list[OSError] = []  # why nothing is stored any more
_log = logging.getLogger("dopt.kernel")


def read(name: str) -> bytes | None:
    """Return the content of a file of the cache; None if it is missing or damaged."""
    try:
        stored = (CACHE_FOLDER / name).read_bytes()
    except OSError:
        return None
    content = stored[32:]
    if hashlib.sha256(content).digest() != stored[:32]:
        drop(name)
        return None
    _used.append(name)
    return content


def drop(name: str) -> None:
    """Remove a damaged file; warn about the first one."""
    if not _dropped:
        _log.warning("%s is damaged: what was lost is compiled again", CACHE_FOLDER / name)
    _dropped.append(name)
    with contextlib.suppress(OSError):
        (CACHE_FOLDER / name).unlink()


def write(name: str, content: bytes) -> None:
    """Store a file as a whole, or not at all, in a temporary folder where the cache takes none."""
    global CACHE_FOLDER
    while not _not_stored:
        try:
            _replace(CACHE_FOLDER / name, hashlib.sha256(content).digest() + content)
        except OSError as error:
            other = None if CACHE_FOLDER in _temporaries else _temporary(CACHE_FOLDER)
            if other is None:
                _not_stored.append(error)
                _log.warning("compiled code is not kept for other processes: %s", error)
            CACHE_FOLDER = other or CACHE_FOLDER
        else:
            _used.append(name)
            return


def _replace(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{os.urandom(8).hex()}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def can_be_filled() -> bool:
    """Return True if other processes can read what this one compiles."""
    return not _not_stored and os.access(CACHE_FOLDER, os.W_OK)


@contextlib.contextmanager
def one_compiler_at_a_time(what: str) -> Iterator[None]:
    """Serialise processes that put ``what`` into the cache; once it is there, all read freely.

    ``what``: name of a function and a hash of its signature, joined by a hyphen. The message goes
    to the logger ``dopt.kernel``. Its level is warning, which Python shows on standard error where
    a program has set up no logging: somebody waits for it.
    """
    name, _, _ = what.partition("-")
    with errors_of_the_system(), contextlib.ExitStack() as held:
        if not is_complete(what):
            with contextlib.suppress(OSError):  # not every file system has locks
                lock = held.enter_context((CACHE_FOLDER / f"{name}.lock").open("w"))
                lock_file(lock.fileno())
        before, there = len(_used), is_complete(what)
        if not there:
            _log.warning("compiling the kernel, %s: %s", for_whom(), name)
        yield
        if not there:
            mark_complete(what, _used[before:])


def for_whom() -> str:
    """Return who can use the code compiled now, for messages."""
    if CACHE_FOLDER not in _temporaries:
        return "once per machine"
    return f"for this command alone, as {_temporaries[CACHE_FOLDER]} cannot be written"


def is_complete(what: str) -> bool:
    """Return True if ``what`` is in the cache, undamaged."""
    name = f"{what}.complete"
    if CACHE_FOLDER / name in _intact:
        return True
    files = read(name)
    if files is None:
        return False
    if None in [*map(read, files.decode().splitlines())]:  # all are looked at
        drop(name)
        return False
    _intact.add(CACHE_FOLDER / name)
    return True


def mark_complete(what: str, files: Sequence[str] | None = None) -> None:
    """Record which files hold ``what``, by default all that this process has used."""
    used = dict.fromkeys(_used if files is None else files)
    there = [name for name in used if (CACHE_FOLDER / name).exists()]
    write(f"{what}.complete", "\n".join(there).encode())


def missing(names: Sequence[str]) -> list[str]:
    """Return the names of the functions that are missing or damaged in the cache."""
    marks = _marks_of(names)
    return [name for name in names if not marks[name] or not all(map(is_complete, marks[name]))]


def files_of(names: Sequence[str]) -> list[str]:
    """Return the files that hold the functions of the cache with these names."""
    marks = [f"{mark}.complete" for found in _marks_of(names).values() for mark in found]
    return [line for mark in marks for line in (read(mark) or b"").decode().splitlines()]


def _marks_of(names: Sequence[str]) -> dict[str, list[str]]:
    """Return the marks of functions, one for each signature that was compiled."""
    marks: dict[str, list[str]] = {name: [] for name in names}
    for stem in [path.stem for path in CACHE_FOLDER.glob("*.complete")]:
        for name in marks.keys() & {stem, stem.rpartition("-")[0]}:
            marks[name].append(stem)
    return marks


ENDS = ("first", "last")
"""Ends of the list of parts, at which the two processes begin."""

SECONDS_BETWEEN_MESSAGES = {True: 1.0, False: 30.0}
"""By whether messages go to a terminal, where each overwrites the one before."""

_PROGRAM = "dopt.kernel.warming"


def compile_missing(names: Sequence[str]) -> None:
    """Compile the parts that the cache does not hold, as :func:`compiling` does, and wait."""
    with compiling(names):
        pass


@contextlib.contextmanager
def compiling(names: Sequence[str]) -> Iterator[None]:
    """Compile the parts that the cache does not hold, in one process on each of two cores.

    The block runs meanwhile; at its end they are waited for. What they could not compile is left
    to the process that needs it.

    Parameters
    ----------
    names : sequence of str
        Names of parts of the package, keys of :func:`dopt.kernel.warming.kernel_parts`.
    """
    needed = [] if PLAIN else missing(names)
    if not needed or not can_be_filled():
        yield
        return
    start, next_message, spoke, over = time.perf_counter(), 0.0, False, False
    running = [_started(end, needed) for end in ENDS[: usable_cores()]]
    try:
        yield
        while not over:
            over = all(process.poll() is not None for process in running)
            seconds = time.perf_counter() - start
            if spoke if over else seconds >= next_message:
                next_message = seconds + SECONDS_BETWEEN_MESSAGES[_on_terminal()]
                there = len(needed) - len(missing(needed))
                state = f"{there} of {len(needed)} parts, {seconds:.0f} s"
                spoke = _said(f"compiling the kernel, {for_whom()}: {state}", last=over)
            time.sleep(0.0 if over else 0.1)
    finally:
        for process in running:
            process.kill()  # where the wait was broken off; one that has ended stays as it is
            process.wait()


def _said(text: str, *, last: bool) -> bool:
    """Print progress, unless another worker does so on the same standard error."""
    try:
        if not lock_stream(sys.stderr, release=last):
            return False
    except (OSError, TypeError, ValueError):  # no file, as in a notebook
        pass
    if _on_terminal():
        sys.stderr.write(f"{text}\x1b[K{chr(10) if last else chr(13)}")
        sys.stderr.flush()
    else:
        _log.warning(text)
    return True


def _on_terminal() -> bool:
    """Return True if messages go to a terminal, and to no handler of the program."""
    return not _log.hasHandlers() and sys.stderr is not None and sys.stderr.isatty()


def _started(end: str, names: Sequence[str]) -> subprocess.Popen[bytes]:
    place = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(filter(None, (place, os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", _PROGRAM, end, *names],  # no module of the working folder
        env=os.environ | {"PYTHONPATH": paths, CACHE_VARIABLE: str(CACHE_FOLDER.parents[1])},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
