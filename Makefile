# make render: a first picture.   make test: the tests.   make verify: the long checks.
# make lint: style and types.     make gallery: all stills.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

.PHONY: render test verify lint gallery clean

render: $(VENV)/.installed
	mkdir -p out
	$(BIN)/nil-mitsuba render scenes/showcase.xml -o out/showcase.exr --png out/showcase.png

test: $(VENV)/.installed-test
	$(BIN)/python -m pytest --durations=10

verify: $(VENV)/.installed-test
	$(BIN)/python -m pytest -m verify

lint: $(VENV)/.installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy

gallery: $(VENV)/.installed-denoise
	$(BIN)/python examples/gallery.py

clean:
	rm -rf $(VENV) out

# The package is installed editable: only a change of its requirements calls for a new install.
# The stamp of each extra says which requirements are in place.
$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/.installed-%: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	touch $@
