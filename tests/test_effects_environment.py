"""Gravity, medium, contact and time step against what physics says of them."""

import mujoco
import numpy as np
import pytest
from effect_bench import Bench, G, pendulum, period

from bo_sysid.effects import CATALOGUE, Site, applicable

FALL = """<mujoco><option timestep="0.001" density="{density}" integrator="implicitfast"/>
<worldbody><body name="ball"><joint name="z" type="slide" axis="0 0 1"/>
 <joint name="x" type="slide" axis="1 0 0"/>
 <geom type="box" size=".1 .2 .3" mass="{mass}"/></body></worldbody></mujoco>"""
PLANE = """<mujoco><option timestep="0.001" cone="elliptic" impratio="10"/>
<default><geom solimp=".9 .9 .001"/></default><worldbody>
<geom name="floor" type="plane" size="5 5 .1" friction="{floor}"/>
<body name="box" pos="0 0 .05"><joint name="x" type="slide" axis="1 0 0"/>
 <joint name="z" type="slide" axis="0 0 1"/>
 <geom name="block" type="box" size=".1 .1 .05" mass="1" friction="{block}"/>
</body></worldbody></mujoco>"""


def test_tilt_changes_the_angle_at_rest() -> None:
    rod = pendulum(damping=0.5)
    _, q, _ = rod.effect("gravity_tilt", "world", "world", [0.0, 0.2], 15.0)
    assert abs(q[-1, 0]) == pytest.approx(0.2, rel=1e-3)


def test_compensated_weight_falls_more_slowly_and_stays_as_inert() -> None:
    rod = pendulum()
    t, q, _ = rod.effect("gravity_compensation", "body", "rod", [0.75], 8.0, q=0.02)
    nominal_t, nominal_q, _ = rod.run(rod.model.compile(), (), 8.0, q=0.02)
    ratio = period(t, q[:, 0]) / period(nominal_t, nominal_q[:, 0])
    assert ratio == pytest.approx(2.0, rel=1e-3)  # a quarter of the weight


def test_compensation_holds_all_that_a_body_carries() -> None:
    arm = Bench("""<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0"/>
      <geom type="sphere" size=".05" pos=".2 0 0"/>
      <body name="lower" pos=".4 0 0"><joint name="b" axis="0 1 0"/>
      <geom type="sphere" size=".05" pos=".2 0 0"/></body></body></worldbody></mujoco>""")
    model, _ = arm.edited("gravity_compensation", "body", "upper", [0.3])
    np.testing.assert_allclose(model.body_gravcomp, [0, 0.3, 0.3])
    model, _ = arm.edited("gravity_compensation", "body", "lower", [0.3])
    np.testing.assert_allclose(model.body_gravcomp, [0, 0, 0.3])


def test_drag_gives_its_terminal_velocity() -> None:
    # MuJoCo's inertia box: force 2 rho r_x r_y |v| v along z, r the half sizes
    fall = Bench(FALL.format(density=0, mass=3))
    _, _, v = fall.effect("fluid_drag", "world", "world", [800.0, 0.0], 3.0)
    assert v[-1, 0] == pytest.approx(-np.sqrt(3 * G / (2 * 800 * 0.1 * 0.2)), rel=1e-3)


def test_viscosity_gives_its_terminal_velocity() -> None:
    # of the equivalent sphere: 6 pi mu r v, r the mean half size
    fall = Bench(FALL.format(density=0, mass=3))
    _, _, v = fall.effect("fluid_drag", "world", "world", [0.0, 5.0], 6.0)
    assert v[-1, 0] == pytest.approx(-3 * G / (6 * np.pi * 5.0 * 0.2), rel=1e-3)


def test_wind_carries_what_is_light() -> None:
    fall = Bench(FALL.format(density=1000, mass=1))
    _, _, v = fall.effect("wind", "world", "world", [2.0, 0.0, 0.0], 20.0)
    assert v[-1, 1] == pytest.approx(2.0, rel=0.02)
    _, _, still = fall.run(fall.model.compile(), (), 1.0)
    assert np.abs(still[:, 1]).max() == 0.0


