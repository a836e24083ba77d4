"""Ray without the services that no launch asks for: half of the time of its start.

They are the autoscaler, the dashboard, which runs even where it is refused, and what collects logs.
The end and the death of a launch, of its workers, of the raylet and of the head are as in a
whole Ray, which ``tests/orchestrate/test_launches.py`` starts.
"""

from __future__ import annotations

from typing import Any

SERVICES = ("start_monitor", "start_api_server", "start_log_monitor")


def leave_services_out() -> None:
    """Let every Ray that this process starts from now on be without them."""
    from ray._private.node import Node

    for name in SERVICES:
        assert hasattr(Node, name), name
        setattr(Node, name, _nothing)


def _nothing(*_: Any, **__: Any) -> None: ...
