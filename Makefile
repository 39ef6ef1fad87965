# make help lists the targets. Needs only make and Python 3.11 or newer; everything else goes into .venv.

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= python3.11 python3.12 python3.13 python3.14 python3 python
ARGS ?=
WORKERS ?= 2

.DEFAULT_GOAL := help
.PHONY: help train test test-fast test-long gpu lint bench docs wheel venv lock clean

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

docs: export NO_MKDOCS_2_WARNING := 1
docs: venv  ## build the documentation as a site in build/site; a warning is an error
	$(BIN)/python -m mkdocs build --strict $(ARGS)

wheel: venv  ## build the wheel into dist/
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

# The stamp holds what was installed; it is compared by content, since a checkout changes the times of files.
# A CPU build of torch comes first, if pip is told where one lies: of files without a hash in their address pip takes none
# as long as there is another.
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
	sed -n 's/^torch==[0-9.]*/&+cpu/; /^torch==/,/[^\\]$$/p' requirements.lock > $(VENV)/torch-cpu.txt; \
	$(BIN)/python -m pip install --quiet --require-hashes --no-deps -r $(VENV)/torch-cpu.txt 2> /dev/null || true; \
	$(BIN)/python -m pip install --disable-pip-version-check --require-hashes --no-deps -r requirements.lock; \
	if $(BIN)/python -c 'import importlib.metadata as m, sys; sys.exit(sys.platform != "linux" or "+" in m.version("torch"))'; then \
	  $(BIN)/python -m pip install --disable-pip-version-check --require-hashes --no-deps -r requirements-cuda.lock; \
	fi; \
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps -e .; \
	cat requirements.lock pyproject.toml > $(VENV)/.installed; \
	echo "== $(VENV) is ready"

# Resolves pyproject.toml anew for all platforms, with the hashes of all files of a release; torch stays at the version
# pinned below. What PyPI's torch for Linux needs besides, for a GPU, is in a lock of its own: a CPU build does without.
# The extra wandb is left out: with it come twenty packages that no run needs.
lock: TORCH := 2.13.0
lock: LOCKED_EXTRAS = $(shell sed -n '/optional-dependencies/,/^$$/s/^\([a-z]*\) = .*/--extra \1/p' pyproject.toml | grep -v wandb)
lock: CPU_WHEELS ?= $(wildcard /opt/wheels/torch-$(TORCH)+cpu-*.whl)
lock:  ## renew requirements.lock and requirements-cuda.lock
	@set -e; scratch=$$(mktemp -d); trap 'rm -rf "$$scratch"' EXIT; \
	python3 -m venv $$scratch; $$scratch/bin/pip install --quiet uv; \
	echo "torch==$(TORCH)" > $$scratch/pins; \
	$$scratch/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
	  $(LOCKED_EXTRAS) --constraint $$scratch/pins $(LOCK_ARGS) pyproject.toml > $$scratch/all; \
	for wheel in $(CPU_WHEELS); do \
	  hash=$$(sha256sum "$$wheel" | cut -d ' ' -f 1); \
	  sed -i "s|^torch==.*|&\n    --hash=sha256:$$hash \\\\|" $$scratch/all; \
	done; \
	for lock in requirements.lock requirements-cuda.lock; do grep '^#' $$lock > $$scratch/$$lock; done; \
	awk -v folder=$$scratch '/^[^ ]/ { cuda = /^(nvidia-|cuda-|triton)/ } \
	  { print >> (folder (cuda ? "/requirements-cuda.lock" : "/requirements.lock")) }' $$scratch/all; \
	mv $$scratch/requirements.lock $$scratch/requirements-cuda.lock .; \
	grep -c '==' requirements.lock requirements-cuda.lock

clean:  ## remove .venv, caches and build outputs; runs/ stays
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +
