# make demo   install what is missing, then drive the paper's vehicle on this machine
# make test   install what is missing, then everything that CI runs
# make setup  install what is missing; the command is then .venv/bin/tod-runner
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test setup bench clean

demo: $(READY)
	$(BIN)/tod-runner demo

test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/check-jsonschema --check-metaschema schemas/*.json
	$(BIN)/tod-runner validate
	$(BIN)/pytest -m "not alone" -n auto --dist loadfile
	$(BIN)/pytest -m alone

bench: $(READY)
	$(BIN)/python bench/live.py
	$(BIN)/python bench/link.py
	$(BIN)/python bench/page.py
	$(BIN)/python bench/replay.py
	$(BIN)/python bench/pqos_map.py

setup: $(READY)

$(READY): pyproject.toml scripts/setup scripts/packages.apt
	scripts/setup $(VENV)
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
