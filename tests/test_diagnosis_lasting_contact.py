"""A sled that slides on a floor: contact that lasts is diagnosed as smooth motion is."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.ground import slide
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import contact_decides, windows_of
from bo_sysid.diagnosis.sets.refit import FINAL
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.fitted_starts import held_joints
from bo_sysid.diagnosis.windows.windowing import in_contact, meets_impacts, prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.touching import joints_to_contact
from bo_sysid.recording import Recording

MASS, FRICTION, MORE, SIGMA, EVERY = 2.0, 0.3, 0.15, 3e-4, 0.005
SLED = f"""<mujoco><option timestep="0.001" integrator="implicitfast"/>
<worldbody><geom name="floor" type="plane" size="5 5 .1" friction="{FRICTION} .005 .0001"/>
<body name="sled" pos="0 0 .05"><joint name="x" type="slide" axis="1 0 0"/>
<joint name="z" type="slide" axis="0 0 1"/>
<geom name="runner" type="box" size=".2 .1 .05" mass="{MASS}" friction="{FRICTION} .005 .0001"/>
<body name="mast" pos="0 0 .05"><joint name="swing" type="hinge" axis="0 1 0" damping=".1"/>
<geom size=".02" mass=".1" pos="0 0 -.02" contype="0" conaffinity="0"/></body></body></worldbody>
<actuator><motor name="pull" joint="x"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def slid() -> Recording:
    """A sled pulled to and fro on a floor with half as much friction again."""
    model = mujoco.MjModel.from_xml_string(SLED)
    model.opt.timestep = 0.0005
    model.geom_friction[:2, 0] = FRICTION + MORE
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    time, rows, controls = np.arange(0, 8, EVERY), [], []
    for t in time:
        pull = 14 * np.sin(2 * np.pi * 0.7 * t) + 8 * np.sin(2 * np.pi * 1.9 * t)
        data.ctrl[0] = pull - 8 * data.qpos[0] - 2 * data.qvel[0]
        rows.append(data.qpos + SIGMA * rng.standard_normal(3))
        controls.append(data.ctrl[0])
        mujoco.mj_step(model, data, round(EVERY / model.opt.timestep))
    place = dict(zip(("x", "z", "swing"), np.array(rows).T, strict=True))
    return Recording.from_arrays(time, qpos=place, ctrl={"pull": np.array(controls)})


def test_friction_of_the_ground_is_fitted_in_the_place_of_friction_at_a_joint(slid) -> None:
    wanted = [CATALOGUE[n] for n in ("dry_friction", "contact_friction")]
    evidence = make_evidence(
        Model.from_xml(SLED), [slid], effects=wanted, noise={"qpos": SIGMA}, threads=1
    )
    prepared = prepare(windows_of(evidence, round(0.3 / EVERY), 0.001))
    assert in_contact(prepared.problem)
    assert not meets_impacts(prepared.problem)
    search = Search.on(prepared, list(evidence.candidates), 3, None)
    moved = joints_to_contact(evidence.machine.model)
    assert moved == {"x", "z"}
    held = {j.name for j in held_joints(prepared.problem, search.nominal.hypothesis)}
    assert held == moved  # what friction of the contact may hold

    rubs = next(c for c in evidence.candidates if c.key == ("dry_friction", "x"))
    load = (MASS + 0.1) * 9.81
    leader = search.refit((rubs,), (np.array([MORE * load]),), effort=FINAL)
    assert leader.x[0][0] == pytest.approx(MORE * load, rel=0.05)
    slide(search, leader)
    for geom in ("floor", "runner"):
        (found,) = (f for f in search.fits.values() if f.names == {("contact_friction", geom)})
        assert found.x[0][0] == pytest.approx(MORE, rel=0.05)
        assert found.rms < 1.3
    assert search.nominal.rms > 10


def test_nothing_is_tried_where_nothing_rubs_at_what_touches(slid) -> None:
    wanted = [CATALOGUE[n] for n in ("dry_friction", "contact_friction")]
    evidence = make_evidence(
        Model.from_xml(SLED), [slid], effects=wanted, noise={"qpos": SIGMA}, threads=1
    )
    prepared = prepare(windows_of(evidence, round(0.3 / EVERY), 0.001))
    search = Search.on(prepared, list(evidence.candidates), 3, None)
    swings = next(c for c in evidence.candidates if c.key == ("dry_friction", "swing"))
    leader = search.refit((swings,), (swings.point[: swings.size],))
    before = set(search.fits)
    slide(search, leader)
    assert set(search.fits) == before


BOX = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
<worldbody><geom name="floor" type="plane" size="20 20 .1" friction="{}"/>
<body name="box" pos="0 0 .05"><freejoint name="root"/>
<geom name="box" type="box" size=".1 .07 .05" mass="1" friction="{}"/></body>
</worldbody></mujoco>"""


def thrown(seed: int) -> Recording:
    """A box that slides over a floor of friction .25 and turns, until it sticks."""
    model = mujoco.MjModel.from_xml_string(BOX.format(0.25, 0.25))
    model.opt.timestep = 0.0005
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qvel[[0, 1, 5]] = rng.uniform(-3, 3, 3)
    time, rows = np.arange(0, 1.5, 0.01), []
    for _ in time:
        pose = data.qpos + np.concatenate([1e-4 * rng.standard_normal(3), np.zeros(4)])
        mujoco.mju_quatIntegrate(pose[3:], 1e-4 * rng.standard_normal(3), 1.0)
        rows.append(pose)
        mujoco.mj_step(model, data, 20)
    return Recording.from_arrays(
        time, qpos={f"root.{k}": v for k, v in enumerate(np.array(rows).T)}
    )


def test_a_contact_that_slips_by_chance_decides_as_impacts_do(slid) -> None:
    made = make_evidence(
        Model.from_xml(BOX.format(0.6, 0.6)), [thrown(0), thrown(1)],
        effects=[CATALOGUE["contact_friction"]], threads=1,
    )  # fmt: skip
    assert not made.machine.impacts  # the box is never lifted
    assert contact_decides(made)
    sled = make_evidence(
        Model.from_xml(SLED), [slid], effects=[CATALOGUE["contact_friction"]],
        noise={"qpos": SIGMA}, threads=1,
    )  # fmt: skip
    assert not sled.machine.impacts
    assert not contact_decides(sled)
