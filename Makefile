# make demo   install what is missing, then drive the paper's vehicle on this machine
# make test   install what is missing, then everything that CI runs
# make check  lint, types, import contracts, schemas, unit tests: no GStreamer, no browser
# make javascript  only the checks of the pages' scripts
# make soak   long repetitions of faults that a drive must survive, 100 minutes; SOAK=0.1 make soak is a tenth, KEYS=1 encrypts
# make deadspot UPLINK=FILE.csv  two drives over a recorded uplink: the picture of the README
# make generated  the schemas and types that scripts/schemas makes of classes
# make everywhere  HEAD on Debian 12, 13 and testing, in root directories made by debootstrap; SYSTEMS="trixie forky" selects
# make packages  Debian packages of HEAD for this system, in dist; SYSTEMS="trixie forky" builds and tries them for others
# make setup  install what driving needs; the command is then .venv/bin/tod-runner
# make ros2   ROS 2 in an environment of its own, .venv-ros2; docs/ros.md
# make ros1   ROS 1, which is end-of-life, as Debian's packages
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
ROS2 := .venv-ros2
TEST_READY := $(VENV)/.ready-for-tests
NODE_READY := node_modules/.ready

# Tests start hundreds of processes; without cached bytecode each would compile the project again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test generated timed untimed checks compiled golden units check fast coverage lint javascript setup bench deadspot uplink-given soak everywhere packages ros1 ros2 clean

demo: $(READY)
	$(BIN)/tod-runner demo

# Timing-sensitive tests leave the processors idle half of the time; everything else runs in the background meanwhile.
test: $(TEST_READY)
	$(MAKE) --no-print-directory -j 2 --output-sync=line timed untimed

# Each worker imports all files that it is given.
# WITHOUT="and not browser" leaves out the tests that need a browser.
ALONE = $(shell grep -l mark.alone tests/integration/test_*.py)
timed: $(TEST_READY)
	$(BIN)/pytest $(ALONE) -m "alone and not soak $(WITHOUT)" -n $$(($$(nproc) + 1)) --dist loadgroup --durations=10
	$(BIN)/pytest tests/integration -m "timed and not soak $(WITHOUT)" -n $$(($$(nproc) + 2)) --dist loadfile --no-loadscope-reorder --durations=30

untimed: $(TEST_READY)
	scripts/background $(MAKE) --no-print-directory -j 1 compiled checks

checks: $(TEST_READY)
	$(MAKE) --no-print-directory -j 2 --output-sync=line lint javascript golden units

# Workers of pytest start at the same time, and each would compile all units, and what Numba compiles at the first call.
# What cannot be imported, or fails, does so there.
compiled: $(TEST_READY)
	@$(BIN)/pytest --collect-only -qq -m "not timed and not alone and not soak" > /dev/null || true
	@$(BIN)/pytest -qq tests/test_synthetic.py tests/test_metrics.py -k "seamless or scores_belong" > /dev/null || true

generated: $(READY)
	$(BIN)/python scripts/schemas --write

golden: $(TEST_READY)
	$(BIN)/python tests/golden

# Some wait, hence one worker more than cores.
units: $(TEST_READY)
	$(BIN)/pytest -m "not timed and not alone and not soak $(WITHOUT)" -n $$(($$(nproc) + 1)) --dist loadfile --durations=30

check: $(TEST_READY) $(NODE_READY)
	$(MAKE) --no-print-directory -j 2 --output-sync=line fast lint javascript

fast: $(TEST_READY)
	$(BIN)/pytest tests --ignore=tests/integration -m "not gst and not slow and not soak" -n auto --dist worksteal

# Branch coverage of the decisions and of reading configuration; make test runs far more of the rest.
coverage: $(TEST_READY)
	$(BIN)/pytest -m "not gst and not soak" -n auto --dist loadfile --cov --cov-report=
	$(BIN)/coverage report --include='runner/core/*' --fail-under=95
	$(BIN)/coverage report --include='runner/configuration/*' --fail-under=95
	$(BIN)/coverage report --include=runner/graph.py --fail-under=95

lint: $(TEST_READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --python-version 3.10 runner/ros/node
	$(BIN)/lint-imports --no-logo
	$(BIN)/check-jsonschema --check-metaschema schemas/*.json

# In one process: a process for each file takes two thirds of the time of the tests.
javascript: $(NODE_READY)
	node_modules/.bin/eslint --cache --cache-strategy content --cache-location node_modules/.cache/eslint .
	node_modules/.bin/tsc --project .
	node --test-reporter=spec --input-type=module --eval 'for (const file of process.argv.slice(1)) await import(`./$${file}`);' tests/js/*.test.js

bench: $(TEST_READY)
	$(BIN)/python bench bench.json

# One drive over a recorded uplink, twice, as shown by the operator's page; DEADSPOT=FILE.png names another output.
DEADSPOT ?= docs/images/deadspot.png
deadspot: uplink-given $(TEST_READY)
	$(BIN)/python bench/deadspot.py "$(UPLINK)" "$(DEADSPOT)"

uplink-given:
	@test -f "$(UPLINK)" || { echo 'make deadspot needs UPLINK=FILE.csv: a recorded uplink with the columns t_s (s) and uplink_kbps (kbit/s)' >&2; exit 2; }

soak: $(TEST_READY) $(NODE_READY)
	PYTHONPATH=tests:tests/integration $(BIN)/python tests/soak $(PARTS)

# Installs nothing outside root directories of its own; needs root and the package debootstrap.
everywhere:
	scripts/everywhere $(SYSTEMS)

packages:
	$(if $(SYSTEMS),scripts/try-packages $(SYSTEMS),scripts/build-packages)

setup: $(READY)

# Tests with a version of ROS run only if its target has been made.
ros1:
	scripts/setup-ros1

ros2: $(ROS2)/.ready

$(ROS2)/.ready: scripts/setup-ros2 scripts/packages-ros2.txt
	scripts/setup-ros2 $(ROS2)
	touch $@

$(READY): pyproject.toml scripts/setup scripts/packages.apt
	scripts/setup $(VENV)
	touch $@

$(TEST_READY): pyproject.toml scripts/setup scripts/packages.apt scripts/packages-test.apt
	scripts/setup $(VENV) test
	touch $(READY) $@

# For checks only: the pages are plain modules, and driving does not need Node.js.
$(NODE_READY): package.json package-lock.json | $(TEST_READY)
	npm ci --no-audit --no-fund
	touch $@

clean:
	rm -rf $(VENV) $(ROS2) node_modules build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
