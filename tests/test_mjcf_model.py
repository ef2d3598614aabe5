"""Models: what is read, how it is named, that stripping and exporting change no physics."""

import os
from time import perf_counter

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import ModelError
from bo_sysid.mjcf import Model, address_edit
from bo_sysid.mjcf.commands import units
from bo_sysid.mjcf.edits import MotorEdit

OFF = mujoco.mjtDisableBit

ARM = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="upper"><joint name="shoulder"/>
      <geom name="rod" size=".05" fromto="0 0 0 .3 0 0" type="capsule"/>
      <body><joint damping="0.1"/><geom size=".04" fromto="0 0 0 .2 0 0" type="capsule"/></body>
    </body>
    <body name="box"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
    <body name="ball"><joint name="socket" type="ball"/><geom size=".1"/></body>
  </worldbody>
  <actuator>
    <motor joint="shoulder"/>
    <general name="valve" joint="shoulder" dyntype="filter" dynprm="0.1"/>
    <motor joint="shoulder" gear="2"/>
  </actuator>
  <sensor><jointpos name="angle" joint="shoulder"/><gyro site="s"/></sensor>
</mujoco>
""".replace("<freejoint/>", '<freejoint/><site name="s"/>')

FLOATING = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1"><freejoint/><geom size=".1"/>
      <body name="leg"><joint name="hip"/><geom size=".1" pos="0 0 -.3"/></body>
    </body>
    <body name="ball" pos="2 0 0"><freejoint name="ball"/><geom size=".1"/></body>
  </worldbody>
  <actuator><position name="hip" joint="hip"/></actuator>
  <keyframe>
    <key name="home" qpos="1 2 3 1 0 0 0 .5 4 5 6 1 0 0 0" qvel="1 2 3 4 5 6 .7 0 0 0 0 0 9"
         ctrl=".3"/>
  </keyframe>
</mujoco>
"""

TETRAHEDRON = """
v 0 0 0
v 0.1 0 0
v 0 0.1 0
v 0 0 0.1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""

MESHES = """
<mujoco>
  <compiler meshdir="parts"/>
  <asset><mesh file="shell.obj"/><mesh name="core" file="shell.obj" scale="2 2 2"/></asset>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="link"><joint name="hinge" axis="0 1 0" damping="0.1"/>
      <inertial mass="1" pos=".1 0 0" diaginertia=".01 .01 .01"/>
      <geom name="seen" type="mesh" mesh="shell" contype="0" conaffinity="0"/>
      <geom name="felt" type="mesh" mesh="core"/>
    </body>
    <body name="other" pos="1 0 0"><joint name="other" axis="0 1 0"/>
      <geom name="weighing" type="mesh" mesh="shell" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""


def roll_out(model: mujoco.MjModel, steps: int = 300) -> np.ndarray:
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    states = []
    for _ in range(steps):
        data.ctrl[:] = rng.uniform(-1, 1, model.nu)
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(states)


SUITE = [("cheetah", "run"), ("hopper", "hop"), ("swimmer", "swimmer6"), ("swimmer", "swimmer3")]


@pytest.mark.parametrize(("domain", "task"), SUITE)
def test_stripped_model_moves_as_the_full_one_to_the_last_bit(domain, task):
    model = Model.from_dm_control(domain, task)
    lean, full = model.compile(), model.compile(visuals=True)
    np.testing.assert_array_equal(roll_out(lean), roll_out(full))
    assert lean.ntex == lean.ncam == lean.nlight == 0
    assert full.ntex > 0
    assert full.ncam > 0


def test_unedited_model_moves_as_the_suites_own_to_the_last_bit():
    from dm_control.mujoco import Physics
    from dm_control.suite import hopper

    ours = Model.from_dm_control("hopper", "stand").compile()
    theirs = Physics.from_xml_string(*hopper.get_model_and_assets()).model.ptr
    np.testing.assert_array_equal(roll_out(ours), roll_out(theirs))


@pytest.mark.parametrize("domain", ["acrobot", "fish", "lqr", "finger"])
def test_what_flags_switch_off_is_written_down_to_the_last_bit(domain):
    """All but finger, which knows no gravity, disable constraints; fish and lqr have limits."""
    from dm_control import suite

    task = next(t for d, t in suite.ALL_TASKS if d == domain)
    ours = Model.from_dm_control(domain, task).compile()
    theirs = suite.load(domain, task, task_kwargs={"random": 0}).physics.model.ptr
    assert theirs.opt.disableflags & (OFF.mjDSBL_CONSTRAINT | OFF.mjDSBL_GRAVITY)
    assert not ours.opt.disableflags & (OFF.mjDSBL_CONSTRAINT | OFF.mjDSBL_GRAVITY)
    np.testing.assert_array_equal(roll_out(ours), roll_out(theirs))


