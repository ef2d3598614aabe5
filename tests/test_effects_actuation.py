"""Actuators, servos and sensors against what physics says of them."""

import mujoco
import numpy as np
import pytest
from effect_bench import MOTOR, PENDULUM, SERVO, SLIDE, Bench, G, pendulum

from bo_sysid.effects import (
    CATALOGUE,
    Filter,
    Machine,
    Part,
    Reading,
    Site,
    applicable,
    extent_at,
    survey,
    unit_at,
)
from bo_sysid.effects.actuation import supply_of
from bo_sysid.effects.balance import balance_notes, balancing_activations
from bo_sysid.effects.readings import readings
from bo_sysid.mjcf import Model, parameter_edits
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Channel, Recording
from bo_sysid.recording.alignment import control_steps
from bo_sysid.simulation import Engine, State
from bo_sysid.simulation.bristles import bristle_motors
from bo_sysid.simulation.lockstep import force_laws

GOAL = 1.0
VOLTS = 24 - 6 * np.linspace(0, 1, 2000)


@pytest.fixture(scope="module")
def slide() -> Bench:
    return Bench(SLIDE, {"voltage": VOLTS})


def rest(bench: Bench, model: mujoco.MjModel, goal: float = GOAL) -> float:
    _, q, v = bench.run(model, (), 6.0, ctrl=goal)
    assert np.abs(v[-1]).max() < 1e-6
    return float(q[-1, 0])


def balance(kp: float, goal: float) -> float:
    """Return where a servo holds the pendulum: kp (goal - q) = m g l sin q."""
    q = goal
    for _ in range(200):
        q = goal - 0.5 * G * 0.2 * np.sin(q) / kp
    return q


@pytest.mark.parametrize("servo", [SERVO, SERVO.replace('kv="1"', 'dampratio="1"')])
class TestServo:
    def test_a_gain_moves_the_rest_only_by_what_gravity_loads(self, servo) -> None:
        arm = pendulum(servo)
        loaded, _ = arm.edited("actuator_gain", "actuator", "servo", [0.2])
        assert rest(arm, loaded) == pytest.approx(balance(12, GOAL), abs=1e-5)
        assert abs(rest(arm, loaded) - balance(10, GOAL)) > 5e-3
        loaded.opt.gravity[:] = 0
        assert rest(arm, loaded) == pytest.approx(GOAL, abs=1e-6)

    def test_kp_moves_the_rest_as_another_servo_would(self, servo) -> None:
        arm = pendulum(servo)
        model, _ = arm.edited("servo_kp", "actuator", "servo", [5.0])
        assert rest(arm, model) == pytest.approx(balance(15, GOAL), abs=1e-5)
        other = pendulum('<actuator><position name="servo" joint="hinge" kp="15"/></actuator>')
        np.testing.assert_allclose(
            model.actuator_biasprm[0, :2], other.machine.model.actuator_biasprm[0, :2]
        )

    def test_kd_adds_damping(self, servo) -> None:
        arm = pendulum(servo)
        before = arm.machine.model.actuator_biasprm[0, 2]
        model, _ = arm.edited("servo_kd", "actuator", "servo", [0.7])
        assert model.actuator_biasprm[0, 2] == pytest.approx(before - 0.7)

    @pytest.mark.parametrize("way", [(1, 0), (0, 0), (0, 1)])
    def test_an_encoder_that_scales_ends_where_its_reading_is_the_goal(self, servo, way) -> None:
        arm = pendulum(servo)
        model, readings = arm.edited("encoder_scale", "joint", "hinge", [0.1, *way])
        model.opt.gravity[:] = 0
        assert 1.1 * rest(arm, model) == pytest.approx(GOAL, abs=1e-6)
        assert readings[0] == Reading("qpos.hinge", scale=0.1, encoder=True)


@pytest.mark.parametrize(
    ("way", "torque"),
    [
        ((1, 0), lambda kp, kd, u, q, v: kp * (u - 1.1 * q) - kd * 1.1 * v),
        ((0, 0), lambda kp, kd, u, q, v: kp * (u - 1.1 * q) - kd * v),
        ((0, 1), lambda kp, kd, u, q, v: kp * (u / 1.1 - q) - kd * v),
    ],
)
def test_what_a_servo_takes_from_an_encoder_that_scales(way, torque) -> None:
    arm = pendulum(SERVO)
    bias, joint = arm.machine.actuators["servo"].bias, arm.machine.joints["hinge"]
    model, _ = arm.edited("encoder_scale", "joint", "hinge", [0.1, *way])
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[joint.dof], data.ctrl[0] = 0.3, -0.7, 0.5
    mujoco.mj_forward(model, data)
    expected = torque(-bias[1], -bias[2], 0.5, 0.3, -0.7)
    assert data.actuator_force[0] == pytest.approx(expected)


