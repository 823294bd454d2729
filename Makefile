# make install, demo, test, test-all, coverage, deliberate-faults, fuzz, lint, colcon, bench, bench-node, bench-bag, soak,
# soak-bag, audit: everything goes into .venv, or .venv-3.10 and so on for test-all; nothing asks anything.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Photographs to measure speed on, separated by spaces; without, the rendered corridor is used.
PHOTOS ?=
# Other scenes to measure accuracy on, and the folder of York Urban (images/*.jpg, gt_csv/*.csv), if it is there.
SEED ?= 0
YORK ?=
# The ROS 2 packages of PyPI are for these machines only; others have ROS 2 from their distribution.
EXTRA := $(if $(filter x86_64,$(shell uname -m)),ros)
# Options of the fuzzing campaign: --inputs 100000 --seed 2 --doors image.
FUZZ ?=
# opencv-contrib, which has EdgeDrawing, cannot be where OpenCV is.
PEERS := .venv-peers
# What the package needs, without ROS 2, which comes from a distribution that says itself what is wrong with it.
AUDIT := .venv-audit

# Docstring codes that ament_pep257 leaves out: its own convention forbids the summary on the first line, so ours is what
# remains of all its codes without these.
#   D105 D107       what __init__ and the like do is said by the class
#   D203 D213       the other of two styles each; ours are D211 and D212
#   D401            'The angle of ...' says more than 'Return the angle of ...'
#   D406 D407 D413  sections of numpy's style; ours are Google's
#   D417            arguments that belong together are described together
PEP257_IGNORE := D105 D107 D203 D213 D401 D406 D407 D413 D417

# Tests of the modules that have kernels.
KERNEL_TESTS = $(patsubst line_feature_node/core/%.py,test/test_%.py,$(shell \
	grep -lE '^@(kernel|inlined)$$' line_feature_node/core/*.py))

.PHONY: install demo test test-all coverage deliberate-faults fuzz lint colcon bench bench-node bench-bag soak soak-bag
.PHONY: audit docs clean

install: $(VENV)/.installed
demo: install
	$(BIN)/line_features demo

test: $(VENV)/.test
	$(BIN)/python -m pytest -n auto

# The tests under coverage, and its table. What the compiler makes of the kernels cannot be seen, so their tests run once
# more as plain Python, but for those that take too long, or round otherwise.
coverage: $(VENV)/.test
	rm -rf build/coverage
	mkdir -p build/coverage
	$(BIN)/python -m coverage run -m pytest -n auto
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m coverage run -m pytest -n auto -m 'not compiled' -W ignore::RuntimeWarning \
		$(KERNEL_TESTS)
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage report

# Deliberate faults in the core, and the test that finds each: hours. The table is in docs/reliability.md.
deliberate-faults: $(VENV)/.test
	$(BIN)/python bench/deliberate_faults.py

# The tests on every Python from 3.10 up that is found.
test-all:
	.ci/test-all

# Inputs with something wrong through every door, a million unless FUZZ says otherwise, and then those of the extractor
# through kernels that check every index; docs/reliability.md says what was found.
fuzz: $(VENV)/.test
	$(BIN)/python test/fuzz/campaign.py $(FUZZ)
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=build/fuzz-cache $(BIN)/python test/fuzz/campaign.py $(FUZZ) --doors extractor \
		--results build/fuzz-bounds

lint: $(VENV)/.lint
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/ament_flake8 --config setup.cfg setup.py line_feature_node bags bench docs test
	$(BIN)/ament_pep257 --ignore $(PEP257_IGNORE) -- setup.py line_feature_node

# Build, test and check the package as a colcon workspace has it; .ci/colcon says what is checked.
colcon: $(VENV)/.colcon
	.ci/colcon $(BIN)

# Accuracy and speed beside OpenCV's detectors, as tables, and curves in bench/results.
bench: $(PEERS)/.installed
	$(PEERS)/bin/python bench/accuracy.py --seed $(SEED) $(if $(YORK),--york "$(YORK)") --results bench/results
	$(PEERS)/bin/python bench/angles.py --seed $(SEED)
	$(PEERS)/bin/python bench/speed.py $(PHOTOS) --results bench/results
	$(PEERS)/bin/python bench/cold_start.py

# Latency, loss and load of the node beside those of an empty one, and five minutes of it as a curve.
bench-node: $(PEERS)/.installed
	$(PEERS)/bin/python bench/node.py --soak 5 --results bench/results

# Frames a second of the offline run over recordings beside the bare extractor, and its memory.
bench-bag: install
	$(BIN)/python bench/bag.py --results bench/results

# The node for half an hour among others that come, go and break, and twenty nodes on one machine; docs/reliability.md.
soak: $(PEERS)/.installed $(VENV)/.test
	LINE_FEATURE_TEST_NODES=20 $(BIN)/python -m pytest test/test_faults.py
	$(PEERS)/bin/python bench/soak.py --results bench/results

# Runs over recordings that are killed or lack something, and resumed: half an hour. Figures are in docs/reliability.md.
soak-bag: install
	$(BIN)/python bench/kills.py

# Versions that are known to be weak. It fails where the package index has no list of these (--strict): finding nothing
# there means nothing.
audit: $(AUDIT)/.installed
	$(AUDIT)/bin/python -m pip freeze --exclude line_feature_node >$(AUDIT)/versions.txt
	$(AUDIT)/bin/pip-audit --strict --no-deps --disable-pip --requirement $(AUDIT)/versions.txt

# The tables in the README, the files of config/, and the pictures in docs/.
docs: install
	$(BIN)/python docs/generate.py

clean:
	rm -rf $(VENV) $(PEERS) $(AUDIT) .venv-3.* build/colcon build/coverage

# Where Debian's python3-venv is missing, a folder without pip is left behind: it must not pass for an environment.
$(BIN)/python:
	$(PYTHON) -m venv $(VENV) && $@ -m pip --version >/dev/null || { rm -rf $(VENV); exit 1; }

$(VENV)/.installed: $(BIN)/python setup.py package.xml
	$(BIN)/python -m pip install --quiet --editable '.[$(EXTRA)]'
	touch $@

$(PEERS)/.installed: bench/requirements.txt setup.py package.xml
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --requirement bench/requirements.txt
	$(PEERS)/bin/python -m pip install --quiet --no-deps --editable .
	touch $@

$(AUDIT)/.installed: setup.py package.xml
	$(PYTHON) -m venv $(AUDIT)
	$(AUDIT)/bin/python -m pip install --quiet '.[fleet]' 'pip-audit>=2.7'
	touch $@

$(VENV)/.test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	touch $@

$(VENV)/.lint: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --editable '.[lint]'
	touch $@

$(VENV)/.colcon: $(VENV)/.test
	$(BIN)/python -m pip install --quiet --editable '.[colcon]'
	touch $@