FLAGGED = """<mujoco><option timestep=".002"><flag {flag}="disable"/></option><worldbody>
 <body><joint name="one" axis="0 1 0" frictionloss="{loss}"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/></body>
 <body pos="0 1 0"><joint name="two" axis="0 1 0" frictionloss="{other}"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/></body></worldbody>
 <equality><joint joint1="one" joint2="two" active="{active}"/></equality></mujoco>"""


@pytest.mark.parametrize("flag", ["constraint", "frictionloss"])
def test_friction_is_added_where_a_flag_switches_all_of_a_model_off(flag):
    active = {"constraint": "false", "frictionloss": "true"}[flag]
    off = Model.from_xml(FLAGGED.format(flag=flag, loss=0, other=0.3, active="true"))
    added = off.compile([address_edit(off, ["joint[one].frictionloss"], 0.2)])
    without_flag = FLAGGED.format(flag="contact", loss=0.2, other=0, active=active)
    truth = mujoco.MjModel.from_xml_string(without_flag)
    np.testing.assert_array_equal(roll_out(added), roll_out(truth))


PASSIVE = """<mujoco><option timestep=".002" density="50" viscosity=".1"><flag {}/></option>
 <worldbody><body gravcomp=".4"><joint name="a" axis="0 1 0" stiffness="2 1 1" damping=".1 .2 .1"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/><site name="s" pos=".2 0 0"/>
  <body pos=".3 0 0"><joint name="b" axis="1 0 1" springdamper=".3 .5"/>
   <geom type="capsule" fromto="0 0 0 .3 .1 .1" size=".02" mass="1"/></body></body>
  <site name="w" pos="0 0 .3"/></worldbody><tendon><spatial stiffness="30" damping=".5"
  springlength=".1"><site site="w"/><site site="s"/></spatial></tendon>
 <actuator><motor joint="a" damping=".05"/></actuator></mujoco>"""


@pytest.mark.parametrize("flag", ['spring="disable"', 'damper="disable"'])
def test_springs_and_dampers_are_added_where_a_flag_switches_those_of_a_model_off(flag):
    """Both flags together switch off what no edit is, and stay."""
    plain = Model.from_xml(text := PASSIVE.format(flag))
    truth = mujoco.MjModel.from_xml_string(text)
    np.testing.assert_array_equal(roll_out(plain.compile()), roll_out(truth))
    what, dof = ("stiffness", "jnt") if "spring" in flag else ("damping", "dof")
    added = plain.compile([address_edit(plain, [f"joint[b].{what}"], 0.3)])
    bare = mujoco.MjModel.from_xml_string(PASSIVE.format(""))
    for name in (f"{dof}_{what}", f"{dof}_{what}poly", f"tendon_{what}", f"actuator_{what}"):
        if hasattr(bare, name):
            getattr(bare, name)[:] = 0.0
    getattr(bare, f"{dof}_{what}")[1] = 0.3
    np.testing.assert_array_equal(roll_out(added), roll_out(bare))
    both = PASSIVE.format('spring="disable" damper="disable"')
    silent = mujoco.MjModel.from_xml_string(both)
    np.testing.assert_array_equal(roll_out(Model.from_xml(both).compile()), roll_out(silent))


@pytest.mark.parametrize(
    ("domain", "task", "bodies"),
    [("swimmer", "swimmer3", 3), ("swimmer3", "swim", 3), ("swimmer", "swimmer15", 15)],
)
def test_swimmers_of_any_length(domain, task, bodies):
    assert len(Model.from_dm_control(domain, task).bodies) == bodies + 1


def test_tasks_arguments_reach_the_builder():
    assert len(Model.from_dm_control("cartpole", "balance").joints) == 2
    assert len(Model.from_dm_control("cartpole", "two_poles").joints) == 3


def test_unnamed_elements_get_stable_names():
    model = Model.from_xml(ARM)
    assert model.joints == ("shoulder", "joint_1", "joint_2", "socket")
    assert model.bodies == ("world", "upper", "body_2", "box", "ball")
    assert model.geoms == ("geom_0", "rod", "geom_2", "geom_3", "geom_4")
    assert model.actuators == ("actuator_0", "valve", "actuator_2")
    assert model.sensors == ("angle", "sensor_1")
    assert model.spec().joint("joint_1").damping[0] == 0.1


