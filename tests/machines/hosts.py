"""Several hosts on one machine: each with its own network, processes, name, HOME and /tmp.

A host is a set of Linux namespaces around one process; ending that process is a power-off. The
cables of all hosts end in a bridge that has a network namespace of its own, so no packet leaves.
Everything ends with the process that opened the network, whatever ends it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from tests import waiting
from tests.paths import ROOT


def unavailable(message: str) -> None:
    """Skip the test, or fail it where DOPT_REQUIRE_MACHINES=1."""
    if os.environ.get("DOPT_REQUIRE_MACHINES") == "1":
        pytest.fail(message)
    pytest.skip(message)


_FIRST_PROCESS = (
    "import os, signal, socket; signal.signal(signal.SIGCHLD, signal.SIG_IGN); "
    "os.write(1, b'up'); signal.pause()"
)
# Every host sees the checkout and the cache of the kernel, also where they lie below /tmp.
_HOST_SCRIPT = """
hostname "$1"
for shared in "$5" "$6"; do
    case "$shared" in /tmp/*) mkdir -p "$2$shared" && mount --bind "$shared" "$2$shared" ;; esac
done
mount --rbind "$2/tmp" /tmp
mount --bind "$2/hosts" /etc/hosts
mount -t tmpfs -o size=1g shm /dev/shm
ip link set lo up
exec "$3" -c "$4"
"""


class Namespaces:
    """One process in namespaces of its own; everything that runs inside ends with it."""

    def __init__(self, kinds: Sequence[str], command: Sequence[str]) -> None:
        with tempfile.TemporaryFile() as errors:
            self._outer = subprocess.Popen(
                # The first process dies with us, and what it holds dies with it.
                ["setpriv", "--pdeathsig", "KILL", "unshare", *kinds, "--", *command],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
            )
            assert self._outer.stdout is not None
            if self._outer.stdout.read(2) != b"up":
                errors.seek(0)
                raise OSError(f"a host did not start: {errors.read().decode()}")
        self.pid = _children(self._outer.pid)[0]

    @property
    def alive(self) -> bool:
        return self._outer.poll() is None

    def end(self) -> None:
        """Kill every process inside, and wait until they are gone."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        self._outer.wait(timeout=30)
        if self._outer.stdout is not None:
            self._outer.stdout.close()


class Process:
    """A program on a host, with what it wrote."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> None:
        self._log = log
        with log.open("w") as output:
            self._popen = subprocess.Popen(
                command,
                env={**os.environ, **environment},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the program itself, not to ``nsenter`` around it."""
        for pid in _children(self._popen.pid):
            os.kill(pid, number)

    def wait(self) -> int:
        """Return the exit code."""
        try:
            return self._popen.wait(waiting.PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            self.end()
            raise AssertionError(f"it does not end:\n{self.output}") from None

    @property
    def running(self) -> bool:
        return self._popen.poll() is None

    @property
    def output(self) -> str:
        return self._log.read_text(errors="replace")

    def end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.signal(signal.SIGKILL)
        self._popen.kill()
        self._popen.wait()


class Host:
    """A machine of the lab.

    Attributes
    ----------
    name, address
        Host name and IPv4 address on the bridge.
    folder
        Its own files: ``home`` is HOME there, and ``tmp`` is what it sees as /tmp.
    """

    def __init__(self, name: str, address: str, folder: Path, environment: Mapping[str, str]):
        self.name = name
        self.address = address
        self.folder = folder
        for part in ("home", "tmp"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        (folder / "tmp").chmod(0o1777)
        (folder / "hosts").write_text(f"127.0.0.1 localhost\n{address} {name}\n")
        self._environment = {**environment, "HOME": str(folder / "home")}
        self._processes: list[Process] = []
        self._namespaces = Namespaces(
            ["--net", "--mount", "--pid", "--fork", "--uts", "--kill-child", "--mount-proc"],
            [
                "sh",
                "-ec",
                _HOST_SCRIPT,
                "sh",
                name,
                str(folder),
                sys.executable,
                _FIRST_PROCESS,
                str(ROOT),
                self._environment["DOPT_CACHE"],
            ],
        )
        self.pid = self._namespaces.pid

    def start(self, *command: str, **environment: str) -> Process:
        """Start a program on the host."""
        inside = ["nsenter", f"--target={self.pid}", "--net", "--mount", "--pid", "--uts"]
        log = self.folder / f"{len(self._processes)}.log"
        process = Process([*inside, "--", *command], {**self._environment, **environment}, log)
        self._processes.append(process)
        return process

    def run(self, *command: str, **environment: str) -> str:
        """Run a program to its end and return what it wrote."""
        process = self.start(*command, **environment)
        code = process.wait()
        assert code == 0, f"{' '.join(command)} on {self.name}: {code}\n{process.output}"
        return process.output

    def logs(self) -> str:
        """Return what every program has written so far."""
        return "\n".join(process.output for process in self._processes)

    def power_off(self) -> None:
        """End every process of the host at once."""
        self._namespaces.end()
        for process in self._processes:
            process.end()


class Network:
    """A bridge, and hosts on it; a context manager that ends them all."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = environment
        self._stack = contextlib.ExitStack()
        self.hosts: dict[str, Host] = {}

    def __enter__(self) -> Network:
        with contextlib.ExitStack() as stack:
            # Not below /tmp, where every host sees its own folder.
            text = stack.enter_context(tempfile.TemporaryDirectory(prefix="lab-", dir="/var/tmp"))
            self._folder = Path(text)
            self._folder.chmod(0o755)  # PostgreSQL refuses to run as root
            self._bridge = Namespaces(
                ["--net", "--fork", "--kill-child"], [sys.executable, "-c", _FIRST_PROCESS]
            )
            stack.callback(self._bridge.end)
            self._ip("link", "add", "name", "bridge", "type", "bridge")
            self._ip("link", "set", "dev", "bridge", "up")
            stack.callback(self._power_off)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, name: str) -> Host:
        """Bring up a host with the next free address and a cable to the bridge."""
        number = len(self.hosts) + 1
        return self._bring_up(name, f"10.77.0.{number}")

    def replace(self, host: Host) -> Host:
        """Bring up a new host in the place of one that is off, empty but with its address."""
        return self._bring_up(host.name, host.address)

    def _bring_up(self, name: str, address: str) -> Host:
        folder = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self._folder))
        folder.chmod(0o755)
        host = Host(name, address, folder, self._environment)
        self.hosts[name] = host
        port = _port(host)
        self._ip("link", "add", "name", port, "type", "veth",
                 "peer", "name", "eth0", "netns", str(host.pid))  # fmt: skip
        self._ip("link", "set", "dev", port, "master", "bridge", "up")
        host.run("ip", "address", "add", f"{host.address}/24", "dev", "eth0")
        host.run("ip", "link", "set", "dev", "eth0", "up")
        return host

    @contextlib.contextmanager
    def link_cut(self, host: Host) -> Iterator[None]:
        """Let no packet of the host through; nobody is told."""
        self._ip("link", "set", "dev", _port(host), "down")
        try:
            yield
        finally:
            self._ip("link", "set", "dev", _port(host), "up")

    @contextlib.contextmanager
    def cut_between(self, one: Host, other: Host) -> Iterator[None]:
        """Let no packet through between two hosts, which both reach all others."""
        self._isolate("on", one, other)
        try:
            yield
        finally:
            self._isolate("off", one, other)

    def power_off(self, host: Host) -> None:
        """End a host as a power cut does: without a last word on the network."""
        self._ip("link", "delete", "dev", _port(host))
        host.power_off()

    def _isolate(self, state: str, *hosts: Host) -> None:
        # Isolated ports of a bridge exchange nothing with each other.
        for host in hosts:
            self._inside("bridge", "link", "set", "dev", _port(host), "isolated", state)

    def _ip(self, *words: str) -> None:
        self._inside("ip", *words)

    def _inside(self, *command: str) -> None:
        inside = ["nsenter", f"--target={self._bridge.pid}", "--net", "--"]
        subprocess.run([*inside, *command], check=True, timeout=30)

    def _power_off(self) -> None:
        for host in self.hosts.values():
            host.power_off()


def until(condition: Callable[[], object], what: Callable[[], str]) -> float:
    """Wait until the condition holds and return how many seconds that took."""
    start = time.monotonic()
    waiting.until(condition, lambda: f"there was no {what()}")
    return time.monotonic() - start


def _port(host: Host) -> str:
    return f"port{host.address.rsplit('.', 1)[1]}"


def _children(pid: int) -> list[int]:
    with contextlib.suppress(OSError):
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []
