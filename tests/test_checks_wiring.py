"""The wiring of logs that were spoilt on purpose, and of one that was not."""

import functools
from dataclasses import replace
from itertools import takewhile
from math import pi

import mujoco
import numpy as np
import pandas as pd
import pytest
from wiring_logs import ARM, SERVO, recorded, spoilt, tones

from bo_sysid.checks.balance import Dynamics, unexplained
from bo_sysid.checks.carriers import carriers
from bo_sysid.checks.channels import channel_flags
from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import Wire, WiringHypothesis
from bo_sysid.checks.motion import turned_inside
from bo_sysid.checks.moves import moves
from bo_sysid.checks.proposal import proposed_columns
from bo_sysid.checks.rewired import rewired
from bo_sysid.checks.search import SUSPICIOUS, search
from bo_sysid.checks.traces import Traces
from bo_sysid.checks.wiring import find_wiring
from bo_sysid.checks.wiring_text import wire_flags
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.touching import touched
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine, LawInputs, State

# friction with bristles, an actuator that no control commands
STUCK = (
    '<general name="stuck" joint="shoulder" dyntype="dcmotor" dynprm="0 0 0 0 0 20 .1" '
    'input="none" gaintype="dcmotor" biastype="dcmotor" gainprm="1 1e-6" actdim="1" '
    'biasprm="0 0 0 1e-9 1e-9 .1" actearly="true"/>'
)


SERVED = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="shoulder" axis="0 1 0" damping=".05" armature=".008"/>
      <geom type="capsule" fromto="0 0 0 .18 0 0" size=".012" mass=".22"/>
      <body pos=".18 0 0"><joint name="elbow" axis="0 1 0" damping=".03" armature=".006"/>
        <geom type="capsule" fromto="0 0 0 .15 0 0" size=".01" mass=".15"/></body></body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="5" kv=".25"/>
    <position name="elbow" joint="elbow" kp="3" kv=".15"/>
  </actuator>
</mujoco>
"""


def served(text: str = SERVED) -> Recording:
    """Return a log of two servos whose arm is a fifth heavier and rubs, sampled every 10 ms."""
    model = Model.from_xml(text)

    def edit(spec: mujoco.MjSpec) -> None:
        for geom, joint in zip(spec.geoms, spec.joints, strict=True):
            geom.mass *= 1.2
            joint.frictionloss = 0.05

    time = np.arange(0.0, 12.0, 0.01)
    ctrl = 0.5 * np.stack([tones(time, 1), tones(time, 2)], axis=1)
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    run = Engine(1).rollout(model.compile([edit]), start, np.repeat(ctrl, 5, axis=0)[None])
    noise = 4e-4 * np.random.default_rng(0).standard_normal((len(time), 2))
    names = ("shoulder", "elbow")
    return Recording.from_arrays(
        time,
        qpos=dict(zip(names, (run.qpos[0, ::5][:-1] + noise).T, strict=True)),
        ctrl=dict(zip(names, ctrl.T, strict=True)),
    )


def test_a_log_as_it_should_be_draws_no_alarm() -> None:
    found = spoilt(lambda values: None)
    assert found.wires == {}
    assert found.delay == 0.0
    assert [f for f in found.flags if f.level == "wrong"] == []
    assert found.balance["after"].max() < 0.05


def test_a_sign() -> None:
    def change(values: dict[str, np.ndarray]) -> None:
        values["ctrl.b"] *= -1

    found = spoilt(change)
    assert found.wires == {"ctrl.b": Wire("ctrl.b", sign=-1)}
    assert [f.kind for f in found.flags] == ["sign"]
    assert "ctrl.b" in found.flags[0].sentence


@pytest.mark.parametrize("speed", [True, False])
def test_an_encoder_that_counts_from_the_base(speed: bool) -> None:
    """The elbow's shows the sum of both angles, as one does that a belt drives from the base."""

    def change(values: dict[str, np.ndarray]) -> None:
        for kind in ("qpos", *(["qvel"] if speed else [])):
            values[f"{kind}.elbow"] += values[f"{kind}.shoulder"]

    found = spoilt(change)
    assert found.wires["qpos.elbow"] == Wire("qpos.elbow", less="qpos.shoulder")
    assert ("qvel.elbow" in found.wires) is speed
    assert found.balance["after"].max() < 0.05
    sentence = next(f.sentence for f in found.flags if f.kind == "absolute")
    assert "qpos.elbow shows qpos.shoulder as well" in sentence
    written = {"qpos.elbow": {"from": "theta2", "unit": "deg"}}
    assert proposed_columns(written, found.wires, {})["qpos.elbow"] == {
        "from": "theta2", "unit": "deg", "less": "qpos.shoulder",
    }  # fmt: skip
    values = {n: c.values.copy() for n, c in recorded().channels.items()}
    change(values)
    shown = {n: Channel(c.time, values[n], hold=c.hold) for n, c in recorded().channels.items()}
    (log,) = rewired([Recording("log", shown)], found.wires, 0.0, "ctrl")
    own = recorded().channels["qpos.elbow"].values
    np.testing.assert_allclose(log.channels["qpos.elbow"].values, own, atol=1e-12)


