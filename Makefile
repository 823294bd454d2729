# make install, demo, test, lint, bench: everything goes into .venv; nothing asks anything.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Photographs to measure speed on, separated by spaces; without, the rendered corridor is used.
PHOTOS ?=

.PHONY: install demo test lint bench readme clean

install: $(VENV)/.installed
demo: install
	$(BIN)/line_features demo

test: $(VENV)/.test
	$(BIN)/python -m pytest -n auto

lint: $(VENV)/.lint
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: install
	$(BIN)/python bench/speed.py $(PHOTOS)

readme: install
	$(BIN)/python bench/readme.py

clean:
	rm -rf $(VENV)

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(BIN)/python setup.py package.xml
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	touch $@

$(VENV)/.lint: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --editable '.[lint]'
	touch $@
