# polypod: everything from a bare machine with Rust, Python >= 3.10, a C compiler and the package registries.
# `make help` lists the targets. Stamps in .venv keep what is done from being done again.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LOCK := requirements.lock
LEARNERS := target/learners
LEARNERS_LOCK := requirements-learners.lock
DOCS := target/docs
DOCS_LOCK := requirements-docs.lock

# The machine's own index, where pip is told of one and uv is not, and its own certificates.
ifndef UV_DEFAULT_INDEX
PIP_INDEX := $(shell $(PYTHON) -m pip config get global.index-url 2>/dev/null)
ifneq ($(PIP_INDEX),)
export UV_DEFAULT_INDEX := $(PIP_INDEX)
endif
endif
# uv, maturin and cargo must agree on where things go.
unexport CARGO_TARGET_DIR CARGO_BUILD_TARGET_DIR CONDA_PREFIX
export VIRTUAL_ENV := $(CURDIR)/$(VENV)

LIBRARY_SOURCES := Cargo.toml Cargo.lock $(shell find src systems configs assets/robots workspace-hack -type f 2>/dev/null)
PROGRAM_SOURCES := $(LIBRARY_SOURCES) $(shell find polypod-sim -type f 2>/dev/null)

# `make demo WHEEL=dist/....whl` runs from an installed wheel, in a new environment outside the checkout.
WHEEL ?=
# Where cargo-nextest is, which runs the tests of Rust if it is installed; `cargo test` runs the same ones.
NEXTEST := $(shell command -v cargo-nextest 2>/dev/null)

# How the bundled policies are filmed.
FILM_ROUGH := --command 0.6 0 0 --warm-up 2 --seconds 4 --fps 6 --size 640 360 --set scene.terrain.max_init_terrain_level=1
FOUR := unitree_go1,spot,anymal_c,unitree_b2
FILM_FOUR := --robots $(FOUR) --size 560 260
# Folder of a run for the film of a training.
RUN ?=
FILM := --command 0.7 0 0 --warm-up 1.5 --seconds 2.4 --fps 12 --size 720 300

# Arguments of `make train`, e.g. make train ARGS="--robots spot --max-iterations 50"
ARGS ?=
# Time that each fuzz target runs for.
SECONDS ?= 600

.PHONY: help build train eval demo film films test test-extended test-learners fuzz test-rust test-python wheel wheel-venv compile bench soak accuracy lint doc docs package format lock clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' Makefile

build: $(VENV)/.extension target/release/polypod-sim ## Build the Python package (into .venv) and target/release/polypod-sim

train: $(VENV)/.extension ## Train one policy over all robots (ARGS="..." is passed on), then evaluate it
	$(BIN)/polypod train --train-config quick $(ARGS)

eval: $(VENV)/.extension ## Evaluate a checkpoint: make eval ARGS="--checkpoint logs/.../model_300.pt"
	$(BIN)/polypod eval $(ARGS)

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
$(1) play --checkpoint flat $(FILM) --video $(abspath logs/demo/eight_robots.gif)
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

film: $(VENV)/.extension ## Regenerate the film of rough ground of the README and docs/terrain.md
	$(BIN)/polypod play --checkpoint rough $(FILM_ROUGH) --video docs/media/rough_robots.webp

films: $(VENV)/.extension ## Film a push, a stranger and MuJoCo for docs/viewer.md; RUN=<folder of a run> also a training
	$(BIN)/polypod film push docs/media/push.webp $(FILM_FOUR) --seconds 4.8 --push 1.5 --fps 8
	$(BIN)/polypod film walk docs/media/ninth.webp --robots unitree_aliengo --seconds 2.4 --fps 8 --size 400 240
	$(BIN)/polypod film mujoco docs/media/mujoco.webp $(FILM_FOUR) --seconds 3.2 --fps 8 --size 560 400
ifneq ($(RUN),)
	$(BIN)/polypod film training docs/media/training.webp --checkpoint $(RUN) --robots $(FOUR) --seconds 2 --fps 8 --size 480 240 --parts 5
endif

test: test-rust test-python ## Run the tests of Rust and of Python

