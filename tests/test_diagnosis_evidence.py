"""What recordings are taken to show before anything is looked for."""

import numpy as np
import pytest

from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.law_controls import driven
from bo_sysid.effects import CATALOGUE
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Controller

TWO = """<mujoco><worldbody>
<geom name="wall" type="box" pos=".31 0 0" size=".02 .2 .1"/>
<body><joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/></body>
<body pos="-1 0 0"><joint name="b" axis="0 1 0"/><geom size=".05" pos="0 0 -.3"/></body>
</worldbody><actuator><motor name="m" joint="a"/></actuator></mujoco>"""
TIME = np.arange(0, 60, 0.002)
SWING = 0.3 * np.sin(2 * TIME)
NOISE = 1e-4 * np.random.default_rng(0).normal(size=(2, len(TIME)))


def evidence_of(a: np.ndarray, b: np.ndarray, *more: Recording) -> Evidence:
    recording = Recording.from_arrays(TIME, qpos={"a": a, "b": b}, ctrl={"m": np.cos(TIME)})
    effects = [CATALOGUE[i] for i in ("channel_swap", "sensor_offset")]
    return make_evidence(Model.from_xml(TWO), [recording, *more], effects=effects, threads=1)


def test_a_joint_that_never_moves_is_swapped_with_none() -> None:
    a, b = SWING + NOISE[0], 0.5 * np.cos(3 * TIME) + NOISE[1]
    swaps = [c for c in evidence_of(a, b).candidates if c.effect.id == "channel_swap"]
    assert [c.site.name for c in swaps] == ["qpos.a"]
    still = evidence_of(a, np.zeros_like(b))
    assert still.still == ("b",)  # so that what is named there is a hint
    assert evidence_of(a, b).still == ()
    assert [c.effect.id for c in still.candidates if c.effect.id == "channel_swap"] == []


@pytest.mark.parametrize("touched", [True, False])
def test_one_short_touch_keeps_contact(touched: bool) -> None:
    a = SWING + NOISE[0]
    tap = (TIME > 30.0) & (TIME < 30.01)
    evidence = evidence_of(np.where(tap & touched, -1.5, a), NOISE[1])
    assert (evidence.model is evidence.given) is touched


@pytest.mark.parametrize("samples", [2, 5])
def test_a_recording_that_ended_at_once_is_named(samples: int) -> None:
    time = 0.01 * np.arange(samples)
    motion = {"qpos": {"a": np.sin(time), "b": time}, "ctrl": {"m": time}}
    aborted = Recording.from_arrays(time, name="run_7", **motion)
    with pytest.raises(RecordingError, match=rf"run_7: {samples} samples .* leave the recording"):
        evidence_of(SWING + NOISE[0], NOISE[1], aborted)


def test_a_recording_that_is_shorter_than_a_window_is_left_out() -> None:
    """It made the diagnosis of all others fail."""
    time = 0.002 * np.arange(100)
    motion = {"qpos": {"a": np.sin(9 * time), "b": 0.5 * time}, "ctrl": {"m": time}}
    short = Recording.from_arrays(time, name="jog", **motion)
    made = evidence_of(SWING + NOISE[0], NOISE[1], short)
    assert [r.name for r in made.recordings] == ["recording"]
    assert any(n.startswith("jog: left out") for n in made.notes)


def test_channels_that_are_not_compared_have_no_faults() -> None:
    """Velocities are recorded, but positions alone are compared with what is predicted."""
    recording = Recording.from_arrays(
        TIME, qpos={"a": SWING + NOISE[0], "b": SWING + NOISE[1]}, ctrl={"m": np.cos(TIME)},
        qvel={"a": np.gradient(SWING, TIME)},
    )  # fmt: skip
    effects = [CATALOGUE[i] for i in ("sensor_delay", "sensor_scale")]
    found = make_evidence(Model.from_xml(TWO), [recording], effects=effects, threads=1)
    assert {c.site.name for c in found.candidates} == {"qpos.a", "qpos.b"}


def test_what_a_constant_command_gives_no_size_is_not_looked_for() -> None:
    recording = Recording.from_arrays(
        TIME, qpos={"a": SWING + NOISE[0], "b": NOISE[1]}, ctrl={"m": np.full_like(TIME, 0.3)}
    )
    effects = [CATALOGUE[i] for i in ("actuator_deadzone", "back_emf", "actuator_gain")]
    found = make_evidence(Model.from_xml(TWO), [recording], effects=effects, threads=1)
    assert "actuator_deadzone" not in {c.effect.id for c in found.candidates}
    assert all(c.probe.any() for c in found.candidates)


def test_a_law_sees_all_joints_and_lags_before_anything_is_simulated() -> None:
    """As it does in every simulation: a joint that was not recorded, what lags behind a control."""
    xml = TWO.replace(
        "</actuator>", '<general name="late" joint="b" dyntype="filter" dynprm=".1"/></actuator>'
    ).replace('name="b" axis', 'name="b" ref="30" axis')
    recording = Recording.from_arrays(TIME, qpos={"a": SWING}, ctrl={"late": np.cos(TIME)})
    law = Controller("m", lambda see: see.qpos["b"] + see.qvel["b"] + see.act["late"])
    (made,) = driven(Model.from_xml(xml).compile(), [recording], [law])
    told = made.channels["ctrl.m"].values
    np.testing.assert_allclose(told, np.radians(30) + np.cos(TIME), atol=1e-12)