def test_an_encoder_that_scales_the_goal_scales_what_normalised_controls_ask_for() -> None:
    """Controls of -1 to 1 ask for -.3 to .7 rad: the constant bias is of the goal."""
    servo = (
        '<actuator><general name="servo" joint="hinge" gainprm="10" biastype="affine" '
        'biasprm="4 -20 -1"/></actuator>'
    )
    model, _ = pendulum(servo).edited("encoder_scale", "joint", "hinge", [0.1, 0, 1])
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.ctrl[0] = 0.2, -0.7, 0.3
    mujoco.mj_forward(model, data)
    goal = (10 * 0.3 + 4) / 20
    assert data.actuator_force[0] == pytest.approx(20 * (goal / 1.1 - 0.2) + 0.7)


@pytest.mark.parametrize("share", [-0.5, 0.4])
def test_kp_of_normalised_controls_keeps_what_they_ask_for(share) -> None:
    """Controls of -1 to 1 ask for -.4 to .6 rad: the gain is no kp, which is 100 N m/rad."""
    servo = (
        '<actuator><general name="servo" joint="hinge" gainprm="50" biastype="affine" '
        'biasprm="10 -100 -2" ctrlrange="-1 1"/></actuator>'
    )
    arm, effect, site = pendulum(servo), CATALOGUE["servo_kp"], Site("actuator", "servo")
    assert effect.nominal(site, arm.machine) == 100.0
    extent = effect.extent(site, arm.machine)
    assert (extent.probe, extent.low, extent.high) == ((2.0,), (-90.0,), (300.0,))
    x, q, v, u = 100.0 * share, 0.3, -0.7, 0.8
    model, _ = arm.edited("servo_kp", "actuator", "servo", [x])
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.ctrl[0] = q, v, u
    mujoco.mj_forward(model, data)
    goal = 0.1 + 0.5 * u
    assert data.actuator_force[0] == pytest.approx((100.0 + x) * (goal - q) - 2.0 * v)
    assert rest(arm, model, u) == pytest.approx(balance(100.0 + x, goal), abs=1e-5)


def test_a_servo_ends_where_an_encoder_with_an_offset_reads_its_goal() -> None:
    arm = pendulum(SERVO)
    model, (reading,) = arm.edited("encoder_offset", "joint", "hinge", [0.2])
    model.opt.gravity[:] = 0
    assert rest(arm, model) + reading.offset == pytest.approx(GOAL)


@pytest.mark.parametrize("limits", ["", 'ctrlrange="-.4 .4"'])
@pytest.mark.parametrize(("gear", "gain", "bias"), [(2, 10, -10), (1, 0.2, -12), (-3, 4, -2)])
def test_an_encoder_offset_is_what_the_servo_reads_whatever_gear_gain_and_range(
    gear, gain, bias, limits
) -> None:
    """What the control asks for is clipped, what the encoder reads is not."""
    servo = (
        f'<actuator><general name="servo" joint="hinge" gear="{gear}" gainprm="{gain}" '
        f'biastype="affine" biasprm="0.3 {bias} -1" {limits}/></actuator>'
    )
    arm, offset, u, q, v = pendulum(servo), 0.2, 0.5, 0.3, -0.7
    model, _ = arm.edited("encoder_offset", "joint", "hinge", [offset])
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.ctrl[0] = q, v, u
    mujoco.mj_forward(model, data)
    told = min(u, 0.4) if limits else u
    expected = gain * told + 0.3 + bias * gear * (q + offset) - gear * v
    assert data.actuator_force[0] == pytest.approx(expected)


def test_back_emf_limits_the_speed(slide) -> None:
    _, _, v = slide.effect("back_emf", "actuator", "drive", [4.0], 6.0, ctrl=0.5)
    assert v[-1, 0] == pytest.approx(3 * 0.5 / 4.0, rel=1e-4)


def test_back_emf_is_for_motors_and_kd_for_servos() -> None:
    for xml, emf, kd in ((MOTOR, 1, 0), (SERVO, 0, 1)):
        machine = pendulum(xml).machine
        assert len(applicable(CATALOGUE["back_emf"], machine)) == emf
        assert len(applicable(CATALOGUE["servo_kd"], machine)) == kd


def test_saturation_clips_the_force(slide) -> None:
    model, _ = slide.edited("actuator_saturation", "actuator", "drive", [1.0])
    top = slide.machine.actuators["drive"].force_max - 1.0
    for u, force in ((0.1, 0.3), (5.0, top), (-5.0, -top)):
        t, _, v = slide.run(model, (), 0.1, ctrl=u)
        assert v[-1, 0] / t[-1] == pytest.approx(force / 2)


