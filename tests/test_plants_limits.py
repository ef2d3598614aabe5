"""Limits bind commands by clipping, positions and velocities by ending the episode."""

import itertools

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import ModelError, StudyError, UserError
from bo_sysid.mjcf import Model, address_edit, parameter_edits
from bo_sysid.plants.build import build_plant, record
from bo_sysid.plants.effects import realised
from bo_sysid.plants.environment import BatchEnvironment, control_range
from bo_sysid.plants.limits import LimitedTask, limit_edits
from bo_sysid.plants.machine import VectorMachine
from bo_sysid.plants.repeat import RepeatedTask
from bo_sysid.plants.tasks import Start, find_task
from bo_sysid.plants.tasks.base import VectorTask
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model

ARM = """
<mujoco>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
      <body name="lower" pos="0 0 -0.5">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" gear="4" ctrlrange="-3 3"/>
    <position name="elbow" joint="elbow" kp="20" ctrlrange="-3 3"/>
  </actuator>
</mujoco>
"""


STUCK = (  # friction, as a diagnosis writes it: an actuator without a control
    '<general name="stuck" joint="shoulder" dyntype="dcmotor" dynprm="0 0 0 0 0 20 .1" input="none"'
    ' gaintype="dcmotor" biastype="dcmotor" gainprm="1 1e-6" biasprm="0 0 0 .1 .15 .1" actdim="1" '
    'actearly="true"/>'
)


class Standing(VectorTask):
    """A task that asks for nothing."""

    control_timestep, time_limit = 0.002, 1.0

    def draw_start(self, model, rng):
        return Start(model.qpos0)

    def get_observation(self, sims):
        return sims.qpos

    def get_reward(self, sims):
        return np.zeros(len(sims))


def study(tmp_path, limits):
    (tmp_path / "arm.xml").write_text(ARM)
    data = {"model": "arm.xml", "recordings": {"train": ["none.csv"]}, "limits": limits}
    return Study.from_dict(data, tmp_path)


def test_commands_are_narrowed_to_what_the_limits_allow(tmp_path):
    limits = {"shoulder": {"effort": 2.0}, "elbow": {"effort": 5.0, "position": [-0.5, 1.0]}}
    model = Model.from_xml(ARM)
    made = model.compile(limit_edits(study(tmp_path, limits), model))
    low, high = control_range(made)
    np.testing.assert_allclose(low, [-0.5, -0.5])  # 2 N m through a gear of 4
    np.testing.assert_allclose(high, [0.5, 1.0])
    np.testing.assert_allclose(made.actuator_forcerange[1], [-5.0, 5.0])
    assert not limit_edits(study(tmp_path, {}), model)


def test_a_servo_of_any_gear_and_gain_is_told_no_position_beyond_its_limits(tmp_path):
    given = '<position name="elbow" joint="elbow" kp="20" ctrlrange="-3 3"/>'
    servo = (
        '<general name="elbow" joint="elbow" gear="-2" gainprm="0.2" biastype="affine" '
        'biasprm="0.4 -12 -8"/>'
    )
    text = ARM.replace(given, servo)
    option = '<option gravity="0 0 0" integrator="implicitfast"/><worldbody>'
    model = Model.from_xml(text.replace("<worldbody>", option, 1))
    limits = {"elbow": {"position": [-0.5, 1.0]}}
    made = model.compile(limit_edits(study(tmp_path, limits), model))
    rests = []
    for command in control_range(made):
        data = mujoco.MjData(made)
        data.ctrl[1] = command[1]
        mujoco.mj_step(made, data, 10000)
        assert abs(data.qvel[1]) < 1e-6
        rests.append(data.qpos[1])
    np.testing.assert_allclose(sorted(rests), [-0.5, 1.0], atol=1e-5)


