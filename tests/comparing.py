"""A small comparison, shared by its tests."""

import json
from pathlib import Path
from typing import Any


def small(**changed: Any) -> dict[str, Any]:
    """Return a study that compares three arms with two seeds in seconds; keys replace its own."""
    study = {
        "name": "small",
        "model": {"dm_control": {"domain": "pendulum", "task": "swingup"}},
        "recordings": {"train": ["none.parquet"]},
        "parameters": [
            {"name": "mass", "address": "body[pole].mass", "apply": "scale",
             "low": 0.5, "high": 1.5, "steps": 7},
            {"name": "damping", "address": "joint[hinge].damping",
             "low": 0.0, "high": 0.3, "steps": 7},
        ],
        "deviation": {"horizon": 5},
        "search": {"budget": 10},
        "compare": {"arms": ["argmin-entropy", "greedy", "random"], "seeds": 2},
        "plant": {
            "parameters": {"mass": 1.2, "damping": 0.1},
            "noise": {"qpos": 0.001, "qvel": 0.01},
            "record": {"train": 1, "seconds": 2.0},
        },
    }  # fmt: skip
    return {**study, **changed}


def record_of(place: Path) -> dict[str, Any]:
    """Return every record of a comparison by its file, without what a clock said."""
    found = {}
    for path in sorted((place / "records").rglob("*.json")):
        record = json.loads(path.read_text())
        record.pop("seconds")
        found[path.relative_to(place).as_posix()] = record
    return found
