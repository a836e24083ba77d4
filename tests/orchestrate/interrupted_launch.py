"""A launch of slow stand-ins, to be interrupted from outside.

``python -m tests.orchestrate.interrupted_launch FOLDER TRIALS``
"""

from __future__ import annotations

import sys
from pathlib import Path

from tests.orchestrate.conftest import Launches
from tests.orchestrate.standins import slow

if __name__ == "__main__":
    launches = Launches(Path(sys.argv[1]))
    code = launches(slow, seeds=int(sys.argv[2]), executor="local")
    sys.stdout.write("\n".join(launches.said))
    sys.exit(code)