def test_encoders_that_all_count_from_the_base_are_told_apart() -> None:
    """In a chain of three each shows what the one before it shows, and its own joint."""
    text = ARM.replace(
        "</body></body>",
        '<body pos="0 0 -.25"><joint name="wrist" axis="0 1 0" damping=".03"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -.15" size=".015" mass=".4"/></body></body></body>',
    ).replace("</actuator>", '<motor name="c" joint="wrist"/></actuator>')
    model = Model.from_xml(text).compile()
    assert carriers(model) == {"elbow": "shoulder", "wrist": "elbow"}
    time = np.arange(0.0, 12.0, 0.004)
    u = np.stack([2.0 * tones(time, 1), 0.8 * tones(time, 2), 0.2 * tones(time, 3)], axis=1)
    start = State(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 0)))
    run = Engine(1).rollout(model, start, np.repeat(u, 4, axis=0)[None])
    noise = 3e-4 * np.random.default_rng(0).standard_normal((len(time), 3))
    shown = np.cumsum(run.qpos[0, ::4][:-1], axis=1) + noise
    log = Recording.from_arrays(
        time,
        qpos=dict(zip(("shoulder", "elbow", "wrist"), shown.T, strict=True)),
        ctrl=dict(zip("abc", u.T, strict=True)),
    )
    found = find_wiring(model, [log])
    assert {n: w.less for n, w in found.wires.items()} == {
        "qpos.elbow": "qpos.shoulder", "qpos.wrist": "qpos.elbow",
    }  # fmt: skip


def test_joints_about_different_axes_do_not_carry_each_other() -> None:
    turned = ARM.replace('name="elbow" axis="0 1 0"', 'name="elbow" axis="1 0 0"')
    assert carriers(Model.from_xml(turned).compile()) == {}


@pytest.mark.parametrize("noise", [0.0, 2e-4])
def test_a_servo_that_a_brake_holds_has_no_other_zero(noise: float) -> None:
    """Where its goal is not, the brake bears the load: that tells no offset of the goal."""
    turning = ARM.replace('name="shoulder" axis="0 1 0"', 'name="shoulder" axis="0 0 1"')
    servo, elbow = (
        '<position name="b" joint="elbow" kp="20"/>',
        'name="elbow" axis="0 1 0" damping=',
    )
    model = Model.from_xml(turning.replace('<motor name="b" joint="elbow"/>', servo)).compile()
    fixed = Model.from_xml(turning.replace(f'{elbow}".05"', f'{elbow}"1e6"'))
    time = np.arange(0.0, 8.0, 0.004)
    start = State(np.array([[0.0, 0.4]]), np.zeros((1, 2)), np.zeros((1, 0)))
    u = np.stack([0.05 * tones(time, 1), np.zeros_like(time)], axis=1)
    run = Engine(1).rollout(fixed.compile(), start, np.repeat(u, 4, axis=0)[None])
    rng = np.random.default_rng(0)
    shoulder = run.qpos[0, ::4][:-1, 0] + 3e-4 * rng.standard_normal(len(time))
    log = Recording.from_arrays(
        time,
        qpos={"shoulder": shoulder, "elbow": 0.4 + noise * rng.standard_normal(len(time))},
        ctrl={"a": u[:, 0], "b": np.full_like(time, 0.4)},
    )
    assert "ctrl.b" not in find_wiring(model, [log]).wires


CRANE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="trolley" type="slide" axis="1 0 0"/><geom size=".1" mass="5"/>
      <body><joint name="sway" axis="0 1 0" damping=".05"/><geom size=".02" mass=".3"/>
        <body pos="0 0 -.5"><joint name="hoist" type="slide" axis="0 0 -1"/>
          <geom size=".06" mass="3"/></body></body></body>
  </worldbody>
  <actuator><motor name="drive" joint="trolley"/><motor name="winch" joint="hoist"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("turned", [True, False])
