# One command each, the same by hand and in CI. Every target installs what it needs into .venv:
# the package with its libraries to run grids and draw figures, the developers' tools for the rest.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DB ?= sqlite:///results/results.db
STUDY_DB ?= sqlite:///results/study.db
CLAIMS_DB ?= sqlite:///results/claims.db
CLAIMS_CONTROL_DB ?= sqlite:///results/claims_control.db
SMOKE_DB := sqlite:///results/smoke.db
# The questions that are compared with their history.
CHECKED := step,evaluation,trial,expansion

# One thread to a process: the grid runs one worker on each core.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
# Python keeps the bytecode of the libraries, which are installed without it: otherwise every process
# that is started compiles their sources again, for seconds.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
# Three workers on two cores: many tests wait for processes, servers and leases.
# tests/conftest.py says what comes first; xdist would put groups of many tests before slow ones.
ALL := --numprocesses 3 --dist loadgroup --no-loadscope-reorder --ignore=tests/studies -m 'not soak and not machines and not image'
# Tests of pure functions, of the configuration and of the architecture: no trial, no database server,
# no cluster and no browser. One file compiles, and is left to `make test`.
FAST := tests/test_architecture.py tests/test_release.py tests/dopt/test_fields.py tests/dopt/test_sphere.py \
	tests/dopt/test_spec.py tests/dopt/test_checks.py tests/dopt/test_control.py tests/dopt/systems tests/analysis/test_statistics.py tests/orchestrate/config \
	--ignore=tests/dopt/systems/test_each.py
.PHONY: help setup run test test-fast test-studies test-lowest test-machines soak image coverage lint format docs \
	grid figures study claims smoke bench bench-check clean

help:  ## show the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 16

setup: $(VENV)/dev  ## create .venv with the tested versions and the developers' tools

run: $(VENV)/run  ## create .venv with what grids and figures need

# Python writes the bytecode of a library when it is first imported; pip would write all of it.
# "dopt" was the name of this package for pip, and is the name of another project.
$(VENV)/run: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip uninstall --yes -qq dopt
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable .
	touch $@

$(VENV)/dev: $(VENV)/run
	$(BIN)/python -m pip install --quiet --constraint constraints.txt pip
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[all]' --group dev
	touch $@

test: setup  ## run the test suite
	$(BIN)/python -c 'from dopt.kernel import warm_up; warm_up(everything=True)'
	$(BIN)/python -m pytest $(ALL)

test-fast: setup  ## run the tests of pure functions and of the configuration
	$(BIN)/python -m pytest --numprocesses 2 --quiet $(FAST)

test-studies: setup  ## check that the tables of the studies follow from stored rows
	$(BIN)/python -m pytest --numprocesses 2 --quiet tests/studies

test-lowest: .venv-lowest/ready  ## run the fast tests with the lowest versions that are supported
	.venv-lowest/bin/python -m pytest --numprocesses 2 --quiet $(FAST)

.venv-lowest/ready: pyproject.toml constraints-lowest.txt
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet --upgrade 'pip>=25.1'
	.venv-lowest/bin/python -m pip install --quiet --no-compile --constraint constraints-lowest.txt --editable '.[all]' --group test
	touch $@

coverage: setup  ## run the test suite and require that 90 % of the lines are run
	$(BIN)/coverage erase
	$(BIN)/python -c 'from dopt.kernel import warm_up; warm_up(everything=True)'
	$(BIN)/coverage run -m pytest $(ALL)
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report

test-machines: setup  ## run grids on hosts that are lost and cut off, as root, in namespaces
	$(BIN)/python -c 'from dopt.kernel import warm_up; warm_up(everything=True)'
	$(BIN)/python -m pytest --numprocesses 3 -m machines tests/machines

soak: setup  ## run thousands of short trials with a fault every few seconds, on both databases
	PYTEST_DEBUG_TEMPROOT=$${TMPDIR:-/tmp} $(BIN)/python -m pytest --numprocesses 3 -m soak tests/soak

image: setup  ## build the image and run its services (root on Debian)
	.ci/image

lint: setup  ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell
	$(BIN)/zizmor --quiet --offline .github
	$(BIN)/hadolint --failure-threshold warning docker/Dockerfile .ci/postgres/Dockerfile
	$(BIN)/check-jsonschema --quiet --builtin-schema vendor.compose-spec docker/compose.yaml docker/compose.hosts.yaml
	$(BIN)/shellcheck docker/*.sh docs/example/*.sh .ci/run .ci/image .ci/packages .ci/start_postgres .ci/postgres/*.sh

format: setup  ## apply the style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: setup  ## build the pages and the API reference into site/, and fail on a broken link
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

grid: run  ## run the paper's grid, or what is left of it
	$(BIN)/python orchestrate/launch.py -m 'env=glob(*)' 'policy=glob(*)' store.url='$(DB)'

figures: grid  ## run the paper's grid and draw its figures
	$(BIN)/python -m analysis figures --db '$(DB)' --out figures

study: run  ## run everything beyond the paper and compare it on one page, report/README.md
	$(BIN)/python orchestrate/launch.py -m experiment=beyond store.url='$(STUDY_DB)'
	$(BIN)/python -m analysis report --db '$(STUDY_DB)' --out report

claims: run  ## run with other seeds what few leave open, and compare it on two pages, report/claims/ and report/claims_control/
	$(BIN)/python orchestrate/launch.py -m experiment=claims store.url='$(CLAIMS_DB)'
	$(BIN)/python -m analysis report --db '$(CLAIMS_DB)' --out report/claims
	$(BIN)/python orchestrate/launch.py -m experiment=claims_control store.url='$(CLAIMS_CONTROL_DB)'
	$(BIN)/python -m analysis report --db '$(CLAIMS_CONTROL_DB)' --out report/claims_control

smoke: run  ## a small grid and its figures, in a database of their own
	$(BIN)/python orchestrate/launch.py -m experiment=smoke store.url='$(SMOKE_DB)'
	$(BIN)/python -m analysis figures --db '$(SMOKE_DB)' --out figures/smoke

bench: run  ## print measured speed beside its targets
	$(BIN)/python -m benchmarks

bench-check: run  ## fail where a step, a trial or the expansion of a grid has become slower
	$(BIN)/python -m benchmarks --quick --only $(CHECKED) --against benchmarks/history.jsonl

clean:  ## remove what the targets made, except results
	rm -rf $(VENV) .venv-lowest figures site build htmlcov .coverage* .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
