"""`init`: what of a model's joints stands in the study: bounds, motors and what is held."""

from pathlib import Path

import numpy as np
import pandas as pd

from bo_sysid.mjcf import Model
from bo_sysid.starter.init import init
from bo_sysid.study import Study

TIME = np.arange(0.0, 4.0, 0.01)


def written(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """Write a log of some columns beside the time."""
    pd.DataFrame({"time": TIME, **columns}).to_csv(path, index=False)
    return path


def test_bounds_hold_what_the_model_has(tmp_path: Path) -> None:
    """Motors that did little speak for less than a model may have from its maker."""
    own = {"frictionloss": 3, "damping": 2, "armature": 1}
    told = " ".join(f'{kind}="{value}"' for kind, value in own.items())
    (tmp_path / "wheel.xml").write_text(
        f'<mujoco><worldbody><body><joint name="wheel" {told}/><geom size=".1" mass="1"/></body>'
        '</worldbody><actuator><motor name="wheel" joint="wheel"/></actuator></mujoco>'
    )
    log = {"wheel_pos": np.sin(2 * TIME), "wheel_torque": 0.1 * np.cos(7 * TIME)}
    path = init(
        tmp_path / "wheel.xml", [written(tmp_path / "log.csv", log)], tmp_path / "wheel.yaml"
    ).path
    bounds = Study.load(path).parameter_set(Model.from_file(tmp_path / "wheel.xml"))
    high = {p.addresses[0]: p.high for p in bounds}
    assert high == {f"joint[wheel].{kind}": 2 * value for kind, value in own.items()}
