# Two commands: `make demo` shows the whole way on a virtual robot, `make test` checks everything.
# Each builds its own environment in .venv on first use; set PYTHON or VENV to use others.
PYTHON ?= python3
VENV   ?= .venv
BIN     = $(VENV)/bin
# Errors only; and what is compiled is what is imported, when it is: a tenth of what these packages hold. pip finds the build of torch
# that a machine has; all else uv unpacks in an eighth of pip's time.
PIP = $(BIN)/pip -qq --disable-pip-version-check --no-input install --root-user-action=ignore --no-compile -c constraints.txt
UV  = $(BIN)/uv -q pip install --python $(BIN)/python -c constraints.txt -C editable_mode=compat
INSTALL = $(PYTHON) -m venv $(VENV) && $(PIP) torch uv && $(UV) -e
unexport PYTHONDONTWRITEBYTECODE
DEMO   ?= demo-robot
# three workers on two cores, what CI has, and any laptop: a seventh of their time tests wait for what is timed; each begins with a
# share of the files, so that few prepare the same
PYTEST_ARGS ?= -n 3 --dist worksteal

.PHONY: demo test lint types contracts pytest docs-check api ecosystem pictures rooms tour clean

demo: $(VENV)/.all
	@$(BIN)/openant demo --robot $(DEMO)

# The checks run beside the first tests: mypy keeps one core busy, and the other would wait for it.
test: $(VENV)/.dev
	$(MAKE) --no-print-directory -j 2 lint types contracts pytest

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Benchmarks are not run in CI: at least what they call has to be there.
types: $(VENV)/.dev
	nice $(BIN)/mypy
	MYPYPATH=benchmarks:tests nice $(BIN)/mypy benchmarks/*.py
	nice $(BIN)/mypy --explicit-package-bases benchmarks/gap_training

contracts: $(VENV)/.dev
	$(BIN)/lint-imports

pytest: $(VENV)/.dev
	$(BIN)/pytest $(PYTEST_ARGS)

# Torch comes first and by name: the constraint names the CPU build's version, which any platform can satisfy.
$(VENV)/.all: pyproject.toml constraints.txt
	@echo "Making an environment in $(VENV), once: a minute or two."
	@$(INSTALL) '.[all]'
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt
	@$(INSTALL) '.[all,dev]'
	@touch $@

# Every command of README and docs/, page by page in one folder, on a virtual robot, and the whole walk by the screens; `make test`
# runs of the pages what is short, and of the walk each step and what goes wrong there.
docs-check: $(VENV)/.dev
	$(BIN)/pytest $(PYTEST_ARGS) --long tests/docs tests/tui/test_walk_screens.py

# A page a module, from docstrings: build/api/index.html. A minute.
api: $(VENV)/.dev
	$(BIN)/python benchmarks/api_pages.py build/api

# docs/ecosystem.md: each peer in a throw-away environment of its own. Minutes a peer; goes on where it was stopped.
ecosystem:
	@$(PYTHON) benchmarks/ecosystem.py

# docs/tour.md, its pictures and its film: the terminal program itself, walked with a virtual robot. Half an hour.
tour: $(VENV)/.all
	$(BIN)/python -m openant_tools.tui.tour docs

# The picture of the packages in docs/architecture.md, from their imports.
rooms: $(VENV)/.dev
	$(BIN)/python benchmarks/rooms.py

# The README's picture is the demo's own.
pictures: demo
	cp $(DEMO)/pictures/overview.png docs/pictures/overview.png

clean:
	rm -rf $(VENV) $(DEMO) build *.egg-info .mypy_cache .pytest_cache .ruff_cache .import_linter_cache
