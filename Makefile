# One command for each job; each runs in the current environment.

.PHONY: install test lint format bench demo picture validation clean

install:  ## this package with everything a developer needs
	python -m pip install -e ".[dev]"

test:  ## the whole test suite, warnings as errors
	python -m pytest -n auto

lint:  ## style, formatting and types, as in CI
	python -m ruff check .
	python -m ruff format --check .
	python -m mypy

format:  ## fix what can be fixed
	python -m ruff check --fix .
	python -m ruff format .

bench:  ## speed as ratios against what a user would write today
	python -m pytest benchmarks --benchmark-only -o "testpaths=benchmarks"

demo:  ## the README's main command
	overtone demo

picture:  ## the picture of the README, made by the program
	python docs/picture.py

validation:  ## figures and tables of the pages that check, each made by its script
	python docs/validation.py
	python docs/blend.py
	python benchmarks/worlds.py --worlds 300
	python docs/instruments.py
	python docs/posterior.py
	python docs/identifiability.py

clean:  ## what tests and builds leave behind
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks build dist overtone-demo