def test_wind_needs_a_medium() -> None:
    for density, sites in ((0, 0), (1.2, 1)):
        machine = Bench(FALL.format(density=density, mass=1)).machine
        assert len(applicable(CATALOGUE["wind"], machine)) == sites


def grip(model: mujoco.MjModel) -> float:
    """Return the ratio of tangential to normal force while the box slides."""
    data = mujoco.MjData(model)
    data.qvel[0] = 1.5
    force, found = np.zeros(6), []
    for _ in range(60):
        mujoco.mj_step(model, data)
        for k in range(data.ncon):
            mujoco.mj_contactForce(model, data, k, force)
            if force[0] > 0:
                found.append(np.linalg.norm(force[1:3]) / force[0])
    return float(np.median(found))


@pytest.mark.parametrize(
    ("floor", "block", "geom", "change"),
    [
        (0.5, 0.5, "floor", 0.2),
        (0.5, 0.5, "floor", -0.3),  # the block's would now be larger
        (0.5, 0.3, "floor", -0.1),
        (0.3, 0.5, "block", -0.4),
    ],
)
def test_a_sliding_box_is_gripped_by_the_changed_coefficient(floor, block, geom, change) -> None:
    plane = Bench(PLANE.format(floor=floor, block=block))
    model, _ = plane.edited("contact_friction", "geom", geom, [change])
    assert grip(model) == pytest.approx(max(floor, block) + change, rel=1e-6)


def test_less_friction_changes_nothing_else_of_a_contact() -> None:
    """Two geoms that differ in all that a contact takes from them; MuJoCo says what it makes."""
    floor = 'friction=".8 .01 .002" condim="3" solref=".02 1" solimp=".9 .95 .001" solmix="2"'
    xml = PLANE.format(floor=0.5, block=0.5)
    xml = xml.replace('friction="0.5"', floor, 1)
    xml = xml.replace('friction="0.5"', 'friction=".6 .03 .001" condim="1" solref=".05 .7"', 1)
    plane = Bench(xml)
    name = applicable(CATALOGUE["contact_friction"], plane.machine)[0].name
    model, _ = plane.edited("contact_friction", "geom", name, [-0.4])
    before, after = touched(plane.machine.model), touched(model)
    assert before["friction"][0] == pytest.approx(0.8)
    assert after["friction"][0] == pytest.approx(0.4)
    for told in (before, after):
        told["friction"][:2] = 0.0
    for what in before:
        np.testing.assert_allclose(after[what], before[what], err_msg=what)


FEET = """<mujoco><worldbody><geom name="floor" type="plane" size="3 3 .1" {floor}/>
  <body name="a" pos="0 0 .099"><joint type="slide" axis="0 0 1"/>
  <geom name="foot" size=".1" {foot}/></body>
  <body name="b" pos="1 0 .099"><joint type="slide" axis="0 0 1"/>
  <geom name="leg" size=".1" {leg}/></body>
  </worldbody><contact><exclude body1="a" body2="b"/>{pair}</contact></mujoco>"""


@pytest.mark.parametrize(
    ("attributes", "offered"),
    [
        ({}, {"floor", "foot", "leg"}),
        ({"foot": 'condim="6"'}, {"foot", "leg"}),
        ({"foot": 'solref=".005 1"'}, {"foot", "leg"}),
        ({"foot": 'friction="1 .02 .001"'}, {"foot", "leg"}),
        ({"foot": 'priority="-1"'}, {"floor", "leg"}),
        ({"foot": 'priority="-1"', "leg": 'condim="4"'}, {"leg"}),
        ({"pair": '<pair geom1="floor" geom2="foot" friction="1 1 .01 .001 .001"/>'}, {"leg"}),
    ],
)
def test_friction_is_offered_where_it_changes_in_all_contacts_and_nothing_else(
    attributes, offered
) -> None:
    text = FEET.format(**{**dict.fromkeys(("floor", "foot", "leg", "pair"), ""), **attributes})
    feet = Bench(text)
    sites = {s.name for s in applicable(CATALOGUE["contact_friction"], feet.machine)}
    assert sites == offered
    before = contacts(feet.machine.model)
    for geom in sites:
        for change in (-0.4, 0.3):
            model, _ = feet.edited("contact_friction", "geom", geom, [change])
            for pair, after in contacts(model).items():
                assert after[1] == pytest.approx(before[pair][1] + change * (geom in pair))
                np.testing.assert_allclose(
                    np.delete(after, [1, 2]), np.delete(before[pair], [1, 2])
                )


