"""Effects against their formulas at one instant; the registry."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bo_sysid.checks.motion import excitation
from bo_sysid.effects import (
    CATALOGUE,
    Effect,
    Filter,
    Force,
    Machine,
    Site,
    applicable,
    catalogue,
    chosen,
    effect,
    load_effects,
    survey,
)
from bo_sysid.errors import StudyError
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation.lockstep import LawInputs

ARM = """<mujoco><compiler angle="degree"/><option timestep="0.002"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" springref="10" stiffness=".5" damping=".1"/>
 <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>
 <body name="fore" pos="0 0 -.3"><joint name="elbow" axis="0 1 0"/>
  <geom name="foregeom" type="capsule" fromto="0 0 0 0 0 -.25" size=".02"/>
  <body name="carriage" pos="0 0 -.25"><joint name="rail" type="slide" axis="1 0 0"/>
   <geom type="box" size=".02 .02 .02" mass=".2"/></body></body></body></worldbody>
<actuator><motor name="motor" joint="shoulder" gear="2"/>
 <position name="servo" joint="elbow" kp="5" kv=".2"/><motor name="pull" joint="rail"/></actuator>
</mujoco>"""
QPOS, QVEL, CTRL = np.array([0.3, 0.5, 0.05]), np.array([1.0, -0.5, 0.3]), np.array([0.4, 0.1, 0.2])


@pytest.fixture(scope="module")
def arm() -> Model:
    return Model.from_xml(ARM)


@pytest.fixture(scope="module")
def machine(arm: Model) -> Machine:
    t = np.arange(0, 4, 0.002)
    recording = Recording.from_arrays(
        t,
        qpos={"shoulder": np.sin(3 * t), "elbow": np.cos(2 * t), "rail": 0.1 * np.sin(5 * t)},
        ctrl={"motor": np.sin(3 * t), "servo": np.cos(2 * t), "pull": np.cos(5 * t)},
    )
    return survey(arm.compile(), [recording])


def compiled(
    arm: Model, machine: Machine, effect: Effect, site: Site, x: np.ndarray
) -> tuple[mujoco.MjModel, tuple]:
    parts: list[tuple] = []
    model = arm.compile([lambda spec: parts.append(effect.parts(spec, site, x, machine))])
    return model, parts[0]


def force(model: mujoco.MjModel) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = QPOS, QVEL, CTRL
    mujoco.mj_forward(model, data)
    return data.qfrc_passive + data.qfrc_actuator + data.qfrc_constraint


def at(arm, machine, id: str, kind: str, site: str, x) -> tuple[mujoco.MjModel, tuple]:
    return compiled(arm, machine, CATALOGUE[id], Site(kind, site), np.array(x, float))


@pytest.mark.parametrize(
    ("id", "site", "x", "expected"),
    [
        ("viscous_damping", "elbow", [0.3], [0, 0.3 * 0.5, 0]),
        ("quadratic_damping", "elbow", [0.3], [0, 0.3 * 0.25, 0]),
        ("constant_force", "shoulder", [0.7], [0.7, 0, 0]),
        ("constant_force", "rail", [-0.7], [0, 0, -0.7]),
        ("joint_spring", "elbow", [2.0, 0.3], [0, 0.3 - 2.0 * 0.5, 0]),
        ("joint_spring", "shoulder", [2.0, 0.3], [0.3 - 2.0 * 0.3, 0, 0]),
        ("cogging", "elbow", [0.1, 0.2, 7.0], [0, 0.1 * np.sin(3.5) + 0.2 * np.cos(3.5), 0]),
    ],
)
def test_forces_follow_their_formula(arm, machine, id, site, x, expected) -> None:
    model, parts = at(arm, machine, id, "joint", site, x)
    assert parts == ()
    np.testing.assert_allclose(force(model) - force(arm.compile()), expected, atol=2e-6)


@pytest.mark.parametrize(
    ("id", "x", "expected"), [("constant_force", [0.7], 0.7), ("joint_spring", [2.0, 0.3], -0.7)]
)
def test_a_force_on_a_joint_leaves_the_rest_length_of_tendons(machine, id, x, expected) -> None:
    text = ARM.replace(
        "<actuator>",
        """<tendon><fixed name="tie" stiffness="3">
      <joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-.5"/></fixed></tendon>
      <actuator>""",
    )
    plain, tied = mujoco.MjModel.from_xml_string(text), Model.from_xml(text)
    model, _ = at(tied, machine, id, "joint", "elbow", x)
    np.testing.assert_array_equal(model.tendon_lengthspring, plain.tendon_lengthspring)
    np.testing.assert_allclose(force(model) - force(plain), [0, expected, 0], atol=2e-6)


def test_two_forces_on_one_joint_add(arm, machine) -> None:
    edits = [
        lambda s: CATALOGUE["constant_force"].parts(
            s, Site("joint", "elbow"), np.array([0.4]), machine
        ),
        lambda s: CATALOGUE["joint_spring"].parts(
            s, Site("joint", "elbow"), np.array([1.0, 0.1]), machine
        ),
        lambda s: CATALOGUE["cogging"].parts(
            s, Site("joint", "elbow"), np.array([0.1, 0.0, 4.0]), machine
        ),
        lambda s: CATALOGUE["cogging"].parts(
            s, Site("joint", "elbow"), np.array([0.1, 0.0, 9.0]), machine
        ),
    ]
    expected = 0.4 + 0.1 - 0.5 + 0.1 * np.sin(2.0) + 0.1 * np.sin(4.5)
    np.testing.assert_allclose(
        force(arm.compile(edits)) - force(arm.compile()), [0, expected, 0], atol=2e-6
    )


def test_dry_friction_holds_a_load_without_creep(machine) -> None:
    slope = Model.from_xml(
        "<mujoco><option timestep='.002'/><worldbody><body><joint name='elbow' axis='0 1 0'/>"
        "<geom type='sphere' size='.02' pos='.3 0 0' mass='.1'/></body></worldbody></mujoco>"
    )
    model, _ = compiled(
        slope, machine, CATALOGUE["dry_friction"], Site("joint", "elbow"), np.array([0.5])
    )
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert abs(data.qvel[0]) < 1e-5


def test_stribeck_friction_falls_from_static_to_coulomb(arm, machine) -> None:
    model, (law,) = at(arm, machine, "stribeck_friction", "joint", "elbow", [0.2, 0.1, 0.05])
    assert isinstance(law, Force)
    assert model.joint("elbow").frictionloss[0] == pytest.approx(0.3)

    speed = np.array([-10.0, 0.0, 0.05, 10.0])
    motion = LawInputs(speed, {}, {"elbow": speed}, {}, {}, 0.002)
    felt = law.law(motion) - 0.3 * np.sign(speed)
    np.testing.assert_allclose(felt, [0.1, 0.0, -(0.1 + 0.2 * np.exp(-1)), -0.1])


def test_link_mass_scales_inertia_and_payload_adds_a_point(arm, machine) -> None:
    heavier, _ = at(arm, machine, "link_mass", "body", "fore", [0.1])
    nominal = arm.compile()
    before, after = nominal.body("fore"), heavier.body("fore")
    assert after.mass[0] == pytest.approx(before.mass[0] + 0.1)
    np.testing.assert_allclose(after.inertia / before.inertia, after.mass[0] / before.mass[0])
    loaded, _ = at(arm, machine, "payload", "body", "fore", [0.1])
    assert loaded.body_subtreemass[1] == pytest.approx(nominal.body_subtreemass[1] + 0.1)


_WEDGE = "0 0 0  .3 .02 0  .3 -.02 0  .3 0 .04"  # from the joint to .3 m along x


@pytest.mark.parametrize(
    ("geoms", "x"),
    [
        ('<geom type="box" pos=".1 0 0" size=".1 .02 .02"/>', 0.2),
        ('<geom type="box" pos=".1 0 0" size=".02 .02 .1" euler="0 90 0"/>', 0.2),
        ('<geom type="mesh" mesh="wedge"/>', 0.3),
        ('<geom type="capsule" fromto="0 0 0 .2 0 0" size=".03"/>', 0.2),
        ('<geom type="box" pos=".1 0 0" size=".03 .03 .03"/>', 0.1),
        ('<geom type="box" pos=".1 0 0" size=".1 .02 .02"/><site pos=".15 0 0"/>', 0.15),
    ],
)
def test_a_payload_hangs_at_the_site_or_the_end_of_a_long_geom(geoms: str, x: float) -> None:
    model = Model.from_xml(
        f'''<mujoco><asset><mesh name="wedge" vertex="{_WEDGE}"/></asset><worldbody>
        <body name="link"><joint name="hinge" axis="0 1 0"/>{geoms}</body></worldbody></mujoco>'''
    ).compile()
    t = np.arange(0, 1, 0.01)
    moved = Recording.from_arrays(t, qpos={"hinge": np.sin(3 * t)})
    tip = survey(model, [moved]).bodies["link"].tip
    assert tip[0] == pytest.approx(x, abs=1e-3)
    assert np.hypot(*tip[1:]) < 0.03  # near the axis of the link, within its thickness


def test_a_servo_with_more_gain_rests_at_the_same_place(arm, machine) -> None:
    model, _ = at(arm, machine, "actuator_gain", "actuator", "servo", [0.5])
    a = model.actuator("servo")
    np.testing.assert_allclose(a.gainprm[0], 7.5)
    np.testing.assert_allclose(a.biasprm[1:3], [-7.5, -0.3])


def test_gravity_turns_and_keeps_its_size(arm, machine) -> None:
    model, _ = at(arm, machine, "gravity_tilt", "world", "world", [0.0, 0.2])
    g = model.opt.gravity
    assert np.linalg.norm(g) == pytest.approx(9.81)
    np.testing.assert_allclose(g, [-9.81 * np.sin(0.2), 0, -9.81 * np.cos(0.2)])


def filtered(arm, machine, id: str, x: float, channel: Channel, dt: float) -> Channel:
    _, (part,) = at(arm, machine, id, "actuator", "motor", [x])
    assert isinstance(part, Filter)
    assert part.actuator == "motor"
    return part.change(channel, dt)


def test_lag_has_the_step_response_of_a_first_order_system(arm, machine) -> None:
    t = np.arange(0, 1, 0.002)
    step = Channel(t, (t >= 0.1 - 1e-9) * 1.0, hold="zero")
    out = filtered(arm, machine, "actuator_lag", 0.05, step, 0.002)
    late = out.time >= 0.1 - 1e-9
    begin = np.maximum(out.time[late] - 0.1, 0)
    exact = 1 - (np.exp(-begin / 0.05) - np.exp(-(begin + 0.002) / 0.05)) * 0.05 / 0.002
    np.testing.assert_allclose(out.values[late], exact, atol=1e-9)
    assert not out.values[~late].any()


def test_delay_and_dead_zone(arm, machine) -> None:
    t = np.arange(0, 1, 0.01)
    ramp = Channel(t, t - 0.5, hold="zero")
    late = filtered(arm, machine, "actuator_delay", 0.013, ramp, 0.002)
    assert late.at(np.array([0.5 + 0.013 + 1e-9]))[0] == pytest.approx(0.0)
    dead = filtered(arm, machine, "actuator_deadzone", 0.2, ramp, 0.002)
    np.testing.assert_allclose(dead.values[[0, 50, 99]], [-0.3, 0, 0.29], atol=1e-12)


def test_saturation_counts_the_torque_lost(arm, machine) -> None:
    model, _ = at(arm, machine, "actuator_saturation", "actuator", "motor", [0.5])
    top = machine.actuators["motor"].force_max
    assert top == pytest.approx(2.0, rel=1e-3)  # gear 2, control up to 1
    assert model.actuator("motor").forcerange[1] * 2 == pytest.approx(top - 0.5)


USER = """
from bo_sysid.effects import Component, Extent, effect