def test_lone_actuator_is_called_after_its_joint():
    text = ARM.replace('<motor joint="shoulder" gear="2"/>', "").replace(
        '<general name="valve" joint="shoulder"', '<general name="valve" joint="joint"'
    )
    model = Model.from_xml(text.replace("<joint damping", '<joint name="joint" damping'))
    assert model.actuators == ("shoulder", "valve")


def test_channels_follow_mujocos_order():
    model = Model.from_xml(ARM)
    compiled = model.compile()
    assert model.qpos_channels == (
        "qpos.shoulder",
        "qpos.joint_1",
        *(f"qpos.joint_2.{i}" for i in range(7)),
        *(f"qpos.socket.{i}" for i in range(4)),
    )
    assert model.qvel_channels[2:8] == tuple(f"qvel.joint_2.{i}" for i in range(6))
    assert len(model.qvel_channels) == compiled.nv
    assert model.act_channels == ("act.valve",)
    assert model.ctrl_channels == ("ctrl.actuator_0", "ctrl.valve", "ctrl.actuator_2")
    assert model.sensor_channels == ("sensor.angle", *(f"sensor.sensor_1.{i}" for i in range(3)))


def test_copies_do_not_reach_the_model():
    model = Model.from_xml(ARM)
    model.spec().joint("shoulder").damping[0] = 7.0
    model.compile().dof_damping[:] = 7.0
    model.compile([lambda spec: spec.joint("shoulder").damping.__setitem__(0, 7.0)])
    assert model.compile().dof_damping[0] == 0.0
    with pytest.raises(AttributeError):
        model.name = "other"  # type: ignore[misc]


def test_timestep():
    model = Model.from_xml(ARM)
    assert model.compile(timestep=0.003).opt.timestep == 0.003
    assert model.compile().opt.timestep == 0.002
    with pytest.raises(ModelError, match="timestep 0 s must be above 0"):
        model.compile(timestep=0.0)
    seen = []  # edits ask what the step resolves, and one that changes it is not simulated

    def edit(spec):
        seen.append(spec.option.timestep)
        spec.option.timestep = 0.005

    assert model.compile([edit], timestep=0.0005).opt.timestep == 0.0005
    assert model.compile([edit]).opt.timestep == 0.005
    assert seen == [0.0005, 0.002]


DELAYED = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <body><joint name="slide" type="slide"/><geom size=".1" mass="1"/></body>
  </worldbody>
  <actuator><motor name="a" joint="slide" delay="0.02" nsample="11" interp="linear"/></actuator>
  <sensor><jointpos name="late" joint="slide" delay="0.02" nsample="11" interp="linear"/></sensor>
