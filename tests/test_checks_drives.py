"""The wiring of correct logs whose drives are late, compensate gravity, saturate or integrate."""

import copy
from collections.abc import Callable
from dataclasses import replace
from math import pi

import mujoco
import numpy as np
import pytest

from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import Wire
from bo_sysid.checks.moves import _other_units
from bo_sysid.checks.traces import Traces
from bo_sysid.checks.wiring import Wiring, find_wiring
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Law

ARM = """
<mujoco>
  <option timestep=".002" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="a" axis="0 1 0" damping=".4"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" contype="0" conaffinity="0"/>
      <body pos="0 0 -.3" {link}><joint name="b" axis="0 1 0" damping=".2" {joint}/>
        <geom type="capsule" fromto="0 0 0 0 0 -.25" size=".025" contype="0" conaffinity="0"/>
      </body></body>
  </worldbody>
  <actuator>{drives}</actuator>
</mujoco>
"""
LATE = 'delay=".03" nsample="16"'
"""Of a buffer that lasts at 2 ms, not at the finer step of the plant."""
FINE, EVERY = 2e-4, 50  # [s] step of the plant, steps between samples

MOTORS = ("ma", "mb")

Command = Callable[[int, np.ndarray], np.ndarray]
"""Returns both commands, given the step of the plant and its positions."""


def arm(drives: str, link: str = "", joint: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM.format(drives=drives, link=link, joint=joint))


def motors(more: str = "") -> str:
    return (
        f'<motor name="ma" joint="a" gear="6" {more}/><motor name="mb" joint="b" gear="2" {more}/>'
    )


def servos(more: str = "") -> str:
    return (
        f'<position name="ma" joint="a" kp="60" kv="3" {more}/>'
        f'<position name="mb" joint="b" kp="30" kv="1" {more}/>'
    )


def tones(size: float, seed: int = 0) -> Command:
    """Return commands to both joints, of six frequencies each, held for a sample."""
    rng = np.random.default_rng(seed)
    rate, phase = 2 * pi * rng.uniform(0.1, 2.5, (6, 2)), rng.uniform(0, 2 * pi, (6, 2))

    def command(step: int, qpos: np.ndarray) -> np.ndarray:
        t = FINE * EVERY * (step // EVERY)
        return np.asarray(size * np.sin(rate * t + phase).sum(axis=0) / np.sqrt(6))

    return command


def played(
    plant: mujoco.MjModel, command: Command, *, late: float = 0.0, shift: float = 0.0
) -> Recording:
    """Return a log of 10 s from plain MuJoCo at .2 ms, every 10 ms, with noise of .5 mrad.

    Commands act `late` [s] after they were given, and are stamped `shift` [s] before.
    """
    plant.opt.timestep = FINE
    data, held = mujoco.MjData(plant), round(late / FINE)
    qpos, given = [], []
    for step in range(round(10.0 / FINE)):
        qpos.append(data.qpos.copy())
        given.append(command(step, qpos[-1]))
        data.ctrl[:] = given[max(step - held, 0)]
        mujoco.mj_step(plant, data)
    time = FINE * EVERY * np.arange(len(qpos) // EVERY)
    seen = np.array(qpos)[::EVERY]
    seen += 5e-4 * np.random.default_rng(1).standard_normal(seen.shape)
    channels = {f"qpos.{n}": Channel(time, seen[:, k]) for k, n in enumerate("ab")}
    for k, name in enumerate(MOTORS):
        values = np.array(given)[::EVERY, k]
        channels[f"ctrl.{name}"] = Channel(time - shift, values, hold="zero")
    return Recording("log", channels)


def nothing_wrong(found: Wiring) -> None:
    assert found.balance["used"].all()
    assert found.balance["before"].max() < 0.02
    assert found.flags == ()
    assert (found.delays["sigma"] > 0.0).all()


@pytest.mark.parametrize("drives", [motors, servos])
def test_a_delay_that_the_model_has_is_no_fault(drives: Callable[[str], str]) -> None:
    log = played(arm(drives("")), tones(0.4), late=0.03)
    nothing_wrong(find_wiring(arm(drives(LATE)), [log]))


def test_a_clock_is_told_beside_a_delay_that_the_model_has() -> None:
    log = played(arm(motors()), tones(0.4), late=0.03, shift=0.025)
    found = find_wiring(arm(motors(LATE)), [log])
    assert found.delay == pytest.approx(0.025, abs=0.0015)
    assert found.wires == {}


def test_a_law_reads_what_its_late_actuator_acts_on() -> None:
    """A law of 3 (goal - q) acts 30 ms later: on what the joint did then."""
    goal = tones(0.5)
    log = played(arm(motors()), lambda t, q: np.asarray(3.0 * (goal(t, q) - q)), late=0.03)
    time = log.channels["qpos.a"].time
    goals = np.array([goal(EVERY * k, np.zeros(2)) for k in range(len(time))])
    told = {f"goal.{n}": Channel(time, goals[:, k], hold="zero") for k, n in enumerate(MOTORS)}
    kept = {n: c for n, c in log.channels.items() if n.startswith("qpos.")}

    def law(joint: str, actuator: str) -> Law:
        return lambda now: 3.0 * (now.signals[f"goal.{actuator}"] - now.qpos[joint])

    laws = {n: (law(j, n), (f"goal.{n}",)) for j, n in zip("ab", MOTORS, strict=True)}
    nothing_wrong(find_wiring(arm(motors(LATE)), [Recording("log", {**kept, **told})], laws))


def test_drives_over_tendons_are_said_to_have_no_tested_delay() -> None:
    """Two tendons of a finger acted 12 ms late, and clocks were said to be right."""
    tendon = """<tendon><fixed name="flexor"><joint joint="a" coef="1"/><joint joint="b" coef=".5"/>
    </fixed></tendon>"""
    pulled = (
        ARM.format(drives='<motor name="ma" tendon="flexor"/>', link="", joint="")
        .replace("</worldbody>", f"</worldbody>{tendon}")
    )  # fmt: skip
    model = mujoco.MjModel.from_xml_string(pulled)
    log = played(arm(motors()), tones(0.4))
    only = Recording("log", {n: c for n, c in log.channels.items() if n != "ctrl.mb"})
    flags = [f for f in find_wiring(model, [only]).flags if f.kind == "clock"]
    assert [f.channels for f in flags] == [("ctrl.ma",)]
    assert "was not tested" in flags[0].sentence


def test_degrees_are_not_converted_twice() -> None:
    """Of a model that explains nothing, a motion of next to nothing explained more."""
    log = played(arm(motors()), tones(0.4))
    heavy = mujoco.MjModel.from_xml_string(
        ARM.format(drives=motors(), link="", joint='stiffness="90"')
    )
    for converted in ("", "deg"):
        channels = {
            n: replace(c, unit="rad", converted=converted) if n.startswith("qpos") else c
            for n, c in log.channels.items()
        }
        evidence = WiringEvidence(heavy, Traces([Recording("log", channels)], ["qpos.a", "qpos.b"]))
        units = list(_other_units(evidence, evidence.identity()))
        again = [names for names, unit, _ in units if unit == "deg" and names]
        back = [names for names, unit, factor in units if unit == "rad" and factor > 1 and names]
        assert bool(again) == (not converted)
        assert ("qpos.a",) in back


def test_a_control_that_never_changes_tells_no_delay() -> None:
    log = played(arm(motors()), lambda t, q: tones(0.4)(t, q) * (1, 0))
    (still,) = find_wiring(arm(motors()), [log]).delays.query("control == 'ctrl.mb'")["sigma"]
    assert still == np.inf


@pytest.mark.parametrize("drives", [motors, servos])
def test_gravity_that_actuators_compensate_is_no_fault(drives: Callable[[], str]) -> None:
    model = arm(drives(), 'gravcomp=".8"', 'actuatorgravcomp="true"')
    nothing_wrong(find_wiring(copy.copy(model), [played(model, tones(0.3))]))


ENDS = {"a": (-3.0, 3.0), "b": (-1.0, 1.0)}


def saturating(kind: str) -> mujoco.MjModel:
    """Return an arm on servos whose forces are limited, each at its actuator or at its joint."""
    model = arm(servos())
    for k, ends in enumerate(ENDS.values()):
        if kind == "actuator":
            model.actuator_forcelimited[k], model.actuator_forcerange[k] = 1, ends
        if kind == "joint":
            model.jnt_actfrclimited[k], model.jnt_actfrcrange[k] = 1, ends
    return model


@pytest.mark.parametrize("kind", ["actuator", "joint"])
def test_drives_that_saturate_as_the_model_does_are_no_fault(kind: str) -> None:
    """Most commands ask for more than the limits: without them a fifth is not explained."""
    log = played(saturating(kind), tones(1.5))
    nothing_wrong(find_wiring(saturating(kind), [log]))
    assert find_wiring(arm(servos()), [log]).balance["before"].max() > 0.1


def test_a_wrong_sign_is_found_at_drives_that_saturate() -> None:
    log = played(saturating("actuator"), tones(1.5))
    c = log.channels["ctrl.ma"]
    turned = {**log.channels, "ctrl.ma": replace(c, values=-c.values)}
    found = find_wiring(saturating("actuator"), [Recording("log", turned)])
    assert found.wires == {"ctrl.ma": Wire("ctrl.ma", sign=-1)}
    assert found.balance["after"].max() < 0.02


def test_limits_that_a_machine_does_not_have_are_left_out() -> None:
    nothing_wrong(find_wiring(saturating("actuator"), [played(arm(servos()), tones(0.8))]))


INTEGRATES = '<intvelocity name="{}" joint="{}" kp="60" kv="3" actrange="-1.5 1.5"/>'


def not_tested(found: Wiring) -> list[str]:
    return [f.sentence for f in found.flags if f.level == "note" and "not tested" in f.sentence]


def test_what_integrates_its_control_is_said_not_to_be_tested() -> None:
    both = arm(INTEGRATES.format("ma", "a") + INTEGRATES.format("mb", "b"))
    found = find_wiring(copy.copy(both), [played(both, tones(1.0))])
    (said,) = not_tested(found)
    assert "The wiring was not tested against the model: ma and mb act by an activation" in said
    assert not len(found.delays)


def test_a_joint_whose_drive_integrates_is_said_not_to_be_tested_beside_others() -> None:
    one = arm(INTEGRATES.format("ma", "a") + '<motor name="mb" joint="b" gear="2"/>')
    found = find_wiring(copy.copy(one), [played(one, tones(0.4))])
    (said,) = not_tested(found)
    assert "The wiring of a was not tested against the model: ma acts by an activation" in said
    assert list(found.delays["control"]) == ["ctrl.mb"]


def test_controls_without_a_column_are_why_nothing_was_tested() -> None:
    log = played(arm(motors()), tones(0.4))
    kept = {n: c for n, c in log.channels.items() if n.startswith("qpos.")}
    (said,) = not_tested(find_wiring(arm(motors()), [Recording("log", kept)]))
    assert "commands were not recorded (ctrl.ma, ctrl.mb)" in said
    still = {n: replace(c, values=0.0 * c.values) for n, c in log.channels.items()}
    (said,) = not_tested(find_wiring(arm(motors()), [Recording("log", still)]))
    assert "none of the recorded joints moves on its own" in said
