PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test check bench soak clean

$(VENV)/.ready: requirements.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.txt
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

demo: $(VENV)/.ready
	$(BIN)/compensator demo --out demo-out

# Or every process of a test run would compile the sources anew.
test check: export PYTHONDONTWRITEBYTECODE =

test: $(VENV)/.ready
	$(BIN)/python -m compileall -q -j 0 compensator drivers sim_hardware tests
	$(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

check: $(VENV)/.ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m compileall -q -j 0 compensator drivers sim_hardware tests
	$(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

soak: $(VENV)/.ready
	$(BIN)/python -m tests.soak

bench: $(VENV)/.ready
	$(BIN)/python -m tests.bench

clean:
	rm -rf $(VENV) demo-out build dist *.egg-info