def contacts(model: mujoco.MjModel) -> dict[tuple[str, ...], np.ndarray]:
    """Return dim, friction, solref and solimp of each contact, by the names of its geoms."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return {
        tuple(model.geom(g).name for g in c.geom): np.array(
            [c.dim, *c.friction, *c.solref, *c.solimp]
        )
        for c in data.contact
    }


def touched(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return what MuJoCo makes of the attributes of two geoms in their first contact."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    contact = data.contact[0]
    return {n: np.copy(getattr(contact, n)) for n in ("dim", "friction", "solref", "solimp")}


def test_friction_acts_at_the_geom_that_decides() -> None:
    for floor, block, sites in ((0.5, 0.5, 2), (0.5, 0.3, 1), (0.3, 0.5, 1)):
        machine = Bench(PLANE.format(floor=floor, block=block)).machine
        assert len(applicable(CATALOGUE["contact_friction"], machine)) == sites


def test_a_softer_contact_sinks_in_by_the_square_of_its_time_constant() -> None:
    plane = Bench(PLANE.format(floor=0.5, block=0.5))
    depths = []
    for x in ([0.0], [0.02]):
        model, _ = plane.edited("contact_softness", "world", "world", x)
        _, q, _ = plane.run(model, (), 1.0)
        depths.append(-q[-1, 1])
    # stiffness per mass 1/T²: four times as deep with 0.04 s as with 0.02 s
    assert depths[1] / depths[0] == pytest.approx(4.0, rel=1e-3)


BALL = """<mujoco><option timestep="0.0002" gravity="0 0 0"/><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body name="a" pos="0 0 0.12"><joint name="z" type="slide" axis="0 0 1"/>
    <geom name="ball" size="0.1" mass="1"/></body></worldbody></mujoco>"""


LISTED = (
    BALL.replace('mass="1"', 'mass="1" contype="0"')
    .replace('size="1 1 1"', 'size="1 1 1" contype="0"')
    .replace(
        "</worldbody>",
        '</worldbody><contact><pair geom1="floor" geom2="ball" solref="0.03 0.7"/></contact>',
    )
)
"""The same, where the model lists the only pair that touches."""


@pytest.mark.parametrize(
    ("effect", "column", "own", "change"),
    [("contact_softness", 0, 0.03, 0.01), ("contact_restitution", 1, 0.7, -0.4)],
)
def test_a_pair_that_a_model_lists_yields_otherwise(
    effect: str, column: int, own: float, change: float
) -> None:
    ball, made = Bench(LISTED), CATALOGUE[effect]
    (site,) = applicable(made, ball.machine)
    assert made.nominal is not None
    assert made.nominal(site, ball.machine) == own
    model, _ = ball.edited(effect, "world", "world", [change])
    data = mujoco.MjData(model)
    data.qpos[0] = -0.03
    mujoco.mj_forward(model, data)
    assert data.contact[0].solref[column] == pytest.approx(own + change)


@pytest.mark.parametrize("change", [-0.9, -0.7, -0.4, 0.0, 0.8])
def test_a_ball_rebounds_with_the_restitution_that_is_told(change: float) -> None:
    ball = Bench(BALL)
    effect = CATALOGUE["contact_restitution"]
    model, _ = ball.edited("contact_restitution", "world", "world", [change])
    data = mujoco.MjData(model)
    data.qvel[0] = -1.0
    while data.qpos[0] <= 0.0 and data.time < 1.0:
        mujoco.mj_step(model, data)
    assert effect.details is not None
    told = effect.details(np.array([change]), ball.machine, Site("world", "world"))
    assert data.qvel[0] == pytest.approx(told["restitution"][0], rel=0.03)
    assert told["restitution in the model"][0] == pytest.approx(np.exp(-2.0))


def test_time_step() -> None:
    rod = pendulum()
    model, _ = rod.edited("timestep", "world", "world", [-0.0004])
    assert model.opt.timestep == pytest.approx(0.0006)
