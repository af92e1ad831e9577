# Two commands are enough on a fresh machine with Python and make: `make demo`, `make test`.
# Both make the virtual environment .venv first; after that nothing needs the network.
# Kept to what GNU make 3.81 (macOS) understands.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
OUT := out
# tests that need a browser or a cluster
ELSEWHERE := --ignore tests/browser --ignore tests/cluster

# without cached bytecode every command would compile the program again, for a quarter of a second
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test slow-test browser-test extras-test reliability lint types pages docs clean

help:
	@echo 'make demo    smooth a real log (Victoria Park, shipped with gtsam) and a simulated lab into $(OUT)/'
	@echo 'make test    run the tests'
	@echo 'make slow-test  run the tests with more seeds and whole logs'
	@echo 'make browser-test  run the tests of the reports in a browser'
	@echo 'make extras-test  viewers, notebook, a Dask cluster, site, and the wheel in a new environment'
	@echo 'make reliability  the tables of docs/reliability.md, in some two hours, into $(OUT)/reliability'
	@echo 'make lint    check style and formatting'
	@echo 'make types   check types'
	@echo 'make pages   write the pages that are made from the code'
	@echo 'make docs    these, and the documentation site into $(OUT)/docs'
	@echo 'make clean   remove $(VENV), $(OUT) and caches'
	@echo 'PYTHON=...   the Python (3.11 or newer) to make $(VENV) with'

demo: $(INSTALLED)
	@mkdir -p $(OUT)
	$(BIN)/graphslam import isam "$$($(BIN)/python -c \
	  'import gtsam; print(gtsam.findExampleDataFile("victoria_park.txt"))')" \
	  -o $(OUT)/victoria_park.mcap --force
	$(BIN)/graphslam smooth $(OUT)/victoria_park.mcap -o $(OUT)/victoria_park --force
	$(BIN)/graphslam smooth $(OUT)/victoria_park.mcap -o $(OUT)/victoria_park_all_poses --force \
	  --set keyframe.mode=all --set robust.kernel=none
	$(BIN)/python benchmarks/victoria_park.py $(OUT)/victoria_park $(OUT)/victoria_park_all_poses
	$(BIN)/graphslam smooth logs/lab.mcap -o $(OUT)/lab --force --start truth
	$(BIN)/graphslam evaluate $(OUT)/lab
	@echo 'Open these in a browser:'
	@echo '$(CURDIR)/$(OUT)/victoria_park/report.html   a truck among trees, a real log'
	@echo '$(CURDIR)/$(OUT)/lab/report.html   a laser in a cluttered room, simulated, with truth'

test: $(INSTALLED)
	$(BIN)/python -m pytest -n auto --dist loadfile $(ELSEWHERE) -m 'not slow'

# more seeds and whole logs, of which make test has the short ones
slow-test: $(INSTALLED)
	$(BIN)/python -m pytest -n auto $(ELSEWHERE) -m slow

# in a browser; Chromium comes from the system's packages, and without it they fail
browser-test: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,browser]'
	$(BIN)/python -m pytest tests/browser

# a campaign that finds something does not stop the others
reliability: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,fuzz]'
	mkdir -p $(OUT)/reliability
	-$(BIN)/python benchmarks/content_faults.py $(OUT)/reliability > $(OUT)/reliability/content_faults.txt
	-$(BIN)/python benchmarks/healthy_logs.py $(OUT)/reliability > /dev/null
	-$(BIN)/python benchmarks/healthy_logs.py $(OUT)/reliability --real > $(OUT)/reliability/healthy_logs.txt
	-$(BIN)/python benchmarks/mutated_files.py $(OUT)/reliability > $(OUT)/reliability/mutated_files.txt
	-$(BIN)/python benchmarks/kills.py > $(OUT)/reliability/kills.txt
	-$(BIN)/python benchmarks/growth.py > $(OUT)/reliability/growth.txt
	-$(BIN)/python benchmarks/long_run.py > $(OUT)/reliability/long_run.txt
	-$(BIN)/python benchmarks/fuzz.py $(OUT)/reliability/fuzz > $(OUT)/reliability/fuzz.txt

lint: $(INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: $(INSTALLED)
	$(BIN)/mypy

# what make test skips without other programs; here it fails without them
extras-test: $(INSTALLED) docs
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable \
	  '.[dev,cluster,viewer,notebook]' evo mcap-ros2-support 'readme_renderer[md]'
	$(BIN)/python -c 'import distributed, evo, mcap_ros2, nbclient, pandas, readme_renderer, rerun'
	$(BIN)/python -m pytest tests/results/test_viewers.py tests/results/test_evo.py \
	  tests/core/test_notebook_views.py tests/cluster tests/test_docs_code.py
	rm -rf $(OUT)/wheel $(OUT)/cold
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps -w $(OUT)/wheel .
	$(BIN)/python -m venv $(OUT)/cold
	$(OUT)/cold/bin/python -m pip install --quiet --disable-pip-version-check \
	  "$$(ls $(OUT)/wheel/*.whl)[notebook]"
	cd $(OUT) && cp ../docs/tutorial.ipynb . && cold/bin/jupyter execute tutorial.ipynb

pages: $(INSTALLED)
	$(BIN)/python docs/configuration.py
	$(BIN)/python docs/commands.py

docs: pages
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs $(OUT)/docs

clean:
	rm -rf $(VENV) $(OUT) .pytest_cache .mypy_cache .ruff_cache .hypothesis

# Installs anew only when pyproject.toml changed; the package itself is used where it lies.
# python3 may be an old one (macOS), so newer names are tried after it.
$(INSTALLED): pyproject.toml
	@new='import sys; sys.exit(sys.version_info < (3, 11))'; \
	if ! test -x $(BIN)/python; then \
	  for python in "$(PYTHON)" python3.14 python3.13 python3.12 python3.11; do \
	    if "$$python" -c "$$new" 2>/dev/null; then found="$$python"; break; fi; \
	  done; \
	  if test -z "$$found"; then \
	    echo 'graphslam needs Python 3.11 or newer; run make PYTHON=/path/to/python3' >&2; exit 1; \
	  fi; \
	  echo "making $(VENV) with $$found"; \
	  "$$found" -m venv $(VENV) || exit 1; \
	fi; \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@$(BIN)/python -m compileall -q graphslam
	@touch $@
