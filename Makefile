# make help lists the targets. Needs only make and Python 3.11 or newer; everything else goes into .venv.

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= python3.11 python3.12 python3.13 python3.14 python3 python
ARGS ?=
WORKERS ?= 2

.DEFAULT_GOAL := help
.PHONY: help train test test-fast test-long gpu lint bench venv lock clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## ?/\1\t/' | expand -t 12

train: venv  ## train a policy: python -m pace.rl.train $(ARGS)
	$(BIN)/python -m pace.rl.train $(ARGS)

test: venv  ## run the test suite, the fast tests first: pytest $(ARGS)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile $(ARGS)

test-fast: venv  ## leave out the end-to-end runs
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile -m "not slow and not long and not gpu" $(ARGS)

test-long: venv  ## what takes many minutes: wheels, kills, compilations
	$(BIN)/python -m pytest -m long $(ARGS)

gpu: venv  ## what only a GPU can show, as one page: pytest -m gpu -s tests/gpu $(ARGS)
	$(BIN)/python -m pytest -m gpu -s tests/gpu $(ARGS)

lint: venv  ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

bench: venv  ## measure speed and memory: python -m pace.bench $(ARGS)
	$(BIN)/python -m pace.bench $(ARGS)

# The stamp holds what was installed; it is compared by content, since a checkout changes the times of files.
venv:  ## make or renew .venv from requirements.lock
	@set -e; \
	if cat requirements.lock pyproject.toml | cmp -s - $(VENV)/.installed && $(BIN)/python -c "" 2>/dev/null; then exit 0; fi; \
	if ! $(BIN)/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	  for candidate in $(PYTHON); do \
	    if $$candidate -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; \
	    then python=$$candidate; break; fi; \
	  done; \
	  if [ -z "$${python:-}" ]; then \
	    echo "PACE needs Python 3.11 or newer with its venv module, and found none (tried: $(PYTHON))." >&2; \
	    echo "Install one (Debian, Ubuntu: apt install python3 python3-venv), or say where it is: make PYTHON=/path/to/python" >&2; \
	    exit 1; \
	  fi; \
	  echo "== $$($$python --version): making $(VENV)"; \
	  $$python -m venv --clear $(VENV); \
	fi; \
	echo "== installing requirements.lock into $(VENV): a few minutes, once"; \
	$(BIN)/python -m pip install --disable-pip-version-check -r requirements.lock; \
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps -e .; \
	cat requirements.lock pyproject.toml > $(VENV)/.installed; \
	echo "== $(VENV) is ready"

# Resolves pyproject.toml anew in a scratch environment; torch stays at the version pinned below.
lock: TORCH := 2.13.0
lock:  ## renew requirements.lock
	@set -e; scratch=$$(mktemp -d); trap 'rm -rf "$$scratch"' EXIT; \
	python3.11 -m venv $$scratch; \
	$$scratch/bin/pip install --quiet torch==$(TORCH) ".[viewer,export,dev]"; \
	{ grep '^#' requirements.lock; \
	  $$scratch/bin/pip freeze --all --exclude pip --exclude pace-table-tennis | sed 's/+cpu$$//'; } > $$scratch/requirements.lock; \
	mv $$scratch/requirements.lock requirements.lock; \
	wc -l requirements.lock

clean:  ## remove .venv, caches and build outputs; runs/ stays
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +
