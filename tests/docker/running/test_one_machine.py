"""Database, head, two workers and a launch on one machine, started from compose.yaml."""

from __future__ import annotations

import json
import urllib.request
from pathlib import Path

import pytest

from tests.docker.running.conftest import PASSWORD, TOKEN, Ended, Machine

pytestmark = [pytest.mark.image, pytest.mark.timeout(900)]

GRID = ("launch", "-m", "experiment=smoke", "env.horizon=20")
TRIALS = 38  # two seeds of each pair that makes sense


@pytest.fixture(scope="module")
def machine(folder: Path) -> Machine:
    """Return a machine on which the cluster is up and healthy."""
    variables = {"COMPOSE_FILE": "docker/compose.yaml", "DOPT_CPUS": "1"}
    machine = Machine(folder, "one", variables)
    machine.compose("up", "--detach", "db", "head")
    machine.wait_until_healthy("db")
    machine.wait_until_healthy("head")
    machine.compose("up", "--detach", "--no-deps", "--scale", "worker=2", "worker")
    machine.wait_until_healthy("worker")
    return machine


@pytest.fixture(scope="module")
def launched(machine: Machine) -> Ended:
    """Return the end of a launch of a small grid."""
    return machine.compose("run", "--rm", "launch", *GRID, check=False)


def test_a_launch_computes_its_grid(machine: Machine, launched: Ended) -> None:
    assert launched.returncode == 0, launched.stderr
    assert machine.rows("SELECT status, count(*) FROM trial GROUP BY 1") == [["done", str(TRIALS)]]


def test_every_curve_is_whole(machine: Machine, launched: Ended) -> None:
    assert launched.returncode == 0
    curves = "SELECT count(*) AS n, max(t) AS last FROM step GROUP BY trial_id"
    shortest = machine.rows(f"SELECT count(*), min(n), max(n), min(last) FROM ({curves}) AS c")
    assert shortest == [[str(TRIALS), "20", "20", "19"]]


@pytest.mark.usefixtures("launched")
def test_the_commit_of_the_image_is_noted(machine: Machine) -> None:
    (image,) = json.loads(machine.run("podman", "image", "inspect", "localhost/dopt").stdout)
    commit = image["Labels"]["org.opencontainers.image.revision"]
    assert len(commit) == 40
    assert machine.rows("SELECT git_commit FROM launch ORDER BY 1 LIMIT 1") == [[commit]]


@pytest.mark.usefixtures("launched")
def test_the_same_launch_runs_nothing_again(machine: Machine) -> None:
    again = machine.compose("run", "--rm", "launch", *GRID)
    assert f"{TRIALS} of {TRIALS} already done" in again.stdout
    assert machine.rows("SELECT count(*) FROM attempt") == [[str(TRIALS)]]


@pytest.mark.usefixtures("launched")
def test_figures_are_drawn_into_their_volume(machine: Machine) -> None:
    wanted = ("analysis", "figures", "--only", "figure1", "--allow-partial")
    machine.compose("run", "--rm", "analysis", *wanted)
    words = ("run", "--rm", "--network=none", "--volume=one_figures:/figures")
    there = machine.run("podman", *words, "localhost/dopt", "ls", "/figures").stdout.split()
    assert {"figure1.pdf", "figure1.svg", "figure1.png", "figure1.csv"} <= set(there)


@pytest.mark.usefixtures("launched")
def test_the_browser_answers_this_machine(machine: Machine) -> None:
    machine.compose("up", "--detach", "--no-deps", "browser")
    machine.wait_until_healthy("browser")
    with urllib.request.urlopen("http://127.0.0.1:8000/", timeout=60) as answer:
        assert "pendulum" in answer.read().decode()


def test_nothing_runs_as_root(machine: Machine) -> None:
    for container in machine.containers():
        users = machine.run("podman", "top", container, "huser").stdout.split()[1:]
        assert users
        assert "root" not in users


def test_a_worker_without_the_token_cannot_join(machine: Machine) -> None:
    (network,) = machine.inspect(machine.containers("head")[0])["NetworkSettings"]["Networks"]
    words = ("--rm", f"--network={network}", "--env=DOPT_HEAD=head:6379", "--no-healthcheck")
    done = machine.run("podman", "run", *words, "localhost/dopt", "worker", check=False)
    assert done.returncode != 0
    assert "token" in (done.stdout + done.stderr).lower()


def secrets_in(text: str) -> list[str]:
    """Return the secrets that a text shows, plain or escaped."""
    escaped = PASSWORD.replace("\\", "\\\\").replace('"', '\\"')
    from_url = PASSWORD.replace("\\", "%5C").replace("@", "%40").replace("/", "%2F")
    return [secret for secret in (PASSWORD, escaped, from_url, TOKEN) if secret in text]


@pytest.mark.usefixtures("launched")
def test_no_secret_is_shown_by_the_engine(machine: Machine) -> None:
    for container in machine.containers():
        assert not secrets_in(machine.run("podman", "inspect", container).stdout)
        assert not secrets_in(machine.logs(container))
    for image in ("localhost/dopt", "docker.io/library/postgres:15-bookworm"):
        assert not secrets_in(machine.run("podman", "history", "--no-trunc", image).stdout)


@pytest.mark.usefixtures("launched")
def test_no_secret_is_an_argument_or_a_variable_of_a_process() -> None:
    for file in (*Path("/proc").glob("[0-9]*/cmdline"), *Path("/proc").glob("[0-9]*/environ")):
        try:
            text = file.read_bytes().decode(errors="replace")
        except (FileNotFoundError, ProcessLookupError):
            continue
        assert not secrets_in(text), file


def test_no_secret_is_in_what_a_launch_says_or_stores(machine: Machine, launched: Ended) -> None:
    assert not secrets_in(launched.stdout + launched.stderr)
    (database,) = machine.containers("db")
    assert not secrets_in(machine.inside(database, "pg_dump", "--username=dopt", "dopt"))


@pytest.mark.usefixtures("launched")
def test_no_secret_is_in_the_logs_of_ray(machine: Machine) -> None:
    for container in (*machine.containers("head"), *machine.containers("worker")):
        logs = machine.inside(container, "sh", "-c", "cat /tmp/ray/session_*/logs/*.*")
        assert logs
        assert not secrets_in(logs)


@pytest.mark.usefixtures("launched")
def test_a_wrong_password_is_refused_without_showing_it(machine: Machine) -> None:
    wrong = "wrong-and-not-to-be-seen"
    url = f"postgresql://dopt:{wrong}@db:5432/dopt"
    words = ("run", "--rm", "--env", f"DOPT_DB={url}", "launch", *GRID)
    done = machine.compose(*words, check=False)
    assert done.returncode == 75
    assert wrong not in done.stderr.split("error:")[-1]


@pytest.mark.usefixtures("launched")
def test_trials_run_on_the_workers_alone(machine: Machine) -> None:
    workers = {machine.inside(name, "hostname") for name in machine.containers("worker")}
    assert machine.spread(2) == workers
