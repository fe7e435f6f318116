"""Does method ``population`` keep its word? Simulated worlds, inverted and scored.

``python benchmarks/worlds.py --worlds 600 --jobs 2`` makes docs/worlds.md, its figures and docs/worlds.csv. Worlds are
seeded; every answer goes to a table under build/ at once, so that ``--resume`` goes on with a run that was cut short
(answers of another version of the package are made again). ``--page`` only writes the page from that table.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import multiprocessing
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import overtone

# all code is loaded before the workers part, so that they work with one and the same
import overtone.inversion.validity
import overtone.population.population
from worlds_page import write_page
from worlds_scores import COLUMNS, KINDS, Row, scores, told, written

FOLDER = Path(__file__).resolve().parent
TABLE = FOLDER.parent / "build" / "worlds.csv"
DOCS = FOLDER.parent / "docs"
SHARES = {
    "three": 18,
    "homogeneous": 15,
    "gradient": 15,
    "jkr": 4,
    "sls": 4,
    "blunted-cone": 4,
    "setpoints": 4,
}
"""Of so many worlds as they add up to."""
ROOMS = ("contact", "dynamics", "inversion", "instrument", "population")

Task = tuple[str, int]
"""Kind and seed."""


def version() -> str:
    """Return a word for what the answers depend on: the package and these simulations."""
    package = Path(overtone.__file__).parent
    paths = [path for room in ROOMS for path in sorted((package / room).glob("*.py"))]
    paths += [
        FOLDER / f"worlds_{part}.py" for part in ("simulated", "forces", "scores", "limit", "setpoints")
    ]
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()[:12]


def tasks_of(count: int, kinds: Sequence[str]) -> list[Task]:
    """Return worlds in an order in which every beginning has about the shares of the whole."""
    shares = {kind: SHARES[kind] for kind in kinds}
    total = sum(shares.values())
    every = [
        ((i + 0.5) / share, kind, i)
        for kind, share in shares.items()
        for i in range(-(-count * share // total))
    ]
    return [(kind, seed) for _, kind, seed in sorted(every)[:count]]


def scored(task: Task) -> tuple[Task, list[Row]]:
    """Return the rows of a world; one that could not be made or scored is a row that says so."""
    kind, seed = task
    try:
        return task, scores(kind, seed)
    except Exception as error:  # one world must not end a run; the page counts these
        return task, [{"kind": kind, "seed": seed, "material": "all", "error": told(error)}]


def read_table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table, without the last world where that was cut short."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    if rows and not text.endswith("\n"):
        last = (rows[-1]["kind"], rows[-1]["seed"])
        rows = [row for row in rows if (row["kind"], row["seed"]) != last]
    return rows


def write_table(path: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Write a table from its head on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def run(tasks: Sequence[Task], path: Path, jobs: int) -> None:
    """Score worlds in worker processes and append each to the table as soon as it is there."""
    name, start = version(), time.perf_counter()
    # the workers part before the package has started threads of its own, which would not live on in them
    context = multiprocessing.get_context("fork")
    with (
        ProcessPoolExecutor(jobs, mp_context=context) as pool,
        path.open("a", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")

        def put(answer: tuple[Task, list[Row]]) -> None:
            writer.writerows(written(answer[1], name))
            file.flush()

        # the first one compiles what the others find on disk
        put(pool.submit(scored, tasks[0]).result())
        waiting = [pool.submit(scored, task) for task in tasks[1:]]
        for done, future in enumerate(as_completed(waiting), start=2):
            put(future.result())
            if done % 10 == 0 or done == len(tasks):
                print(f"{done} of {len(tasks)} worlds, {time.perf_counter() - start:.0f} s", flush=True)


def main() -> None:
    """Run worlds and write the page."""
    parser = argparse.ArgumentParser(description="Method population against simulated worlds.")
    parser.add_argument(
        "--worlds", type=int, default=600, help="of all kinds together, or of those of --only"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), help="kinds of worlds")
    parser.add_argument("--resume", action="store_true", help="keep what is in the table and go on")
    parser.add_argument("--page", action="store_true", help="only write the page from the table")
    parser.add_argument("--table", type=Path, default=TABLE)
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of the page")
    options = parser.parse_args()
    if not options.page:
        tasks = tasks_of(options.worlds, options.only)
        name = version()
        kept = [row for row in read_table(options.table) if row["version"] == name] if options.resume else []
        write_table(options.table, kept)
        done = {(row["kind"], int(row["seed"])) for row in kept}
        todo = [task for task in tasks if task not in done]
        print(
            f"{len(done)} worlds in the table, {len(todo)} to go: {dict(Counter(kind for kind, _ in todo))}"
        )
        if todo:
            run(todo, options.table, options.jobs)
    rows = read_table(options.table)
    if not rows:
        parser.error(f"there are no answers in {options.table}")
    write_page(rows, options.docs)


if __name__ == "__main__":
    main()
