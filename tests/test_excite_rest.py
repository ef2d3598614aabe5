"""Plans of machines that gravity pulls: held at rest, within limits whatever is not known."""

import itertools
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import StudyError
from bo_sysid.excite.excite import excite
from bo_sysid.excite.limits import Limits
from bo_sysid.excite.rest import corners, held, holding
from bo_sysid.excite.trial import Trial
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.simulation import ForceLaw
from bo_sysid.study import Study
from bo_sysid.study.outer import Limit

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/><joint axis="0 1 0"/></default>
  <worldbody><body>
    <joint name="shoulder" damping=".3" frictionloss=".4"/>
    <geom name="upper" type="capsule" fromto="0 0 0 .4 0 0" size=".02" mass="1"/>
    <body pos=".4 0 0">
      <joint name="elbow" damping=".1" stiffness="2" springref=".3"/>
      <geom name="fore" type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/></body>
  </body></worldbody>
  <actuator><motor name="s" joint="shoulder" gear="10" ctrlrange="-2 2"/>
    <motor name="e" joint="elbow" gear="4" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
G = 9.81
HOLD = np.array([  # [N m]; gravity turns a link that lies along x towards +q, the spring its own
    -(1.0 * 0.2 + 0.5 * 0.55) * G, -0.5 * 0.15 * G - 2.0 * 0.3
])  # fmt: skip
LIMITS = {
    "shoulder": {"position": [-0.4, 0.3], "velocity": 2.0, "effort": 10},
    "elbow": {"position": [-0.25, 0.8], "velocity": 3.0, "effort": 4},
}
PARAMETERS = [
    {"name": "spring", "address": "joint[elbow].stiffness", "low": 1.5, "high": 2.5},
    {"name": "friction", "address": "joint[shoulder].frictionloss", "low": 0.3, "high": 0.6},
]
POLE = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="hinge" axis="0 1 0" damping=".01"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 .4" size=".02" mass=".5"/></body></worldbody>
  <actuator><motor name="m" joint="hinge" ctrlrange="-2 2"/></actuator>