</mujoco>
"""


@pytest.mark.parametrize("timestep", [0.004, 0.002, 0.0005, 0.0003])
def test_a_delay_lasts_as_long_at_any_time_step(timestep, tmp_path):
    model = Model.from_xml(DELAYED)
    assert _arrivals(model.compile(timestep=timestep)) == pytest.approx([0.05, 0.13], abs=0.005)

    def finer(spec: mujoco.MjSpec) -> None:
        spec.option.timestep = timestep

    model.export(tmp_path / "finer.xml", [finer])
    exported = mujoco.MjModel.from_xml_path(str(tmp_path / "finer.xml"))
    assert _arrivals(exported) == pytest.approx([0.05, 0.13], abs=0.005)


def test_a_buffer_grows_with_an_edited_delay_and_stays_as_written_otherwise() -> None:
    """Plain MuJoCo answers what is older than a buffer with its oldest value."""
    short = DELAYED.replace('nsample="11"', 'nsample="6"')
    model = Model.from_xml(short)
    plain = _arrivals(mujoco.MjModel.from_xml_string(short))

    def heavier(spec: mujoco.MjSpec) -> None:
        spec.geoms[0].mass = 2.0

    assert _arrivals(model.compile([heavier])) == plain
    edited = model.compile([address_edit(model, ["actuator[a].delay"], 0.04)])
    truth = short.replace('delay="0.02" nsample="6"', 'delay="0.04" nsample="30"', 1)
    expected = _arrivals(mujoco.MjModel.from_xml_string(truth))
    assert _arrivals(edited) == expected
    assert expected[0] > plain[0] + 0.02


def _arrivals(model: mujoco.MjModel) -> list[float]:
    """Return when the force of a command at 0.03 s, and a jump of the joint at 0.11 s, are felt."""
    data, dt = mujoco.MjData(model), model.opt.timestep
    felt: dict[str, float] = {}
    for k in range(round(0.2 / dt)):
        data.ctrl[:] = k * dt >= 0.03
        data.qpos[:] = k * dt >= 0.11
        mujoco.mj_step(model, data)
        for name, value in (("force", data.actuator_force[0]), ("sensor", data.sensordata[0])):
            if value > 0.5:
                felt.setdefault(name, k * dt)
    return [felt["force"], felt["sensor"]]


def test_fixed_base_holds_the_robot_and_leaves_objects_free(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(FLOATING)
    model = Model.from_file(path, base="fixed")
    assert model.joints == ("hip", "ball")
    compiled = model.compile()
    np.testing.assert_array_equal(compiled.body("base").pos, [0, 0, 1])
    np.testing.assert_array_equal(compiled.key_qpos[0], [0.5, 4, 5, 6, 1, 0, 0, 0])
    np.testing.assert_array_equal(compiled.key_qvel[0], [0.7, 0, 0, 0, 0, 0, 9])
    np.testing.assert_array_equal(compiled.key_ctrl[0], [0.3])
    assert Model.from_file(path).joints == ("joint_0", "hip", "ball")


def test_a_fixed_base_takes_along_what_pushes_it(tmp_path):
    """A disturbance along the free joint, with a sensor of it, and a keyframe of both controls."""
    pushed = FLOATING.replace("<freejoint/>", '<freejoint name="root"/>', 1)
    pushed = pushed.replace(
        "</actuator>",
        '<motor name="push" joint="root" gear="1 0 0 0 0 0"/></actuator>'
        '<sensor><actuatorfrc name="pushed" actuator="push"/><jointpos joint="hip"/></sensor>',
    )
    path = tmp_path / "robot.xml"
    path.write_text(pushed.replace('ctrl=".3"', 'ctrl=".3 7"'))
    model = Model.from_file(path, base="fixed")
    assert (model.joints, model.actuators) == (("hip", "ball"), ("hip",))
    assert len(model.sensors) == 1
    plain = FLOATING.replace("<freejoint/>", "", 1).replace("1 2 3 1 0 0 0 .5", ".5")
    truth = mujoco.MjModel.from_xml_string(plain.replace("1 2 3 4 5 6 .7", ".7"))
    compiled = model.compile()
    np.testing.assert_array_equal(compiled.key_ctrl, truth.key_ctrl)
    np.testing.assert_array_equal(roll_out(compiled), roll_out(truth))


def test_keyframes_follow_an_edit_that_adds_a_joint():
    def add(spec: mujoco.MjSpec) -> None:
        motor = spec.body("leg").add_joint(name="play", ref=0.1)
        motor.armature = 0.1

    compiled = Model.from_xml(FLOATING).compile([add])
    expected = [1, 2, 3, 1, 0, 0, 0, 0.5, np.radians(0.1), 4, 5, 6, 1, 0, 0, 0]
    np.testing.assert_allclose(compiled.key_qpos[0], expected)


def test_only_meshes_without_effect_are_stripped(tmp_path):
    model = Model.from_xml(MESHES, assets={"parts/shell.obj": TETRAHEDRON})
    lean, full = model.compile(), model.compile(visuals=True)
    assert model.geoms == ("felt", "weighing")
    assert (full.ngeom, full.nmesh) == (3, 2)
    np.testing.assert_array_equal(lean.body_mass, full.body_mass)
    np.testing.assert_array_equal(roll_out(lean), roll_out(full))


def test_what_a_sensor_sees_stays():
    text = MESHES.replace(
        "</worldbody>", '<site name="eye" pos="0 0 1"/></worldbody><sensor>SENSOR</sensor>'
    )
    assets = {"parts/shell.obj": TETRAHEDRON}
    ray = text.replace("SENSOR", '<rangefinder site="eye"/>')
    assert "seen" in Model.from_xml(ray, assets=assets).geoms
    distance = text.replace("SENSOR", '<distance geom1="seen" geom2="weighing"/>')
    assert "seen" in Model.from_xml(distance, assets=assets).geoms


SENSING = """
<mujoco><asset><mesh name="shell" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>
  <mesh name="pad" builtin="sphere" params="1" scale=".05 .05 .05"/></asset>
  <worldbody>
    <body name="arm"><joint axis="0 1 0"/><geom name="hand" size=".05" pos=".2 0 0"/>
      <geom type="mesh" mesh="shell" contype="0" conaffinity="0" mass="0" pos=".5 0 0"/></body>
    <body name="post" pos="1 0 .3"><geom name="pole" size=".05"/></body>
  </worldbody><sensor>SENSOR</sensor></mujoco>
