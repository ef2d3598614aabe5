"""Small studies of the outer loop, shared by its tests."""

from pathlib import Path
from typing import Any

from bo_sysid.learn.learn import Learning, learn
from bo_sysid.runs import Run
from bo_sysid.study import Study


def pendulum(**changed: Any) -> dict[str, Any]:
    """Return a study of dm-control's pendulum whose plant lies on B; keys replace its own."""
    suite = {"dm_control": {"domain": "pendulum", "task": "swingup"}}
    study = {
        "name": "pendulum",
        "model": suite,
        "recordings": {"train": ["none.parquet"], "noise": {"qpos": 0.001, "qvel": 0.01}},
        "parameters": [
            {
                "name": "mass",
                "address": "body[pole].mass",
                "apply": "scale",
                "low": 0.5,
                "high": 1.5,
            },
            {
                "name": "damping",
                "address": "joint[hinge].damping",
                "apply": "scale",
                "low": 0.5,
                "high": 1.5,
            },
        ],
        "search": {"budget": 12},
        "task": suite,
        "policy": {"batch": 400, "steps": 800, "hidden": [8]},
        "learn": {"trajectories": 2, "episodes": 2, "epsilon": 0.1},
        "plant": {
            "parameters": {"mass": 1.2, "damping": 0.8},
            "noise": {"qpos": 0.001, "qvel": 0.01},
        },
    }
    return {**study, **changed}


def learned(folder: Path, study: dict[str, Any], name: str = "run") -> Learning:
    """Run the loop into a folder."""
    made = Study.from_dict(study, folder, trust_code=True)
    place = folder / name
    with Run.open(place, made.resolved(relative_to=place), "learn") as run:
        return learn(made, run)