@effect("my_friction", kind="joint", components=(Component("level", "N m"),),
        extent=lambda site, machine: Extent((0.1,), (0.0,), (1.0,)),
        noun="my friction", sentence="{site} has {value} of mine.", evidence="e", separation="s")
def my_friction(spec, site, x, machine):
    spec.joint(site.name).frictionloss += x[0]
"""


def test_a_channel_that_only_some_recordings_have_is_no_site(arm) -> None:
    t = np.arange(0, 1, 0.002)
    qpos = {"shoulder": np.sin(3 * t), "elbow": np.cos(2 * t)}
    ctrl = {"shoulder": 0 * t, "elbow": 0 * t}
    both = [
        Recording.from_arrays(t, qpos=qpos, ctrl=ctrl),
        Recording.from_arrays(t, qpos=qpos, ctrl=ctrl, qvel={"elbow": np.sin(t)}),
    ]
    machine = survey(arm.compile(), both)
    assert machine.channels == ("qpos.shoulder", "qpos.elbow")
    for own in CATALOGUE.values():
        assert "qvel.elbow" not in {s.name for s in applicable(own, machine)}


def test_a_pause_in_a_log_is_no_motion(arm) -> None:
    """Two sessions with the stamps of one clock have the scales of both, not of the pause."""
    t = np.concatenate([np.arange(0, 5, 0.01), 86400 + np.arange(0, 5, 0.01)])
    moved = {"shoulder": np.sin(4 * t), "elbow": np.cos(3 * t)}
    log = Recording.from_arrays(t, qpos=moved, ctrl=moved)
    first = log.between(0.0, 5.0)
    both, one = survey(arm.compile(), [log]), survey(arm.compile(), [first])
    for joint in ("shoulder", "elbow"):
        assert both.joints[joint].speed == pytest.approx(one.joints[joint].speed, rel=0.1)
        assert both.joints[joint].force == pytest.approx(one.joints[joint].force, rel=0.1)
    told = excitation([log], arm.compile()).set_index("joint")
    assert told.loc["shoulder", "speed"] == pytest.approx(4 / np.sqrt(2), rel=0.1)


def test_a_user_registers_an_effect(tmp_path: Path, arm, machine) -> None:
    file = tmp_path / "mine.py"
    file.write_text(USER)
    for _ in range(2):  # again: nothing of the first time is left
        (mine,) = load_effects(file)
    assert mine.id == "my_friction"
    assert "my_friction" not in CATALOGUE  # it is the study's that names the file
    assert set(catalogue([file])) == {*CATALOGUE, "my_friction"}
    with pytest.raises(StudyError, match=r"mine\.py: effect 'my_friction' is registered twice"):
        catalogue([file, file])
    model, _ = compiled(arm, machine, mine, Site("joint", "elbow"), np.array([0.3]))
    assert model.joint("elbow").frictionloss[0] == 0.3
    file.write_text("raise OSError('no')")
    with pytest.raises(StudyError, match=r"mine\.py: OSError: no"):
        load_effects(file)
    file.write_text("import sys; sys.exit(0)")
    with pytest.raises(StudyError, match=r"mine\.py ends the program \(SystemExit\(0\)\)"):
        load_effects(file)
    file.write_text("x = 1")
    with pytest.raises(StudyError, match="registers no effect"):
        load_effects(file)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "jiont"}, r"unknown kind of site 'jiont'; did you mean 'joint'"),
        ({"shapes": 1}, r"shapes is 1 of 1 components"),
        ({"sentence": "{sit} has {value}"}, r"nothing is called \{sit\}; did you mean 'site'"),
        ({"sentence": "{site has {value}"}, r"sentence: .*; a brace is written twice"),
        ({"sentence": "{site} has {}"}, r"sentence: .*positional.*; a brace is written twice"),
        ({"sentence": "{site} has {value:.2f}"}, r"sentence: .*'f'.* what stands for \{value\} is"),
        ({"sentence": "{site} has {value:{width}}"}, r"nothing is called \{width\}"),
        ({"sentence": "{site.name} has {value}"}, r"sentence: .*no attribute 'name'"),
    ],
)
def test_an_effect_that_cannot_be_is_refused_when_it_is_registered(change, said) -> None:
    own = CATALOGUE["dry_friction"]
    fields = {f.name: getattr(own, f.name) for f in dataclasses.fields(own)}
    fields = {n: v for n, v in fields.items() if n not in ("id", "apply")}
    fields |= {"components": own.components[:1], "shapes": 0, **change}
    with pytest.raises(StudyError, match=said):
        effect("of_my_own", **fields)(own.apply)
    assert "of_my_own" not in CATALOGUE


def test_unknown_effects_are_named_with_the_nearest() -> None:
    with pytest.raises(
        StudyError, match="unknown effect 'dry_fricton'; did you mean 'dry_friction'"
    ):
        chosen(CATALOGUE, ["dry_fricton"])
    assert all(e.id != "cogging" for e in chosen(CATALOGUE, "all", ("cogging",)))


PLANAR = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body name="torso" pos="0 0 1">
<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
<joint name="pitch" axis="0 1 0"/><geom size=".1"/>
<body name="leg"><joint name="hip" axis="0 1 0"/><geom size=".05" pos="0 0 -.3"/></body></body>
</worldbody><actuator><motor joint="hip"/>{}</actuator></mujoco>"""


