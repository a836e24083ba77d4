"""``python -m analysis``: figures and tables from the results database."""

from __future__ import annotations

import sys

from analysis.cli import main
from dopt.garbage_collection import collect_rarely


def program() -> None:
    """Run the command line as a program of its own: ``dopt-analysis``."""
    collect_rarely()
    sys.exit(main(sys.argv[1:]))


if __name__ == "__main__":
    program()