</mujoco>
"""
MASS = (Parameter("mass", ("geom[rod].mass",), 0.45, 0.55),)


def study(folder: Path, **changes: object) -> Study:
    (folder / "arm.xml").write_text(ARM)
    data = {
        "model": "arm.xml",
        "recordings": {"train": "later.csv"},
        "parameters": PARAMETERS,
        "limits": LIMITS,
    }
    return Study.from_dict(data | changes, folder)


def pole(text: str, seconds: float, position: tuple[float, float] = (-1.0, 1.0)) -> Trial:
    model = Model.from_xml(text)
    limits = Limits.of(model, {"hinge": Limit(position=position)})
    return Trial(model, MASS, limits, {"qpos.hinge": 1e-3}, seconds=seconds, interval=0.02)


def test_controls_hold_an_arm_against_gravity_and_springs() -> None:
    model, ends = Model.from_xml(ARM), np.array([2.0, 1.0])
    hold = holding(model.compile(), (), -ends, ends)
    np.testing.assert_allclose(hold.ctrl, HOLD / [10, 4], rtol=1e-9)
    np.testing.assert_allclose(hold.given, HOLD, rtol=1e-9)
    data = mujoco.MjData(model.compile())
    data.ctrl[:] = hold.ctrl
    mujoco.mj_step(model.compile(), data, 400)
    np.testing.assert_allclose(data.qpos, 0.0, atol=1e-9)


def test_controls_hold_against_forces_beside_the_model() -> None:
    model, ends = Model.from_xml(ARM), np.array([2.0, 1.0])
    laws = [ForceLaw("elbow", lambda motion: 0.7 + motion.qpos["elbow"])]
    hold = holding(model.compile(), laws, -ends, ends)
    np.testing.assert_allclose(hold.ctrl * [10, 4], HOLD - [0.0, 0.7], rtol=1e-9)


def test_a_servo_and_a_filtered_motor_hold() -> None:
    motor = '<motor name="s" joint="shoulder" gear="10" ctrlrange="-2 2"/>'
    filtered = (
        '<general name="s" joint="shoulder" dyntype="filter" dynprm=".05" gainprm="10"/>'
        '<position name="p" joint="shoulder" kp="50"/>'
    )
    compiled = Model.from_xml(ARM.replace(motor, filtered)).compile()
    ends = np.array([2.0, 2.0, 1.0])
    hold = holding(compiled, (), -ends, ends)
    ctrl = hold.ctrl
    assert 10 * ctrl[0] + 50 * ctrl[1] == pytest.approx(HOLD[0])
    start = held(compiled, ctrl)
    np.testing.assert_allclose(start.act, [[ctrl[0]]])


@pytest.mark.parametrize("spring", [(1.95, 2.05), (1.5, 2.5)])
def test_limits_are_kept_under_gravity_at_all_corners(
    spring: tuple[float, float], tmp_path: Path
) -> None:
    parameters = [PARAMETERS[0] | dict(zip(("low", "high"), spring, strict=True)), PARAMETERS[1]]
    told = study(tmp_path, parameters=parameters)
    found = excite(told, seconds=4.0, interval=0.02, budget=28)
    assert found.parameters["of_range"].max() < 0.2
    assert any("Controls rest at s" in n for n in found.notes)
    ctrl = found.controls[["ctrl.s", "ctrl.e"]].to_numpy()
    assert np.ptp(ctrl, axis=0).min() > 0.01
    if spring[0] > 1.9:
        np.testing.assert_allclose(ctrl[0], HOLD / [10, 4], rtol=1e-9)
    friction = (0.3, 0.6)
    for stiffness, loss in itertools.product((*spring, 2.0), (*friction, 0.4)):
        model = mujoco.MjModel.from_xml_string(ARM)
        model.jnt_stiffness[1], model.dof_frictionloss[0] = stiffness, loss
        _kept(model, ctrl)


def _kept(model: mujoco.MjModel, ctrl: np.ndarray) -> None:
    data = mujoco.MjData(model)
    for u in np.repeat(ctrl, 4, axis=0):
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        for j, limit in enumerate(LIMITS.values()):
            assert limit["position"][0] <= data.qpos[j] <= limit["position"][1]
            assert abs(data.qvel[j]) <= limit["velocity"]
            assert abs(data.qfrc_actuator[j]) <= limit["effort"]


FLAT = POLE.replace("<option ", '<option gravity="0 0 0" ').replace('damping=".01"', 'damping="1"')
MOTOR = '<motor name="m" joint="hinge" ctrlrange="-2 2"/>'


@pytest.mark.parametrize(
    "drive",
    [
        MOTOR.replace("-2 2", "0 4"),
        '<position name="m" joint="hinge" kp="20" kv="1"/>',
        '<velocity name="m" joint="hinge" kv="2" ctrlrange="-1 3"/>',
        '<position name="m" joint="hinge" kp="20" kv="1" timeconst=".1"/>',
    ],
)
def test_a_plan_begins_and_ends_without_a_step_where_the_range_of_a_control_is_lopsided(
    drive: str,
) -> None:
    """No gravity: what holds the machine is no force at all."""
    made = pole(FLAT.replace(MOTOR, drive), 1.0, (-0.3, 2.5))
    np.testing.assert_allclose(made.series.at_rest, 0.0, atol=1e-9)
    controls = made.series.controls(np.ones((1, made.series.size)))[0]
    np.testing.assert_allclose(controls[0], 0.0, atol=1e-9)
    assert np.abs(controls).max() > 0.1
    model = made.model.compile()
    data = mujoco.MjData(model)
    data.ctrl[:], data.act[:] = controls[0], made.start.act[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator, 0.0, atol=1e-9)


def test_lags_start_at_the_controls_that_rest() -> None:
    lag = '<general name="m" joint="hinge" dyntype="filter" dynprm=".1" ctrlrange="-3 3"/>'
    lying = POLE.replace("0 0 .4", ".4 0 0").replace(MOTOR, lag)
    made = pole(lying, 1.0, (-9.0, 9.0))
    np.testing.assert_allclose(made.series.at_rest, -0.5 * G * 0.2)
    np.testing.assert_allclose(made.start.act, [made.series.at_rest])
    assert made.left < 1e-6


@pytest.mark.parametrize(
    ("ends", "low", "said"),
    [
        ("-2 2", 0.45, "rest at m -0.981, which hold the model"),
        ("-.5 2", 0.45, "rest at m -0.5, which come nearest to holding the model"),
        ("-2 2", 0.1, "rest in the middle of their ranges"),  # under that force the lightest spins
    ],
)
def test_what_controls_do_at_rest_is_told(ends: str, low: float, said: str, tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(POLE.replace("0 0 .4", ".4 0 0").replace("-2 2", ends))
    data = {
        "model": "arm.xml", "recordings": {"train": "later.csv"},
        "parameters": [{"address": "geom[rod].mass", "low": low, "high": 0.55}],
        "limits": {"hinge": {"velocity": 20}},
    }  # fmt: skip
    found = excite(Study.from_dict(data, tmp_path), seconds=1.0, interval=0.02, budget=28)
    assert any(said in n for n in found.notes)
    assert found.used <= 1.0


def test_what_drifts_whatever_is_done_is_refused_before_the_search(tmp_path: Path) -> None:
    wide = [{"name": "fore", "address": "geom[fore].mass", "low": 0.1, "high": 2.0}]
    tried: list[int] = []
    with pytest.raises(StudyError) as error:
        excite(
            study(tmp_path, parameters=wide), seconds=4.0, interval=0.02, budget=28,
            report=lambda done, cost: tried.append(done),
        )  # fmt: skip
    assert str(error.value).startswith("limits: ")
    assert "with fore" in str(error.value)
    assert "it drifts under controls that are constant" in str(error.value)
    assert "widen limits, or narrow low and high of parameters" in str(error.value)
    assert max(tried) == 0


def test_actuators_that_are_too_weak_are_named(tmp_path: Path) -> None:
    weak = {**LIMITS, "shoulder": {**LIMITS["shoulder"], "effort": 3}}
    with pytest.raises(StudyError, match=r"shoulder needs -4.66 there, actuators give -3 within"):
        excite(study(tmp_path, limits=weak), seconds=2.0, interval=0.02, budget=28)


def test_a_reference_outside_the_limits_is_named() -> None:
    with pytest.raises(
        StudyError, match=r"hinge: position is 0 rad \(limit 0.5 to 0.6\) at the model's reference"
    ):
        pole(POLE, 2.0, (0.5, 0.6))


def test_an_unstable_reference_is_refused_with_joint_limit_value_and_time() -> None:
    with pytest.raises(StudyError) as error:
        pole(POLE, 10.0)
    text = str(error.value)
    inertia, torque = 0.5 * 0.4**2 / 3, 0.5 * G * 0.2  # of a thin rod
    rate = np.sqrt(torque / inertia)
    falls = np.log(2 / 1e-4) / rate  # of 1e-4 cosh(rate t) to 1 rad
    said = float(text.split(" after ")[1].split(" s ")[0])
    assert said == pytest.approx(falls, rel=0.1)
    assert text.startswith("limits: hinge: position is -1.")
    assert "(limit -1 to 1)" in text
    assert "unstable" in text
    assert f"plan less than {said:.2g} s (--seconds)" in text
    pole(POLE, 1.0)  # shorter than it falls


def test_a_machine_that_stands_at_its_limit_is_not_shrunk_for_ever() -> None:
    hanging = POLE.replace("0 0 .4", "0 0 -.4")
    d = pole(hanging, 1.0, (0.0, 1.0))
    t = d.series.time[:, None]
    with pytest.raises(StudyError, match=r"hinge: position is -.* \(limit 0 to 1\) .* smallest"):
        d.safe(-np.sin(2 * np.pi * t))


def test_corners_are_those_of_the_box() -> None:
    found = corners(np.array([1.0, -2.0]), np.array([3.0, 5.0]), np.zeros((1, 2)))
    assert {tuple(c) for c in found} == {(1, -2), (1, 5), (3, -2), (3, 5)}
    many = corners(np.zeros(7), np.ones(7), np.random.default_rng(0).random((32, 7)))
    assert set(np.unique(many)) == {0.0, 1.0}
