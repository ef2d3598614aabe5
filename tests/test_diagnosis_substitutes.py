"""What could stand for a member of a set is tried, also where slopes say that it does less."""

import mujoco
import numpy as np

from bo_sysid.diagnosis.search.final import compare
from bo_sysid.diagnosis.search.held_friction import prefer_static_friction
from bo_sysid.diagnosis.search.rounds import substitute
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.fit import set_key
from bo_sysid.diagnosis.sets.refit import FINAL
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
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


SLED = """<mujoco><option timestep=".002"/><worldbody><body name="sled">
  <joint name="rail" type="slide" axis="1 0 0" damping="2" frictionloss="{friction}"/>
  <geom type="box" size=".1 .1 .1" mass="{mass}"/></body></worldbody>
  <actuator><motor name="left" joint="rail"/><motor name="right" joint="rail"/></actuator>
</mujoco>"""
LOAD, FRICTION, SCALE = 0.6, 3.0, 1e-4  # [kg], [N], [m]


def pushed(sigma: float = SCALE, load: float = LOAD) -> Recording:
    """Return 6 s of a sled with a load and friction, which creeps as MuJoCo's does."""
    plant = mujoco.MjModel.from_xml_string(SLED.format(friction=FRICTION, mass=2 + load))
    data, rows, rng = mujoco.MjData(plant), [], np.random.default_rng(3)
    for _ in range(3000):
        t = data.time
        data.ctrl[:] = 20 * np.sin(7 * t), 15 * np.cos(11 * t + 1) - 5 * np.sin(3 * t)
        rows.append((t, data.qpos[0] + sigma * rng.normal(), *data.ctrl))
        mujoco.mj_step(plant, data)
    time, place, left, right = np.array(rows).T
    return Recording.from_arrays(time, qpos={"rail": place}, ctrl={"left": left, "right": right})


def test_a_load_beside_friction_of_another_shape_is_fitted_with_that_of_the_leader() -> None:
    """Two gains and a smaller friction do what one load does, and friction that holds does less."""
    effects = [CATALOGUE[e] for e in ("dry_friction", "actuator_gain", "link_mass")]
    damping = Parameter("damping", ("joint[rail].damping",), 0.0, 10.0)
    evidence = make_evidence(
        Model.from_xml(SLED.format(friction=0, mass=2)), [pushed()], effects=effects,
        parameters=(damping,), noise={"qpos": SCALE}, threads=1,
    )  # fmt: skip
    problem = windows_of(evidence, 150, 0.002, everything=True)
    holds = next(c for c in evidence.candidates if c.is_dry_friction).usual
    creeps = holds.with_shapes(np.zeros_like(holds.shapes))
    gains = [c for c in evidence.candidates if c.effect.id == "actuator_gain"]
    mass = next(c for c in evidence.candidates if c.effect.id == "link_mass")
    share = 1 / (1 + LOAD / 2)
    own = [np.array([share * FRICTION]), *(np.array([share - 1]) for _ in gains)]
    held = [*evidence.candidates, creeps]
    first = Search.on(prepare(problem), held, 3, None).fit([creeps, *gains], own)
    final = Search.on(prepare(problem, first.hypothesis), held, 3, first.hypothesis)
    leader = final.fit([creeps, *gains], first.x, effort=FINAL)
    far = final.fit([holds, mass], [np.array([FRICTION]), np.array([LOAD])], effort=FINAL)
    assert leader.rms < 1.02
    assert 1.02 * leader.rms < far.rms < 2 * leader.rms
    compare(final, leader)
    load = final.fits[set_key([creeps, mass])]
    assert abs(load.rms / leader.rms - 1) < 0.01
    np.testing.assert_allclose(np.concatenate(load.x), (FRICTION, LOAD), rtol=0.01)


def test_what_stands_for_the_creep_of_friction_is_no_rival_of_friction_that_holds() -> None:
    """Recordings that hardly tell creep from hold tell Stribeck friction from hold as little."""
    sigma = 4e-3
    effects = [CATALOGUE[e] for e in ("dry_friction", "stribeck_friction")]
    evidence = make_evidence(
        Model.from_xml(SLED.format(friction=0, mass=2)), [pushed(sigma, load=0)],
        effects=effects, noise={"qpos": sigma}, threads=1,
    )  # fmt: skip
    problem = windows_of(evidence, 150, 0.002, everything=True)
    holds = next(c for c in evidence.candidates if c.effect.id == "dry_friction").usual
    creeps = holds.with_shapes(np.zeros_like(holds.shapes))
    held = [*evidence.candidates, creeps]
    first = Search.on(prepare(problem), held, 3, None).fit([creeps], [np.array([FRICTION])])
    final = Search.on(prepare(problem, first.hypothesis), held, 3, first.hypothesis)
    leader = final.fit([creeps], first.x, effort=FINAL)
    rising = [c for c in held if c.effect.id == "stribeck_friction"]
    richer = [final.fit([c], [np.array([0.1, FRICTION])], effort=FINAL) for c in rising]
    assert min(f.rss for f in richer) > leader.rss
    prefer_static_friction(final)
    (kept,) = (f for f in final.fits.values() if f.members)
    assert kept.key == set_key([holds])
    np.testing.assert_allclose(kept.x[0], FRICTION, rtol=0.03)
