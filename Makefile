.DELETE_ON_ERROR:
.PHONY: help install demo test test-all bench baselines ogbench lowest highest newest audit licences docs dist format lint type linked clean

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
# d3rlpy needs another gymnasium, robomimic a torchvision, OGBench another MuJoCo.
OTHERS := .venv-baselines
ROBOMIMIC := .venv-robomimic
OGBENCH := .venv-ogbench
# Tools that check dependencies, make the site and check releases, apart from them.
TOOLS := .venv-tools
# Tests of each part that meets other packages.
SMOKE := tests/cli/test_command_line.py tests/data/test_minari.py tests/envs/robosuite/test_env.py tests/files/test_model.py \
	tests/files/test_onnx.py
# Some of them, without robosuite, in seconds.
NEWEST := tests/data/test_minari.py tests/files/test_model.py \
	tests/cli/test_command_line.py::test_train_writes_what_enjoy_reads \
	tests/files/test_onnx.py::test_a_file_holds_a_function_for_any_number_of_rows_and_its_settings
# What is checked and formatted besides the package.
SOURCES := sb3_dtfm envs zoo_configs tests studies examples docs

help:
	@echo "make install  pinned environment in $(VENV), for Python 3.10 to 3.13"
	@echo "make demo     record, train and evaluate on robosuite's Lift: 4 minutes on 2 cores"
	@echo "make test     the fast tests"
	@echo "make test-all the slow tests too: kills, a million calls, several processes; half an hour on 2 cores"
	@echo "make bench    DT and DTFM beside d3rlpy, training and acting: 15 minutes on 2 idle cores"
	@echo "make baselines    DT and DTFM beside d3rlpy's and robomimic's algorithms on studies/baselines.yml: days on one core;"
	@echo "              ARGUMENTS=\"--data can-10 --seeds 0\" runs some of it, ARGUMENTS=--help says what there is"
	@echo "make ogbench  environment of studies/ogbench in $(OGBENCH), with this package and OGBench"
	@echo "make lowest   tests of each part with the lowest versions that pyproject.toml allows; make highest: the highest"
	@echo "make newest   tests of the package without robosuite on the newest Python here, with constraints-numpy2.txt: a minute"
	@echo "make audit    ask for known vulnerabilities of the pinned versions; needs the network"
	@echo "make licences write docs/licences.csv anew"
	@echo "make docs     the report of results/suite.csv as docs/report.md, and the site, into build/site"
	@echo "make dist     source distribution and wheel, into dist/; for PyPI with ADDRESS=https://github.com/OWNER/sb3_dtfm"
	@echo "make format   rewrite the sources in the project's format"
	@echo "make lint     check format, style and the sizes of docs and results"
	@echo "make type     check types"
	@echo "make clean    remove $(VENV), builds and caches"

install: $(STAMP)

