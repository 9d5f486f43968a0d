# Everything a fresh machine with Python >= 3.11 and git needs: `make demo`, `make test`, `make test-all`, `make docs`.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
WORLDS = $(VENV)-worlds
GYMNAX = $(VENV)-gymnax
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

test-all: test $(WORLDS)/installed $(GYMNAX)/installed
	$(BIN)/python -m pytest --numprocesses $(WORKERS) -m slow
	$(WORLDS)/bin/python -m pytest --numprocesses $(WORKERS) $(addprefix tests/environments/test_,brax.py jaxmarl.py jumanji.py playground.py) tests/evolution/test_strategies.py tests/runs/test_onnx.py
	$(GYMNAX)/bin/python -m pytest --numprocesses $(WORKERS) tests/environments/test_gymnax.py

# Packages of tasks, and strategies, of others: in environments of their own, since they bring much with them. gymnax wants a
# Gymnasium that is older than ours.
$(WORLDS)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(WORLDS)
	$(WORLDS)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[brax,jaxmarl,jumanji,onnx,playground,strategies]' pytest pytest-xdist
	@touch $@

$(GYMNAX)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(GYMNAX)
	grep -v '^gymnasium==' constraints.txt > $(GYMNAX)/constraints.txt
	$(GYMNAX)/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(GYMNAX)/constraints.txt --editable . 'gymnax>=1' six pytest pytest-xdist
	@touch $@

docs: $(VENV)/installed
	$(BIN)/python -m sphinx -E -W --keep-going -b html docs build/docs
	@echo "build/docs/index.html"

lint: $(VENV)/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: $(VENV)/installed
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) $(WORLDS) $(GYMNAX) .pytest_cache .ruff_cache