@pytest.mark.parametrize(
    ("motor", "sites"),
    [("", ("hip",)), ('<motor joint="x"/>', ("x", "z", "pitch", "hip"))],
    ids=["a walker floats", "a gantry is driven"],
)
def test_nothing_acts_at_the_joints_of_a_base_that_floats(motor: str, sites: tuple[str]) -> None:
    model = Model.from_xml(PLANAR.format(motor))
    t = np.arange(0, 1, 0.002)
    recording = Recording.from_arrays(t, qpos={n: np.sin(3 * t) for n in model.joints})
    machine = survey(model.compile(), [recording])
    assert machine.names("joint") == sites
    assert set(machine.joints) == {"x", "z", "pitch", "hip"}  # their scales are known all the same


def test_a_file_of_effects_may_hold_dataclasses(tmp_path) -> None:
    text = (Path(__file__).parent.parent / "studies" / "effects" / "my_effect.py").read_text()
    head = "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    own = "\n@dataclass\nclass Own:\n    size: float = 1.0\n\nassert Own().size == 1\n"
    (tmp_path / "mine.py").write_text(head + text + own)
    (made,) = load_effects(tmp_path / "mine.py")
    assert made.id == "worn_spot"


@pytest.mark.parametrize("periods", [1.3, 5.0, 9.6, 16.5, 30.5, 47.5])
def test_a_periodic_force_in_the_stroke_of_a_slide_is_seen_at_a_point_of_the_grid(
    machine: Machine, periods: float
) -> None:
    """Whatever its period, one of the grid explains a third of it: enough to be refined from."""
    points = CATALOGUE["cogging"].extent(Site("joint", "rail"), machine).grid
    q = np.linspace(-0.1, 0.1, 4001)  # the stroke that was recorded, at one speed
    wave = np.sin(2 * np.pi * periods / 0.2 * q + 0.7)
    explained = 0.0
    for *_, k in points:
        A = np.stack([np.sin(k * q), np.cos(k * q), np.ones_like(q)], axis=1)
        left = wave - A @ np.linalg.lstsq(A, wave, rcond=None)[0]
        explained = max(explained, 1 - (left @ left) / (wave @ wave))
    assert explained > 1 / 3


