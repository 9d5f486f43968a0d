# Everything a fresh machine with Python >= 3.11 and git needs: `make demo`, `make test`, `make test-all`, `make docs`.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
WORKERS ?= auto

.PHONY: demo test test-all docs lint benchmark clean

$(VENV)/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 11) else f"Credo needs Python 3.11 or newer; $(PYTHON) is {v[0]}.{v[1]}. Try: make PYTHON=python3.12 $(MAKECMDGOALS)")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,mujoco,pettingzoo,sweep]'
	@touch $@

demo: $(VENV)/installed
	@rm -rf runs/demo
	$(BIN)/credo train neuroevolution sequence-classification --preset ours --depth 5 --generations 300 --path runs/demo
	$(BIN)/credo evaluate runs/demo
	$(BIN)/credo report runs/demo --output runs/demo/report.html

test: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/python -m pytest --numprocesses $(WORKERS) -m "not slow"

test-all: test
	$(BIN)/python -m pytest --numprocesses $(WORKERS) -m slow

docs: $(VENV)/installed
	$(BIN)/python -m sphinx -E -W --keep-going -b html docs build/docs
	@echo "build/docs/index.html"

lint: $(VENV)/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: $(VENV)/installed
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache
