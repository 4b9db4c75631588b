# Two commands do all the set-up: `make demo` runs the main job, `make test` the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
CAPTURES ?=
DEMO ?= demo

.PHONY: demo test thorough check bench dist clean

demo: $(READY)
	$(BIN)/evnlos demo --out $(DEMO) $(if $(strip $(CAPTURES)),--captures $(CAPTURES))

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal -q

# With the tests that take long and repeat at another instant or format what a quicker one tests.
thorough: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal -q --thorough

check: $(READY)
	$(BIN)/ruff format --check src tests benchmarks examples tools
	$(BIN)/ruff check src tests benchmarks examples tools
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache
	$(BIN)/python -m pytest -q tests/test_architecture.py

bench: $(READY)
	for question in benchmarks/*.py; do $(BIN)/python $$question || exit 1; done

# Two wheels, the package below 10 MB and its pretrained weights, with what is not Python in them.
dist: $(READY)
	rm -rf dist build packages/*/build
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist . ./packages/evnlos-weights
	$(BIN)/python -c "import glob, os, zipfile; names = set(zipfile.ZipFile(glob.glob('dist/evnlos-*.whl')[0]).namelist()); \
	  lost = [n for n in ('evnlos/py.typed', 'evnlos/__init__.pyi', 'evnlos/live/page.html', 'evnlos/app/page.css', 'evnlos/app/page.js', \
	  'evnlos/app/opening.js', \
	  'evnlos/report/style.css', 'evnlos/analysis/classifier.safetensors') if n not in names]; assert not lost, lost; \
	  size = os.path.getsize(glob.glob('dist/evnlos-*.whl')[0]); assert size < 10e6, f'the wheel has {size / 1e6:.1f} MB'; \
	  names = set(zipfile.ZipFile(glob.glob('dist/evnlos_weights-*.whl')[0]).namelist()); \
	  lost = [n for n in ('SHA256SUMS', 'near-frame.safetensors', 'near.yaml') if f'evnlos_weights/{n}' not in names]; assert not lost, lost"
	ls -l dist

clean:
	rm -rf $(DEMO) build dist packages/*/build src/*.egg-info packages/*/src/*.egg-info .pytest_cache .ruff_cache .hypothesis
	find src tests benchmarks examples tools -name __pycache__ -prune -exec rm -rf {} +

# PyTorch first: its CPU build where the package index has one, else whatever build the index gives.
$(READY): pyproject.toml packages/evnlos-weights/pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "torch==2.13.0+cpu" \
	  || $(BIN)/python -m pip install --quiet --disable-pip-version-check "torch==2.13.0"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[all,dev]" -e packages/evnlos-weights
	touch $@
