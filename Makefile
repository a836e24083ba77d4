# One command each, the same by hand and in CI. Every target sets up .venv by itself when missing.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DB ?= sqlite:///results/results.db
STUDY_DB ?= sqlite:///results/study.db
CLAIMS_DB ?= sqlite:///results/claims.db
SMOKE_DB := sqlite:///results/smoke.db
# The policies of which figure 5 shows what their models are good for: all would hide each other.
CONTROLLED := d_optimal lookahead uniform periodic random random_held

# One thread to a process: the grid runs one worker on each core.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS := 1

.DEFAULT_GOAL := help
.PHONY: help setup test test-machines soak image lint format grid figures study claims smoke bench clean

help:  ## show the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 16

setup: $(VENV)/ready  ## create .venv with the tested versions

$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

test: setup  ## run the test suite
	$(BIN)/python -c 'from dopt.kernel import warm_up; warm_up()'
	$(BIN)/python -m pytest --numprocesses 2 --dist loadgroup -m 'not soak and not machines and not image'

test-machines: setup  ## run grids on hosts that are lost and cut off, as root, in namespaces
	$(BIN)/python -c 'from dopt.kernel import warm_up; warm_up()'
	$(BIN)/python -m pytest -m machines tests/machines

soak: setup  ## run thousands of short trials with a fault every few seconds, on both databases
	$(BIN)/python -m pytest -m soak tests/soak

image: setup  ## build the image and run its services (root on Debian)
	.ci/image

lint: setup  ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/hadolint --failure-threshold warning docker/Dockerfile .ci/postgres/Dockerfile
	$(BIN)/check-jsonschema --quiet --builtin-schema vendor.compose-spec docker/compose.yaml docker/compose.hosts.yaml
	$(BIN)/shellcheck docker/*.sh .ci/run .ci/image .ci/packages .ci/start_postgres .ci/postgres/*.sh

format: setup  ## apply the style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

grid: setup  ## run the paper's grid, or what is left of it
	$(BIN)/python orchestrate/launch.py -m 'env=glob(*)' 'policy=glob(*)' store.url='$(DB)'

figures: grid  ## run the paper's grid and draw its figures
	$(BIN)/python -m analysis figures --db '$(DB)' --out figures

study: setup  ## run everything beyond the paper and compare it on one page, report/README.md
	$(BIN)/python orchestrate/launch.py -m experiment=beyond store.url='$(STUDY_DB)'
	$(BIN)/python -m analysis report --db '$(STUDY_DB)' --out report
	$(BIN)/python -m analysis figures --db '$(STUDY_DB)' --out report/figures --only figure5_control --env pendulum cartpole arm quadrotor --policy $(CONTROLLED)

claims: setup  ## run with 100 seeds what few leave open, and compare it on one page, report/claims/README.md
	$(BIN)/python orchestrate/launch.py -m experiment=claims store.url='$(CLAIMS_DB)'
	$(BIN)/python -m analysis report --db '$(CLAIMS_DB)' --out report/claims
	$(BIN)/python -m analysis figures --db '$(CLAIMS_DB)' --out report/claims/figures --only figure5_control --env pendulum --policy $(CONTROLLED)

smoke: setup  ## a small grid and its figures, in a database of their own
	$(BIN)/python orchestrate/launch.py -m experiment=smoke store.url='$(SMOKE_DB)'
	$(BIN)/python -m analysis figures --db '$(SMOKE_DB)' --out figures/smoke

bench: setup  ## print measured speed beside its targets, and draw cost against width
	$(BIN)/python -m benchmarks
	$(BIN)/python orchestrate/launch.py -m experiment=width executor=local store.url='$(DB)'
	$(BIN)/python -m analysis figures --db '$(DB)' --out figures --only figure4_width
	$(BIN)/python -m analysis figures --db '$(DB)' --out figures --only figure4_width_loss

clean:  ## remove what the targets made, except results
	rm -rf $(VENV) figures .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
