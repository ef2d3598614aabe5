"""Strips of pictures: what a policy does on the plant before and after the repair of the model.

After `python benchmarks/learn_effect.py`, where rendering works:

    MUJOCO_GL=egl python benchmarks/learn_pictures.py
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from learn_effect import ROOT, STUDIES, study_of
from matplotlib.figure import Figure

from bo_sysid.learn.play import render
from bo_sysid.learn.scene import Scene
from bo_sysid.plants.build import build_plant
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.report.figures import save

HERE = Path(__file__).parent
RUNS = ROOT / "runs" / "benchmark-learn-effect" / "full"
ROWS = {"nominal": "learned on the model as it was", "with": "learned on the repaired model"}
SEED, EPISODES, SECONDS = 0, 20, 5.0


def main() -> None:
    """Write one picture a task."""
    for task in STUDIES:
        scene = Scene.of(study_of(task, SEED, False))
        figure = Figure(figsize=(12, 3.6), layout="constrained")
        for axes, (arm, words) in zip(figure.subplots(2, 1), ROWS.items(), strict=True):
            policy = LearnedPolicy.load(RUNS / f"{task}-{arm}-{SEED}" / "policy.npz")
            plant = build_plant(scene.study, seed=SEED)
            told = plant.evaluate(policy.act, EPISODES, seed=SEED).mean()
            recording = plant.record(policy.act)
            axes.imshow(render(scene.model, recording.between(0.0, SECONDS), goal=plant.goal))
            axes.set_axis_off()
            axes.set_title(f"{task}, {words}: return on the plant {told:.0f}", fontsize="medium")
        save(figure, HERE / "figures" / f"learn_effect_{task}.png")


if __name__ == "__main__":
    main()
