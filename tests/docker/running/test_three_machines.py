"""The page's commands for three machines, each machine a network namespace on one bridge."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docker.running.conftest import Ended, Machine
from tests.pages import PAGES, blocks

pytestmark = [pytest.mark.image, pytest.mark.timeout(900)]

SECTION = PAGES["docs/many_machines.md"].split("## Three machines")[1].split("\n## ")[0]
FIRST, OTHERS, LAST, _ = (
    [line.split("  #")[0].strip() for line in block.splitlines()]
    for block in blocks(SECTION, "bash")
)
SMALL = "launch -m experiment=smoke env.horizon=20"
TRIALS = 38


def namespace(number: int) -> tuple[str, ...]:
    """Connect one more machine to the bridge and return the words that run a command there."""
    name, address = f"m{number}", f"10.77.0.{number}"
    for command in (
        f"ip netns add {name}",
        f"ip link add {name} type veth peer name eth0 netns {name}",
        f"ip link set {name} master lan up",
        f"ip -n {name} link set lo up",
        f"ip -n {name} address add {address}/24 dev eth0",
        f"ip -n {name} link set eth0 up",
    ):
        subprocess.run(command.split(), check=True)
    there = ("nsenter", f"--net=/run/netns/{name}", "unshare", "--uts")
    return (*there, "sh", "-euc", f'hostname {name}; exec "$@"', "sh")


class Reader:
    """Someone who types the page's lines at a machine, with a smaller grid."""

    def __init__(self, folder: Path, number: int) -> None:
        self.variables = {"DOPT_CPUS": "1"}
        self.machine = Machine(folder, f"m{number}", self.variables, namespace(number))

    def types(self, line: str) -> Ended:
        """Run one line as the shell of that machine would."""
        words = line.split()
        if words[0] == "export":
            self.variables |= dict(word.split("=", 1) for word in words[1:])
            return self.machine.run("true")
        if words[-3:] == ["docker", "compose", "build"]:
            return self.machine.run("podman", "image", "exists", "dopt")  # built before the tests
        if words[:2] == ["docker", "compose"]:
            return self.machine.compose(
                *words[2:], *(SMALL.split() if words[-1] == "launch" else ())
            )
        if words[0] == "docker":
            return self.machine.run("podman", *words[1:])
        return self.machine.run(*words)


@pytest.fixture(scope="module")
def readers(folder: Path, _cleared: None) -> Iterator[list[Reader]]:
    """Return three machines, on each of which the page's lines have been typed."""
    for command in ("ip link add lan type bridge", "ip link set lan up"):
        subprocess.run(command.split(), check=True)
    readers = [Reader(folder, number) for number in (1, 2, 3)]
    for line in FIRST:
        readers[0].types(line)
    readers[0].machine.wait_until_healthy("db")
    readers[0].machine.wait_until_healthy("head")
    for number, reader in enumerate(readers[1:], start=2):
        for line in OTHERS:
            reader.types(line.replace("DOPT_NODE_IP=10.77.0.2", f"DOPT_NODE_IP=10.77.0.{number}"))
        reader.machine.wait_until_healthy("worker")
    yield readers
    for reader in readers:
        subprocess.run(["ip", "netns", "delete", reader.machine.name], check=True)
    subprocess.run(["ip", "link", "delete", "lan"], check=True)


def test_the_page_runs_a_grid_on_three_machines(readers: list[Reader]) -> None:
    first = readers[0]
    launched = first.types(LAST[0])
    assert f"{TRIALS} of {TRIALS} done" in launched.stdout
    assert first.machine.rows("SELECT status, count(*) FROM trial GROUP BY 1") == [
        ["done", str(TRIALS)]
    ]
    assert first.machine.spread(3) == {"m1", "m2", "m3"}
    for line in LAST[1:]:
        first.types(line)
    assert {"figure1.pdf", "summary.csv"} <= {
        path.name for path in (first.machine.root / "figures").iterdir()
    }