@pytest.mark.parametrize("volts", [24.0, 21.0, 18.0])
def test_a_full_sag_makes_torque_follow_the_voltage(slide, volts) -> None:
    t, _, v = slide.effect(
        "voltage_sag", "actuator", "drive", [6.0], 0.1, ctrl=0.5, signals={"aux.voltage": volts}
    )
    assert v[-1, 0] / t[-1] == pytest.approx(3 * 0.5 / 2 * volts / 24)


def test_voltage_sag_needs_a_voltage_that_sags() -> None:
    for aux, sites in (({}, 0), ({"voltage": VOLTS}, 1), ({"voltage": 0 * VOLTS + 24}, 0)):
        assert len(applicable(CATALOGUE["voltage_sag"], Bench(SLIDE, aux).machine)) == sites


@pytest.mark.parametrize(
    ("aux", "supply"),
    [
        (["forearm_voltage", "arm_voltage"], "aux.arm_voltage"),
        (["fore_arm_voltage", "voltage"], "aux.voltage"),
        (["arm.volts", "voltage"], "aux.arm.volts"),
        (["forearm_voltage"], "aux.forearm_voltage"),  # names no actuator
        (["fore_arm_voltage"], None),  # another motor's
    ],
)
def test_a_supply_belongs_to_the_actuator_that_it_names_as_a_whole(aux, supply) -> None:
    motors = "".join(f'<motor name="{n}" joint="hinge"/>' for n in ("arm", "fore_arm"))
    xml = PENDULUM.format(actuator=f"<actuator>{motors}</actuator>", damping=0)
    machine = Bench(xml, {n: VOLTS - k for k, n in enumerate(aux)}).machine
    assert supply_of(Site("actuator", "arm"), machine) == supply


def filtered(bench: Bench, id: str, x: float, channel: Channel, dt: float = 0.001) -> Channel:
    _, (part,) = bench.edited(id, "actuator", "drive", [x])
    assert isinstance(part, Filter)
    return part.change(channel, dt)


