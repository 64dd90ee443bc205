# polypod: everything from a bare machine with Rust, Python >= 3.10, a C compiler and the package registries.
# `make help` lists the targets. Stamps in .venv keep what is done from being done again.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LOCK := uv.lock
LEARNERS := target/learners
DOCS := target/docs

# The machine's own index, where pip is told of one and uv is not, and its own certificates.
ifndef UV_DEFAULT_INDEX
PIP_INDEX := $(or $(PIP_INDEX_URL),$(shell $(PYTHON) -m pip config get global.index-url 2>/dev/null))
ifneq ($(PIP_INDEX),)
export UV_DEFAULT_INDEX := $(PIP_INDEX)
endif
endif
# uv, maturin and cargo must agree on where things go.
unexport CARGO_TARGET_DIR CARGO_BUILD_TARGET_DIR CONDA_PREFIX
export VIRTUAL_ENV := $(CURDIR)/$(VENV)

CRATES := $(filter-out crates/sim,$(wildcard crates/*))
LIBRARY_SOURCES := Cargo.toml Cargo.lock $(shell find src systems $(CRATES) configs assets/robots workspace-hack -type f 2>/dev/null)
PROGRAM_SOURCES := $(LIBRARY_SOURCES) $(shell find crates/sim -type f 2>/dev/null)

# `make demo WHEEL=dist/....whl` runs from an installed wheel, in a new environment outside the checkout.
WHEEL ?=
# Where cargo-nextest is, which runs the tests of Rust if it is installed; `cargo test` runs the same ones.
NEXTEST := $(shell command -v cargo-nextest 2>/dev/null)

# Arguments that are passed on: make train ARGS="--robots spot --max-iterations 50"
ARGS ?=
# `make test ONLY=python` runs a part: rust, python, learners (other learners and Ray), fuzz or instructions (of a control
# step). `make test TIER=extended` runs all of them, with larger sizes; instructions where valgrind is installed.
TIER ?=
ONLY ?= rust python $(if $(filter extended,$(TIER)),learners fuzz $(if $(shell command -v valgrind),instructions))
# `make lint FIX=1` formats all code first.
FIX ?=

.PHONY: help build train demo test bench accuracy lint docs wheel lock
.PHONY: .test-rust .test-python .test-learners .test-fuzz .test-instructions .format .wheel-venv .compile

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' Makefile

build: $(VENV)/.extension target/release/polypod-sim ## Build the Python package (into .venv) and target/release/polypod-sim

train: $(VENV)/.extension ## Train one policy over all robots (ARGS="..." is passed on), then evaluate it
	$(BIN)/polypod train --train-config quick $(ARGS)

# Installs the wheel $(1) with what training and playing need into a new environment, $(2): versions and hashes of the
# lock, and the base's torch where that is used.
define install_wheel
$(PYTHON) -m venv $(if $(wildcard $(VENV)/.base-torch),--system-site-packages) "$(2)"
@echo torch > $(VENV)/torch.txt
$(BIN)/uv pip install --python "$(2)/bin/python" --constraint $(VENV)/requirements.txt --verify-hashes \
	$(if $(wildcard $(VENV)/.base-torch),--excludes $(VENV)/torch.txt) "$$(realpath "$(1)")[train,play]"
endef

# Three commands of an installed polypod, $(1).
define play_shipped
$(1) eval --checkpoint flat --num-envs 128
$(1) play --checkpoint flat --headless --seconds 20 --command 0.5 0 0
$(1) play --checkpoint flat --command 0.7 0 0 --warm-up 1.5 --seconds 2.4 --fps 12 --size 720 300 --video $(abspath logs/demo/eight_robots.gif)
endef

ifeq ($(WHEEL),)
demo: $(VENV)/.extension ## Play the bundled policy: evaluate it on all eight robots and film them, without a display
	$(call play_shipped,$(BIN)/polypod)
else
# A new environment in a separate folder: nothing of the checkout is in reach.
demo: $(VENV)/.requirements
	$(eval folder := $(shell mktemp -d))
	$(call install_wheel,$(WHEEL),$(folder)/venv)
	$(call play_shipped,cd $(folder) && venv/bin/polypod)
	rm -rf "$(folder)"
endif

ifneq ($(TIER),)
test: export POLYPOD_TEST_TIER := $(TIER)
endif
test: $(ONLY:%=.test-%) ## Run the tests of Rust and of Python (TIER=extended: all, larger; ONLY=python: a part)

.test-rust:
ifneq ($(NEXTEST),)
	cargo nextest run --release --locked --workspace --exclude polypod-python
	cargo test --release --locked --doc --package polypod --package polypod-lanes
else
	cargo test --release --locked --workspace --exclude polypod-python
endif
	cargo run --release --locked --target-dir target/loom --manifest-path tests/loom/Cargo.toml

# In an environment of its own: these packages pin others, and Ray's tests take minutes.
.test-learners: $(VENV)/.extension $(LEARNERS)/.installed
	PYTHONPATH=$(CURDIR)/python $(LEARNERS)/bin/python -m pytest -n 0 $(addprefix tests/python/,train/test_learners.py deploy/test_policies.py train/test_ray.py repository/test_docs_run.py)

# Needs a C++ compiler, for libFuzzer.
.test-fuzz:
	fuzz/run 120

# Needs valgrind. ARGS=--write stores the counts of this build.
.test-instructions: target/release/polypod-sim
	$(PYTHON) tools/instructions.py $(ARGS)

.test-python: build wheel
	$(BIN)/pytest

wheel: $(VENV)/.extension ## Build the wheel: dist/*.whl
	rm -rf dist
	$(BIN)/python tools/ptx.py --package
	$(BIN)/maturin build --release --locked --out dist

# What `make demo WHEEL=...` installs, into the environment INTO.
.wheel-venv: $(VENV)/.requirements
	$(call install_wheel,$(WHEEL),$(INTO))

bench: build ## Measure the speed, beside MuJoCo in the same run (ARGS="--quick" takes a minute)
	$(BIN)/polypod bench $(ARGS)

accuracy: build ## Compare the physics with MuJoCo and write the tables
	$(BIN)/python -m lab.accuracy --out docs/accuracy.md --readme README.md $(ARGS)

lint: $(VENV)/.dependencies $(if $(FIX),.format) ## Check formatting, lints, types, import directions, documentation (FIX=1 formats first)
	cargo fmt --all --check
	cargo fmt --all --check --manifest-path tests/loom/Cargo.toml
	cargo fmt --check --manifest-path fuzz/Cargo.toml
	cargo clippy --release --locked --workspace --all-targets -- -D warnings
	$(BIN)/ruff check python lab tests/python examples tools
	$(BIN)/ruff format --check python lab tests/python examples tools
	$(BIN)/mypy
	PYTHONPATH=python $(BIN)/lint-imports --no-cache
	$(BIN)/python tools/style.py
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.dependabot .github/dependabot.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-issue-config .github/ISSUE_TEMPLATE/config.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.github-issue-forms $(filter-out %/config.yml,$(wildcard .github/ISSUE_TEMPLATE/*.yml))
	$(BIN)/check-jsonschema --builtin-schema vendor.citation-file-format CITATION.cff
	RUSTDOCFLAGS="-D warnings" cargo doc --release --locked --workspace --no-deps

# In an environment of its own: MkDocs reads the sources and needs nothing of polypod's.
docs: $(DOCS)/.installed ## Build the documentation as a site: target/site/index.html
	$(DOCS)/bin/mkdocs build --quiet --strict

.format: $(VENV)/.dependencies
	cargo fmt --all
	$(BIN)/ruff check --fix python lab tests/python examples tools
	$(BIN)/ruff format python lab tests/python examples tools

# The index is named, so that the lock names PyPI's files on machines that have a mirror, too.
lock: $(VENV)/.venv ## Pin the newest versions that pyproject.toml allows, for every platform and Python, with their hashes
	env -u UV_INDEX -u UV_EXTRA_INDEX_URL -u UV_FIND_LINKS $(BIN)/uv lock --upgrade --default-index https://pypi.org/simple

# The environment. A torch that the base interpreter has already is used; it is the only large download.
$(VENV)/.venv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
		|| { echo "polypod needs Python >= 3.10: make PYTHON=python3.12 build" >&2; exit 1; }
	rm -rf $(VENV)
	@if $(PYTHON) -c 'import torch; assert tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 6)' 2>/dev/null; then \
		echo "using the torch of $(PYTHON)"; $(PYTHON) -m venv --system-site-packages $(VENV); touch $(VENV)/.base-torch; \
	else $(PYTHON) -m venv $(VENV); fi
	@awk -v package=uv -f .ci/locked.awk $(LOCK) > $(VENV)/uv.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes --requirement $(VENV)/uv.txt
	@touch $@

# Requirements of the lock with their hashes and without addresses: they are installed from any index that has the files.
EXPORT := $(BIN)/uv export --frozen --quiet --no-emit-project --no-default-groups --no-annotate --no-header

# With the base's torch, torch and its GPU libraries are left out of the requirements.
without_base_torch = if [ -e $(VENV)/.base-torch ]; then \
	awk '/^[^ ]/ { left_out = /^((torch|triton)==|nvidia-|cuda-)/ } !left_out'; else cat; fi

# Installs requirements into an environment. They are complete, so nothing is resolved; a file of another hash is refused.
INSTALL := $(BIN)/uv pip install --no-deps --require-hashes

$(VENV)/.requirements: $(VENV)/.venv $(LOCK)
	@$(EXPORT) --extra all --group dev | { $(without_base_torch); } > $(VENV)/requirements.txt
	@awk -v package=maturin -f .ci/locked.awk $(LOCK) > $(VENV)/maturin.txt
	$(INSTALL) --python $(BIN)/python --requirement $(VENV)/maturin.txt
	@touch $@

$(VENV)/.dependencies: $(VENV)/.requirements
	$(INSTALL) --python $(BIN)/python --compile-bytecode --requirement $(VENV)/requirements.txt
	@touch $@

$(LEARNERS)/.installed: $(VENV)/.venv $(LOCK)
	$(BIN)/uv venv --quiet --allow-existing --python $(BIN)/python $(LEARNERS) \
		$(if $(wildcard $(VENV)/.base-torch),--system-site-packages)
	@$(EXPORT) --extra all --extra ray --extra learners --group tests | { $(without_base_torch); } > $(LEARNERS)/requirements.txt
	$(INSTALL) --quiet --python $(LEARNERS)/bin/python --requirement $(LEARNERS)/requirements.txt
	@touch $@

$(DOCS)/.installed: $(VENV)/.venv $(LOCK)
	$(BIN)/uv venv --quiet --allow-existing --python $(BIN)/python $(DOCS)
	@$(EXPORT) --only-group docs > $(DOCS)/requirements.txt
	$(INSTALL) --quiet --python $(DOCS)/bin/python --requirement $(DOCS)/requirements.txt
	@touch $@

# The extension, the program and the tests share target/, the release profile and the features of workspace-hack, so that
# dependencies are built once.
#
# Python's packages arrive while the extension compiles, which needs maturin alone.
$(VENV)/.extension: pyproject.toml $(LOCK) $(LIBRARY_SOURCES)
	@$(MAKE) --no-print-directory --jobs=2 $(VENV)/.dependencies .compile
	$(BIN)/maturin develop --release --locked --uv
	@touch $@

.compile: $(VENV)/.requirements
	$(BIN)/maturin develop --release --locked --skip-install

target/release/polypod-sim: $(PROGRAM_SOURCES)
	cargo build --release --locked --package polypod-sim
	@touch $@
