"""``python -m analysis``: figures and tables from the results database."""

from __future__ import annotations

from dopt.process import collect_rarely, end_at_interrupt

if __name__ == "__main__":
    end_at_interrupt()

from orchestrate.program import run


def program() -> None:
    """Run the command line as the program ``dopt-analysis``."""
    collect_rarely()
    run("analysis.cli")


if __name__ == "__main__":
    program()
