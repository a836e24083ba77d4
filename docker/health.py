"""Is this container's node alive? Exit 0 if the head of the cluster says so, 1 if not.

A container that is no node of a cluster, such as a figure being drawn, is healthy while it runs.
"""

from __future__ import annotations

import sys
from pathlib import Path

NODE_FILE = Path("/tmp/dopt-node")
"""Address of the head and of this node, written by the entry point."""

TIMEOUT_SECONDS = 10


def main() -> int:
    """Ask the head of the cluster."""
    if not NODE_FILE.exists():
        return 0
    from ray._raylet import GcsClient
    from ray.core.generated.gcs_pb2 import GcsNodeInfo

    head, address = NODE_FILE.read_text().split()
    nodes = GcsClient(address=head).get_all_node_info(timeout=TIMEOUT_SECONDS)
    here = [node for node in nodes.values() if node.node_manager_address == address]
    return 0 if any(node.state == GcsNodeInfo.ALIVE for node in here) else 1


if __name__ == "__main__":
    sys.exit(main())
