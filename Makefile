# Every target sets up .venv by itself; a second call starts at once.
.PHONY: demo test test-fast check fuzz bench tables clean

demo: .venv/installed
	.venv/bin/pf2mp-demo --output_dir=demo

# Two processes, each of which takes whole files. Then the policies that need transformers.
test: .venv/installed .venv-vla/installed
	.venv/bin/pytest --numprocesses=2 --dist=loadfile --no-loadscope-reorder --durations=20
	.venv-vla/bin/pytest tests/test_guarded_vla.py

test-fast: .venv/installed
	.venv/bin/pytest --numprocesses=2 --dist=loadfile --no-loadscope-reorder --durations=20 -m "not slow"

check: .venv/installed
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

fuzz: .venv/installed
	.venv/bin/python tests/fuzzing

bench: .venv-bench/installed
	.venv-bench/bin/python tests/benchmarks

tables:
	.ci/fill_tables README.md results/ABLATIONS.md results/BENCHMARKS.md results/FAULTS.md

clean:
	rm -rf .venv .venv-bench .venv-vla demo build *.egg-info

.venv/installed: pyproject.toml constraints.txt lerobot_pf2mp/density/_kernel_tree.c
	@.ci/set_up .venv dev

# Apart from the other tests' environment, like the next one.
.venv-vla/installed: pyproject.toml constraints.txt lerobot_pf2mp/density/_kernel_tree.c
	@.ci/set_up .venv-vla vla

# Apart from the tests' environment: with transformers, every command of LeRobot starts 2.5 seconds later.
.venv-bench/installed: pyproject.toml constraints.txt lerobot_pf2mp/density/_kernel_tree.c
	@.ci/set_up .venv-bench bench