class TestCommandRate:
    @pytest.fixture
    def step(self) -> Channel:
        t = np.arange(0, 1, 0.001)
        return Channel(t, (t >= 0.1 - 1e-9) * 1.0, hold="zero")

    def lost(self, bench: Bench, rate: float) -> float:
        x = np.array([1.0])
        told = CATALOGUE["command_rate"].reported(x, bench.machine, Site("actuator", "drive"))
        return told + 1.0 - rate

    def test_a_step_becomes_a_ramp(self, slide, step) -> None:
        out = filtered(slide, "command_rate", self.lost(slide, 0.5), step)
        ramp = np.clip((out.time + 0.0005 - 0.1) * 0.5, 0, 1)  # mean over each step
        np.testing.assert_allclose(out.values[1:], ramp[1:], atol=3e-4)

    def test_it_does_not_depend_on_the_time_step(self, slide, step) -> None:
        lost = self.lost(slide, 7.3)
        coarse = filtered(slide, "command_rate", lost, step, 0.004)
        fine = filtered(slide, "command_rate", lost, step, 0.001)
        mean = fine.values[: len(fine.values) // 4 * 4].reshape(-1, 4).mean(axis=1)
        both = slice(min(len(mean), len(coarse.values)))
        np.testing.assert_allclose(coarse.values[both], mean[both], atol=1e-9)

    def test_slow_commands_pass(self, slide) -> None:
        t = np.arange(0, 1, 0.001)
        slow = Channel(t, np.floor(t * 100) / 100, hold="zero")  # steps of 0.01
        out = filtered(slide, "command_rate", self.lost(slide, 1e3), slow)
        np.testing.assert_allclose(out.at(t + 5e-4), slow.at(t + 5e-4), atol=1e-4)


def moved(model: mujoco.MjModel, ctrl: np.ndarray) -> np.ndarray:
    """Return where plain MuJoCo has a model's first coordinate after each of its controls."""
    data, out = mujoco.MjData(model), []
    for u in ctrl:
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        out.append(data.qpos[0])
    return np.array(out)


class TestWritten:
    """Filters that plain MJCF can say move the machine alike."""

    @pytest.mark.parametrize(
        ("id", "x", "share"),
        [
            ("actuator_delay", 0.0127, 1e-6),
            ("actuator_delay", 0.006, 1e-6),
            ("actuator_lag", 0.05, 0.012),  # within half a step of 1 ms
            ("actuator_lag", 0.01, 0.06),
        ],
    )
    def test_as_the_filter_does(self, slide, id, x, share) -> None:
        dt, steps = 0.001, 1500
        t = np.arange(steps) * dt
        u = np.where(t > 0.2, np.sin(20 * t) + (t > 0.7), 0.0)  # at rest while the history fills
        model, (part,) = slide.edited(id, "actuator", "drive", [x])
        channel = part.change(Channel(t, u, hold="zero"), dt)
        one = moved(model, control_steps(channel, np.zeros(1), steps, dt)[0])
        written, parts = slide.edited(id, "actuator", "drive", [x], written=True)
        assert parts == ()
        assert written.nu == 1
        two = moved(written, u)
        nominal = moved(slide.model.compile(), u)
        np.testing.assert_allclose(two, one, atol=share * np.abs(one - nominal).max() + 1e-9)

    def test_a_delay_below_a_step_stays_a_filter(self, slide) -> None:
        model, (part,) = slide.edited("actuator_delay", "actuator", "drive", [4e-4], written=True)
        assert isinstance(part, Filter)
        assert not model.actuator_delay.any()


class TestReadings:
    def test_what_they_are(self) -> None:
        arm = pendulum(SERVO)
        for id, x, expected in (
            ("sensor_offset", 0.3, Reading("qpos.hinge", offset=0.3)),
            ("sensor_scale", 0.3, Reading("qpos.hinge", scale=0.3)),
            ("sensor_delay", 0.02, Reading("qpos.hinge", delay=0.02)),
            ("sensor_sign", 1.0, Reading("qpos.hinge", scale=-2.0)),
        ):
            _, (part,) = arm.edited(id, "channel", "qpos.hinge", [x])
            assert part == expected

    def test_offset_and_scale_of_a_motors_encoder_are_the_encoders(self) -> None:
        for xml, sites in ((MOTOR, 0), (SERVO, 1)):
            machine = pendulum(xml).machine
            for id in ("sensor_offset", "sensor_scale"):
                assert len(applicable(CATALOGUE[id], machine)) == sites

    def test_two_channels_swap(self) -> None:
        arm = Bench("""<mujoco><worldbody><body><joint name="a" axis="0 1 0"/>
          <geom size=".1"/><body><joint name="b" axis="0 1 0"/><geom size=".1"/>
          <body><joint name="rail" type="slide"/><geom size=".1"/></body></body></body>
          </worldbody></mujoco>""")
        effect = CATALOGUE["channel_swap"]
        assert [s.name for s in applicable(effect, arm.machine)] == [
            "qpos.a"
        ]  # once, like with like
        extent = effect.extent(Site("channel", "qpos.a"), arm.machine)
        _, parts = arm.edited("channel_swap", "channel", "qpos.a", list(extent.probe))
        assert parts == (
            Reading("qpos.a", source="qpos.b"),
            Reading("qpos.b", source="qpos.a"),
        )
        details = effect.details(np.array(extent.probe), arm.machine, Site("channel", "qpos.a"))
        assert list(details) == ["with qpos.b"]


def test_a_limit_of_the_model_is_never_raised() -> None:
    """A servo held at -3 and 5 N m: what is lost is counted from the largest force it can give."""
    arm = pendulum(SERVO.replace('kv="1"', 'kv="1" forcerange="-3 5"'))
    scale = arm.machine.actuators["servo"]
    assert scale.force_max == pytest.approx(5.0)
    for lost, expected in ((1.0, (-3.0, 4.0)), (4.0, (-1.0, 1.0))):
        model, _ = arm.edited("actuator_saturation", "actuator", "servo", [lost])
        np.testing.assert_allclose(model.actuator_forcerange[0], expected)
    site = Site("actuator", "servo")
    assert CATALOGUE["actuator_saturation"].nominal(site, arm.machine) == 5.0


def test_what_is_no_position_servo_has_no_proportional_gain() -> None:
    """A spring that an actuator of negative gain makes is none, and no bounds are out of order."""
    spring = """<actuator><general name="servo" joint="hinge" gainprm="-10"
      biastype="affine" biasprm="0 -10 -2"/></actuator>"""
    machine = pendulum(spring).machine
    assert CATALOGUE["servo_kp"].extent(Site("actuator", "servo"), machine) is None


QUADROTOR = """<mujoco><worldbody><body name="frame" pos="0 0 1"><freejoint name="base"/>
  <geom type="box" size=".1 .1 .02" mass="1"/><site name="left" pos=".1 0 0"/>
  <site name="right" pos="-.1 0 0"/></body></worldbody>
  <actuator><motor name="left" site="left" gear="0 0 1 0 0 .016"/>
  <motor name="right" site="right" gear="0 0 1 0 0 -.016"/></actuator></mujoco>"""


GRIPPER = """<mujoco><worldbody>
<body><joint name="left" type="{kind}" axis="0 1 0"/><geom size=".1"/></body>
<body pos="1 0 0"><joint name="right" type="{kind}" axis="0 1 0"/><geom size=".1"/></body>
</worldbody><tendon><fixed name="split"><joint joint="left" coef=".5"/>
<joint joint="right" coef=".5"/></fixed></tendon>
<actuator><motor name="grip" tendon="split"/></actuator></mujoco>"""


@pytest.mark.parametrize(("kind", "unit"), [("slide", "N"), ("hinge", "N m")])
def test_what_pulls_at_a_tendon_of_slides_is_a_force_and_at_one_of_hinges_a_torque(
    kind: str, unit: str
) -> None:
    time = np.arange(0.0, 1.0, 0.01)
    moved = {"left": np.sin(time), "right": np.cos(time)}
    log = Recording.from_arrays(time, qpos=moved, ctrl={"grip": np.sin(9 * time)})
    machine = survey(mujoco.MjModel.from_xml_string(GRIPPER.format(kind=kind)), [log])
    assert unit_at("N m", Site("actuator", "grip"), machine) == unit


def test_a_propeller_can_be_weak_late_and_limited() -> None:
    """It acts at a site, on no joint; its forces are in N, and a weak one tilts the frame."""
    spec = mujoco.MjSpec.from_string(QUADROTOR)
    time = np.arange(0.0, 1.0, 0.01)
    u = 4.9 + np.sin(time)
    pose = {f"base.{k}": np.zeros(100) for k in range(7)}
    log = Recording.from_arrays(time, qpos=pose, ctrl={"left": u, "right": u})
    machine = survey(spec.compile(), [log])
    site = Site("actuator", "left")
    assert site in applicable(CATALOGUE["actuator_gain"], machine)
    for id in ("actuator_lag", "actuator_delay", "actuator_deadzone", "actuator_saturation"):
        assert CATALOGUE[id].extent(site, machine) is not None
    for id in ("servo_kp", "back_emf"):  # they need a joint
        assert CATALOGUE[id].extent(site, machine) is None
    assert unit_at("N m", site, machine) == "N"
    CATALOGUE["actuator_gain"].parts(spec, site, np.array([-0.06]), machine)
    data = mujoco.MjData(weak := spec.compile())
    data.ctrl[:] = 5.0
    mujoco.mj_forward(weak, data)
    lever, inertia = 0.1, weak.body_inertia[1, 1]
    assert data.qacc[4] == pytest.approx(0.06 * 5.0 * lever / inertia, rel=1e-6)
    limited = CATALOGUE["actuator_saturation"]
    assert limited.reported(np.array([1.0]), machine, site) == pytest.approx(float(u.max()) - 1.0)


@pytest.mark.parametrize("flag", ["", '<option><flag clampctrl="disable"/></option>'])
@pytest.mark.parametrize(
    ("gear", "joint", "drive"),
    [
        (3, "", 'forcerange="-1.5 2"'),
        (3, 'actuatorfrcrange="-4.5 6"', ""),
        (-3, 'actuatorfrcrange="-4.5 6"', 'forcerange="-1.7 2"'),
    ],
)
def test_forces_that_laws_read_are_clipped_as_mujoco_does(gear, joint, drive, flag) -> None:
    """Commands of policies lie beyond the control range; the actuator does not."""
    model = Model.from_xml(
        f'<mujoco>{flag}<worldbody><body><joint name="j" {joint}/><geom size=".1" mass="1"/></body>'
        f'</worldbody><actuator><general name="a" joint="j" gear="{gear}" gainprm="2" '
        f'biastype="affine" biasprm=".1 -1 -.2" ctrlrange="-1 1" {drive}/></actuator></mujoco>'
    ).compile()
    time = np.arange(200) * 0.01
    u, q = 2.5 * np.sin(3 * time), 0.4 * np.sin(2 * time)
    log = Recording.from_arrays(time, qpos={"j": q}, ctrl={"a": u})
    scale = survey(model, [log]).actuators["a"]
    data, v = mujoco.MjData(model), 0.8 * np.cos(2 * time)
    applied = np.empty(200)
    for k in range(200):
        data.ctrl[0], data.qpos[0], data.qvel[0] = u[k], q[k], v[k]
        mujoco.mj_forward(model, data)
        applied[k] = data.qfrc_actuator[0]
    np.testing.assert_allclose(scale.force(u, q, v), applied, atol=1e-12)
    assert scale.force_max == pytest.approx(np.abs(applied).max(), rel=0.02)
    machine, site = survey(model, [log]), Site("actuator", "a")
    (late,) = CATALOGUE["actuator_delay"].parts(mujoco.MjSpec(), site, np.array([0.01]), machine)
    sent = late.change(log.channels["ctrl.a"], 0.002).values
    np.testing.assert_array_equal(sent, u if flag else np.clip(u, -1.0, 1.0))
    most = CATALOGUE["actuator_saturation"].nominal(site, machine)
    assert most == pytest.approx(
        np.abs(scale.force(np.array([-9.0, 9.0]), 0 * q[:2], 0 * v[:2])).max()
    )


LIMITED = (  # a joint whose actuators' forces are limited together, as by `effort` in a URDF
    '<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" actuatorfrcrange="-1 2"/>'
    '<geom size=".1" pos="0 .3 0" mass="1"/></body></worldbody><actuator>{drives}</actuator>'
    "</mujoco>"
)
DRIVE = '<motor name="{name}" joint="j" gear="{gear}"/>'


def written(effect: str, joint: str, x: list[float], machine: Machine):
    """Return the edit that writes an effect at a joint into a model's file."""
    return lambda spec: CATALOGUE[effect].write(spec, Site("joint", joint), np.array(x), machine)


@pytest.mark.parametrize("gear", [1.0, -4.0])
def test_friction_and_cogging_are_not_clipped_with_the_motor(gear: float) -> None:
    """A motor at its limit of 2 N m against friction of .5: the joint feels 1.5."""
    model = Model.from_xml(LIMITED.format(drives=DRIVE.format(name="m", gear=gear)))
    time = np.arange(400) * 0.01
    log = Recording.from_arrays(time, qpos={"j": np.sin(3 * time)}, ctrl={"m": np.sin(time)})
    machine = survey(model.compile(), [log])
    rub = ("stribeck_friction", [0.0, 0.5, 0.01, 1e-4], [2.0 - 0.5, -1.0 - 0.5])
    for effect, x, expected in (rub, ("cogging", [0.0, -0.7, 3.0], [2.0 - 0.7, -1.0 - 0.7])):
        compiled = model.compile([written(effect, "j", x, machine)])
        data = mujoco.MjData(compiled)
        for wanted, total in zip((9.0, -9.0), expected, strict=True):
            data.ctrl[0], data.qvel[0] = wanted / gear, 5.0
            bent = bristle_motors(compiled)
            friction = compiled.actuator_biasprm[bent, 3] / compiled.actuator_dynprm[bent, 5]
            data.act[:] = friction  # they slide
            mujoco.mj_forward(compiled, data)
            assert data.qfrc_actuator[0] == pytest.approx(total, rel=1e-3)


def test_a_limit_of_several_motors_together_stays() -> None:
    drives = DRIVE.format(name="m", gear=1) + DRIVE.format(name="n", gear=1)
    model = Model.from_xml(LIMITED.format(drives=drives))
    time = np.arange(400) * 0.01
    told = {"m": np.sin(time), "n": np.sin(time)}
    log = Recording.from_arrays(time, qpos={"j": np.sin(3 * time)}, ctrl=told)
    machine = survey(model.compile(), [log])
    compiled = model.compile([written("cogging", "j", [0.0, -0.7, 3.0], machine)])
    assert compiled.jnt_actfrclimited.all()
    assert not compiled.actuator_forcelimited.any()


@pytest.mark.parametrize(
    ("drive", "follows"),
    [
        ('<position name="a" joint="j" kp="40" kv="2" timeconst=".1"/>', True),
        ('<general name="a" joint="j" dyntype="filter" dynprm=".2" ctrlrange="-.4 .4"/>', True),
        ('<intvelocity name="a" joint="j" kp="40" kv="3" actrange="-.5 .5"/>', False),
    ],
)
def test_forces_of_actuators_with_memory_are_those_of_their_activations(drive, follows) -> None:
    """Steps of the control, of which plain MuJoCo makes much less than the command asks for."""
    plant = mujoco.MjModel.from_xml_string(
        '<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" axis="0 1 0" '
        'damping=".1"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/></body>'
        f"</worldbody><actuator>{drive}</actuator></mujoco>"
    )
    data, rows = mujoco.MjData(plant), []
    for k in range(2000):
        data.ctrl[0] = (0.0, 0.6, -0.6, 0.9)[k // 100 % 4]
        rows.append([data.time, data.qpos[0], data.ctrl[0]])
        mujoco.mj_step(plant, data)
        rows[-1].append(data.qfrc_actuator[0])
    time, q, u, force = np.transpose(rows)
    log = Recording.from_arrays(time, qpos={"j": q}, ctrl={"a": u})
    scale = survey(plant, [log]).actuators["a"]
    assert scale.force_max == pytest.approx(np.abs(force).max(), rel=0.15)
    assert scale.force_std == pytest.approx(force.std(), rel=0.1)
    assert (scale.plain, scale.follows) == (True, follows)


class TestCommandsBeyondTheirRange:
    """MuJoCo clips a command before an activation or a delay acts on it."""

    LIMITED = SLIDE.replace('gear="3"', 'gear="3" ctrlrange="-.4 .4"')
    WAVE = 1.2 * np.sin(9 * np.arange(2000) * 0.001)

    @pytest.mark.parametrize(
        ("id", "x", "plain"),
        [
            ("actuator_lag", 0.05, 'dyntype="filterexact" dynprm=".0495"'),
            ("actuator_delay", 0.02, 'delay=".02" nsample="21" interp="linear"'),
        ],
    )
    def test_a_filter_acts_on_what_plain_mujoco_acts_on(self, id, x, plain) -> None:
        bench, dt = Bench(self.LIMITED), 0.001
        truth = self.LIMITED.replace("<motor", f"<general {plain}")
        wanted = moved(mujoco.MjModel.from_xml_string(truth), self.WAVE)
        told = Channel(np.arange(2000) * dt, self.WAVE, hold="zero")
        out = control_steps(filtered(bench, id, x, told), np.zeros(1), 2000, dt)[0]
        nominal = bench.model.compile()
        found, plainly = moved(nominal, out), moved(nominal, self.WAVE)
        assert np.abs(found - wanted).max() < 0.01 * np.abs(plainly - wanted).max()

    @pytest.mark.parametrize("way", ["zoh", "linear"])
    def test_more_of_a_delay_in_a_file_is_what_was_fitted(self, way) -> None:
        """One that is held, and no multiple of the step, was interpolated from then on."""
        late = f'delay=".0105" nsample="40" interp="{way}"'
        bench = Bench(self.LIMITED.replace("<motor", f"<motor {late}"))
        model, parts = bench.edited("actuator_delay", "actuator", "drive", [0.003], written=True)
        told, dt = Channel(np.arange(2000) * 0.001, self.WAVE, hold="zero"), 0.001
        fitted = filtered(bench, "actuator_delay", 0.003, told)
        u, sent = control_steps(fitted, np.zeros(1), 2000, dt)[0], self.WAVE
        if parts:
            sent = control_steps(parts[0].change(told, dt), np.zeros(1), 2000, dt)[0]
        nominal = bench.model.compile()
        plainly, wanted = moved(nominal, self.WAVE), moved(nominal, u)
        assert np.abs(moved(model, sent) - wanted).max() < 0.02 * np.abs(plainly - wanted).max()

    def test_a_dead_zone_cuts_from_what_is_left(self) -> None:
        told = Channel(np.arange(2.0), np.full(2, 1.2), hold="zero")
        out = filtered(Bench(self.LIMITED), "actuator_deadzone", 0.1, told)
        np.testing.assert_allclose(out.values, 0.3)

    @pytest.mark.parametrize(
        "before", ["", '<dcmotor joint="x" input="none" motorconst="1e-9" resistance="1"/>']
    )
    def test_scales_are_those_of_what_acts(self, before) -> None:
        """Also behind an actuator without a control."""
        xml = self.LIMITED.replace("<actuator>", f"<actuator>{before}")
        t = np.arange(2000) * 0.002
        u = 1.2 * np.sign(np.sin(9 * t))
        recording = Recording.from_arrays(t, qpos={"x": np.sin(2 * t)}, ctrl={"drive": u})
        drive = survey(Model.from_xml(xml).compile(), [recording]).actuators["drive"]
        assert drive.ctrl_limits == (-0.4, 0.4)
        assert drive.ctrl_max == pytest.approx(0.4)
        assert drive.ctrl_std == pytest.approx(0.4, rel=1e-2)
        assert drive.jumps[0] == pytest.approx(0.8)


def test_a_force_that_goes_with_the_drive_follows_what_lags_behind_the_command() -> None:
    """Friction of a share of the torque, against steps of plain MuJoCo and its activation."""
    model = Model.from_xml(
        '<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" damping="5"/>'
        '<geom size=".1" pos="0 .3 0" mass="1"/></body></worldbody><actuator>'
        '<general name="m" joint="j" gainprm="4" dyntype="filterexact" dynprm=".1"/></actuator>'
        "</mujoco>"
    )
    time = np.arange(500) * 0.002
    u = np.sign(np.sin(2 * np.pi * 3 * time + 0.1))
    log = Recording.from_arrays(time, qpos={"j": np.sin(3 * time)}, ctrl={"m": u})
    compiled = model.compile()
    machine, share = survey(compiled, [log]), 0.2
    rub = CATALOGUE["load_dependent_friction"].parts
    parts = rub(model.spec(), Site("joint", "j"), np.array([share, 0.0]), machine)
    start = State(np.zeros((1, 1)), np.full((1, 1), 0.1), np.zeros((1, 1)))
    found = Engine(1).rollout(compiled, start, u[None, :, None], laws=force_laws(parts))
    data = mujoco.MjData(compiled)
    data.qvel[0], inertia = 0.1, machine.joints["j"].inertia
    for k in range(len(u)):
        v, data.ctrl[0] = data.qvel[0], u[k]
        stopping = 0.5 * inertia * abs(v) / compiled.opt.timestep
        data.qfrc_applied[0] = -np.sign(v) * min(share * abs(4 * data.act[0]), stopping)
        mujoco.mj_step(compiled, data)
        assert found.qpos[0, k + 1, 0] == pytest.approx(data.qpos[0], abs=1e-12)


@pytest.mark.parametrize("first", ["encoder_scale", "encoder_offset"])
@pytest.mark.parametrize("way", [(1.0, 0.0), (1.0, 1.0)], ids=["position", "goal"])
def test_a_servo_goes_by_what_an_encoder_with_two_faults_reads(first: str, way) -> None:
    """It rests where the channel shows its goal, in whichever order the two are named."""
    arm, hinge = pendulum(SERVO), Site("joint", "hinge")
    told = {"encoder_scale": np.array([0.5, *way]), "encoder_offset": np.array([0.05])}
    order = sorted(told, key=lambda name: name != first)
    parts: list[Part] = []

    def edit(spec: mujoco.MjSpec) -> None:
        parts[:] = [p for e in order for p in CATALOGUE[e].parts(spec, hinge, told[e], arm.machine)]

    model = arm.model.compile([edit])
    model.opt.gravity[:] = 0
    shown = readings(parts)["qpos.hinge"]
    assert (1 + shown.scale) * rest(arm, model) + shown.offset == pytest.approx(GOAL, abs=1e-6)


@pytest.mark.parametrize("lost", [(0.4, 0.05), (0.05, 0.4)])
def test_of_two_limits_the_tighter_one_stays(lost: tuple[float, float]) -> None:
    arm = pendulum(MOTOR)
    made, at = CATALOGUE["actuator_saturation"], Site("actuator", "motor")
    most = arm.machine.actuators["motor"].force_max

    def edit(spec: mujoco.MjSpec) -> None:
        for x in lost:
            made.parts(spec, at, np.array([x]), arm.machine)

    limits = arm.model.compile([edit]).actuator_forcerange[0]
    np.testing.assert_allclose(limits, [0.4 - most, most - 0.4])


def test_magnitudes_are_of_the_machine_whose_parameters_were_fitted() -> None:
    """A gear of 2, where the model has 1."""
    arm = pendulum(MOTOR)
    fitted = [Parameter("gear", ("actuator[motor].gear[0]",), 0.1, 5.0)]

    def made(id: str, site: Site, x: list[float]) -> mujoco.MjModel:
        def edit(spec: mujoco.MjSpec) -> None:
            CATALOGUE[id].parts(spec, site, np.array(x), arm.machine)

        return arm.model.compile([*parameter_edits(arm.model, fitted, [2.0]), edit])

    def torque(model: mujoco.MjModel, ctrl: float, v: float) -> float:
        data = mujoco.MjData(model)
        data.ctrl[0], data.qvel[0] = ctrl, v
        mujoco.mj_forward(model, data)
        return float(data.qfrc_actuator[0])

    motor, most = Site("actuator", "motor"), arm.machine.actuators["motor"].force_max
    assert torque(made("back_emf", motor, [0.3]), 0.0, 1.0) == pytest.approx(-0.3)
    limited = made("actuator_saturation", motor, [0.4])
    assert torque(limited, 10.0, 0.0) == pytest.approx(most - 0.4)


@pytest.mark.parametrize(
    "drive",
    ['<position name="d" joint="hinge" kp="10" gear="0"/>',
     '<motor name="d" joint="hinge" ctrlrange="-10 10" forcerange="3 10"/>'],
)  # fmt: skip
def test_what_cannot_be_weaker_is_looked_for_at_no_idle_drive(drive: str) -> None:
    arm = pendulum(f"<actuator>{drive}</actuator>")
    found = {}
    for id in ("servo_kd", "servo_kp", "actuator_saturation", "back_emf"):
        at = Site("actuator", "d")
        if (extent := extent_at(CATALOGUE[id], at, arm.machine)) is not None:
            found[id] = arm.edited(id, "actuator", "d", list(extent.probe))
    assert "actuator_saturation" not in found, "it has no torque that could be less"


@pytest.mark.parametrize("other", ["", '<motor name="other" joint="j"/>'])
def test_where_an_integrating_servo_begins_is_told_as_it_is_done(other: str) -> None:
    """Beside another drive it is not known what it holds, and where it begins may be far off."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/>'
        '</body></worldbody><actuator><intvelocity name="a" joint="j" kp="40" kv="3" '
        f'actrange="-9 9"/>{other}</actuator></mujoco>'
    )
    time = np.arange(0.0, 2.0, 0.01)
    sent = {"a": np.cos(time), **({"other": np.sin(time)} if other else {})}
    log = Recording.from_arrays(time, qpos={"j": np.sin(time)}, ctrl=sent)
    (note,) = balance_notes(model, log)
    assert ("no constant force on j can be told" in note) == (not other)
    assert ("it would hold nothing" in note and "act.a is needed" in note) == bool(other)
    found = balancing_activations(model, log, 0)
    assert found is not None
    held = found[1] - np.interp(found[0], time, np.sin(time))
    assert (np.abs(held).max() < 0.1) == bool(other)  # beside the weight of .2 m, 50 N over kp
    recorded = Recording.from_arrays(
        time, qpos={"j": np.sin(time)}, ctrl=sent, act={"a": np.sin(time)}
    )
    assert balance_notes(model, recorded) == ()
