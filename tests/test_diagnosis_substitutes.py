"""What could stand for a member of a set is tried, also where slopes say that it does less."""

import mujoco
import numpy as np

from bo_sysid.diagnosis.search.rounds import substitute
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.refit import FINAL
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

SERVO = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="a" axis="0 0 1"
armature=".02" damping=".05"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
</body></worldbody><actuator><position name="a" joint="a" kp="40" kv="1.5"/></actuator></mujoco>"""
LATE, FINER, SIGMA = 0.004, 20, 3e-4  # [s] of the encoder, steps of the plant in one, [rad]


def recorded() -> Recording:
    """A servo, stepped twenty times finer, whose encoder is late."""
    plant, rng = mujoco.MjModel.from_xml_string(SERVO), np.random.default_rng(0)
    plant.opt.timestep /= FINER
    data, time, late = mujoco.MjData(plant), np.arange(3000) * 0.002, round(LATE / 0.002 * FINER)
    waves = zip(rng.uniform(0.3, 3, 5), rng.uniform(0, 6, 5), strict=True)
    sent = sum(0.3 * np.sin(2 * np.pi * f * time + p) for f, p in waves)
    angle = np.zeros(len(time) * FINER)
    for k in range(len(angle)):
        angle[k] = data.qpos[0]
        data.ctrl[0] = sent[k // FINER]
        mujoco.mj_step(plant, data)
    seen = np.concatenate([np.zeros(late), angle[: len(angle) - late]])[::FINER]
    seen += rng.normal(0, SIGMA, len(time))
    return Recording.from_arrays(time, qpos={"a": seen}, ctrl={"a": sent})


def test_a_late_encoder_is_tried_for_a_late_command_of_another_slope() -> None:
    """One servo alone does the same with either, but not by a slope that was taken at 20 ms."""
    effects = [CATALOGUE[e] for e in ("actuator_delay", "sensor_delay", "servo_kp", "armature")]
    evidence = make_evidence(
        Model.from_xml(SERVO), [recorded()], effects=effects, noise={"qpos": SIGMA}, threads=1
    )
    problem = windows_of(evidence, 150, 0.002, everything=True)
    held = list(evidence.candidates)
    command = max(
        (c for c in held if c.effect.id == "actuator_delay"), key=lambda c: float(c.point[0])
    )
    first = Search.on(prepare(problem), held, 3, None).fit([command], [np.array([LATE])])
    final = Search.on(prepare(problem, first.hypothesis), held, 3, first.hypothesis)
    base = final.fit([command], first.x, effort=FINAL)
    substitute(final, base)
    encoder = next(f for f in final.fits.values() if ("sensor_delay", "qpos.a") in f.names)
    assert abs(encoder.x[0][0] / LATE - 1) < 0.02
