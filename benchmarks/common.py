"""What the benchmarks share: resumable cases, stored figures, a last line of JSON.

Every benchmark is run as ``python benchmarks/NAME.py [--quick]``. It prints its progress and, as
its last line, one JSON object with its figures, which is stored under ``benchmarks/results/``
beside the versions and the machine. Cases that take long are kept one by one, so that a benchmark
that is stopped goes on where it was.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bo_sysid.runs import atomic, plain, versions

RESULTS = Path(__file__).parent / "results"


def _tree() -> str | None:
    """Return the commit that is checked out; None outside a repository."""
    command = ["git", "-C", str(RESULTS.parent), "rev-parse", "--short", "HEAD"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


_TREE = _tree()  # at the start: a later commit is not what computes


class Cases:
    """The finished cases of a benchmark by key, one JSON object a line with the tree that met it.

    Args:
        name: of the benchmark.
        quick: cases with fewer repeats are kept apart.
        stored: none is to be computed; figures are made of those that are there.
    """

    def __init__(self, name: str, quick: bool, stored: bool = False) -> None:
        self.stored = stored
        self._path = RESULTS / f"{name}{'-quick' if quick else ''}.cases.jsonl"
        self._done: dict[str, Any] = {}
        if self._path.is_file():
            for line in self._path.read_text().splitlines():
                entry = json.loads(line)
                self._done[entry["key"]] = entry["value"]

    def __contains__(self, key: str) -> bool:
        """Return whether a case is finished."""
        return key in self._done

    def get(self, key: str, compute: Callable[[], Any]) -> Any:
        """Return the stored value of a case, computing and storing it where there is none."""
        if key not in self._done:
            started = time.perf_counter()
            self._done[key] = plain(compute())
            print(f"  {key}: {time.perf_counter() - started:.1f} s", flush=True)
            self._path.parent.mkdir(exist_ok=True)
            with open(self._path, "a") as file:
                entry = {"key": key, "tree": _TREE, "value": self._done[key]}
                file.write(json.dumps(entry) + "\n")
        return self._done[key]


def benchmark(
    name: str, run: Callable[[bool, Cases], Mapping[str, Any]], *, partial: bool = False
) -> None:
    """Run a benchmark from the command line.

    Args:
        name: of the benchmark.
        run: from (quick, cases) to the figures.
        partial: it can make figures of the cases that are finished (`Cases.stored`).
    """
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats, same code")
    parser.add_argument("--fresh", action="store_true", help="forget cases that were finished")
    if partial:
        parser.add_argument(
            "--stored", action="store_true", help="figures of the finished cases; compute none"
        )
    arguments = parser.parse_args()
    cases_file = RESULTS / f"{name}{'-quick' if arguments.quick else ''}.cases.jsonl"
    if arguments.fresh:
        cases_file.unlink(missing_ok=True)
    started = time.perf_counter()
    cases = Cases(name, arguments.quick, getattr(arguments, "stored", False))
    figures = plain(dict(run(arguments.quick, cases)))
    stored = {
        "benchmark": name,
        "quick": arguments.quick,
        "seconds": round(time.perf_counter() - started, 1),
        "date": time.strftime("%Y-%m-%d"),
        "versions": versions(),
        "machine": {
            "processor": _processor(),
            "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
            "system": platform.system(),
        },
        "figures": figures,
    }
    RESULTS.mkdir(exist_ok=True)
    with atomic(RESULTS / f"{name}{'-quick' if arguments.quick else ''}.json") as path:
        path.write_text(json.dumps(stored, indent=1) + "\n")
    print(json.dumps(figures))


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), "")
