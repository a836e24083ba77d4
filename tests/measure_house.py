"""Size of the project in one table: ``python tests/measure_house.py [--cases]``.

Lines of code are the lines that hold a token of a program: no blank lines, comments, imports,
docstrings, or strings that stand alone below a name.

The walk of a specification: one short trial is run twice by ``dopt.run.run_trial``, and the second
run is followed by ``sys.setprofile``. A room is a module of the packages in which a function is
called with a ``TrialSpec`` among its arguments. A return is the end of such a call whose caller
lies in another module of the packages. The first two numbers leave out the module of ``TrialSpec``
itself, whose attributes the others read; the numbers in brackets count it. Beside them stand all
modules of the packages of which a function ran. Functions that are compiled are not seen.
"""

from __future__ import annotations

import ast
import io
import re
import statistics
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("dopt", "orchestrate", "analysis")
LONGEST = 700
"""Lines above which a file is counted as long."""

SKIPPED = {"vendor", "__pycache__"}
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
NO_CODE |= {tokenize.ENCODING, tokenize.ENDMARKER}


def files(folders: Iterable[str], *endings: str) -> list[Path]:
    """Return the files of some folders by their endings, vendored ones left out."""
    return sorted(
        path
        for folder in folders
        for ending in endings
        for path in (ROOT / folder).rglob(f"*.{ending}")
        if not SKIPPED & set(path.parts)
    )


def lines(paths: Iterable[Path]) -> int:
    """Return the number of lines of some files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def code_lines(text: str) -> int:
    """Return the number of lines of code of a module."""
    left_out: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        value = node.value if isinstance(node, ast.Expr) else None
        text_alone = isinstance(value, ast.Constant) and isinstance(value.value, str)
        if text_alone or isinstance(node, ast.Import | ast.ImportFrom):
            left_out |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    found: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            found |= set(range(token.start[0], token.end[0] + 1))
    return len(found - left_out)


GENERATED = re.compile(r"<!-- table: \w+ -->\n.*?<!-- end -->", re.DOTALL)
"""Block of a page that ``docs/tables.py`` writes."""


def words(paths: Iterable[Path], written: bool = False) -> int:
    """Return the number of words of some pages, their tables and code included.

    Generated blocks are left out where ``written`` is true.
    """
    texts = (path.read_text(encoding="utf-8") for path in paths)
    return sum(len((GENERATED.sub("", text) if written else text).split()) for text in texts)


def walk() -> tuple[int, int, int, int, int]:
    """Return rooms and returns of a specification through ``run_trial``, and modules that ran.

    Rooms and returns come twice: without the module of ``TrialSpec``, and with it.
    """
    from dopt.run import run_trial
    from dopt.spec.trial import TrialSpec

    env = {"name": "cartpole", "horizon": 5, "grid_points": [3, 4, 3]}
    spec = TrialSpec.from_names(env, "d_optimal")
    run_trial(spec)
    rooms, ran = set[str](), set[str]()
    calls: list[tuple[FrameType, bool]] = []
    returns = {False: 0, True: 0}
    home = TrialSpec.__module__

    def follow(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and _own(frame):
            ran.add(_module(frame))
        if event == "call" and _own(frame) and _is_given(frame, TrialSpec):
            rooms.add(_module(frame))
            calls.append((frame, _comes_from_another(frame)))
        elif event == "return" and calls and calls[-1][0] is frame:
            returns[_module(frame) == home] += calls.pop()[1]

    sys.setprofile(follow)
    try:
        run_trial(spec)
    finally:
        sys.setprofile(None)
    others = rooms - {home}
    return len(others), returns[False], len(rooms), sum(returns.values()), len(ran)


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", ""))


def _own(frame: FrameType) -> bool:
    return _module(frame).partition(".")[0] in PACKAGES


def _is_given(frame: FrameType, kind: type) -> bool:
    code = frame.f_code
    names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return any(isinstance(frame.f_locals.get(name), kind) for name in names)


def _comes_from_another(frame: FrameType) -> bool:
    """Return whether the nearest caller of the packages is another module."""
    caller = frame.f_back
    while caller is not None and not _own(caller):
        caller = caller.f_back
    return caller is not None and _module(caller) != _module(frame)


def cases() -> str:
    """Return the number of cases that pytest collects."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "--quiet", "tests"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    found = re.search(r"(\d+)(?:/\d+)? tests collected", done.stdout)
    return f"{int(found[1]):,}" if found else f"not collected: {done.stdout[-200:]}"


def pages() -> list[Path]:
    """Return the pages of ``docs`` except the method; generated pages lie in folders."""
    return [path for path in sorted((ROOT / "docs").glob("*.md")) if path.name != "method.md"]


def rows(with_cases: bool) -> Iterator[tuple[str, str]]:
    """Yield what is counted, and its number."""
    source = files(PACKAGES, "py")
    sizes = [lines([path]) for path in source]
    total = sum(code_lines(path.read_text(encoding="utf-8")) for path in source)
    long = [
        f"{path.relative_to(ROOT)} {n}"
        for path, n in zip(source, sizes, strict=True)
        if n > LONGEST
    ]
    yield "source lines, " + ", ".join(PACKAGES), f"{sum(sizes):,}"
    yield "lines of code", f"{total:,}"
    yield "files", f"{len(source):,}"
    yield "median file [lines]", f"{statistics.median(sizes):g}"
    yield f"files above {LONGEST} lines", f"{len(long)} {', '.join(long)}".strip()
    for name in PACKAGES:
        own = files([name], "py")
        yield f"  {name}: lines, files", f"{lines(own):,}, {len(own)}"
    yield (
        "rooms, returns of a specification; modules that ran",
        "{}, {} ({}, {}); {}".format(*walk()),
    )
    for name in ("studies", "benchmarks"):
        own = files([name], "py")
        yield f"{name}: lines, files", f"{lines(own):,}, {len(own)}"
    yield (
        "js + css + html of the browser",
        f"{lines(files(['analysis/serve'], 'js', 'css', 'html')):,}",
    )
    yield "YAML of conf and studies", f"{lines(files(['conf', 'studies'], 'yaml')):,}"
    yield "test lines, files", "{:,}, {}".format(lines(tests := files(["tests"], "py")), len(tests))
    if with_cases:
        yield "test cases", cases()
    yield "words of README", f"{words([ROOT / 'README.md']):,}"
    yield "words of docs/*.md without method.md", f"{words(pages()):,}"
    yield "  the same without generated blocks", f"{words(pages(), written=True):,}"


def main() -> None:
    """Print the table as it is counted."""
    for what, number in rows("--cases" in sys.argv[1:]):
        sys.stdout.write(f"{what:<58} {number}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main()
