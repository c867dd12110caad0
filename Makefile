# make demo   install what the lock says into .venv, solve a real route and show the map
# make bench  times and ratios, measured on this machine
# make test   the same, with the tools of development: lint, types, layers, tests
PYTHON ?= python3
BIN := .venv/bin
export PIP_CONSTRAINT := $(CURDIR)/requirements.lock
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test lint bench lock clean

demo: .venv/base
	$(BIN)/python examples/demo.py out

test: lint
	$(BIN)/pytest -n auto

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: .venv/base
	$(BIN)/python benchmarks/circuits.py
	$(BIN)/python benchmarks/images.py

lock: .venv/dev
	$(BIN)/python -m uv pip compile --upgrade --universal --no-header --no-annotate --extra dev --python-version 3.11 -o requirements.lock pyproject.toml

.venv/base: pyproject.toml requirements.lock
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -e .
	touch $@

.venv/dev: pyproject.toml requirements.lock
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -e '.[dev]'
	touch $@ .venv/base

clean:
	rm -rf .venv out