"""


@pytest.mark.parametrize(
    "sensor",
    [
        '<distance body1="arm" body2="post" cutoff="5"/>',
        '<fromto body1="post" body2="arm" cutoff="5"/>',
        '<normal body1="arm" geom2="pole" cutoff="5"/>',
        '<tactile geom="hand" mesh="pad"/>',
    ],
)
def test_sensors_of_all_geoms_of_a_body_and_of_a_mesh_alone_show_the_same(sensor):
    text = SENSING.replace("SENSOR", sensor)
    readings = []
    for model in (Model.from_xml(text).compile(), mujoco.MjModel.from_xml_string(text)):
        mujoco.mj_forward(model, data := mujoco.MjData(model))
        readings.append(data.sensordata.copy())
    np.testing.assert_array_equal(*readings)


def test_export_loads_in_plain_mujoco_and_moves_the_same(tmp_path):
    model = Model.from_dm_control("cheetah", "run")
    edits = [
        address_edit(model, ["body[torso].mass"], 1 / 3, "scale"),
        address_edit(model, ["joint[*].damping"], np.pi, "scale"),
        address_edit(model, ["geom[ffoot].size[0]"], 0.05123456789012345),
    ]
    model.export(tmp_path / "deep" / "cheetah.xml", edits)
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "deep" / "cheetah.xml"))
    np.testing.assert_array_equal(roll_out(loaded), roll_out(model.compile(edits)))
    assert loaded.ntex > 0
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["cheetah.xml"]


def test_export_carries_its_assets_along(tmp_path):
    source = tmp_path / "source"
    (source / "parts").mkdir(parents=True)
    (source / "parts" / "shell.obj").write_text(TETRAHEDRON)
    (source / "robot.xml").write_text(MESHES)
    from_disk = Model.from_file(source / "robot.xml")
    from_memory = Model.from_xml(MESHES, assets={"shell.obj": TETRAHEDRON})
    for model in (from_disk, from_memory):
        folder = tmp_path / model.name
        model.export(folder / "out.xml")
        moved = folder.rename(tmp_path / f"{model.name} moved")
        loaded = mujoco.MjModel.from_xml_path(str(moved / "out.xml"))
        # MuJoCo writes where it moved a mesh to, which rounds
        np.testing.assert_allclose(roll_out(loaded), roll_out(model.compile()), atol=1e-10)
        assert [p.name for p in (moved / "out_assets").iterdir()] == ["shell.obj"]


def test_export_of_a_model_that_strips_the_paths_of_its_assets(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "shell.obj").write_text(TETRAHEDRON)
    text = MESHES.replace('meshdir="parts"', 'meshdir="parts" strippath="true"')
    text = text.replace('"shell.obj"', '"C:/cad/shell.obj"')
    (tmp_path / "robot.xml").write_text(text)
    model = Model.from_file(tmp_path / "robot.xml")
    model.export(tmp_path / "deep" / "out.xml")
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "deep" / "out.xml"))
    np.testing.assert_allclose(roll_out(loaded), roll_out(model.compile()), atol=1e-10)


def attaching(folder) -> str:
    """Write two models with a mesh each; return a model that attaches both, one by the other."""
    hand, arm = folder / "arms" / "hands", folder / "arms"
    (hand / "parts").mkdir(parents=True)
    (hand / "parts" / "shell.obj").write_text(TETRAHEDRON)
    (arm / "bone.obj").write_text(TETRAHEDRON.replace("1", "2", 1))
    body = '<body name="{0}"><joint name="{0}" axis="0 1 0"/><geom type="mesh" mesh="m"/>{1}</body>'
    (hand / "hand.xml").write_text(
        '<mujoco><compiler meshdir="parts"/><asset><mesh name="m" file="shell.obj"/></asset>'
        f"<worldbody>{body.format('palm', '')}</worldbody></mujoco>"
    )
    frame = '<frame pos="1 0 0"><attach model="hand" body="palm" prefix="h_"/></frame>'
    (arm / "arm.xml").write_text(
        '<mujoco><asset><model name="hand" file="hands/hand.xml"/><mesh name="m" file="bone.obj"/>'
        f"</asset><worldbody>{body.format('arm', frame)}</worldbody></mujoco>"
    )
    (folder / "assets.xml").write_text(
        '<mujoco><asset><model name="arm" file="arms/arm.xml"/></asset></mujoco>'
    )
    return """<mujoco><include file="assets.xml"/>
      <worldbody><frame><attach model="arm" body="arm" prefix="a_"/></frame></worldbody></mujoco>"""


def test_export_of_a_model_that_attaches_others_with_meshes_of_their_own(tmp_path):
    (tmp_path / "robot.xml").write_text(attaching(tmp_path))
    model = Model.from_file(tmp_path / "robot.xml")
    plain = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    model.export(tmp_path / "out" / "out.xml")
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "out.xml"))
    assert loaded.nmesh == 2
    np.testing.assert_allclose(loaded.body_mass, plain.body_mass)
    np.testing.assert_allclose(roll_out(loaded), roll_out(plain), atol=1e-10)
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "shell.obj").write_text("another")
    with pytest.raises(ModelError, match=r"'parts/shell.obj' differs between .*hands"):
        model.export(tmp_path / "out" / "out.xml")


def test_export_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "model.xml"
    path.write_text("old")
    model = Model.from_xml(ARM)
    with pytest.raises(ModelError, match="mass"):
        model.export(path, [address_edit(model, ["geom[rod].mass"], -1.0)])
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["model.xml"]


def test_includes_and_urdf_from_files(tmp_path):
    (tmp_path / "common.xml").write_text('<mujoco><option timestep="0.004"/></mujoco>')
    (tmp_path / "main.xml").write_text(
        '<mujoco><include file="common.xml"/><worldbody><body><joint name="j"/>'
        '<geom size=".1"/></body></worldbody></mujoco>'
    )
    assert Model.from_file(tmp_path / "main.xml").compile().opt.timestep == 0.004
    inertial = (
        '<inertial><mass value="2"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="arm"><link name="base">{inertial}</link><link name="link">{inertial}</link>'
        '<joint name="hinge" type="revolute"><parent link="base"/><child link="link"/>'
        '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="3"/></joint></robot>'
    )
    urdf = Model.from_file(tmp_path / "arm.urdf")
    assert urdf.joints == ("hinge",)
    assert urdf.compile().body("link").mass[0] == 2.0


def test_menagerie(tmp_path, monkeypatch):
    monkeypatch.delenv("BO_SYSID_MENAGERIE", raising=False)
    with pytest.raises(ModelError, match=r"set \$BO_SYSID_MENAGERIE to a folder"):
        Model.from_menagerie("arm")
    robot = tmp_path / "maker_arm"
    robot.mkdir()
    (robot / "arm.xml").write_text(ARM)
    (robot / "hand.xml").write_text(FLOATING)
    monkeypatch.setenv("BO_SYSID_MENAGERIE", str(tmp_path))
    with pytest.raises(ModelError, match=r"name one of its files: 'maker_arm/arm\.xml'"):
        Model.from_menagerie("maker_arm")
    with pytest.raises(ModelError, match="did you mean 'maker_arm'"):
        Model.from_menagerie("makers_arm")
    assert Model.from_menagerie("maker_arm/hand.xml", base="fixed").joints == ("hip", "ball")
    (robot / "scene.xml").write_text('<mujoco><include file="arm.xml"/></mujoco>')
    assert Model.from_menagerie("maker_arm").joints[0] == "shoulder"


def test_messages_for_files_that_are_no_models(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "photo.xml").write_bytes(b"\x89PNG\x00\x01")
    (tmp_path / "typo.xml").write_text(ARM.replace("<worldbody>", "<worldbod>"))
    (tmp_path / "dust.xml").write_text(
        '<mujoco><worldbody><body name="dust"><joint/></body></worldbody></mujoco>'
    )
    with pytest.raises(ModelError, match=r"amr\.xml: no such model file; did you mean 'arm\.xml'"):
        Model.from_file(tmp_path / "amr.xml")
    with pytest.raises(ModelError, match=r"photo\.xml: not a model"):
        Model.from_file(tmp_path / "photo.xml")
    with pytest.raises(ModelError, match=r"typo\.xml: not a model.*worldbod"):
        Model.from_file(tmp_path / "typo.xml")
    with pytest.raises(ModelError, match=r"dust\.xml: the model does not compile.*'dust'"):
        Model.from_file(tmp_path / "dust.xml")


def test_messages_for_tasks_that_the_suite_lacks():
    with pytest.raises(ModelError, match="no domain 'cheeta'; did you mean 'cheetah'"):
        Model.from_dm_control("cheeta", "run")
    with pytest.raises(ModelError, match="hopper has no task 'hops'; did you mean 'hop'"):
        Model.from_dm_control("hopper", "hops")


def test_plugins_survive(tmp_path):
    text = """
    <mujoco><extension><plugin plugin="mujoco.elasticity.cable"/></extension><worldbody>
      <composite type="cable" curve="s" count="6 1 1" size="1" offset="0 0 1" initial="none">
        <plugin plugin="mujoco.elasticity.cable"><config key="bend" value="4e6"/></plugin>
        <joint kind="main" damping=".01"/><geom type="capsule" size=".005" density="1000"/>
      </composite></worldbody></mujoco>"""
    model = Model.from_xml(text)
    np.testing.assert_array_equal(roll_out(model.compile()), roll_out(model.compile(visuals=True)))
    model.export(tmp_path / "cable.xml")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "cable.xml")).nplugin == 1


def test_mocap_bodies_survive_a_changed_keyframe():
    mocap = '<worldbody><body name="hand" mocap="true" pos="0 0 2"><site name="grip"/></body>'
    text = FLOATING.replace("<worldbody>", mocap).replace('ctrl=".3"', 'ctrl=".3" mpos="1 2 3"')

    def add(spec: mujoco.MjSpec) -> None:
        spec.body("leg").add_joint(name="play").armature = 0.1

    for edits in ([], [add]):
        compiled = Model.from_xml(text).compile(edits)
        np.testing.assert_array_equal(compiled.key_mpos[0], [1, 2, 3])
        assert compiled.body("hand").mocapid[0] == 0


def test_masses_of_discarded_geoms_can_be_scaled():
    text = """
    <mujoco><compiler discardvisual="true"/><worldbody><body name="arm"><joint/>
      <geom size=".1" contype="0" conaffinity="0"/><geom size=".2"/></body></worldbody></mujoco>"""
    model = Model.from_xml(text)
    nominal = model.compile()
    assert nominal.ngeom == 1
    volume = 4 / 3 * np.pi * (0.1**3 + 0.2**3)
    assert nominal.body("arm").mass[0] == pytest.approx(1000 * volume)
    edited = model.compile([address_edit(model, ["body[arm].mass"], 3.0, "scale")])
    np.testing.assert_allclose(edited.body("arm").mass, 3 * nominal.body("arm").mass)
    np.testing.assert_allclose(edited.body("arm").inertia, 3 * nominal.body("arm").inertia)


GEOMS_WIN = """
<mujoco><compiler inertiafromgeom="true" inertiagrouprange="0 2" {total}/><worldbody>
<body name="arm"><inertial pos="0 0 .1" mass="9" fullinertia="1 1 1 .1 .1 .1"/>
 <joint name="swing" axis="0 1 0"/>
 <geom type="capsule" fromto="0 0 0 .1 0 -.5" size=".03" mass="1"/>
 <body name="weight" pos="0 0 -.5"><inertial pos="0 0 .1" mass="2" diaginertia="1 1 1"/></body>
 <body name="shown" pos="0 0 .1"><inertial pos="0 0 .1" mass="3" diaginertia="1 1 1"/>
  <geom type="sphere" size=".1" group="3"/></body>
 <body name="box" pos="0 0 .2"><joint axis="0 1 0"/>
  <geom type="box" size=".1 .2 .3" euler="10 20 30" pos=".1 .2 0"/>
  <geom type="sphere" size=".1" pos="0 .3 0"/></body>