def test_a_sign_is_told_where_gravity_is_most_of_what_a_motor_bears(turned: bool) -> None:
    model = Model.from_xml(CRANE).compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    time = np.arange(0.0, 20.0, model.opt.timestep)
    goal = np.stack([0.3 * tones(time, 3), 0.03 + 0.03 * tones(time, 4)], axis=1)
    q, u = np.zeros((len(time), 3)), np.zeros((len(time), 2))
    for k, target in enumerate(goal):
        q[k] = data.qpos
        force = [40.0, 300.0] * (target - data.qpos[[0, 2]]) - [25.0, 60.0] * data.qvel[[0, 2]]
        data.ctrl = u[k] = force - [0.0, 3.0 * 9.81]
        mujoco.mj_step(model, data)
    q += 2e-4 * rng.standard_normal(q.shape)
    log = Recording.from_arrays(
        time[::5],
        qpos={"trolley": q[::5, 0], "sway": q[::5, 1], "hoist": (-q if turned else q)[::5, 2]},
        ctrl={"drive": u[::5, 0], "winch": u[::5, 1]},
    )
    found = find_wiring(model, [log])
    assert {n: w.sign for n, w in found.wires.items()} == ({"qpos.hoist": -1} if turned else {})


def test_an_actuator_without_a_control_stands_before_the_motors() -> None:
    log = recorded()
    channels = dict(log.channels)
    told = channels["ctrl.b"]
    channels["ctrl.b"] = Channel(told.time, -told.values, told.unit, "ctrl.b", told.hold)
    model = Model.from_xml(ARM.replace("<actuator>", f"<actuator>{STUCK}"))
    found = find_wiring(model.compile(), [Recording("log", channels)])
    assert found.wires == {"ctrl.b": Wire("ctrl.b", sign=-1)}
    assert channel_flags(model.compile(), [log]) == []


def test_an_order_and_a_late_clock_at_once() -> None:
    def change(values: dict[str, np.ndarray]) -> None:
        values["ctrl.a"], values["ctrl.b"] = values["ctrl.b"].copy(), values["ctrl.a"].copy()

    found = spoilt(change, late=0.043)
    assert found.wires == {"ctrl.a": Wire("ctrl.b"), "ctrl.b": Wire("ctrl.a")}
    assert found.delay == pytest.approx(0.043, abs=0.0015)
    assert {f.kind for f in found.flags if f.level == "wrong"} == {"order", "clock"}


def test_commands_in_the_place_of_positions() -> None:
    def change(values: dict[str, np.ndarray]) -> None:
        for q, u in (("qpos.shoulder", "ctrl.a"), ("qpos.elbow", "ctrl.b")):
            values[q], values[u] = values[u].copy(), values[q].copy()

    found = spoilt(change)
    assert found.wires["qpos.elbow"] == Wire("ctrl.b")
    assert found.wires["ctrl.a"] == Wire("qpos.shoulder")
    assert {f.kind for f in found.flags if f.level == "wrong"} == {"swap"}


@pytest.mark.parametrize("zero", [-0.3, 0.08])
def test_the_zero_of_an_encoder(zero: float) -> None:
    def change(values: dict[str, np.ndarray]) -> None:
        values["qpos.shoulder"] += zero

    found = spoilt(change)
    assert set(found.wires) == {"qpos.shoulder"}
    assert found.wires["qpos.shoulder"].offset == pytest.approx(-zero, abs=0.01)
    (told,) = (f.sentence for f in found.flags if f.kind == "zero")
    assert "A load that the model lacks, as a tool, or a base that is not level may look" in told


def test_ranges_tell_that_servos_count_from_one_end_where_forces_do_not() -> None:
    """About vertical axes no force hangs on a zero."""
    text = SERVED.replace('axis="0 1 0"', 'axis="0 0 1" limited="true" range="-150 150"')
    log = served(text)
    counted = {n: replace(c, values=c.values + pi) for n, c in log.channels.items()}
    found = find_wiring(Model.from_xml(text).compile(), [Recording("log", counted)])
    offsets = {n: w.offset for n, w in found.wires.items()}
    assert offsets == pytest.approx(dict.fromkeys(counted, -pi))