test-extended: export POLYPOD_TEST_TIER := extended
test-extended: test test-learners ## The same tests with larger sizes, those of learners and Ray, and two minutes of each fuzz target
	$(MAKE) --no-print-directory fuzz SECONDS=120

test-rust:
ifneq ($(NEXTEST),)
	cargo nextest run --release --locked --workspace --exclude polypod-python
	cargo test --release --locked --doc
else
	cargo test --release --locked --workspace --exclude polypod-python
endif
	cargo run --release --locked --target-dir target/loom --manifest-path tests/loom/Cargo.toml

# Needs a C++ compiler, for libFuzzer.
fuzz: ## Feed mutated files to the readers: make fuzz SECONDS=600 ARGS="urdf_loader" (all targets without ARGS)
	fuzz/run $(SECONDS) $(ARGS)

test-python: build wheel
	$(BIN)/pytest

# In an environment of its own: these packages pin others, and Ray's tests take minutes.
test-learners: $(VENV)/.extension $(LEARNERS)/.installed ## Run the tests of other learners and of Ray: Stable-Baselines3, skrl, TorchRL, RLlib
	PYTHONPATH=$(CURDIR)/python $(LEARNERS)/bin/python -m pytest -n 0 $(addprefix tests/python/test_,learners.py policies.py ray.py docs_run.py)

wheel: $(VENV)/.extension ## Build the wheel: dist/*.whl
	rm -rf dist
	$(BIN)/maturin build --release --locked --out dist

# What `make demo WHEEL=...` installs, into the environment INTO.
wheel-venv: $(VENV)/.requirements
	$(call install_wheel,$(WHEEL),$(INTO))

bench: build ## Measure the speed, beside MuJoCo in the same run (ARGS="--quick" takes a minute)
	$(BIN)/polypod bench $(ARGS)

accuracy: build ## Compare the physics with MuJoCo and write the tables
	$(BIN)/polypod accuracy --out docs/accuracy.md --readme README.md $(ARGS)

soak: build ## Step all robots for an hour of simulated time under random targets; about an hour on 2 cores
	target/release/polypod-sim soak $(ARGS)

lint: $(VENV)/.dependencies doc ## Check formatting, lints, types, documentation
	cargo fmt --all --check
	cargo fmt --all --check --manifest-path tests/loom/Cargo.toml
	cargo fmt --check --manifest-path fuzz/Cargo.toml
	cargo clippy --release --locked --workspace --all-targets -- -D warnings
	$(BIN)/ruff check python lab tests/python examples
	$(BIN)/ruff format --check python lab tests/python examples
	$(BIN)/mypy
	PYTHONPATH=python $(BIN)/lint-imports --no-cache
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.dependabot .github/dependabot.yml

doc: ## Build the documentation of the Rust crates: target/doc/polypod/index.html
	RUSTDOCFLAGS="-D warnings" cargo doc --release --locked --workspace --no-deps

# In an environment of its own: MkDocs reads the sources and needs nothing of polypod's.
docs: $(DOCS)/.installed ## Build the documentation as a site: target/site/index.html
	$(DOCS)/bin/mkdocs build --quiet --strict

package: ## Pack the crates as `cargo publish` would: target/package
	cargo package --locked --no-verify --allow-dirty --package polypod-dynamics --package polypod-learner --package polypod

format: $(VENV)/.dependencies ## Format all code
	cargo fmt
	$(BIN)/ruff check --fix python lab tests/python examples
	$(BIN)/ruff format python lab tests/python examples

# Versions for every platform and Python version, each file with its SHA-256: an installation checks what it downloads.
PIP_COMPILE = $(BIN)/uv pip compile --universal --python-version 3.10 --upgrade --generate-hashes --no-emit-index-url \
	--no-emit-find-links --custom-compile-command "make lock" --quiet
COMPILE = $(PIP_COMPILE) pyproject.toml --extra train --extra bench --extra export --extra play --extra add --group dev