@pytest.mark.parametrize("beside", [("com_shift", [0.01, 0.0, 0.0]), ("link_inertia", [0.1])])
@pytest.mark.parametrize("first", ["payload", "other"])
def test_a_payload_counts_once_where_static_bodies_are_fused(
    tmp_path: Path, beside: tuple[str, list[float]], first: str
) -> None:
    """As in every URDF: what follows freezes the body's inertial, without the load on it."""
    (tmp_path / "arm.urdf").write_text(
        '<robot name="r"><link name="base"/><link name="l1"><inertial><origin xyz="0.1 0 0"/>'
        '<mass value="1"/><inertia ixx=".01" iyy=".02" izz=".02" ixy=".001" ixz="0" iyz="0"/>'
        '</inertial></link><joint name="j1" type="revolute"><parent link="base"/>'
        '<child link="l1"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="10" velocity="10"/></joint></robot>'
    )
    model, time = Model.from_file(tmp_path / "arm.urdf"), np.arange(300) * 0.01
    machine = survey(model.compile(), [Recording.from_arrays(time, qpos={"j1": np.sin(3 * time)})])
    edits = [("payload", [0.5, 0.3, 0.0, 0.0]), beside]
    made = model.compile(
        [
            lambda spec, e=e: CATALOGUE[e[0]].parts(
                spec, Site("body", "l1"), np.array(e[1]), machine
            )
            for e in (edits if first == "payload" else edits[::-1])
        ]
    )
    assert made.body_subtreemass[0] == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("load", "offered"),
    [
        ('<inertial pos="0 0 0" mass=".2" diaginertia="1e-9 1e-9 1e-9"/>', True),
        ('<geom size=".03" pos=".02 0 0" mass=".2"/>', False),
        ('<joint name="grip"/><geom size=".03" mass=".2"/>', False),
    ],
)
def test_a_body_that_only_bears_the_name_of_a_load_is_left_alone(load: str, offered: bool) -> None:
    """A gripper of that name would have become a point mass, at magnitude 0 too."""
    model = Model.from_xml(
        '<mujoco><worldbody><body name="hand"><joint name="j" axis="0 1 0"/><geom size=".1" '
        f'mass="1"/><body name="hand_payload" pos=".1 0 0">{load}</body></body></worldbody>'
        "</mujoco>"
    )
    time = np.arange(300) * 0.01
    names = [model.compile().joint(k).name for k in range(model.compile().njnt)]
    moved = {n: np.sin((3 + k) * time) for k, n in enumerate(names)}
    machine = survey(model.compile(), [Recording.from_arrays(time, qpos=moved)])
    sites = applicable(CATALOGUE["payload"], machine)
    assert (Site("body", "hand") in sites) == offered


def test_a_body_that_no_force_moves_has_no_mass_to_be_wrong() -> None:
    """A mocap body, with what is welded to it, and a table."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="table"><geom size=".1"/></body><body name="target" '
        'mocap="true" pos="1 0 0"><geom size=".1"/><body name="flag"><geom size=".1"/></body>'
        '</body><body name="arm" pos="2 0 0"><joint name="j" axis="0 1 0"/><geom size=".1"/>'
        '<body name="hand" pos=".3 0 0"><geom size=".05"/></body></body></worldbody></mujoco>'
    )
    time = np.arange(300) * 0.01
    machine = survey(model, [Recording.from_arrays(time, qpos={"j": np.sin(3 * time)})])
    assert set(machine.bodies) == {"arm", "hand"}