# A candidate has to run: an installed name may be a shim without a Python behind it. Plain python3 comes first, as the
# interpreter that this machine is set up for.
$(STAMP): pyproject.toml constraints.txt
	@set -e; python=; \
	for candidate in $(PYTHON) python3 python3.13 python3.12 python3.11 python3.10 python; do \
		if $$candidate -c 'import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' \
				>/dev/null 2>&1; then \
			python=$$candidate; break; \
		fi; \
	done; \
	if [ -z "$$python" ]; then \
		echo "No Python 3.10 to 3.13 with the venv module was found; 'make install PYTHON=/path/to/python' names one." >&2; \
		exit 1; \
	fi; \
	echo "Installing into $(VENV) with $$($$python --version)"; \
	rm -rf $(VENV); \
	$$python -m venv $(VENV)
	@$(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt -e ".[all,dev]" || { \
		echo "The installation failed. robosuite needs evdev, which pip builds: that takes a C compiler, Python's headers" >&2; \
		echo "(python3-dev) and the kernel's (linux-libc-dev). docs/howto/install.md says how to install without it." >&2; \
		exit 1; \
	}
	@$(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt --no-deps robosuite  # left out on 3.13
	@touch $@

demo: install
	$(BIN)/sb3-dtfm demo

test: install
	$(BIN)/python -m pytest -n 2 --dist loadfile --durations=10

test-all: install
	$(BIN)/python -m pytest -n 2 --maxschedchunk 1 --durations=20 -m "slow or not slow"

bench: install $(OTHERS)/installed
	$(BIN)/python studies/compare.py --baseline-python $(OTHERS)/bin/python

$(OTHERS)/installed: constraints.txt
	rm -rf $(OTHERS)
	$(BIN)/python -m venv $(OTHERS)
	$(OTHERS)/bin/pip install --disable-pip-version-check --quiet $$(grep '^torch==' constraints.txt) d3rlpy==2.8.1
	@touch $@

baselines: install $(OTHERS)/installed $(ROBOMIMIC)/installed
	PYTHONPATH=studies $(BIN)/python -m baselines $(ARGUMENTS)

# Learning from vectors in robomimic needs no more than this; with its own requirements pip would take another torch.
$(ROBOMIMIC)/installed: constraints.txt
	rm -rf $(ROBOMIMIC)
	$(BIN)/python -m venv $(ROBOMIMIC)
	$(ROBOMIMIC)/bin/pip install --disable-pip-version-check --quiet $$(grep '^torch==' constraints.txt) numpy h5py matplotlib \
		pillow six termcolor tqdm
	$(ROBOMIMIC)/bin/pip install --disable-pip-version-check --quiet --no-deps robomimic==0.3.0 torchvision==0.28.0
	@touch $@

ogbench: install $(OGBENCH)/installed

# OGBench refuses the pinned MuJoCo 3.9.0.
$(OGBENCH)/installed: constraints.txt
	rm -rf $(OGBENCH)
	$(BIN)/python -m venv $(OGBENCH)
	grep -v '^mujoco==' constraints.txt > $(OGBENCH)/constraints.txt
	$(OGBENCH)/bin/pip install --disable-pip-version-check --quiet -c $(OGBENCH)/constraints.txt -e ".[zoo]" \
		ogbench==1.2.2 mujoco==3.8.1 dm_control==1.0.41
	@touch $@

lowest: RESOLUTION := lowest-direct
highest: RESOLUTION := highest
lowest highest: install $(TOOLS)/installed
	rm -rf .venv-$@
	$(BIN)/python -m venv .venv-$@
	$(TOOLS)/bin/uv pip install --python .venv-$@/bin/python --resolution $(RESOLUTION) -e ".[all,dev]"
	.venv-$@/bin/python -m pytest -n 2 $(SMOKE)

# pyenv's shims find all of its Pythons if all are chosen.
newest: $(TOOLS)/installed
	@set -e; export PYENV_VERSION=$$(pyenv versions --bare 2>/dev/null | paste -sd:); \
	tested=$$($(BIN)/python -c 'import sys; print(sys.version_info[:2])'); \
	for python in python3.14 python3.13 python3.12 ""; do \
		$$python -c "import sys; sys.exit(sys.version_info[:2] <= $$tested)" >/dev/null 2>&1 && break; \
	done; \
	if [ -z "$$python" ]; then echo "make $@: skipped, no Python newer than that of $(VENV) is here"; exit; fi; \
	echo "Installing into .venv-$@ with $$($$python --version)"; \
	rm -rf .venv-$@; \
	$(TOOLS)/bin/uv venv --quiet --python $$python .venv-$@; \
	$(TOOLS)/bin/uv pip install --quiet --python .venv-$@ -c constraints-numpy2.txt -e ".[export,minari,mujoco,zoo]" pytest; \
	.venv-$@/bin/python -m pytest $(NEWEST)

# Strict: a package that the service does not know is an error, not a clean one.
audit: install $(TOOLS)/installed
	$(TOOLS)/bin/pip-audit --strict --disable-pip --no-deps -r constraints.txt

# The pinned packages alone: CUDA's, which PyTorch brings on some platforms, are left to docs/licences.md.
licences: install $(TOOLS)/installed
	$(TOOLS)/bin/pip-licenses --python $(BIN)/python --from=mixed --with-system --format=csv \
		--packages $$(sed '/^#/d; s/==.*//' constraints.txt | sort -u) > docs/licences.csv

# Strict: a link or an anchor that leads nowhere is an error.
docs: $(TOOLS)/installed linked
	$(BIN)/sb3-dtfm report results/suite.csv -o build/report
	cp build/report/report.md docs/
	NO_MKDOCS_2_WARNING=1 $(TOOLS)/bin/mkdocs build --strict

# The wheel is built from the source distribution, so that both are known to be whole.
# PyPI needs the repository's address: make dist ADDRESS=https://github.com/OWNER/sb3_dtfm
dist: $(TOOLS)/installed
	rm -rf dist build/lib build/release
	$(if $(ADDRESS),$(BIN)/python docs/addresses.py $(ADDRESS) build/release)
	$(TOOLS)/bin/python -m build --outdir dist $(if $(ADDRESS),build/release,.)
	$(TOOLS)/bin/twine check --strict dist/*

$(TOOLS)/installed: Makefile | install
	rm -rf $(TOOLS)
	$(BIN)/python -m venv $(TOOLS)
	$(TOOLS)/bin/pip install --disable-pip-version-check --quiet pip-audit==2.10.1 pip-licenses==5.5.5 uv==0.13.9 \
		mkdocs-material==9.7.7 mkdocstrings==1.0.6 mkdocstrings-python==2.0.9 pymdown-extensions==11.0.2 \
		latex2mathml==3.81.1 build==1.6.1 ruff==$$(sed -n 's/^ruff==//p' constraints.txt) twine==7.0.0
	@touch $@

format: install
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

lint: install
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/python docs/limits.py

type: install linked
	cd build/linked && ../../$(BIN)/mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache

# Tools that read folders get the package put together by links, as an installation would have it.
linked:
	@rm -rf build/linked && mkdir -p build/linked/sb3_dtfm
	@ln -s $(CURDIR)/sb3_dtfm/* build/linked/sb3_dtfm/
	@ln -s $(CURDIR)/envs $(CURDIR)/zoo_configs build/linked/sb3_dtfm/

clean:
	rm -rf $(VENV) $(OTHERS) $(ROBOMIMIC) $(OGBENCH) $(TOOLS) .venv-lowest .venv-highest .venv-newest build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache
