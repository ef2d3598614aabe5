"""Units of a log that were spoilt on purpose, and the constants of motors."""

from math import pi

import numpy as np
import pytest
from wiring_logs import ARM, SERVO, picked, recorded, speed_servo, spoilt, tones, without

from bo_sysid.checks.balance import Terms, free_gain
from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import FREE, Wire
from bo_sysid.checks.motion import range_flags
from bo_sysid.checks.motors import scaled
from bo_sysid.checks.proposal import proposed_columns
from bo_sysid.checks.search import SUSPICIOUS, search
from bo_sysid.checks.traces import Traces
from bo_sysid.checks.wiring import find_wiring
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine, State

LIMITED = ARM.replace(
    'joint="shoulder"/><motor', 'joint="shoulder" ctrlrange="-.6 .6"/><motor'
).replace('joint="elbow"/></actuator>', 'joint="elbow" ctrlrange="-.25 .25"/></actuator>')


@pytest.mark.parametrize(("factor", "unit"), [(1.0, ""), (-1.0, ""), (1e3, "milli")])
def test_commands_beyond_their_range_act_at_its_ends(factor: float, unit: str) -> None:
    """The log has what was asked for, more than half of it beyond what the motors give."""
    model = Model.from_xml(LIMITED).compile()
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = np.stack([2.0 * tones(time, 1), 0.8 * tones(time, 2)], axis=1)
    beyond = (np.abs(ctrl) > model.actuator_ctrlrange[:, 1]).mean(axis=0)
    assert ((beyond > 0.55) & (beyond < 0.65)).all()
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    qpos = Engine(1).rollout(model, start, np.repeat(ctrl, 4, axis=0)[None]).qpos[0, ::4][:-1]
    qpos = qpos + 3e-4 * np.random.default_rng(0).standard_normal(qpos.shape)
    log = Recording.from_arrays(
        time,
        qpos={"shoulder": qpos[:, 0], "elbow": qpos[:, 1]},
        ctrl={"a": ctrl[:, 0], "b": factor * ctrl[:, 1]},
    )
    found = find_wiring(model, [log])
    if factor == 1.0:
        assert found.wires == {}
    else:
        sign = -1 if factor < 0 else 1
        assert found.wires == {"ctrl.b": Wire("ctrl.b", sign, 1 / abs(factor), 0.0, unit)}
    if factor < 2:
        assert found.balance["after"].max() < 1e-3  # as they are written they leave .7 and 1.8 %
        assert not [f for f in found.flags if f.kind in ("balance", "clock")]


def test_degrees_of_one_encoder_and_its_speed() -> None:
    def change(values: dict[str, np.ndarray]) -> None:
        values["qpos.elbow"] *= 180 / pi
        values["qvel.elbow"] *= 180 / pi

    found = spoilt(change)
    assert set(found.wires) == {"qpos.elbow", "qvel.elbow"}
    assert found.wires["qpos.elbow"] == Wire("qpos.elbow", scale=pi / 180, unit="deg")
    assert found.wires["qvel.elbow"].unit == "deg/s"


@pytest.mark.parametrize("names", [("qpos.elbow",), ("qpos.shoulder", "qpos.elbow")])
def test_degrees_that_were_stated_and_are_radians(names: tuple[str, ...]) -> None:
    """As read with `unit: deg`, which took the angles for smaller than they are."""
    channels = dict(recorded().channels)
    for name in names:
        c = channels[name]
        channels[name] = Channel(c.time, c.values * pi / 180, "rad", name, c.hold)
    found = find_wiring(Model.from_xml(ARM).compile(), [Recording("log", channels)])
    assert found.wires == {n: Wire(n, scale=180 / pi, unit="rad") for n in names}
    written = {n: {"unit": "degree", "scale": 1.0} for n in names}
    assert proposed_columns(written, found.wires, {}) == {n: {"unit": "rad"} for n in names}


@pytest.mark.parametrize("rests", [True, False])
def test_the_speed_of_a_joint_that_rests_is_no_rate_of_another(rests: bool) -> None:
    def change(values: dict[str, np.ndarray]) -> None:
        rng = np.random.default_rng(5)
        values["qpos.elbow"] = 3e-4 * rng.standard_normal(len(values["qpos.elbow"]))
        values["ctrl.b"][:] = 0.0
        if rests:
            values["qvel.elbow"] = 3e-3 * rng.standard_normal(len(values["qpos.elbow"]))

    told = [f for f in spoilt(change).flags if f.channels == ("qvel.elbow",)]
    assert [f.kind for f in told] == ([] if rests else ["order"])


def test_the_unit_of_a_speed_that_was_stated_and_is_wrong() -> None:
    channels = dict(recorded().channels)
    c = channels["qvel.elbow"]
    channels["qvel.elbow"] = Channel(c.time, c.values * pi / 30, "rad/s", c.source, c.hold)
    found = find_wiring(Model.from_xml(ARM).compile(), [Recording("log", channels)])
    assert found.wires == {"qvel.elbow": Wire("qvel.elbow", scale=30 / pi, unit="rad/s")}
    written = {"qvel.elbow": {"from": "w", "unit": "rpm"}}
    assert proposed_columns(written, found.wires, {}) == {
        "qvel.elbow": {"from": "w", "unit": "rad/s"}
    }


@pytest.mark.parametrize("sign", [1, -1])
def test_a_current_tells_the_constant_of_its_motor(sign: int) -> None:
    """One A gives 0.105 N m; the machine is a tenth heavier than the model."""

    def change(values: dict[str, np.ndarray]) -> None:
        values["ctrl.b"] *= sign / 0.105

    found = spoilt(change)
    (wire,) = found.wires.values()
    assert (wire.source, wire.sign, wire.unit) == ("ctrl.b", sign, FREE)
    assert wire.scale == pytest.approx(0.105 / 1.1, rel=0.03)
    (flag,) = (f for f in found.flags if f.kind == "scale")
    assert flag.sentence.startswith(f"Scale: one unit of ctrl.b gives about {wire.scale:.3g} N m")
    assert proposed_columns({"ctrl.b": {"from": "i"}}, found.wires, {})["ctrl.b"] == {
        "from": "i", **({"sign": -1} if sign < 0 else {}), "scale": wire.scale,
    }  # fmt: skip


def test_each_of_two_motors_has_a_constant_of_its_own() -> None:
    def change(values: dict[str, np.ndarray]) -> None:
        values["ctrl.a"] /= 0.2
        values["ctrl.b"] /= -0.03

    found = spoilt(change, late=0.02)
    assert set(found.wires) == {"ctrl.a", "ctrl.b"}
    assert found.wires["ctrl.a"].scale == pytest.approx(0.2 / 1.1, rel=0.05)
    assert found.wires["ctrl.b"].scale == pytest.approx(0.03 / 1.1, rel=0.05)
    assert (found.wires["ctrl.a"].sign, found.wires["ctrl.b"].sign) == (1, -1)
    assert found.delay == pytest.approx(0.02, abs=0.0015)


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milli"), (100.0, "%"), (255.0, "PWM")])
def test_a_known_unit_comes_before_a_constant(factor: float, unit: str) -> None:
    def change(values: dict[str, np.ndarray]) -> None:
        values["ctrl.a"] *= factor
        values["ctrl.b"] *= factor

    found = spoilt(change)
    assert {(w.unit, w.scale) for w in found.wires.values()} == {(unit, 1 / factor)}
    assert set(found.wires) == {"ctrl.a", "ctrl.b"}


def test_a_motor_that_the_motion_does_not_need_has_no_constant() -> None:
    """A control that is noise is not scaled down until it does not disturb."""

    def change(values: dict[str, np.ndarray]) -> None:
        values["ctrl.b"] = 3.0 * np.random.default_rng(5).standard_normal(len(values["ctrl.b"]))

    found = spoilt(change)
    assert [f for f in found.flags if f.level == "wrong"] == []
    (flag,) = (f for f in found.flags if f.kind == "balance")
    share = float(found.balance.set_index("joint").loc["elbow", "after"])
    assert share > SUSPICIOUS
    assert flag.channels == ("elbow",)
    assert flag.sentence.startswith(f"{100 * share:.0f} % of the forces at elbow")


def test_a_rotor_that_the_model_lacks_is_no_constant_of_a_motor() -> None:
    """Without gravity 25 times the inertia is a 25th of the torque, but for the noise."""
    turned = SERVO.format(kind="motor").replace('axis="0 1 0"', 'axis="0 0 1"')
    turned = turned.replace("0 0 0 0 0 -.3", "0 0 0 .3 0 0").replace(' damping=".02"', "")
    model = Model.from_xml(turned)
    inertia = float(model.compile().dof_M0[0])
    geared = Model.from_xml(turned.replace('".002"', f'"{24 * inertia}"'))
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = tones(time, 5)
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    run = Engine(1).rollout(geared.compile(), start, np.repeat(ctrl, 4)[None, :, None])
    noise = 1e-4 * np.random.default_rng(1).standard_normal(len(time))
    log = Recording.from_arrays(
        time, qpos={"hinge": run.qpos[0, ::4, 0][:-1] + noise}, ctrl={"m": ctrl}
    )
    evidence = WiringEvidence(model.compile(), Traces([log], ["qpos.hinge"]))
    assert (evidence.shares(evidence.identity(), [0.0]) > SUSPICIOUS).all()
    assert list(scaled(evidence, evidence.identity(), [0.0])) == []


