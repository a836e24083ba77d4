"""Files of the containers: services, secrets, images, and the objects of Kubernetes."""

from __future__ import annotations

import functools
import os
import re
import shutil
import subprocess
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from sqlalchemy import Engine, create_engine, make_url, text
from sqlalchemy.exc import ProgrammingError
from starlette.testclient import TestClient

from analysis.serve.app import create_app
from orchestrate.errors import ExitCode
from orchestrate.store import QueryError, Reader
from tests.analysis.browser import grids
from tests.analysis.browser.conftest import BASE
from tests.analysis.browser.grids import post
from tests.machines.hosts import unavailable
from tests.pages import PAGES
from tests.paths import ROOT

DOCKER = ROOT / "docker"
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text())
HOSTS = yaml.safe_load((DOCKER / "compose.hosts.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
DOCKERFILE = (DOCKER / "Dockerfile").read_text()


def test_every_service_of_ours_runs_the_one_image_without_rights() -> None:
    for name in SERVICES.keys() - {"db"}:
        wanted = SERVICES[name]
        assert wanted["image"] == "${DOPT_IMAGE:-dopt}"
        assert wanted["cap_drop"] == ["ALL"]
        assert wanted["security_opt"] == ["no-new-privileges:true"]
        assert "user" not in wanted  # the image's own, which is not root
        assert not wanted.get("privileged")
    *_, last = re.findall(r"^USER (\d+):(\d+)$", DOCKERFILE, flags=re.MULTILINE)
    assert "0" not in last


def test_every_node_has_the_settings_of_ray() -> None:
    [path] = re.findall(
        r"^    \. (\S+ray\.env)$", (DOCKER / "entrypoint.sh").read_text(), re.MULTILINE
    )
    assert (ROOT / path).is_file()


def holds_a_secret(name: str, value: object) -> bool:
    """Return whether a variable is a secret, and not the path of one, or an address with one."""
    is_named = not name.endswith(("_FILE", "_PATH")) and re.search("PASSWORD|TOKEN$", name)
    return bool(is_named or re.search(r"://[^/@]*:[^/@]*@", str(value)))


def test_no_variable_and_no_word_holds_a_secret() -> None:
    for service in (*SERVICES.values(), *HOSTS["services"].values()):
        for name, value in service.get("environment", {}).items():
            assert not holds_a_secret(name, value), name


def test_a_secret_reaches_those_alone_who_need_it() -> None:
    readers = {name: set(service.get("secrets", [])) for name, service in SERVICES.items()}
    assert readers == {
        "db": {"postgres_password", "postgres_read_password"},
        "head": {"ray_auth_token"},
        "worker": {"ray_auth_token"},
        "launch": {"postgres_password", "ray_auth_token"},
        "analysis": {"postgres_password"},
        "browser": {"postgres_read_password"},  # it cannot even write
    }


def test_a_service_waits_until_those_it_needs_are_healthy() -> None:
    needs = {name: service.get("depends_on", {}) for name, service in SERVICES.items()}
    conditions = {
        (name, needed): needs[name][needed]["condition"] for name in needs for needed in needs[name]
    }
    assert conditions.keys() == {
        ("worker", "head"),
        ("launch", "head"),
        ("launch", "db"),
        ("analysis", "db"),
        ("browser", "db"),
    }
    assert set(conditions.values()) == {"service_healthy"}
    assert "HEALTHCHECK" in DOCKERFILE


def test_no_port_is_open_to_other_machines() -> None:
    services = [*SERVICES.values(), *HOSTS["services"].values()]
    ports = [port for service in services for port in service.get("ports", [])]
    assert len(ports) == 2
    assert all(port.startswith("127.0.0.1:") for port in ports)


def test_the_database_is_asked_by_address_and_the_versions_are_the_tested_ones() -> None:
    assert "--host=127.0.0.1" in SERVICES["db"]["healthcheck"]["test"]
    assert "--constraint constraints.txt" in DOCKERFILE


def test_only_what_is_named_gets_into_a_build() -> None:
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    assert next(line for line in lines if line and not line.startswith("#")) == "*"
    copied = re.findall(r"^COPY (?!--from)(.*) \S+$", DOCKERFILE, flags=re.MULTILINE)
    sources = {word for line in copied for word in line.split()}
    assert {line[1:] for line in lines if line.startswith("!")} == sources
    assert all((ROOT / source).exists() for source in sources)


def write_secrets(folder: Path, **variables: str) -> dict[str, str]:
    script = folder / "secrets.sh"
    script.write_text((DOCKER / "secrets.sh").read_text())
    surroundings = {"PATH": os.environ["PATH"], **variables}
    done = subprocess.run(
        ["sh", script], env=surroundings, capture_output=True, text=True, check=True
    )
    assert done.stdout == done.stderr == ""
    return {path.name: path.read_text().strip() for path in (folder / "secrets").iterdir()}


def test_secrets_come_from_the_environment(tmp_path: Path) -> None:
    passwords = {"POSTGRES_PASSWORD": "a b:c", "POSTGRES_READ_PASSWORD": "d\\e"}
    assert write_secrets(tmp_path, RAY_AUTH_TOKEN="t" * 32, **passwords) == {
        "postgres_password": "a b:c",
        "postgres_read_password": "d\\e",
        "ray_auth_token": "t" * 32,
    }


def test_secrets_are_made_up_once_and_nobody_else_on_the_machine_reads_them(tmp_path: Path) -> None:
    made = write_secrets(tmp_path)
    assert all(len(secret) >= 32 for secret in made.values())
    assert len(set(made.values())) == 3
    assert write_secrets(tmp_path, POSTGRES_PASSWORD="other") == made
    assert (tmp_path / "secrets").stat().st_mode & 0o777 == 0o700
    for path in (tmp_path / "secrets").iterdir():
        assert path.stat().st_mode & 0o777 == 0o644  # the container's user reads its own copy


def test_the_page_names_services_and_variables_that_exist() -> None:
    section = PAGES["docs/many_machines.md"].split("## Three machines")[1].split("\n## ")[0]
    named = re.findall(r"^docker compose (?:up|run) (.*?)(?:  #.*)?$", section, flags=re.MULTILINE)
    words = {word for line in named for word in line.split() if not word.startswith("--")}
    assert words - {"figures"} == {"db", "head", "worker", "launch", "analysis"}
    given = set(re.findall(r"(DOPT_\w+)=", section)) - {"DOPT_COMMIT"}
    assert given == set(re.findall(r"(DOPT_\w+):\?", (DOCKER / "compose.hosts.yaml").read_text()))
    (files,) = set(re.findall(r"^export COMPOSE_FILE=(\S+)$", section, flags=re.MULTILINE))
    assert all((ROOT / file).is_file() for file in files.split(":"))


SCRIPT = ROOT / "docker" / "kubernetes" / "database" / "reader.sh"


@pytest.fixture
def database(server: Engine, server_url: str) -> Iterator[str]:
    """Return the URL of a new database, whose user may be made."""
    if shutil.which("psql") is None:
        unavailable("psql not on PATH: install postgresql-client")
    name = f"dopt_{uuid.uuid4().hex}"
    alone = server.execution_options(isolation_level="AUTOCOMMIT")
    with alone.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    yield make_url(server_url).set(database=name).render_as_string(hide_password=False)
    with alone.connect() as connection:
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
        connection.execute(text("DROP ROLE IF EXISTS dopt_read"))


@pytest.fixture
def make_reader(database: str, tmp_path: Path) -> Callable[[str], str]:
    """Return a function that runs the script and returns the URL of the user."""

    def run(password: str) -> str:
        url, secret = make_url(database), tmp_path / "postgres_read_password"
        secret.write_text(f"{password}\n")
        given = {
            "PGHOST": url.host,
            "PGPORT": str(url.port),
            "POSTGRES_USER": url.username,
            "POSTGRES_DB": url.database,
            "READ_PASSWORD_FILE": str(secret),
        }
        done = subprocess.run(
            [SCRIPT], env={**os.environ, **given}, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
        login = url.set(username="dopt_read", password=password)
        return login.render_as_string(hide_password=False)

    return run


def test_it_reads_tables_that_come_later_and_writes_nothing(
    database: str, make_reader: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    login = make_reader("a'b \\ \"c")
    grids.one_trial(database)
    assert make_reader("another") != login
    with Reader.open(login) as reader:
        assert len(reader.query("SELECT * FROM v_trial")) == 1
        with pytest.raises(QueryError, match="permission denied"):
            reader.query("SELECT pg_read_file('/etc/passwd')")
    engine = create_engine(make_url(login))
    for statement in ("DELETE FROM step", "CREATE TABLE mine (x int)", "DROP VIEW v_trial"):
        refused = pytest.raises(ProgrammingError, match=r"permission denied|must be owner")
        with engine.connect() as connection, refused:
            connection.execute(text(statement))
    engine.dispose()
    monkeypatch.setenv("DOPT_READ_DB", login)
    with TestClient(create_app(login, "0.0.0.0"), base_url=BASE) as client:
        for page in ("/", "/curves", "/trials", "/sql"):
            assert client.get(page).status_code == 200, page
        assert post(client, "/api/sql", "SELECT count(*) FROM v_trial").json()["rows"] == [[1]]


def test_the_files_run_it_where_the_secret_is() -> None:
    assert os.access(SCRIPT, os.X_OK)
    compose = (ROOT / "docker" / "compose.yaml").read_text()
    assert f"./{SCRIPT.relative_to(ROOT / 'docker')}:/docker-entrypoint-initdb.d/" in compose
    assert "files: [reader.sh]" in (SCRIPT.parent / "kustomization.yaml").read_text()


KUBERNETES = ROOT / "docker" / "kubernetes"

Manifest = dict[str, Any]


def rendered(folder: str) -> list[Manifest]:
    """Return the manifests of a folder; skip the test where no kubectl is installed."""
    if shutil.which("kubectl") is None:
        unavailable("kubectl not on PATH: install kubernetes-client")
    return _rendered(folder)


@functools.cache
def _rendered(folder: str) -> list[Manifest]:
    done = subprocess.run(
        ["kubectl", "kustomize", KUBERNETES / folder], capture_output=True, text=True, check=False
    )
    if done.returncode:
        pytest.fail(done.stderr)
    return list(yaml.safe_load_all(done.stdout))


def of_kind(folder: str, kind: str, name: str) -> Manifest:
    """Return the manifest of an object of a folder."""
    [found] = (
        one for one in rendered(folder) if (one["kind"], one["metadata"]["name"]) == (kind, name)
    )
    return found


def pods(manifest: Manifest) -> list[Manifest]:
    """Return the pod templates of an object."""
    spec = manifest.get("spec", {})  # a ConfigMap has none
    if manifest["kind"] == "RayCluster":
        groups = [spec["headGroupSpec"], *spec["workerGroupSpecs"]]
        return [group["template"] for group in groups]
    return [spec["template"]] if "template" in spec else []


def containers(manifest: Manifest) -> list[Manifest]:
    """Return all containers of an object, those that come first included."""
    return [
        container
        for pod in pods(manifest)
        for key in ("initContainers", "containers")
        for container in pod["spec"].get(key, [])
    ]


FOLDERS = ("database", "workers", "ray")
VERSIONS = ("1.31", "1.37")
"""The first in which a Job may ignore evicted pods without a feature gate, and the newest."""

RAY_CLUSTER = {
    "headGroupSpec": {"rayStartParams", "template"},
    "workerGroupSpecs": {
        "groupName", "maxReplicas", "minReplicas", "rayStartParams", "replicas", "template",
    },
}  # fmt: skip
"""The fields of ray.io/v1 that are used, by their part."""


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("folder", FOLDERS)
def test_every_object_is_valid_by_the_schemas_of_kubernetes(folder: str, version: str) -> None:
    for manifest in rendered(folder):
        if manifest["kind"] != "RayCluster":  # which Kubernetes itself does not know
            kubernetes_validate.validate(manifest, version, strict=True)
        for pod in pods(manifest):
            alone = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "one"}, **pod}
            kubernetes_validate.validate(alone, version, strict=True)


def test_a_cluster_has_the_fields_of_its_kind() -> None:
    cluster = of_kind("ray", "RayCluster", "dopt")
    assert cluster["apiVersion"] == "ray.io/v1"
    assert cluster["metadata"]["annotations"] == {"ray.io/overwrite-container-cmd": "true"}
    spec = cluster["spec"]
    assert spec.keys() == RAY_CLUSTER.keys()
    assert spec["headGroupSpec"].keys() == RAY_CLUSTER["headGroupSpec"]
    for group in spec["workerGroupSpecs"]:
        assert group.keys() == RAY_CLUSTER["workerGroupSpecs"]
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_container_has_rights_a_secret_or_unlimited_memory_and_none_is_root(folder: str) -> None:
    found = [(one, container) for one in rendered(folder) for container in containers(one)]
    assert found
    for manifest, container in found:
        assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        assert container["securityContext"]["allowPrivilegeEscalation"] is False
        assert container["resources"]["limits"]["memory"]
        for variable in container.get("env", []):
            assert not holds_a_secret(variable["name"], variable["value"]), variable
        for pod in pods(manifest):
            assert pod["spec"]["securityContext"]["runAsNonRoot"] is True
            assert pod["spec"]["automountServiceAccountToken"] is False


def test_a_worker_has_a_core_for_each_trial_and_memory_for_all() -> None:
    job = of_kind("workers", "Job", "dopt-workers")
    [worker] = job["spec"]["template"]["spec"]["containers"]
    given = dict(word[2:].split("=") for word in worker["args"] if word.startswith("--"))
    assert worker["resources"]["requests"]["cpu"] == given["processes"]
    gib = float(worker["resources"]["limits"]["memory"].removesuffix("Gi"))
    assert int(given["processes"]) * float(given["memory-gib"]) + 1.0 <= gib


def test_a_job_counts_only_what_it_cannot_mend() -> None:
    """An eviction, a lost database and a failed trial cost no pod one of its tries."""
    rules = of_kind("workers", "Job", "dopt-workers")["spec"]["podFailurePolicy"]["rules"]
    actions = {
        (rule["onExitCodes"]["containerName"], code): rule["action"]
        for rule in rules
        if "onExitCodes" in rule
        for code in rule["onExitCodes"]["values"]
    }
    assert actions == {
        ("register", ExitCode.BAD_REQUEST): "FailJob",
        ("register", ExitCode.INFRASTRUCTURE): "Ignore",
        ("worker", ExitCode.SOME_FAILED): "Ignore",
        ("worker", ExitCode.INFRASTRUCTURE): "Ignore",
        ("worker", ExitCode.INTERRUPTED): "Ignore",
    }
    evicted = {"type": "DisruptionTarget", "status": "True"}
    assert {"action": "Ignore", "onPodConditions": [evicted]} in rules


def test_the_head_is_found_by_the_name_that_the_operator_gives_it() -> None:
    cluster = of_kind("ray", "RayCluster", "dopt")
    head = f"{cluster['metadata']['name']}-head-svc:6379"
    launch = of_kind("ray", "Job", "dopt-launch")
    given = [
        variable["value"]
        for manifest in (cluster, launch)
        for container in containers(manifest)
        for variable in container["env"]
        if variable["name"] == "DOPT_HEAD"
    ]
    assert given == [head, head]


def test_commands_of_the_files_name_folders_that_exist() -> None:
    for path in KUBERNETES.glob("*/kustomization.yaml"):
        for folder in re.findall(r"--kustomize (\S+)", path.read_text()):
            assert (KUBERNETES.parents[1] / folder / "kustomization.yaml").exists()
        assert yaml.safe_load(path.read_text())["kind"] == "Kustomization"
