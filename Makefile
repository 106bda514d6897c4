# make demo   install what is missing, then drive the paper's vehicle on this machine
# make test   install what is missing, then everything that CI runs
# make check  lint, types, import contracts, schemas, unit tests: no GStreamer, no browser
# make javascript  only the checks of the pages' scripts
# make soak   long repeats of what a drive must survive, 45 minutes; SOAK=0.1 make soak is a tenth of it
# make setup  install what is missing; the command is then .venv/bin/tod-runner
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
NODE_READY := node_modules/.ready

.PHONY: demo test timed untimed golden units check lint javascript setup bench soak clean

demo: $(READY)
	$(BIN)/tod-runner demo

# Tests that live by the clock leave the processors idle most of the time; all else runs beside them at the lowest
# priority, which they hardly notice.
test: $(READY) $(NODE_READY)
	$(MAKE) --no-print-directory -j 2 --output-sync=line timed untimed

timed: $(READY)
	$(BIN)/pytest -m timed -n 3 --dist loadfile --durations=30
	$(BIN)/pytest -m alone --durations=10

untimed: $(READY) $(NODE_READY)
	nice -n 19 $(MAKE) --no-print-directory -j 1 lint javascript golden units

golden: $(READY)
	$(BIN)/tod-runner validate all=true
	$(BIN)/python tests/golden

units: $(READY)
	$(BIN)/pytest -m "not timed and not alone" -n auto --dist loadfile --durations=30

check: lint javascript
	$(BIN)/pytest -m "not gst" -n auto --dist loadfile

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/check-jsonschema --check-metaschema schemas/*.json

javascript: $(NODE_READY)
	node_modules/.bin/eslint .
	node_modules/.bin/tsc --project .
	node --test --test-reporter=spec tests/js/*.test.js

bench: $(READY)
	$(BIN)/python bench/live.py
	$(BIN)/python bench/link.py
	$(BIN)/python bench/page.py
	$(BIN)/python bench/replay.py
	$(BIN)/python bench/validate.py
	$(BIN)/python bench/pqos_map.py

soak: $(READY)
	PYTHONPATH=tests/integration $(BIN)/python tests/soak $(PARTS)

setup: $(READY)

$(READY): pyproject.toml scripts/setup scripts/packages.apt
	scripts/setup $(VENV)
	touch $@

# Checks only: the pages are plain modules, and nothing that drives needs Node.js.
$(NODE_READY): package.json package-lock.json | $(READY)
	npm ci --no-audit --no-fund
	touch $@

clean:
	rm -rf $(VENV) node_modules build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
