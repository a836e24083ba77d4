"""Tables and colours for terminals; elsewhere each row is one line, however long."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator, Sequence

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from orchestrate.cli_parser import visible

_UNLIMITED_WIDTH = 100_000  # characters: no line is folded or cut


class _Console(Console):
    """Console that shows the control characters of texts, and sends its own."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        for one in super().render(renderable, options):
            yield one if one.control else Segment(visible(one.text), one.style)


def console() -> Console:
    """Return a console on the standard output; colours follow NO_COLOR and the terminal."""
    width = None if sys.stdout.isatty() else _UNLIMITED_WIDTH
    return _Console(file=sys.stdout, width=width, highlight=False, markup=False, emoji=False)


def show(*parts: RenderableType) -> None:
    """Print the parts below each other; a table may be wider than the terminal."""
    out = console()
    for part in parts:
        if isinstance(part, Table):
            out.width = max(out.width, out.measure(part).minimum)
        out.print(part, soft_wrap=isinstance(part, str | Text))


def table(
    heads: Sequence[str],
    *,
    numbers: Collection[str] = (),
    styles: Sequence[str] = (),
    footers: Sequence[str] = (),
) -> Table:
    """Return an empty table whose cells do not wrap; columns in ``numbers`` are right-aligned."""
    result = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_footer=bool(footers))
    for i, head in enumerate(heads):
        result.add_column(
            head,
            footer=footers[i] if footers else "",
            justify="right" if head in numbers else "left",
            style=styles[i] if styles else "",
            no_wrap=True,
            overflow="ignore",
        )
    return result


def plain(text: str) -> Text:
    """Return the text with control characters escaped."""
    return Text(
        "".join(
            char if char.isprintable() or char == "\n" else repr(char)[1:-1]
            for char in text.expandtabs()
        )
    )
