"""Results browser: read-only web pages over a results database, served on the local machine.

``app`` has the routes, ``pages`` computes what they show with the functions behind the figures,
``sql`` runs statements, ``web`` reads queries, renders answers and holds the database with its
event stream; ``app`` checks every request, too.
"""

from __future__ import annotations

import ipaddress


def is_loopback(host: str) -> bool:
    """Return True if an address to listen at is reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
