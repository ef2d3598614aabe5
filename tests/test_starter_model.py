"""`init`: what of a model's joints stands in the study: bounds, motors and what is held."""

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from bo_sysid.mjcf import Model
from bo_sysid.recording import read_tables
from bo_sysid.simulation import Engine, State
from bo_sysid.starter.guess import guess_rules
from bo_sysid.starter.init import init
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model

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


def test_bounds_hold_the_friction_of_a_servo_that_rests_most_of_the_time(tmp_path: Path) -> None:
    text = (
        '<mujoco><worldbody><body><joint name="arm" axis="0 0 1" damping=".2"/>'
        '<geom size=".1" pos=".3 0 0" mass="1"/></body></worldbody>'
        '<actuator><position name="arm" joint="arm" kp="40" kv="3"/></actuator></mujoco>'
    )
    (tmp_path / "arm.xml").write_text(text)
    plant = mujoco.MjModel.from_xml_string(text)
    plant.dof_frictionloss[0], data = 2.0, mujoco.MjData(plant)
    goal = 0.5 * np.sin(2 * np.pi * np.clip(TIME, 0.0, 1.0))  # it moves for a second of four
    shown = np.empty_like(TIME)
    for k, now in enumerate(TIME):
        data.ctrl[:] = goal[k]
        while data.time < now - 1e-9:
            mujoco.mj_step(plant, data)
        shown[k] = data.qpos[0]
    log = written(tmp_path / "log.csv", {"arm_pos": shown, "arm_goal": goal})
    path = init(tmp_path / "arm.xml", [log], tmp_path / "arm.yaml").path
    bounds = Study.load(path).parameter_set(Model.from_file(tmp_path / "arm.xml"))
    (high,) = (p.high for p in bounds if p.addresses[0] == "joint[arm].frictionloss")
    assert 2.0 < high < 20.0


LINK = (
    '<link name="{0}"><inertial><mass value="1"/><origin xyz="0 0 -.1"/>'
    '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><axis xyz="0 1 0"/>'
    '<limit lower="-3" upper="3" effort="9" velocity="9"/>{4}</joint>'
)
GRIPPER = (
    '<robot name="arm"><link name="base"/>'
    + "".join(LINK.format(n) for n in ("upper", "thumb", "finger"))
    + JOINT.format("elbow", "continuous", "base", "upper", "")
    + JOINT.format("mimic", "prismatic", "upper", "finger", '<mimic joint="grip"/>')
    + JOINT.format("grip", "prismatic", "upper", "thumb", "")
    + "</robot>"
)


@pytest.mark.parametrize(
    ("efforts", "expected"),
    [
        (("elbow",), ["elbow"]),  # nothing tells what the gripper did
        (("elbow", "grip"), ["elbow", "grip"]),
        ((), ["elbow", "grip"]),  # to be filled in
    ],
)
def test_a_urdf_gets_motors_where_a_column_may_tell_about_them(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    efforts: tuple[str, ...],
    expected: list[str],
) -> None:
    """A finger that mimics another has none, and one without a column keeps nobody waiting."""
    by_names = "bo_sysid.starter.init.by_behaviour"  # of a motion that nothing explains: slow
    monkeypatch.setattr(by_names, lambda model, tables, rules: rules)
    (tmp_path / "arm.urdf").write_text(GRIPPER)
    log = {"elbow_pos": np.sin(3 * TIME), "grip_pos": 0.02 * np.cos(5 * TIME)}
    log |= {f"{name}_effort": np.cos(TIME) for name in efforts}
    started = init(
        tmp_path / "arm.urdf", [written(tmp_path / "log.csv", log)], tmp_path / "arm.yaml"
    )
    assert started.rules.following == ("mimic",)
    assert started.rules.unmatched == (() if efforts else ("elbow", "grip"))
    exported = mujoco.MjModel.from_xml_path(str(tmp_path / "arm_motors.xml"))
    assert [exported.actuator(a).name for a in range(exported.nu)] == expected
    dropped = "drives grip, which got no motor"
    assert any(dropped in n for n in started.notes) == (efforts == ("elbow",))
    passive = "If nothing drives the machine, write model: arm.urdf and remove the lines of ctrl."
    assert (passive in started.notes) == (not efforts)