def test_friction_without_bounds_is_no_unit() -> None:
    """The position in mrad hardly moves, and friction could take all that the servo gives."""
    found = speed_servo(0.0, 1)
    assert found.wires == {}
    assert found.flags == ()


@pytest.mark.filterwarnings("error")
def test_a_motion_that_needs_no_force_has_no_constant() -> None:
    """As of a command that is 0 throughout and is tried as a position."""
    none, phase = np.zeros((50, 1)), np.linspace(0.0, 6.0, 50)
    ends = np.array([[-np.inf], [np.inf]])
    terms = Terms(none, none, none, none, none, none + 1.0, none[..., None] + 1.0, ends, ends)
    assert free_gain(terms, 0, np.sin(phase)[None], none.T)[0] == 0.0


BEARING = Model.from_xml(
    SERVO.format(kind='position kp="60" kv="4" timeconst=".12"').replace("0 0 -.3", ".3 0 0")
)


def bearing(zero: float = 0.0) -> Recording:
    """Return a log of a servo that holds a link out against gravity, its encoder `zero` off."""
    time = np.arange(0.0, 6.0, 0.01)
    goal = 0.7 * tones(time, 3)
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    run = Engine(1).rollout(BEARING.compile(), start, np.repeat(goal, 10)[None, :, None])
    noise = 1e-4 * np.random.default_rng(0).standard_normal(len(time))
    hinge = run.qpos[0, ::10, 0][:-1] + noise + zero
    return Recording.from_arrays(time, qpos={"hinge": hinge}, ctrl={"m": goal})


def test_a_load_that_a_new_zero_bears_is_no_reason_for_a_smaller_unit() -> None:
    """In mrad the link would hardly move: what bears its weight explains its forces at any time."""
    log = without(bearing(), 2.0, 2.6)
    evidence = WiringEvidence(BEARING.compile(), Traces([log], ["qpos.hinge"]))  # at the gap too
    weight = 0.5 * 9.81 * 0.15
    wires = {
        "qpos.hinge": Wire("qpos.hinge", 1, 1e-3, 0.0, "mrad"),
        "ctrl.m": Wire("ctrl.m", 1, 1e-3, -weight / 60.0, "mrad"),
    }
    asis = evidence.identity()
    still = asis.with_wires(wires, "unit")
    assert evidence.shares(asis, [0.0]).max() > SUSPICIOUS
    assert evidence.shares(still, [0.0]).max() < 1e-5
    assert evidence.scores(still, [0.0])[0] > evidence.scores(asis, [0.0])[0]
    found, twins = search(evidence, asis)
    assert {w.unit for h in (found, *twins) for w in h.wires.values()} == {""}


def test_a_smaller_unit_beside_a_new_zero_is_told_where_the_motion_says_so() -> None:
    """The same servo, written in mrad by an encoder that is 0.2 rad off."""
    log = picked(bearing(zero=0.2), np.arange(100, 600), 1e3)
    found = find_wiring(BEARING.compile(), [log])
    assert {(w.unit, w.scale) for w in found.wires.values()} == {("mrad", 1e-3)}
    assert set(found.wires) == {"qpos.hinge", "ctrl.m"}
    zero = found.wires["qpos.hinge"].offset - found.wires["ctrl.m"].offset
    assert zero == pytest.approx(-0.2, abs=0.01)  # which of the two is off, so stiff a servo hides
    assert found.balance["after"].max() < SUSPICIOUS


@pytest.mark.parametrize(("reach", "told"), [(1.4, False), (1.5, True)])
def test_a_range_in_radians_is_told_by_motion_many_times_as_wide(reach: float, told: bool) -> None:
    """A range of ±.5 rad, or of ±.9 degrees that was written in radians."""
    degrees = 0.9 if told else np.rad2deg(0.5)
    model = Model.from_xml(
        f'<mujoco><worldbody><body><joint name="a" axis="0 1 0" range="-{degrees} {degrees}" '
        'limited="true"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    time = np.arange(0.0, 4.0, 0.01)
    log = Recording.from_arrays(time, qpos={"a": 0.5 * reach * np.sin(3 * time)})
    (flag,) = range_flags(model.compile(), [log])
    assert ("written in radians" in flag.sentence) is told