@pytest.mark.parametrize("turn", [2 * pi, 5 * pi / 3])
def test_servos_that_count_from_one_end_are_all_off_by_half_of_what_they_count(
    turn: float,
) -> None:
    """One fault explains all four, where another zero of the shoulder alone did nearly as well."""
    log = served()
    counted = {n: replace(c, values=c.values + turn / 2) for n, c in log.channels.items()}
    found = find_wiring(Model.from_xml(SERVED).compile(), [Recording("log", counted)])
    offsets = {n: w.offset for n, w in found.wires.items()}
    assert offsets == pytest.approx(dict.fromkeys(counted, -turn / 2), abs=0.02)


class Told(WiringEvidence):
    """What a log says of two encoders that turn the other way, the second hardly felt."""

    def __init__(self, late: float) -> None:
        self.joints, self.hinges, self.inputs, self.motors = ["a", "b"], {"a", "b"}, set(), set()
        self.stated, self.weights, self.late = {"qpos.a": "", "qpos.b": ""}, np.ones(2), late
        self.converted, self.carriers = set(), {}

    def scores(self, h: WiringHypothesis, delays) -> np.ndarray:
        felt = {"qpos.a": 3.0, "qpos.b": 0.85}
        wrong = sum(size for n, size in felt.items() if h.wires[n] != Wire(n, -1))
        return wrong + 5.0 * np.minimum(np.abs(np.array(delays) - self.late) / 0.012, 1.0)

    def value(self, h: WiringHypothesis, name: str, *, held: bool = False) -> np.ndarray:
        return np.array([-1.0, 1.0])

    def shares(self, h: WiringHypothesis, delays) -> np.ndarray:
        return np.repeat(self.scores(h, delays)[:, None] > 0.1, 2, axis=1).astype(float)

    def noise(self, h: WiringHypothesis) -> np.ndarray:
        return np.zeros(2)


@pytest.mark.parametrize("late", [0.0, 0.012])
def test_what_is_needed_is_kept_whenever_the_controls_act(late: float) -> None:
    first = WiringHypothesis({n: Wire(n) for n in ("qpos.a", "qpos.b")})
    found, _ = search(Told(late), first)
    assert found.delay == pytest.approx(late)
    assert found.wires == {n: Wire(n, -1) for n in first.wires}


def test_a_correction_that_leaves_much_is_not_proposed() -> None:
    """The elbow's command has the wrong sign, and something else pushes that no log has."""

    def change(values: dict[str, np.ndarray]) -> None:
        other = tones(0.004 * np.arange(len(values["ctrl.b"])), 7)
        values["ctrl.b"] = -(values["ctrl.b"] + 1.3 * other)

    found = spoilt(change)
    assert found.balance.set_index("joint").loc["elbow", "after"] > SUSPICIOUS
    assert found.wires == {}
    assert [f for f in found.flags if f.level == "wrong"] == []
    assert [f.channels for f in found.flags if f.kind == "balance"] == [("elbow",)]
    assert any("Perhaps: sign of ctrl.b" in f.sentence for f in found.flags)


def test_inverse_dynamics_balance_exactly_along_a_simulated_motion() -> None:
    model = Model.from_xml(ARM).compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (0.4, -0.9), (1.1, -2.0), (0.7, -0.3)
    mujoco.mj_forward(model, data)
    terms = Dynamics(Model.from_xml(ARM).compile()).terms(
        data.qpos[None].copy(), data.qvel[None].copy(), data.qacc[None].copy()
    )
    assert terms.required_force == pytest.approx(terms.actuated(np.array([[0.7, -0.3]])), abs=1e-10)


def test_gain_and_friction_are_physics_and_not_wiring() -> None:
    rng = np.random.default_rng(3)
    terms = Dynamics(Model.from_xml(ARM).compile()).terms(*rng.standard_normal((3, 200, 2)))
    friction = 0.7 * terms.velocity + 0.2 * terms.dry
    share = unexplained(terms, ((terms.required_force + friction * [1, -1]) / [1.3, 1.0])[None])[0]
    assert share[0] == pytest.approx(0.0, abs=1e-6)
    assert share[1] > 1e-3  # friction that drives would be no friction
    share = unexplained(terms, -terms.required_force[None])[0]
    assert (share > 0.5).all()


