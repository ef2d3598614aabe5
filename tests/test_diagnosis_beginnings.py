"""Logs of a motor that lags and was switched on with them, or before: plants by plain MuJoCo."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

STEP, LAG, SIGMA = 0.002, 0.04, 5e-4
XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="a" axis="0 1 0" damping=".1"/><geom size=".05" pos="0 0 -.3" mass="1"/></body>
</worldbody><actuator><general name="drive" joint="a" {lag} {limit}/></actuator></mujoco>"""
LOOKED_FOR = ("actuator_lag", "actuator_gain", "viscous_damping", "armature", "actuator_saturation")


def evidence(
    *, lag: float = 0.0, delay: float = 0.0, on: bool = False, limit: float = 0.0,
    looked_for: Sequence[str] = LOOKED_FOR,
) -> Evidence:  # fmt: skip
    """What a plant does from rest on: its motor is on before the log, or begins with it."""
    about = {
        "lag": f'dyntype="filterexact" dynprm="{lag}"' if lag else "",
        "limit": f'forcerange="-{limit} {limit}"' if limit else "",
    }
    plant = mujoco.MjModel.from_xml_string(XML.format(**about))
    plant.opt.timestep = STEP / 8
    data, rng = mujoco.MjData(plant), np.random.default_rng(3)
    u = np.repeat(rng.uniform(-2.0, 2.0, 100), 30)
    u[:30] = 2.5  # at once, and never again as much
    data.act[:] = u[0] if on else 0.0
    q, time = np.zeros(len(u)), STEP * np.arange(len(u))
    sent = np.concatenate([np.full(round(delay / STEP), u[0] if on else 0.0), u])
    for k in range(len(u)):
        q[k], data.ctrl[0] = data.qpos[0], sent[k]
        mujoco.mj_step(plant, data, nstep=8)
    q += rng.normal(0.0, SIGMA, len(q))
    recording = Recording.from_arrays(time, qpos={"a": q}, ctrl={"drive": u})
    effects = [e for e in CATALOGUE.values() if e.id in looked_for]
    model = Model.from_xml(XML.format(lag="", limit=""))
    return make_evidence(model, [recording], effects=effects, noise={"qpos": SIGMA}, threads=1)


@pytest.mark.parametrize("on", [False, True])
def test_a_missing_lag_is_found_in_a_log_that_begins_with_its_command(on: bool) -> None:
    located = locate(evidence(lag=LAG, on=on))
    (found,), (x,) = (located.decision.best.members, located.decision.best.x)
    assert found.key == ("actuator_lag", "drive")
    assert x[0] == pytest.approx(LAG, abs=1e-3)
    assert located.decision.best.rms < 1.05
    # six time constants are left out where the motor was not on before, and only there
    assert located.evidence.skipped_start == (0.0 if on else pytest.approx(6 * LAG, rel=0.1))
    begins = min(r.span[0] for r in located.evidence.recordings)
    assert begins == pytest.approx(located.evidence.skipped_start, abs=STEP)
    assert all(r.channels["ctrl.drive"].time[0] == 0 for r in located.evidence.recordings)


def test_what_half_of_a_log_would_go_for_stays_whole() -> None:
    made = evidence(lag=LAG).skipping_start(0.24)
    (log,) = made.recordings
    assert log.span == (pytest.approx(0.24), pytest.approx(5.998))
    short = evidence(lag=LAG).recordings[0].between(0.0, 0.4)
    assert made.without_skipped_start([short]) == (short,)
    assert any("are not compared: a late drive" in n for n in made.notes)
    both = replace(made, recordings=(log, replace(short, name="short")))
    assert any("are not compared, but in short, of which half would go: a" in n for n in both.notes)


def test_a_torque_limit_that_is_reached_in_the_first_moments_is_not_left_out() -> None:
    located = locate(evidence(limit=2.2))
    assert [c.key for c in located.decision.best.members] == [("actuator_saturation", "drive")]
    assert located.evidence.skipped_start == 0


@pytest.mark.parametrize("on", [False, True])
def test_a_late_motor_and_a_late_encoder_of_one_joint_are_equals(on: bool) -> None:
    """What was sent before the log told them apart, and that is not known."""
    delays = ("actuator_delay", "sensor_delay", "viscous_damping")
    decision = locate(evidence(delay=0.012, on=on, looked_for=delays)).decision
    equals = [decision.best, *decision.equivalents]
    names = [[c.effect.id for c in f.members] for f in equals]
    assert sorted(names) == [["actuator_delay"], ["sensor_delay"]]
    assert [f.x[0][0] for f in equals] == pytest.approx([0.012, 0.012], abs=5e-4)
    assert decision.probability[:2] == pytest.approx([0.5, 0.5])
