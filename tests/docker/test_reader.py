"""The user that docker/ makes for the browser reads every table, and does nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine, create_engine, make_url, text
from sqlalchemy.exc import ProgrammingError
from starlette.testclient import TestClient

from analysis.serve.app import create_app
from orchestrate.store import QueryError, Reader
from tests.analysis.browser import grids
from tests.analysis.browser.conftest import BASE
from tests.analysis.browser.forms import post
from tests.machines.requirements import unavailable
from tests.paths import ROOT

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