@pytest.mark.parametrize("limited", ["auto", "true"])
def test_a_servo_that_inherits_the_range_of_its_joint_is_narrowed(tmp_path, limited):
    text = ARM.replace('<joint name="elbow"', '<joint name="elbow" range="-100 100"')
    inherits = f'kp="20" inheritrange="1" ctrllimited="{limited}"'
    model = Model.from_xml(text.replace('kp="20" ctrlrange="-3 3"', inherits))
    limits = {"elbow": {"position": [-0.5, 1.0]}}
    made = model.compile(limit_edits(study(tmp_path, limits), model))
    np.testing.assert_allclose(made.actuator_ctrlrange[1], [-0.5, 1.0])
    data = mujoco.MjData(made)
    data.ctrl[1] = 1.7
    mujoco.mj_forward(made, data)
    assert data.actuator_force[1] == pytest.approx(20 * 1.0)


def test_an_integrator_keeps_the_range_that_it_inherits(tmp_path):
    """It is that of its activation, not of its control, which is a rate."""
    text = ARM.replace('<joint name="elbow"', '<joint name="elbow" range="-100 100"')
    given = '<position name="elbow" joint="elbow" kp="20" ctrlrange="-3 3"/>'
    rated = '<intvelocity name="elbow" joint="elbow" kp="20" inheritrange="1" ctrlrange="-3 3"/>'
    model = Model.from_xml(text.replace(given, rated))
    limits = {"elbow": {"position": [-0.5, 1.0]}}
    made = model.compile(limit_edits(study(tmp_path, limits), model))
    np.testing.assert_allclose(made.actuator_actrange[1], np.radians([-100, 100]))


def test_a_velocity_servo_keeps_to_the_effort_however_fast_its_joint_is(tmp_path):
    servo = '<velocity name="shoulder" joint="shoulder" gear="2" kv="1.5" ctrlrange="-9 9"/>'
    text = ARM.replace('<motor name="shoulder" joint="shoulder" gear="4" ctrlrange="-3 3"/>', servo)
    model = Model.from_xml(text)
    made = model.compile(limit_edits(study(tmp_path, {"shoulder": {"effort": 2.0}}), model))
    data = mujoco.MjData(made)
    for speed in (-30.0, -1.0, 0.0, 0.2, 30.0):
        for command in control_range(made):
            data.qvel[0], data.ctrl[0] = speed, command[0]
            mujoco.mj_forward(made, data)
            assert abs(data.qfrc_actuator[0]) <= 2.0 + 1e-9
            free = 2 * 1.5 * (command[0] - 2 * speed)  # r k (u - r v)
            assert data.qfrc_actuator[0] == pytest.approx(np.clip(free, -2.0, 2.0))
    weak = Model.from_xml(text.replace(servo, servo.replace("kv", 'forcerange="-.3 .3" kv')))
    made = weak.compile(limit_edits(study(tmp_path, {"shoulder": {"effort": 2.0}}), weak))
    np.testing.assert_allclose(made.actuator_forcerange[0], [-0.3, 0.3])  # its own is narrower


@pytest.mark.parametrize(
    "actuator",
    [
        '<dcmotor joint="elbow" motorconst="1" resistance="0.1" ctrlrange="-24 24"/>',
        '<dcmotor joint="elbow" motorconst="0.1" resistance="1" ctrlrange="-24 24"/>',
        '<general joint="elbow" gainprm="10" dyntype="integrator" actrange="-5 5" '
        'ctrlrange="-10 10"/>',
        '<intvelocity joint="elbow" kp="50" actrange="-3 3" ctrlrange="-2 2"/>',
        '<general joint="elbow" gaintype="affine" gainprm="1 0 0.5" ctrlrange="-10 10"/>',
        '<muscle joint="elbow" force="80" lengthrange="0.1 3" ctrlrange="0 1"/>',
    ],
)
def test_an_effort_is_kept_whatever_commands_mean(tmp_path, actuator):
    """And commands keep their range where neither the effort nor a position says what they are."""
    given = '<position name="elbow" joint="elbow" kp="20" ctrlrange="-3 3"/>'
    named = actuator.replace("joint=", 'name="elbow" joint=', 1)
    model = Model.from_xml(ARM.replace(given, named))
    limits = {"elbow": {"effort": 2.0, "position": [-0.5, 1.0]}}
    made, own = model.compile(limit_edits(study(tmp_path, limits), model)), model.compile()
    np.testing.assert_array_equal(made.actuator_ctrlrange[1], own.actuator_ctrlrange[1])
    data, most = mujoco.MjData(made), 0.0
    for command in control_range(made):
        data.ctrl[1] = command[1]
        for _ in range(500):
            mujoco.mj_step(made, data)
            most = max(most, abs(data.qfrc_actuator[1]))
    assert most == pytest.approx(2.0)


