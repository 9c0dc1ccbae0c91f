# make demo   smooth four flights and write their reports
# make test   linters, types, import contract, tests
# make lock   renew requirements.lock with the newest versions
# PYTHON=python3.12 chooses the interpreter the virtual environment is made with.

PYTHON ?= python3
VENV ?= .venv
PYTEST_ARGS ?= -n auto --dist loadfile
ifeq ($(OS),Windows_NT)
BIN := $(VENV)/Scripts
else
BIN := $(VENV)/bin
endif
INSTALLED := $(VENV)/installed-relnav
TESTABLE := $(VENV)/installed-test

.PHONY: demo test check lock clean

demo: $(INSTALLED)
	$(BIN)/relnav demo

test: check
	$(BIN)/python -m pytest $(PYTEST_ARGS)

check: $(TESTABLE)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

$(BIN)/python:
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'relnav needs Python 3.11 or newer, and $(PYTHON) is ' + sys.version.split()[0] + '; try: make PYTHON=python3.12')"
	$(PYTHON) -m venv $(VENV)

# cssrlib brings the recording of the demo; its own dependencies (notebooks, maps) are not needed for that.
$(INSTALLED): pyproject.toml requirements.lock | $(BIN)/python
	@echo "Installing relnav and the packages it needs into $(VENV); this takes a minute or two."
	$(BIN)/python -m pip install --quiet -c requirements.lock -e ".[figures]"
	$(BIN)/python -m pip install --quiet -c requirements.lock --no-deps cssrlib
	@touch $@

$(TESTABLE): $(INSTALLED)
	$(BIN)/python -m pip install --quiet -c requirements.lock -e ".[cluster,figures,test]"
	@touch $@

lock:
	rm -rf $(VENV)-lock
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/python -m pip install --quiet -e ".[cluster,figures,test]"
	$(VENV)-lock/bin/python -m pip install --quiet --no-deps cssrlib
	{ echo "# The tested versions; make uses them as constraints. Renew with: make lock"; \
	  $(VENV)-lock/bin/python -m pip freeze --exclude-editable --all | grep -v '^pip=='; } > requirements.lock
	rm -rf $(VENV)-lock

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .pytest_cache .ruff_cache .import_linter_cache relnav-out