def test_a_law_is_checked_with_the_goal_that_it_reads() -> None:
    gain = 4.0
    servo = Model.from_xml(SERVO.format(kind=f'position kp="{gain}"'))
    time = np.arange(0.0, 12.0, 0.004)
    goal = 0.8 * tones(time, 5)
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    run = Engine(1).rollout(servo.compile(), start, np.repeat(goal, 4)[None, :, None])
    noise = 1e-4 * np.random.default_rng(1).standard_normal(len(time))
    log = Recording.from_arrays(
        time, qpos={"hinge": run.qpos[0, ::4, 0][:-1] + noise}, goal={"m": -goal}
    )

    def law(now: LawInputs) -> np.ndarray:
        return gain * (now.signals["goal.m"] - now.qpos["hinge"])

    motor = Model.from_xml(SERVO.format(kind="motor"))
    found = find_wiring(motor.compile(), [log], {"m": (law, ("goal.m",))})
    assert found.wires == {"goal.m": Wire("goal.m", sign=-1)}
    assert found.balance["after"].max() < 0.05


def test_what_cannot_be_tested_is_said() -> None:
    free = Model.from_xml(
        "<mujoco><worldbody><body><freejoint name='root'/><geom size='.1'/></body></worldbody>"
        "</mujoco>"
    )
    time = np.arange(0.0, 1.0, 0.01)
    log = Recording.from_arrays(time, qpos={"root": np.ones((100, 7))})
    (flag,) = find_wiring(free.compile(), [log]).flags
    assert flag.level == "note"
    assert "not tested" in flag.sentence


def noisy_elbow(seconds: float, noise: float) -> list[str]:
    """Return what is said of the arm's log, so long, with noise at the elbow: in [rad]."""
    channels = dict(recorded().between(0.0, seconds).channels)
    c = channels["qpos.elbow"]
    values = c.values + noise * np.random.default_rng(3).standard_normal(len(c.values))
    channels["qpos.elbow"] = Channel(c.time, values, c.unit, c.source, c.hold)
    found = find_wiring(Model.from_xml(ARM).compile(), [Recording("log", channels)])
    return [f.sentence for f in found.flags if "not tested" in f.sentence]


def test_a_log_that_is_too_short_says_how_long_it_must_be_and_for_which_noise() -> None:
    """Instants are 1.5 widths of the filter apart, and noise takes the widest, of 0.07 s."""
    assert noisy_elbow(4.0, 0.0) == []
    (said,) = noisy_elbow(4.0, 0.05)
    assert "have 4 s, and need 7.1 s, since the noise of qpos.elbow" in said
    assert noisy_elbow(7.2, 0.05) == []


@functools.cache
def sprung() -> Recording:
    """Return a log of the arm with a spring about the elbow's 1 rad that the model lacks."""
    spring = 'name="elbow" axis="0 1 0" stiffness="6" springref="57.3"'
    plant = Model.from_xml(ARM.replace('name="elbow" axis="0 1 0"', spring)).compile()
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = np.stack([2.0 * tones(time, 1), 0.8 * tones(time, 2)], axis=1)
    start = State(np.array([[0.0, 0.8]]), np.zeros((1, 2)), np.zeros((1, 0)))
    run = Engine(1).rollout(plant, start, np.repeat(ctrl, 4, axis=0)[None])
    qpos = run.qpos[0, ::4][:-1] + 3e-4 * np.random.default_rng(0).standard_normal((len(time), 2))
    return Recording.from_arrays(
        time,
        qpos={"shoulder": qpos[:, 0], "elbow": -qpos[:, 1]},
        ctrl={"a": ctrl[:, 0], "b": ctrl[:, 1]},
    )


def test_an_encoder_is_turned_where_its_range_says_so() -> None:
    """Beside a spring that the model lacks, no sign explains the forces."""
    model = Model.from_xml(ARM.replace('name="elbow"', 'name="elbow" range="-10 150"')).compile()
    found = find_wiring(model, [sprung()])
    assert found.wires == {"qpos.elbow": Wire("qpos.elbow", sign=-1)}
    assert [f.kind for f in found.flags if f.level == "wrong"] == ["sign"]


@pytest.mark.parametrize(
    ("low", "high", "turned"), [(-10, 150, True), (-150, 150, False), (-10, 20, False)]
)
def test_a_range_says_that_an_encoder_is_turned(low: int, high: int, turned: bool) -> None:
    ranged = ARM.replace('name="elbow"', f'name="elbow" range="{low} {high}"')
    assert turned_inside(Model.from_xml(ranged).compile(), [sprung()]) == ["elbow"] * turned


