# make demo   reconstruct a bundled scene, print the statistics, write a page to look at
# make test   the default tests (minutes)
# make test-slow   the sample scenes end to end (more minutes)
# make test-processors   the numeric tests as older processors round, see tests/processors.sh
# make test-consumers   the packages that read our exports, on our exports (downloads 600 MB)
# make lint   format check, linter, type checker; make format repairs what it can
# make reference   write docs/reference.md from the commands' help
# make tables   write the tables of README.md and results/README.md from the result files
# make clean   remove the environment and what was built

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

.PHONY: demo test test-slow test-processors test-consumers lint format reference tables clean

$(STAMP): pyproject.toml constraints.txt
	@echo "== making the environment $(VENV) (downloads torch, a few hundred MB, once)"
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, this is " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[report,evaluate,train,heif,cluster,dev]'
	@touch $@

demo: $(STAMP)
	@echo "== reconstructing sample_scenes/courtyard into demo/"
	$(BIN)/corrsfm run sample_scenes/courtyard/images demo
	@echo "== open demo/report.html in a browser"

test: $(STAMP)
	$(BIN)/python -m pytest -q

test-slow: $(STAMP)
	$(BIN)/python -m pytest -q -m slow

test-processors: $(STAMP)
	sh tests/processors.sh $(BIN)/python

test-consumers: $(STAMP)
	sh tests/consumers.sh $(BIN)/python $(VENV)/consumers

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

reference: $(STAMP)
	$(BIN)/python tools/reference.py

tables: $(STAMP)
	$(BIN)/python tools/tables.py

clean:
	rm -rf $(VENV) demo build dist *.egg-info
