"""Joints that a log says nothing about, held where the model puts them."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import ModelError, RecordingError, StudyError
from bo_sysid.mjcf import Model
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.study.overview import overview

ARM = """
<mujoco>
  <worldbody>
    <body><joint name="elbow" axis="0 1 0"/><geom size=".02" fromto="0 0 0 0 0 -.3" type="capsule"/>
      <body pos="0 0 -.3" euler="0 30 0"><joint name="finger" axis="0 1 0" type="slide"/>
        <geom size=".01" pos=".1 0 0" mass=".2"/></body></body>
  </worldbody>
  <actuator><motor name="e" joint="elbow"/><motor name="f" joint="finger"/></actuator>
  <sensor><jointpos joint="finger"/><jointpos name="at" joint="elbow"/></sensor>
  <keyframe><key qpos=".3 .01" ctrl="1 2"/></keyframe>
</mujoco>
"""
WELDED = (
    ARM.replace('<joint name="finger" axis="0 1 0" type="slide"/>', "")
    .replace('<motor name="f" joint="finger"/>', "")
    .replace('<jointpos joint="finger"/>', "")
    .replace('qpos=".3 .01" ctrl="1 2"', 'qpos=".3" ctrl="1"')
)


def test_a_held_joint_is_a_weld(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    held = Model.from_file(tmp_path / "arm.xml", hold=["finger"])
    assert (held.joints, held.actuators, held.sensors) == (("elbow",), ("e",), ("at",))
    accelerations = []
    for model in (held.compile(), Model.from_xml(WELDED).compile()):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        accelerations.append(data.qacc.copy())
    np.testing.assert_allclose(accelerations[0], accelerations[1], rtol=1e-12)


def test_a_held_joint_takes_the_sensors_of_its_motor_along(tmp_path: Path) -> None:
    sensors = '<actuatorfrc actuator="f"/><actuatorfrc name="torque" actuator="e"/></sensor>'
    (tmp_path / "arm.xml").write_text(ARM.replace("</sensor>", sensors))
    held = Model.from_file(tmp_path / "arm.xml", hold=["finger"])
    assert (held.actuators, held.sensors) == (("e",), ("at", "torque"))
    data = mujoco.MjData(compiled := held.compile())
    data.ctrl[0] = 1.5
    mujoco.mj_forward(compiled, data)
    assert data.sensor("torque").data[0] == 1.5


def test_a_joint_that_is_named_twice_is_held_once(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    held = Model.from_file(tmp_path / "arm.xml", hold=["finger", "finger"])
    assert held.joints == ("elbow",)


def test_an_unknown_joint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    with pytest.raises(ModelError, match=r"no joint 'fingr'; did you mean 'finger'"):
        Model.from_file(tmp_path / "arm.xml", hold=["fingr"])


def elbow_alone(folder: Path, model: str) -> Study:
    """A study whose log has no finger."""
    (folder / "arm.xml").write_text(model)
    rows = "".join(f"{0.01 * k:.2f},{np.sin(k):.4f},0\n" for k in range(80))
    (folder / "log.csv").write_text("time,qpos.elbow,ctrl.e\n" + rows)
    return Study.from_dict({"model": "arm.xml", "recordings": {"train": "log.csv"}}, folder)


def test_a_log_without_a_joint_says_how_to_hold_it(tmp_path: Path) -> None:
    study = elbow_alone(tmp_path, ARM)
    with pytest.raises(RecordingError, match=r"no channel 'qpos.finger'.*hold: \[finger\]"):
        overview(study)
    source = {"file": "arm.xml", "hold": ["finger"]}
    study = Study.from_dict({"model": source, "recordings": {"train": "log.csv"}}, tmp_path)
    assert load_model(study).joints == ("elbow",)
    assert overview(study).channels["channel"].tolist() == ["qpos.elbow", "qvel.elbow", "ctrl.e"]


def test_a_log_without_a_ball_joint_says_how_to_hold_it(tmp_path: Path) -> None:
    """The joint is named, and not its first coordinate; `unrecorded` is for hinges and slides."""
    text = ARM.replace('axis="0 1 0" type="slide"', 'type="ball"').replace(".3 .01", ".3 1 0 0 0")
    text = text.replace('<motor name="f" joint="finger"/>', "")
    text = text.replace(' ctrl="1 2"', "").replace('<jointpos joint="finger"/>', "")
    study = elbow_alone(tmp_path, text)
    with pytest.raises(RecordingError, match=r"no channel 'qpos.finger.0'.*hold: \[finger\]\}$"):
        overview(study)


def test_tasks_of_dm_control_hold_nothing() -> None:
    model = {"dm_control": {"domain": "cheetah", "task": "run"}, "hold": ["bthigh"]}
    with pytest.raises(StudyError, match="hold goes with file"):
        Study.from_dict({"model": model, "recordings": {"dataset": "emps"}})