# RLlib and TorchRL want older versions of some packages than the newest, but the same torch.
lock: $(VENV)/.venv ## Pin the newest versions that pyproject.toml allows, and their hashes
	$(COMPILE) -o $(LOCK)
	sed -nE '/^((torch|triton|numpy|mujoco|rsl-rl-lib)==|nvidia-|cuda-)/s/ \\$$//p' $(LOCK) > $(VENV)/same.txt
	$(COMPILE) --extra ray --extra learners --constraint $(VENV)/same.txt --no-annotate -o $(LEARNERS_LOCK)
	$(PIP_COMPILE) --group docs --no-annotate -o $(DOCS_LOCK)

clean: ## Remove everything that is built; training runs in logs/ stay
	rm -rf $(VENV) target dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find python -name '__pycache__' -prune -exec rm -rf {} +
	rm -f python/polypod/_core*.so python/polypod/_core*.pyd

# The environment. A torch that the base interpreter has already is used; it is the only large download.
$(VENV)/.venv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
		|| { echo "polypod needs Python >= 3.10: make PYTHON=python3.12 build" >&2; exit 1; }
	rm -rf $(VENV)
	@if $(PYTHON) -c 'import torch; assert tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 6)' 2>/dev/null; then \
		echo "using the torch of $(PYTHON)"; $(PYTHON) -m venv --system-site-packages $(VENV); touch $(VENV)/.base-torch; \
	else $(PYTHON) -m venv $(VENV); fi
	@$(call entries,$(LOCK),uv) > $(VENV)/uv.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes --requirement $(VENV)/uv.txt
	@touch $@

# An entry of a lock is a line and its indented lines, the hashes. Prints the entries of package $(2).
entries = awk '/^[^ ]/ { found = index($$0, "$(2)==") == 1 } found' $(1)

# The locks are complete, so nothing is resolved: with the base's torch, torch and its GPU libraries are left out of it.
without_base_torch = if [ -e $(VENV)/.base-torch ]; then \
	awk '/^[^ ]/ { left_out = /^((torch|triton)==|nvidia-|cuda-)/ } !left_out' $(1); else cat $(1); fi

# Installs what a lock pins into an environment: a file of another hash than the lock's is refused.
INSTALL := $(BIN)/uv pip install --no-deps --require-hashes

$(VENV)/.requirements: $(VENV)/.venv $(LOCK)
	@$(call without_base_torch,$(LOCK)) > $(VENV)/requirements.txt
	@$(call entries,$(LOCK),maturin) > $(VENV)/maturin.txt
	$(INSTALL) --python $(BIN)/python --requirement $(VENV)/maturin.txt
	@touch $@

$(VENV)/.dependencies: $(VENV)/.requirements
	$(INSTALL) --python $(BIN)/python --compile-bytecode --requirement $(VENV)/requirements.txt
	@touch $@

$(LEARNERS)/.installed: $(VENV)/.venv $(LEARNERS_LOCK)
	$(BIN)/uv venv --quiet --allow-existing --python $(BIN)/python $(LEARNERS) \
		$(if $(wildcard $(VENV)/.base-torch),--system-site-packages)
	@$(call without_base_torch,$(LEARNERS_LOCK)) > $(LEARNERS)/requirements.txt
	$(INSTALL) --quiet --python $(LEARNERS)/bin/python --requirement $(LEARNERS)/requirements.txt
	@touch $@

$(DOCS)/.installed: $(VENV)/.venv $(DOCS_LOCK)
	$(BIN)/uv venv --quiet --allow-existing --python $(BIN)/python $(DOCS)
	$(INSTALL) --quiet --python $(DOCS)/bin/python --requirement $(DOCS_LOCK)
	@touch $@

# The extension, the program and the tests share target/, the release profile and the features of workspace-hack, so that
# dependencies are built once.
#
# Python's packages arrive while the extension compiles, which needs maturin alone.
$(VENV)/.extension: pyproject.toml $(LOCK) $(LIBRARY_SOURCES)
	@$(MAKE) --no-print-directory --jobs=2 $(VENV)/.dependencies compile
	$(BIN)/maturin develop --release --locked --uv
	@touch $@

compile: $(VENV)/.requirements
	$(BIN)/maturin develop --release --locked --skip-install

target/release/polypod-sim: $(PROGRAM_SOURCES)
	cargo build --release --locked --package polypod-sim
	@touch $@
