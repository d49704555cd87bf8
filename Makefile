# make train: set up everything and train PCIL on a real task. make test: set up everything and run the tests.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.ready
EXTRAS := --extra report --extra sweep --extra onnx --extra film --extra mujoco --extra lerobot --extra wandb --extra mlflow

# make mutants FILES="losses noise" N=200: shows which changes of the source no test notices (docs/mutants.md)
# make fuzz N=2000, make kills N=100: test randomly changed inputs, and runs that are killed and damaged (docs/reliability.md)
# make race: PCIL and other libraries, each on one core (experiments/race.py); TASKS="walker_walk" MINUTES=10 for less
# make archive: the results of this commit for a release, in dist/
.PHONY: setup train test test-slow mutants fuzz kills check bench race archive docs format clean

setup: $(STAMP)

$(STAMP): pyproject.toml uv.lock
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	VIRTUAL_ENV=$(CURDIR)/.venv $(BIN)/uv sync --frozen $(EXTRAS) --inexact --quiet
	touch $(STAMP)

train: $(STAMP)
	$(BIN)/pcil train walker_walk --preset default --seed 1 --frames 80000 --evaluate-every 10000 --until 0.95 --out runs/quickstart

test: $(STAMP)
	$(BIN)/python -m pytest

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow

mutants: $(STAMP)
	$(BIN)/python tests/mutants.py $(FILES) $(if $(N),--number $(N))

fuzz: $(STAMP)
	$(BIN)/python tests/fuzz.py $(KINDS) $(if $(N),--number $(N)) $(if $(SEED),--seed $(SEED))

kills: $(STAMP)
	$(BIN)/python tests/kills.py $(METHODS) $(if $(N),--number $(N)) $(if $(SEED),--seed $(SEED))

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

bench: $(STAMP)
	$(BIN)/pcil bench

.race/.ready: experiments/peers/requirements.txt
	$(PYTHON) -m venv .race
	.race/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	touch $@

race: $(STAMP) .race/.ready
	$(BIN)/python experiments/race.py $(if $(TASKS),--tasks $(TASKS)) $(if $(MINUTES),--minutes $(MINUTES))
	$(BIN)/python experiments/race.py --costs

archive: $(STAMP)
	$(BIN)/python experiments/archive.py

docs: $(STAMP)
	VIRTUAL_ENV=$(CURDIR)/.venv $(BIN)/uv sync --frozen --group docs $(EXTRAS) --inexact --quiet
	$(BIN)/mkdocs build

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv .race .pytest_cache .ruff_cache .hypothesis site
