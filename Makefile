# Every target sets up .venv by itself; a second call starts at once.
.PHONY: demo test check bench tables clean

demo: .venv/installed
	.venv/bin/pf2mp-demo --output_dir=demo

test: .venv/installed
	.venv/bin/python -m pytest

check: .venv/installed
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

bench: .venv/installed
	.venv/bin/python tests/benchmarks

tables:
	.ci/fill_tables README.md results/ABLATIONS.md results/BENCHMARKS.md

clean:
	rm -rf .venv demo build *.egg-info

.venv/installed: pyproject.toml constraints.txt lerobot_pf2mp/_kernel_tree.c
	@.ci/set_up
