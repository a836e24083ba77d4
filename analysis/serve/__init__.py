"""Results browser: read-only web pages over a results database, served on the local machine.

``app`` has the routes, ``pages`` computes what they show with the functions behind the figures,
``sql`` runs statements, ``web`` reads queries, renders answers and holds the database with its
event stream, and ``server`` checks every request. This file has the command.
"""

from __future__ import annotations

import argparse
import ipaddress
import os
import socket
import sys
from contextlib import ExitStack

from analysis.errors import AnalysisError
from dopt.errors import install_command
from orchestrate.store import DEFAULT_URL, default_url


def is_loopback(host: str) -> bool:
    """Whether an address to listen at is reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


HELP = "show the results in a browser, read-only, while a launch writes"
PORT = 8000
HOST = "127.0.0.1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "--db", nargs="+", default=[default_url()], metavar="URL", help=f"(DOPT_DB, {DEFAULT_URL})"
    )
    parser.add_argument("--port", type=int, default=PORT, help=f"port, 0: any free one ({PORT})")
    parser.add_argument("--host", default=HOST, help=f"address to listen at ({HOST})")


def run(options: argparse.Namespace) -> int:
    """Serve until the user ends it with Ctrl-C."""
    _check_one_database(options)
    try:
        from analysis.serve.app import create_app
        from analysis.serve.server import Server
    except ModuleNotFoundError as error:
        raise AnalysisError(
            f"The browser needs the library {error.name}: "
            f"install it with {install_command('serve')}."
        ) from error
    app = create_app(options.db[0], options.host)
    listening = _listen(options.host, options.port)
    sys.stdout.write(_greeting(options, listening.getsockname()[1]))
    sys.stdout.flush()
    try:
        Server(app, leave=lambda: os._exit(0)).run(sockets=[listening])
    except KeyboardInterrupt:
        return 0
    finally:
        listening.close()
    return 0


def _check_one_database(options: argparse.Namespace) -> None:
    if len(options.db) > 1:
        raise AnalysisError(
            f"A browser shows one database, but {len(options.db)} are given: start one for each, "
            f"with --port 0, or put them together with orchestrate merge."
        )


def _listen(host: str, port: int) -> socket.socket:
    """Return a bound socket; raise ``AnalysisError`` where the address is taken or wrong."""
    if not 0 <= port < 2**16:
        raise AnalysisError(f"--port is {port}, expected is a number of 0 to 65535: give one.")
    with ExitStack() as failing:
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            listening = failing.enter_context(socket.socket(family, kind, protocol))
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(address)
            listening.listen()  # a browser that comes before the first page is ready waits
        except OSError as error:
            raise AnalysisError(
                f"The browser cannot listen at {host}:{port} ({error.strerror or error}): "
                f"give another --port or --host, --port 0 takes any free port."
            ) from error
        failing.pop_all()
    return listening


def _greeting(options: argparse.Namespace, port: int) -> str:
    host = f"[{options.host}]" if ":" in options.host else options.host
    text = f"Results browser at http://{host}:{port}/ (read-only; Ctrl-C ends it)\n"
    if not is_loopback(options.host):
        text += "Whoever reaches this machine can read the database: there is no password.\n"
    return text