@pytest.mark.parametrize(("own", "kept"), [("-1 5", [-1, 5]), ("-1 50", [-1, 10]), ("3 5", [3, 5])])
def test_an_effort_widens_no_range_of_the_model(tmp_path, own, kept):
    model = Model.from_xml(ARM.replace('kp="20"', f'kp="20" forcerange="{own}"'))
    made = model.compile(limit_edits(study(tmp_path, {"elbow": {"effort": 10.0}}), model))
    np.testing.assert_allclose(made.actuator_forcerange[1], kept)
    if own == "3 5":
        with pytest.raises(StudyError, match="leaves actuator 'elbow' no force"):
            limit_edits(study(tmp_path, {"elbow": {"effort": 2.0}}), model)


def test_a_plant_that_saturates_below_its_limits_still_does(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    weak = {"effect": "actuator_saturation", "kind": "actuator", "site": "elbow"}
    data = {
        "model": "arm.xml", "recordings": {"train": ["none.csv"]},
        "limits": {"elbow": {"effort": 5.0}},
    }  # fmt: skip
    model = Model.from_xml(ARM)

    def most(lost: float) -> list[float]:
        bound = Study.from_dict({**data, "plant": {"effects": [{**weak, "value": lost}]}}, tmp_path)
        effects = realised(bound, model).edits
        made = [model.compile(effects), model.compile([*effects, *limit_edits(bound, model)])]
        return [float(m.actuator_forcerange[1, 1]) for m in made]

    alone, kept = most(1.0)
    assert kept == 5.0 < alone  # what it gives at most is beyond the effort
    alone, kept = most(alone + 1.0 - 2.0)
    assert kept == alone == pytest.approx(2.0)


def test_a_force_range_that_is_a_parameter_differs_between_candidates(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM.replace('kp="20"', 'kp="20" forcerange="-4 4"'))
    most = {"address": "actuator[elbow].forcerange[1]", "low": 1.0, "high": 6.0}
    data = {
        "model": "arm.xml", "recordings": {"train": ["none.csv"]}, "parameters": [most],
        "limits": {"elbow": {"effort": 5.0}},
    }  # fmt: skip
    uncertain = Study.from_dict(data, tmp_path)
    model = load_model(uncertain)
    narrowed = limit_edits(uncertain, model)
    for value, kept in ((1.0, 1.0), (3.0, 3.0), (6.0, 5.0)):
        edits = parameter_edits(model, uncertain.parameter_set(model), [value])
        made = model.compile([*edits, *narrowed])
        np.testing.assert_allclose(made.actuator_forcerange[1], [-4.0, kept])


def test_an_actuator_without_a_control_is_not_limited(tmp_path):
    limits = {"shoulder": {"effort": 2.0}, "elbow": {"position": [-0.5, 1.0]}}
    model = Model.from_xml(ARM.replace("<actuator>", f"<actuator>{STUCK}"))
    made = model.compile(limit_edits(study(tmp_path, limits), model))
    np.testing.assert_allclose(control_range(made), [[-0.5, -0.5], [0.5, 1.0]])
    without = ARM.replace("<actuator>", f"<actuator>{STUCK}").replace(' ctrlrange="-3 3"', "", 1)
    with pytest.raises(ModelError, match="actuator 'shoulder' has no control range"):
        control_range(Model.from_xml(without).compile())


def test_a_plant_keeps_to_them_whatever_is_commanded(tmp_path):
    bound = study(tmp_path, {"shoulder": {"effort": 2.0}})
    free = study(tmp_path, {})
    much, allowed = np.tile([3.0, 0.0], (50, 1)), np.tile([0.5, 0.0], (50, 1))
    positions = [
        build_plant(s).record(c).channels["qpos.shoulder"].values
        for s, c in ((bound, much), (free, allowed), (free, much))
    ]
    np.testing.assert_allclose(positions[0], positions[1], atol=1e-12)
    assert np.abs(positions[0] - positions[2]).max() > 0.01


def test_an_episode_ends_where_a_limit_of_motion_is_left():
    model = Model.from_dm_control("cartpole", "swingup")
    data = {
        "model": {"dm_control": {"domain": "cartpole", "task": "swingup"}},
        "recordings": {"train": ["none.csv"]},
        "limits": {"slider": {"position": [-0.3, 0.3], "velocity": 1.0}},
    }
    task = LimitedTask(find_task("cartpole", "swingup"), Study.from_dict(data), model)
    environment = BatchEnvironment(task, model.compile(), 2)
    environment.begin([Start(np.array([0.0, 3.1])), Start(np.array([0.0, 3.1]))])
    ended = None
    for k in range(200):
        step = environment.step(np.array([[1.0], [0.0]]))
        assert not step.terminated[1]
        if step.terminated[0]:
            ended = k
            break
        assert abs(environment.sims.qpos[0, 0]) <= 0.3
        assert abs(environment.sims.qvel[0, 0]) <= 1.0
    assert ended is not None


UNSTABLE = """
<mujoco><option timestep=".002"/>
  <worldbody><body><joint name="j" axis="0 1 0" stiffness="-2e7" armature="1e-3"/>
    <geom size=".02" pos="0 0 -.1" mass="1"/></body></worldbody>
  <actuator><motor name="m" joint="j" gear="100" ctrlrange="-1 1"/></actuator></mujoco>
"""


def test_a_simulation_that_diverges_within_an_action_has_left_its_limits(tmp_path):
    """MuJoCo puts it back at the reference, where it is within all limits again."""
    (tmp_path / "unstable.xml").write_text(UNSTABLE)
    data = {"model": "unstable.xml", "recordings": {"train": ["none.csv"]}}
    bound = Study.from_dict({**data, "limits": {"j": {"position": [-1.0, 1.0]}}}, tmp_path)
    model, standing = load_model(bound), Standing()
    standing.control_timestep = 0.02
    task = LimitedTask(standing, bound, model)
    environment = BatchEnvironment(task, model.compile(), 2)
    environment.reset()
    step = environment.step(np.array([[1.0], [0.0]]))
    assert step.terminated.tolist() == [True, False]
    assert np.abs(step.final[:, 0]).max() < 1.0
    assert task.beyond.tolist() == [True, False]
    environment.step(np.zeros((2, 1)))
    assert not task.beyond.any()


HELD = 25  # parts of an action


def swinging(repeat):
    """Return pendulum swing-up within 6 rad/s, and its compiled model."""
    model = Model.from_dm_control("pendulum", "swingup")
    data = {
        "model": {"dm_control": {"domain": "pendulum", "task": "swingup"}},
        "recordings": {"train": ["none.csv"]},
        "limits": {"hinge": {"velocity": 6.0}},
    }
    task = RepeatedTask(find_task("pendulum", "swingup"), repeat)
    return LimitedTask(task, Study.from_dict(data), model), model.compile()


def played(repeat, actions):
    """Return which episodes left the limits, their returns and the control steps they lasted."""
    task, model = swinging(repeat)
    environment = BatchEnvironment(task, model, len(actions), seed=3)
    environment.reset()
    running, total = np.ones(len(actions), bool), np.zeros(len(actions))
    left, lasted = np.zeros(len(actions), bool), np.zeros(len(actions), int)
    for k in range(1000 // HELD * (HELD // repeat)):
        step = environment.step(actions[:, k * repeat // HELD, None])
        total += np.where(running, step.reward, 0.0)
        lasted += running
        left |= running & task.beyond
        running &= ~(step.terminated | step.truncated)
    return left, total, lasted


def test_limits_that_are_left_within_a_held_action_end_the_episode_as_if_it_were_not_held():
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 1000 // HELD))
    fine, earned, parts = played(1, actions)
    held, total, lasted = played(HELD, actions)
    assert 0.2 < fine.mean() < 0.8
    np.testing.assert_array_equal(held, fine)
    np.testing.assert_allclose(total, earned, atol=1e-9)
    np.testing.assert_array_equal(lasted, -(-parts // HELD))


def test_a_machine_that_swings_out_and_back_within_an_action_has_left_its_limits():
    task, model = swinging(HELD)
    machine = VectorMachine(task, model, 0)
    for speed, ended in ((5.0, False), (7.0, True)):  # upwards from the bottom: it slows down
        machine.begin(Start(np.array([np.pi]), np.array([speed])))
        applied = machine.apply(np.zeros((1, 1)))
        assert np.abs(applied.rows["qvel"][-1]) < 6.0
        assert applied.ended == ended


def test_an_environment_begins_within_limits_though_the_reference_is_outside(tmp_path):
    bound, model = study(tmp_path, {"elbow": {"position": [0.1, 1.0]}}), Model.from_xml(ARM)
    task = LimitedTask(Standing(), bound, model)
    environment = BatchEnvironment(task, model.compile(), 2)
    environment.begin([Start(np.array([0.0, 0.5]))] * 2)
    assert not environment.step(np.zeros((2, 2))).terminated.any()


SHARED = """
<motor name="one" joint="shoulder" gear="4" ctrlrange="-3 3"/>
<motor name="two" joint="shoulder" gear="-1" ctrlrange="-3 3"/>
<velocity name="three" joint="shoulder" gear="2" kv="1.5" ctrlrange="-9 9"/>
"""
BOUNDS = {"actuator[one].gear[0]": (3.0, 5.0), "actuator[one].gainprm[0]": (0.5, 2.0),
          "actuator[three].gear[0]": (1.0, 3.0), "joint[elbow].damping": (0.0, 1.0)}  # fmt: skip


@pytest.mark.parametrize("known", [True, False])
def test_actuators_of_one_joint_keep_to_its_effort_together_on_every_machine(tmp_path, known):
    motor = '<motor name="shoulder" joint="shoulder" gear="4" ctrlrange="-3 3"/>'
    (tmp_path / "arm.xml").write_text(ARM.replace(motor, SHARED))
    parameters = [{"address": a, "low": x, "high": y} for a, (x, y) in BOUNDS.items()]
    data = {"model": "arm.xml", "recordings": {"train": ["none.csv"]},
            "limits": {"shoulder": {"effort": 2.0}}}  # fmt: skip
    uncertain = Study.from_dict(data | ({} if known else {"parameters": parameters}), tmp_path)
    model = Model.from_xml(ARM.replace(motor, SHARED))
    edits = limit_edits(uncertain, model)
    worst = 0.0
    for point in [()] if known else itertools.product(*BOUNDS.values()):
        own = [address_edit(model, [a], x) for a, x in zip(BOUNDS, point, strict=not known)]
        made = model.compile([*own, *edits])
        data = mujoco.MjData(made)
        for ends in itertools.product(*zip(*control_range(made), strict=True)):
            for speed in (-30.0, 0.0, 30.0):
                data.qvel[0], data.ctrl[:] = speed, ends
                mujoco.mj_forward(made, data)
                worst = max(worst, abs(data.qfrc_actuator[0]))
    assert worst == pytest.approx(2.0)


TENDON = """
  <tendon><fixed name="cord"><joint joint="elbow" coef="0.1"/></fixed></tendon>
  <actuator><motor name="cord" tendon="cord" ctrlrange="-1 1"/>
"""
SITE = '<actuator><motor name="fan" site="tip" gear="0 0 1 0 0 0" ctrlrange="-1 1"/>'


@pytest.mark.parametrize(
    ("drive", "name", "joint"),
    [(TENDON, "cord", "elbow"), (SITE, "fan", "elbow"), (SITE, "fan", "shoulder")],
)
def test_an_effort_along_a_joint_that_is_driven_from_elsewhere_is_refused(
    tmp_path, drive, name, joint
):
    tip = '<site name="tip" pos=".1 0 -.4"/></body>'
    model = Model.from_xml(ARM.replace("</body>", tip, 1).replace("<actuator>", drive))
    with pytest.raises(StudyError, match=f"limits.{joint}.effort: actuator '{name}' acts on it"):
        limit_edits(study(tmp_path, {joint: {"effort": 2.0}}), model)
    assert limit_edits(study(tmp_path, {joint: {"position": [-1.0, 1.0]}}), model)


def test_a_tendon_elsewhere_hinders_no_effort(tmp_path):
    model = Model.from_xml(ARM.replace("<actuator>", TENDON))
    made = model.compile(limit_edits(study(tmp_path, {"shoulder": {"effort": 2.0}}), model))
    np.testing.assert_allclose(control_range(made)[1], [1.0, 0.5, 3.0])


def test_an_excitation_needs_no_control_range_where_an_effort_is_stated(tmp_path):
    text = ARM.replace(' ctrlrange="-3 3"', "")
    limits = {"shoulder": {"effort": 2.0}, "elbow": {"position": [-0.5, 1.0]}}
    bound, model = study(tmp_path, limits), Model.from_xml(text)
    (tmp_path / "arm.xml").write_text(text)
    narrowed = limit_edits(bound, model)
    (recording,) = record(build_plant(bound), model, 1, duration=2.0, limits=narrowed)
    assert 0.2 < np.abs(recording.channels["ctrl.shoulder"].values).max() <= 0.5
    with pytest.raises(ModelError, match="an effort under limits"):
        record(build_plant(bound), model, 1, duration=2.0)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"sholder": {"effort": 1.0}}, "no such joint; did you mean 'shoulder'"),
        ({"elbow": {"position": [3.5, 4.0]}}, "leaves actuator 'elbow' no command"),
    ],
)
def test_wrong_limits_are_told(tmp_path, limits, message):
    with pytest.raises(StudyError, match=message):
        limit_edits(study(tmp_path, limits), Model.from_xml(ARM))


def test_a_limit_of_no_joint_is_told_before_a_task_keeps_it():
    data = {
        "model": {"dm_control": {"domain": "cartpole", "task": "swingup"}},
        "recordings": {"train": "x.csv"},
        "plant": {},
        "limits": {"slidr": {"velocity": 3.0}},
    }
    with pytest.raises(StudyError, match="no such joint; did you mean 'slider'"):
        build_plant(Study.from_dict(data))


def test_a_task_that_does_not_fit_is_named_however_it_is_wrapped():
    data = {
        "model": {"dm_control": {"domain": "cartpole", "task": "swingup"}},
        "recordings": {"train": "x.csv"},
        "task": {"dm_control": {"domain": "reacher", "task": "easy"}, "repeat": 2},
        "plant": {},
        "limits": {"slider": {"velocity": 3.0}},
    }
    with pytest.raises(UserError, match="task Reacher does not fit the model"):
        build_plant(Study.from_dict(data))