</body></worldbody></mujoco>"""


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize("total", ["", 'settotalmass="3"'])
def test_a_model_whose_geoms_overrule_its_inertials_is_read_as_it_is(total):
    text = GEOMS_WIN.format(total=total)
    plain, read = mujoco.MjModel.from_xml_string(text), Model.from_xml(text).compile()
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_array_equal(getattr(read, field), getattr(plain, field))


@pytest.mark.parametrize("address", ["inertia[2]", "ipos[0]", "mass"])
@pytest.mark.parametrize("body", ["arm", "weight"])
def test_an_inertial_that_geoms_would_overrule_is_edited(body, address, tmp_path):
    model = Model.from_xml(GEOMS_WIN.format(total=""))
    name, _, index = address.partition("[")
    at = int(index[:-1]) if index else 0
    value = 1.1 * float(getattr(model.compile().body(body), name)[at]) + 0.01 * (name == "ipos")
    edit = address_edit(model, [f"body[{body}].{address}"], value)
    model.export(tmp_path / "model.xml", [edit])
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    for edited in (model.compile([edit]), written):
        row = getattr(edited.body(body), name)
        assert row[at] == pytest.approx(value)
        others = [i for i in range(edited.nbody) if edited.body(i).name != body]
        np.testing.assert_allclose(edited.body_mass[others], model.compile().body_mass[others])


def test_edits_that_touch_no_mass_keep_the_masses_of_settotalmass_to_the_last_bit():
    model = Model.from_dm_control("cheetah", "run")

    def wind(spec: mujoco.MjSpec) -> None:
        spec.option.wind[0] = 1.0

    np.testing.assert_array_equal(model.compile([wind]).body_mass, model.compile().body_mass)


def test_a_model_with_settotalmass_is_hashed_and_written_without_a_warning(tmp_path):
    model = Model.from_dm_control("cheetah", "run")  # a warning is an error in these tests
    assert model.sha256 == Model.from_dm_control("cheetah", "run").sha256
    model.export(tmp_path / "cheetah.xml")


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize("total", ["", '<compiler settotalmass="3"/>'])
@pytest.mark.parametrize("address", ["joint[a].armature", "body[link].mass"])
def test_servos_and_springs_stay_as_mujoco_derived_them_when_masses_change(
    address, total, tmp_path
):
    text = f"""<mujoco>{total}<worldbody><body name="link"><joint name="a" axis="0 1 0"/>
      <geom size=".1" pos=".3 0 0"/><body pos=".6 0 0"><joint name="b" springdamper=".1 .7"/>
      <geom size=".1" pos="0 .1 0"/></body></body></worldbody>
      <actuator><position joint="a" kp="20" dampratio="1"/></actuator></mujoco>"""
    plain, model = mujoco.MjModel.from_xml_string(text), Model.from_xml(text)
    edit = address_edit(model, [address], 1.1)
    model.export(tmp_path / "edited.xml", [edit])
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "edited.xml"))
    for compiled in (model.compile(), model.compile([edit]), written):
        for field in ("actuator_biasprm", "dof_damping", "jnt_stiffness"):
            np.testing.assert_allclose(getattr(compiled, field), getattr(plain, field), rtol=1e-14)
    assert written.actuator_biasprm[0, 2] == plain.actuator_biasprm[0, 2] < 0
    assert not np.allclose(written.dof_invweight0, plain.dof_invweight0)


def test_compiling_for_simulation_is_cheap():
    model = Model.from_dm_control("cheetah", "run")

    def median(visuals: bool, repeats: int) -> float:
        times = []
        for _ in range(repeats):
            start = perf_counter()
            model.compile(visuals=visuals)
            times.append(perf_counter() - start)
        return float(np.median(times))

    assert median(False, 50) < 0.1 * median(True, 5)


def test_actuators_without_a_control_are_no_controls() -> None:
    friction = (
        '<general name="friction" joint="shoulder" dyntype="dcmotor" dynprm="0 0 0 0 0 20 .1" '
        'input="none" gaintype="dcmotor" biastype="dcmotor" gainprm="1 1e-6" actdim="1" '
        'biasprm="0 0 0 .1 .15 .1" actearly="true"/>'
    )
    model = Model.from_xml(ARM.replace("<actuator>", f"<actuator>{friction}"))
    assert model.actuators == ("friction", "actuator_1", "valve", "actuator_3")
    assert model.controlled == ("actuator_1", "valve", "actuator_3")
    assert model.ctrl_channels == tuple(f"ctrl.{name}" for name in model.controlled)


def test_an_added_motor_gives_what_it_is_told_whatever_the_defaults_of_a_model() -> None:
    model = Model.from_xml("""<mujoco>
      <default><motor gear="5" ctrllimited="true" ctrlrange="-1 1" forcerange="-2 2"/></default>
      <worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>""")
    compiled = model.compile([MotorEdit("j")])
    data = mujoco.MjData(compiled)
    data.ctrl[0] = 3.0
    mujoco.mj_forward(compiled, data)
    assert data.qfrc_actuator[0] == 3.0


def test_only_controls_that_are_a_force_or_a_position_have_a_unit() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody>
        <body><joint name="hinge"/><geom size=".1"/></body>
        <body><joint name="rail" type="slide"/><geom size=".1"/></body>
        <body><joint name="socket" type="ball"/><geom size=".1"/></body>
        <body><freejoint name="base"/><geom size=".1"/></body></worldbody><actuator>
        <motor name="torque" joint="hinge"/> <motor name="force" joint="rail"/>
        <motor name="geared" joint="hinge" gear="5"/> <motor name="ball" joint="socket"/>
        <position name="goal" joint="hinge" kp="3"/> <position name="place" joint="rail"/>
        <intvelocity name="rate" joint="hinge" kp="3" actrange="-1 1"/>
        <velocity name="speed" joint="hinge" kv="2"/>
        <dcmotor name="voltage" joint="hinge" motorconst=".1 .1" resistance="1"/>
        </actuator></mujoco>"""
    )
    assert units(model) == {
        "qpos.hinge": "rad", "qvel.hinge": "rad/s", "qpos.rail": "m", "qvel.rail": "m/s",
        "ctrl.torque": "N m", "ctrl.force": "N", "ctrl.goal": "rad", "ctrl.place": "m",
        **{f"qvel.socket.{k}": "rad/s" for k in range(3)},
        **{f"qpos.base.{k}": "m" for k in range(3)}, **{f"qvel.base.{k}": "m/s" for k in range(3)},
        **{f"qvel.base.{k}": "rad/s" for k in range(3, 6)},
    }  # fmt: skip