@pytest.mark.parametrize(
    "hung",
    ['pos="0 .3 -.1"', 'pos="0 0 -.1"'],  # the second is its own mirror image
)
def test_a_machine_that_was_released_gets_no_motors(tmp_path: Path, hung: str) -> None:
    """A pendulum that swings as the model says: its driver was to be filled in."""
    (tmp_path / "rod.xml").write_text(
        f"""<mujoco><option timestep="0.002"/><worldbody><body>
        <joint name="swing" axis="1 0 0" damping=".002"/><geom size=".02" {hung} mass=".2"/>
        </body></worldbody></mujoco>"""
    )
    model = Model.from_file(tmp_path / "rod.xml").compile()
    start = State(np.full((1, 1), 0.8), np.zeros((1, 1)), np.zeros((1, 0)))
    run = Engine(1).rollout(model, start, np.zeros((1, 5 * len(TIME), 0)))
    angle = run.qpos[0, :-1:5, 0] + 1e-3 * np.random.default_rng(0).standard_normal(len(TIME))
    log = written(tmp_path / "log.csv", {"swing (deg)": np.rad2deg(angle)})
    started = init(tmp_path / "rod.xml", [log], tmp_path / "rod.yaml")
    assert started.rules.to_fill_in == ()
    assert Study.load(tmp_path / "rod.yaml").model.file == "rod.xml"
    assert any("moves as if nothing did" in note for note in started.notes)
    assert not (tmp_path / "rod_motors.xml").exists()


CASTER = """
<mujoco><worldbody><body name="cart"><joint name="wheel"/><geom size=".1"/>
  <body name="caster" pos="0 0 -.2"><joint name="caster_ball" type="ball"/><geom size=".03"/>
  </body></body>{}</worldbody>{}
  <actuator><motor name="wheel" joint="wheel"/></actuator></mujoco>"""
ROD = '<body name="rod"><joint name="rod"/><geom size=".1"/></body>'
CLOSED = '<equality><connect body1="caster" body2="rod" anchor="0 0 0"/></equality>'


@pytest.mark.parametrize(
    ("recorded", "elsewhere", "equality", "expected"),
    [
        (False, "", "", ("caster_ball",)),
        (True, "", "", ()),
        (False, ROD, CLOSED, ()),  # it moves as the loop asks
    ],
)
def test_a_ball_joint_that_was_not_recorded_is_held(
    tmp_path: Path, recorded: bool, elsewhere: str, equality: str, expected: tuple[str, ...]
) -> None:
    (tmp_path / "cart.xml").write_text(CASTER.format(elsewhere, equality))
    wave = np.sin(3 * TIME)
    log = {f"qpos.caster_ball.{k}": np.full(len(TIME), float(k == 0)) for k in range(4 * recorded)}
    log |= {"wheel_pos": wave, "rod_pos": 0.5 * wave, "wheel_torque": np.cos(TIME)}
    (table,) = read_tables(written(tmp_path / "log.csv", log))
    rules = guess_rules(Model.from_file(tmp_path / "cart.xml"), table)
    assert rules.held == expected
    assert "caster_ball" not in rules.following


def test_a_study_holds_a_ball_joint_and_says_what_it_would_be_read_from(tmp_path: Path) -> None:
    (tmp_path / "cart.xml").write_text(CASTER.format("", ""))
    log = {"wheel_pos": np.sin(3 * TIME), "wheel_torque": np.cos(TIME), "spare": np.cos(9 * TIME)}
    path = init(
        tmp_path / "cart.xml", [written(tmp_path / "log.csv", log)], tmp_path / "cart.yaml"
    ).path
    study, text = Study.load(path), path.read_text()
    assert study.model.hold == ("caster_ball",)
    assert "not recorded, so held where the model puts them: caster_ball" in text
    assert "# qpos.caster_ball.3: {from: FILL IN}  # or held; one of: spare" in text
    assert load_model(study).qpos_channels == ("qpos.wheel",)


def test_a_study_of_a_joint_with_quotes_in_its_name_can_be_read(tmp_path: Path) -> None:
    (tmp_path / "wheel.xml").write_text(
        "<mujoco><worldbody><body><joint name='\"front\"<b>'/><geom size='.1'/></body></worldbody>"
        "<actuator><motor name='m' joint='\"front\"<b>'/></actuator></mujoco>"
    )
    log = written(tmp_path / "log.csv", {"q": np.sin(5 * TIME), "torque": np.cos(5 * TIME)})
    path = init(tmp_path / "wheel.xml", [log], tmp_path / "wheel.yaml").path
    bounds = Study.load(path).parameter_set(Model.from_file(tmp_path / "wheel.xml"))
    assert 'joint["front"<b>].damping' in {p.addresses[0] for p in bounds}
