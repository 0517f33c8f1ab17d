# Two commands do it all on a fresh machine with Python >= 3.11 and git: make demo, make test.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV ?= .venv
EXTRAS ?= simulate,dev
BIN := $(VENV)/bin
TESTS ?= tests
comma := ,
stamp = $(VENV)/.ready-$(subst $(comma),-,$(1))

.PHONY: demo test lint bench bench-tables bench-fleet schemas clean

demo: $(call stamp,simulate)
	$(BIN)/rtmap demo -o demo_out --overwrite

test: $(call stamp,$(EXTRAS))
	$(BIN)/python -m pytest -n auto $(TESTS)

lint: $(call stamp,$(EXTRAS))
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(call stamp,$(EXTRAS))
	@for file in benchmarks/*/[a-z]*.py; do grep -q __main__ $$file || continue; \
	  name=$$(echo $${file%.py} | tr / .); \
	  echo "== python -m $$name"; $(BIN)/python -m $$name --help | head -3; done

bench-tables: $(call stamp,simulate)
	$(BIN)/python -m benchmarks.paper.tables

bench-fleet: $(call stamp,simulate)
	$(BIN)/python -m benchmarks.fleet.tables $(if $(PARTS),--parts $(PARTS))

schemas: $(call stamp,$(EXTRAS))
	$(BIN)/python schemas/generate.py

clean:
	rm -rf $(VENV) build dist demo_out bench_tables bench_fleet .pytest_cache .mypy_cache .ruff_cache

$(VENV)/.ready-%: pyproject.toml
	@test -n "$(PYTHON)" || { echo "make: no Python >= 3.11 found; set PYTHON=..." >&2; exit 3; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[$(subst -,$(comma),$*)]'
	@touch $@
