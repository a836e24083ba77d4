"""The pages for readers: their commands, queries, links and the headings that links may name."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.paths import ROOT

DOCS = ROOT / "docs"
PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in (ROOT / "README.md", *sorted(DOCS.rglob("*.md")))
}
GENERATED = (
    "docs/beyond/README.md",
    "docs/claims/README.md",
    "docs/claims_control/README.md",
    "docs/mujoco/README.md",
    "docs/rivals/README.md",
    "docs/space_filling/README.md",
)
"""Pages that ``python -m analysis report`` writes."""

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"(?<!`)\[[^\]]*\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class Command:
    """A line that a reader types.

    Attributes
    ----------
    page : str
        Path of the page from the root of the repository.
    variables : dict
        Variables that are set in front of the program.
    program : str
        Such as ``launch.py``, ``orchestrate``, ``analysis`` or ``make``.
    words : tuple of str
        Arguments of the program.
    """

    page: str
    variables: dict[str, str]
    program: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: {self.program} {shlex.join(self.words)}"


def blocks(text: str, language: str) -> list[str]:
    """Return the contents of all fenced blocks of a language."""
    return [body for name, body in _FENCE.findall(text) if name == language]


def commands(*programs: str, pages: tuple[str, ...] = tuple(PAGES)) -> list[Command]:
    """Return the commands of these programs, by default of all, on the pages."""
    return [
        command
        for page in pages
        for command in _of_page(page)
        if not programs or command.program in programs
    ]


def _of_page(page: str) -> Iterator[Command]:
    """Yield the lines of the shell blocks, and the indented and inline ``python`` commands."""
    text = PAGES[page]
    lines = [line for block in blocks(text, "bash") for line in block.splitlines()]
    rest = _FENCE.sub("", text)
    lines += re.findall(r"`(python (?:-m|orchestrate/)[^`\n]*)`", rest)
    lines += re.findall(r"^    ((?:[A-Z_]+=\S+ )*python .*)$", rest, flags=re.MULTILINE)
    for line in lines:
        if words := shlex.split(re.sub(r"\$\([^)]*\)", "OUTPUT", line), comments=True):
            yield _command(page, words)


def _command(page: str, words: list[str]) -> Command:
    first = next(i for i, word in enumerate(words) if not re.match(r"[A-Z_]+=", word))
    variables = dict(word.split("=", 1) for word in words[:first])
    program, *rest = words[first:]
    if program == "python":
        rest = rest[2:] if rest[:2] == ["-m", "pdb"] else rest  # a program under the debugger
        program, rest = (rest[1], rest[2:]) if rest[0] == "-m" else (Path(rest[0]).name, rest[1:])
    return Command(page, variables, program, tuple(rest))


def links(page: str) -> list[str]:
    """Return the targets of the links of a page that lead to a file or a heading."""
    found = _LINK.findall(_FENCE.sub("", PAGES[page]))
    return [link for link in found if "://" not in link and not link.startswith("mailto:")]


def anchors(text: str) -> set[str]:
    """Return the names by which links reach the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", _FENCE.sub("", text), flags=re.MULTILINE)
    plain = [re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in plain}
