# Python 3.11 to 3.13 and make are all that is needed. Another interpreter: PYTHON=python3.12 make demo
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint configs/constraints.txt
INPUTS := pyproject.toml configs/constraints.txt
PYTEST_WORKERS ?= 2

.DEFAULT_GOAL := help
.PHONY: help demo test check check-slow docs constraints clean

help:
	@echo "make demo         install, then run the main job on surveys/demo"
	@echo "make test         install, then run all tests but the slow ones"
	@echo "make check        lint, format, types, layers, documents"
	@echo "make check-slow   the slow tests"
	@echo "make docs         write what is made from the code: docs/reference/cli.md"
	@echo "make constraints  renew configs/constraints.txt from the newest versions that fit"
	@echo "make clean        remove what the surveys and the tools produced; the environment .venv stays"

demo: $(VENV)/installed
	$(BIN)/changedetect update surveys/demo

test: $(VENV)/installed-test
	$(BIN)/python -m pytest -n $(PYTEST_WORKERS) -m "not slow"
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -n $(PYTEST_WORKERS) -m "not slow" tests/kernels

check: $(VENV)/installed-check
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --strict -p changedetect
	$(BIN)/lint-imports
	$(BIN)/python -m changedetect.cli.reference --check docs/reference/cli.md
	$(BIN)/python -m pytest tests/test_docs.py

check-slow: $(VENV)/installed-test
	$(BIN)/python -m pytest -n $(PYTEST_WORKERS) -m slow

docs: $(VENV)/installed
	$(BIN)/python -m changedetect.cli.reference docs/reference/cli.md

# Each environment holds what the one before it holds; its file says that it is complete.
$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
	  || { echo "Python 3.11 to 3.13 is needed, $(PYTHON) is another. Name one: PYTHON=python3.12 make ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { echo "On Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	@touch $@

$(VENV)/installed: $(VENV)/created $(INPUTS)
	$(PIP_INSTALL) --editable .
	@touch $@

$(VENV)/installed-test: $(VENV)/installed $(INPUTS)
	$(PIP_INSTALL) --editable '.[test]'
	@touch $@

$(VENV)/installed-check: $(VENV)/installed-test $(INPUTS)
	$(PIP_INSTALL) --editable '.[test,check]'
	@touch $@

constraints:
	rm -rf build/constraints
	$(PYTHON) -m venv build/constraints
	build/constraints/bin/python -m pip install --quiet '.[test,check,compare]'
	{ sed -n '/^#/p' configs/constraints.txt; \
	  build/constraints/bin/python -m pip freeze --exclude changedetect --exclude setuptools; } > build/constraints.txt
	mv build/constraints.txt configs/constraints.txt
	rm -rf build/constraints

clean:
	rm -rf surveys/*/state surveys/*/products surveys/*/runs surveys/*/.lock
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find changedetect tests -name __pycache__ -type d -prune -exec rm -rf {} +
