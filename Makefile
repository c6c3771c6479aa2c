# `make demo` and `make test` set up what they need in .venv, then run. On another Python or torch:
#   make test PYTHON=python3.12 TORCH='torch>=2.1'
PYTHON ?= python3
VENV ?= .venv
TORCH ?= torch==2.13.0
BIN = $(VENV)/bin
SIDE_BY_SIDE = -n auto --maxprocesses 4 --dist worksteal
# The demo needs a part of torch: Python compiles what it imports, once, where pip would compile all of it for a minute.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-slow lint docs dist clean

demo: $(VENV)/.demo
	$(BIN)/legs demo
	@echo "legs is installed in $(VENV): source $(BIN)/activate"

test: $(VENV)/.test
	$(BIN)/python -m pytest -q -m "not slow" $(SIDE_BY_SIDE)

test-slow: $(VENV)/.test $(VENV)/.lint
	$(BIN)/python -m pytest -q -m slow $(SIDE_BY_SIDE)

lint: $(VENV)/.lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo site/index.html

dist: $(VENV)/.lint
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*

$(VENV)/.demo: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check "$(TORCH)" -e ".[report,patch,completion]"
	touch $@

$(VENV)/.test: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(TORCH)" -e ".[test]"
	touch $@ $(VENV)/.demo

$(VENV)/.lint: $(VENV)/.test
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[lint]"
	touch $@

$(VENV)/.docs: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $$($(BIN)/python -c 'import tomllib; \
		print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"])')
	touch $@

clean:
	rm -rf $(VENV) build dist site legs_demo *.egg-info
