# Two commands do all the set-up: `make demo` runs the main job, `make test` the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# One folder of captures, or a pattern of names: it may hold spaces.
CAPTURES ?=
DEMO ?= demo
OPTIONS ?=

.PHONY: demo test thorough check site declared bench dist clean

demo: $(READY)
	$(BIN)/evnlos demo --out "$(DEMO)" $(if $(strip $(CAPTURES)),--captures "$(CAPTURES)")

# OPTIONS=--coverage: also how many of the package's statements ran; kernels and started programs are not counted.
test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal -q $(OPTIONS)

# With the tests that take long and repeat at another instant or format what a quicker one tests.
thorough: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal -q --thorough

check: $(READY)
	$(BIN)/ruff format --check src tests benchmarks examples tools
	$(BIN)/ruff check src tests benchmarks examples tools
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache
	$(BIN)/python -m pytest -q tests/test_architecture.py

# The documentation as a site in build/site; a warning or a dead link is an error.
site: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

bench: $(READY)
	for question in benchmarks/*.py; do $(BIN)/python "$$question" || exit 1; done

# Sdist and wheel of the package, the wheel below 10 MB and without weights, and the wheel of the weights.
dist: $(READY)
	$(BIN)/python tools/distributions.py --out dist

# The wheels of package and weights where nothing but declared dependencies is: no extra, nothing of development.
declared: $(READY)
	$(BIN)/python tools/distributions.py --out build/declared/dist --environment build/declared/venv
	build/declared/venv/bin/python -I tests/declared.py

clean:
	rm -rf "$(DEMO)" build dist packages/*/build src/*.egg-info packages/*/src/*.egg-info .pytest_cache .ruff_cache .hypothesis
	find src tests benchmarks examples tools -name __pycache__ -prune -exec rm -rf {} +

# PyTorch first: its CPU build where the package index has one, else whatever build the index gives.
$(READY): pyproject.toml packages/evnlos-weights/pyproject.toml constraints.txt
	@echo "setting up .venv, some minutes"
	test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "torch==2.13.0+cpu" \
	  || $(BIN)/python -m pip install --quiet --disable-pip-version-check "torch==2.13.0"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[all,dev,docs]" -e packages/evnlos-weights
	touch $@