STOPPED = ARM.replace('name="shoulder"', 'name="shoulder" limited="true" range="-20 20"')


BESIDE_A_WALL = ARM.replace("<body>", '<geom type="box" size=".05 .3 .6" pos=".3 0 -.5"/><body>', 1)


@pytest.mark.parametrize(("text", "sign"), [(STOPPED, 1), (STOPPED, -1), (BESIDE_A_WALL, 1)])
def test_what_is_hit_hides_neither_forces_nor_a_sign(text: str, sign: int) -> None:
    """What a stop or a wall holds against a motor takes less time than the filter resolves."""
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = np.stack([2.0 * tones(time, 1), 0.8 * tones(time, 2)], axis=1)
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    model = Model.from_xml(text).compile()
    run = Engine(1).rollout(model, start, np.repeat(ctrl, 4, axis=0)[None])
    noise = 3e-4 * np.random.default_rng(0).standard_normal((len(time), 2))
    qpos = run.qpos[0, ::4][:-1] + noise
    if text == STOPPED:
        assert (np.abs(qpos[:, 0]) > 0.35).mean() > 0.02
    else:
        assert 0.02 < touched(model, qpos).mean() < 0.3
    log = Recording.from_arrays(
        time,
        qpos={"shoulder": qpos[:, 0], "elbow": sign * qpos[:, 1]},
        ctrl={"a": ctrl[:, 0], "b": ctrl[:, 1]},
    )
    found = find_wiring(model, [log])
    assert found.wires == ({} if sign > 0 else {"qpos.elbow": Wire("qpos.elbow", sign=-1)})
    assert not [f for f in found.flags if f.kind == "balance"]


FOUR = "".join(
    f'<body pos="{k} 0 0"><joint name="q{k}" axis="0 0 1" damping=".1"/>'
    '<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/></body>'
    for k in range(4)
)


FOUR = (
    f'<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>{FOUR}</worldbody>'
    + "<actuator>"
    + "".join(f'<position name="u{k}" joint="q{k}" kp="20" kv="2"/>' for k in range(4))
    + "</actuator></mujoco>"
)


@pytest.mark.parametrize("constant", ["ctrl.u3", "qpos.q3"])
def test_an_order_is_proposed_beside_what_is_constant(constant: str) -> None:
    """Three columns are written one place further; what never changes follows nothing."""
    time = np.arange(0.0, 6.0, 0.01)
    goal = np.stack([tones(time, 10 + k) for k in range(4)], axis=1)
    goal[:, 3] *= constant != "ctrl.u3"
    start = State(np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((1, 0)))
    model = Model.from_xml(FOUR).compile()
    qpos = Engine(1).rollout(model, start, np.repeat(goal, 5, axis=0)[None]).qpos[0, ::5][:-1]
    qpos[:, 3] *= constant != "qpos.q3"
    log = Recording.from_arrays(
        time,
        qpos={f"q{k}": qpos[:, c] for k, c in enumerate([2, 0, 1, 3])},
        ctrl={f"u{k}": goal[:, k] for k in range(4)},
    )
    evidence = WiringEvidence(model, Traces([log], [f"qpos.q{k}" for k in range(4)]))
    first = evidence.identity()
    true = {"qpos.q0": "qpos.q1", "qpos.q1": "qpos.q2", "qpos.q2": "qpos.q0"}
    wires = {**first.wires, **{n: Wire(source) for n, source in true.items()}}
    assert any(h.wires == wires for h in takewhile(_no_zero, moves(evidence, first)))


def _no_zero(h: WiringHypothesis) -> bool:
    return not any(w.offset for w in h.wires.values())


@pytest.mark.parametrize(
    ("name", "after", "level"),
    [("ctrl.m", 0.14, "look"), ("ctrl.m", 0.05, "wrong"), ("qvel.b", 0.14, "wrong")],
)
def test_a_fault_that_leaves_every_joint_badly_explained_is_no_more_than_likely(
    name: str, after: float, level: str
) -> None:
    """A spring that the model lacked was told as a reversed cable, to be corrected first of all."""
    balance = pd.DataFrame(
        {"joint": ["a", "b"], "before": [0.0, 0.75], "after": [0.0, after], "used": [True, True]}
    )
    (flag,) = wire_flags({name: Wire(name, sign=-1)}, balance, {})
    assert (flag.level, flag.kind) == (level, "sign")
    assert flag.sentence.startswith("Perhaps: ") == (level == "look")
