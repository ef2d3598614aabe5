"""Addresses and edits, against plain MuJoCo compiling an MJCF text with the value written in."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import ModelError
from bo_sysid.mjcf import Address, Model, address_edit, inertial, nominal, parameter_edits
from bo_sysid.mjcf.attributes import ATTRIBUTES
from bo_sysid.parameters import Parameter

# One element of every kind, called "x", with a neighbour or two; angles in radians.
MACHINE = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" wind="1 2 3" density="1.2" viscosity="1e-5"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="x" pos="0.1 0.2 1" gravcomp="0.1">
      <inertial mass="2" pos="0.01 0.02 0.03" diaginertia="0.03 0.02 0.025"/>
      <joint name="x" pos="0.01 0 0" axis="0 1 0" range="-1 1" armature="0.1" ref="0.1"
             springref="0.2" stiffness="3 0.2 0.1" damping="0.4 0.1 0.1" frictionloss="0.1"
             margin="0.01" actuatorfrcrange="-5 5"/>
      <geom name="ballast" size="0.1"/>
      <site name="x" pos="0.1 0.2 0.3" size="0.01 0.02 0.03" type="box"/>
      <body name="rod" pos="0 0 -0.3">
        <joint name="y" axis="0 1 0"/>
        <geom name="x" type="box" size="0.1 0.05 0.04" pos="0.2 0 0" margin="0.002" gap="0.001"/>
        <geom name="heavy" type="sphere" size="0.05" pos="0.4 0 0" mass="0.7"/>
      </body>
    </body>
  </worldbody>
  <contact><pair name="x" geom1="ballast" geom2="floor" margin="0.01" gap="0.001"/></contact>
  <equality><joint name="x" joint1="x" joint2="y" polycoef="0 0.5 0.1 0 0"/></equality>
  <tendon>
    <fixed name="x" range="-3 3" stiffness="1 0.1 0.1" damping="0.3 0.1 0.1" margin="0.1"
           frictionloss="0.1" armature="0.01" springlength="0.1 0.2" actuatorfrcrange="-5 5">
      <joint joint="x" coef="1"/><joint joint="y" coef="0.5"/>
    </fixed>
  </tendon>
  <actuator>
    <general name="x" joint="x" gear="2 0 0 0 0 0" gainprm="3" biasprm="0.1 -2 -0.3"
             biastype="affine" dyntype="filterexact" dynprm="0.05" ctrlrange="-2 2"
             forcerange="-9 9" actrange="-3 3" armature="0.01" damping="0.2 0.1 0.1"
             nsample="100" delay="0.011" interp="linear"/>
    <position name="servo" joint="y" kp="20" kv="2"/>
    <velocity name="speed" joint="y" kv="3"/>
  </actuator>
</mujoco>
"""
PARENTS = {"pair": "contact", "equality": "equality", "tendon": "tendon", "actuator": "actuator"}
# A servo's gains are read off the servo; only a joint pair has a geometry of its own.
ELEMENTS = {("actuator", "kp"): "servo", ("actuator", "kv"): "servo"}
# What MJCF does not spell like the address.
SPELLING = {"inertia": "diaginertia", "ipos": "pos"}


def xml_element(root: ET.Element, kind: str, name: str, attribute: str) -> ET.Element:
    if kind == "option":
        return root.find("option")
    if kind == "equality":
        return root.find("equality/joint")
    if kind in PARENTS:
        return root.find(f"{PARENTS[kind]}/*[@name='{name}']")
    element = root.find(f".//{kind}[@name='{name}']")
    inertial_has_it = kind == "body" and attribute in ("mass", "inertia", "ipos")
    return element.find("inertial") if inertial_has_it else element


FIELDS = [
    name
    for name in dir(mujoco.MjModel)
    if not name.startswith(("_", "bind_", "tex_"))
    and name.split("_")[0] in (*ATTRIBUTES, "dof", "jnt", "eq", "qpos0", "qpos")
]


def differences(one: mujoco.MjModel, other: mujoco.MjModel, tolerance: float = 0.0) -> list[str]:
    """Return the fields in which two compiled models differ."""
    pairs = [(n, getattr(one, n), getattr(other, n)) for n in FIELDS]
    pairs += [(n, getattr(one.opt, n), getattr(other.opt, n)) for n in ATTRIBUTES["option"]]
    return [
        name
        for name, a, b in pairs
        if isinstance(a, float | np.ndarray)
        and not np.allclose(a, b, rtol=tolerance, atol=tolerance)
    ]


@pytest.fixture(scope="module")
def machine() -> Model:
    return Model.from_xml(MACHINE, name="machine")


CASES = [
    (kind, name, index)
    for kind, table in ATTRIBUTES.items()
    for name, attribute in table.items()
    for index in (range(attribute.size) if attribute.size else [None])
]


@pytest.mark.parametrize(("kind", "name", "index"), CASES)
def test_every_address_writes_what_mjcf_means(machine, kind, name, index):
    """Write by address, and into the text: all arrays of the two models are equal."""
    element = ELEMENTS.get((kind, name), "x")
    address = Address(kind, "" if kind == "option" else element, name, index)
    own = address.read(machine)
    value = own * 1.07 + (0.001 if name != "timestep" else 0.0)
    edited = machine.compile([address_edit(machine, [str(address)], value)])

    if index is None:
        text = repr(value)
    else:
        size = ATTRIBUTES[kind][name].size
        vector = [Address(kind, address.pattern, name, i).read(machine) for i in range(size)]
        vector[index] = value
        text = " ".join(map(repr, vector))
    root = ET.fromstring(MACHINE)  # noqa: S314 - written above
    written = xml_element(root, kind, element, name)
    written.set(SPELLING.get(name, name), text)
    if (kind, name) == ("body", "mass"):  # here an edit does more: inertia goes with the mass
        inertia = np.array([0.03, 0.02, 0.025]) * value / own
        written.set("diaginertia", " ".join(map(repr, inertia.tolist())))
    expected = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))

    assert differences(edited, expected, 1e-13) == []
    assert differences(edited, machine.compile()) != []  # the edit is not lost on both sides


@pytest.mark.parametrize("apply", ["scale", "add"])
def test_an_edit_without_a_change_leaves_every_bit(apply):
    for model in (Model.from_xml(MACHINE), Model.from_dm_control("cheetah", "run")):
        spec_names = {
            "joint": "*",
            "geom": "*",
            "body": "*",
            "actuator": "*",
            "option": "",
        }
        for kind, pattern in spec_names.items():
            for name, attribute in ATTRIBUTES[kind].items():
                address = str(Address(kind, pattern, name, 0 if attribute.size else None))
                try:
                    edit = address_edit(model, [address], 1.0 if apply == "scale" else 0.0, apply)
                except ModelError:  # the cheetah has no servo
                    continue
                assert differences(model.compile([edit]), model.compile()) == []


def test_mass_of_a_body_scales_its_inertia_wherever_it_comes_from():
    text = """
    <mujoco><worldbody>
      <body name="densities"><freejoint/><geom size=".1"/><geom size=".05" pos=".3 0 0"/></body>
      <body name="mixed" pos="1 0 0"><freejoint/>
        <geom size=".1" mass="2"/><geom type="box" size=".1 .2 .1" pos="0 .3 0"/></body>
      <body name="full" pos="2 0 0"><freejoint/><geom size=".1"/>
        <inertial mass="3" pos="0 0 .1" fullinertia=".03 .02 .025 .001 .002 .003"/></body>
      <body name="diagonal" pos="3 0 0"><freejoint/><geom size=".1"/>
        <inertial mass="3" pos="0 0 .1" diaginertia=".03 .02 .025"/></body>
    </worldbody></mujoco>"""
    model = Model.from_xml(text)
    nominal = model.compile()
    for name in model.bodies[1:]:
        edited = model.compile([address_edit(model, [f"body[{name}].mass"], 2.0, "scale")])
        np.testing.assert_allclose(edited.body(name).mass, 2 * nominal.body(name).mass)
        np.testing.assert_allclose(edited.body(name).inertia, 2 * nominal.body(name).inertia)
        np.testing.assert_allclose(edited.body(name).ipos, nominal.body(name).ipos, atol=1e-15)
        others = [i for i in range(1, nominal.nbody) if nominal.body(i).name != name]
        np.testing.assert_array_equal(edited.body_mass[others], nominal.body_mass[others])


def test_settotalmass_does_not_undo_an_edit():
    model = Model.from_dm_control("cheetah", "run")
    nominal = model.compile()
    assert nominal.body_mass.sum() == pytest.approx(14.0)
    edited = model.compile([address_edit(model, ["body[torso].mass"], 9.0)])
    assert edited.body("torso").mass[0] == pytest.approx(9.0)
    np.testing.assert_allclose(edited.body_mass[2:], nominal.body_mass[2:], rtol=1e-14)
    by_hand = model.compile([lambda spec: setattr(spec.geom("head"), "mass", 2.0)])
    torso = Address.parse("geom[torso].mass").read(model)
    assert by_hand.body("torso").mass[0] == pytest.approx(torso + 2.0)


def test_size_of_a_geom_changes_mass_and_inertia_as_written_by_hand():
    text = """
    <mujoco><worldbody><body name="arm"><joint/>
      <geom name="rod" type="capsule" fromto="0 0 0 {length} 0 0" size="{radius}"/>
    </body></worldbody></mujoco>"""
    model = Model.from_xml(text.format(length=0.4, radius=0.03))
    thick = model.compile([address_edit(model, ["geom[rod].size[0]"], 0.05)])
    expected = mujoco.MjModel.from_xml_string(text.format(length=0.4, radius=0.05))
    for field in ("geom_size", "geom_pos", "body_mass", "body_inertia", "body_ipos", "dof_M0"):
        np.testing.assert_array_equal(getattr(thick, field), getattr(expected, field))
    # the half length is fixed by fromto until it is addressed; the centre stays where it was
    longer = model.compile([address_edit(model, ["geom[rod].size[1]"], 0.3)])
    expected = mujoco.MjModel.from_xml_string(
        text.format(length=0.5, radius=0.03).replace("0 0 0 0.5", "-0.1 0 0 0.5")
    )
    for field in ("geom_size", "geom_pos", "body_mass", "body_inertia", "body_ipos", "dof_M0"):
        np.testing.assert_allclose(getattr(longer, field), getattr(expected, field), atol=1e-12)


def test_angles_are_radians_whatever_the_file_says():
    text = """
    <mujoco><compiler angle="degree"/><worldbody>
      <body><joint name="hinge" range="-90 45" ref="30" springref="60"/><geom size=".1"/></body>
      <body><joint name="slide" type="slide" range="-90 45"/><geom size=".1"/></body>
    </worldbody></mujoco>"""
    model = Model.from_xml(text)
    assert Address.parse("joint[hinge].range[1]").read(model) == pytest.approx(np.pi / 4)
    assert Address.parse("joint[hinge].springref").read(model) == pytest.approx(np.pi / 3)
    edits = [
        address_edit(model, ["joint[*].range[1]"], 1.5),
        address_edit(model, ["joint[hinge].ref"], 0.25),
    ]
    compiled = model.compile(edits)
    np.testing.assert_allclose(compiled.jnt_range[:, 1], 1.5)
    assert compiled.qpos0[0] == pytest.approx(0.25)


def test_values_from_defaults_are_read_and_overruled():
    text = """
    <mujoco><default><joint damping="0.5"/><default class="stiff"><joint stiffness="9"/></default>
      </default><worldbody><body childclass="stiff"><joint name="a"/><geom size=".1"/></body>
      <body><joint name="b" damping="0.7"/><geom size=".1"/></body></worldbody></mujoco>"""
    model = Model.from_xml(text)
    assert Address.parse("joint[a].damping").read(model) == 0.5
    assert Address.parse("joint[a].stiffness[0]").read(model) == 9.0
    compiled = model.compile([address_edit(model, ["joint[*].damping"], 3.0, "scale")])
    np.testing.assert_allclose(compiled.dof_damping, [1.5, 2.1])


def test_what_mujoco_derives_is_settled_before_it_is_overruled():
    text = """
    <mujoco><compiler angle="radian"/>
      <worldbody><body><joint name="a" range="-1 2" springdamper="0.1 1" axis="0 1 0"/>
      <geom size=".1" pos=".3 0 0"/><site name="s" pos=".1 0 0"/></body>
      <site name="w" pos="0 0 1"/></worldbody>
      <tendon><spatial name="t" stiffness="1"><site site="s"/><site site="w"/></spatial></tendon>
      <actuator><position name="p" joint="a" kp="5" inheritrange="1"/>
      <position name="q" joint="a" kp="5" dampratio="1"/></actuator></mujoco>"""
    model = Model.from_xml(text)
    nominal = model.compile()
    damped = model.compile([address_edit(model, ["joint[a].damping"], 2.0, "scale")])
    np.testing.assert_allclose(damped.dof_damping, 2 * nominal.dof_damping)
    np.testing.assert_allclose(damped.jnt_stiffness, nominal.jnt_stiffness)
    limited = model.compile([address_edit(model, ["actuator[p].ctrlrange[0]"], -0.5)])
    np.testing.assert_allclose(limited.actuator_ctrlrange[0], [-0.5, 2.0])
    length = nominal.tendon_lengthspring[0, 0]
    sprung = model.compile([address_edit(model, ["tendon[t].springlength[1]"], length + 0.1)])
    np.testing.assert_allclose(sprung.tendon_lengthspring[0], [length, length + 0.1])
    assert Address.parse("actuator[q].kv").read(model) == -nominal.actuator_biasprm[1, 2] > 0
    braked = model.compile([address_edit(model, ["actuator[q].kv"], 0.25)])
    assert braked.actuator_biasprm[1, 2] == -0.25


def test_servo_gains_keep_the_resting_point(machine):
    stiff = machine.compile([address_edit(machine, ["actuator[servo].kp"], 40.0)])
    np.testing.assert_array_equal(stiff.actuator("servo").gainprm[:1], [40.0])
    np.testing.assert_array_equal(stiff.actuator("servo").biasprm[:3], [0.0, -40.0, -2.0])
    fast = machine.compile([address_edit(machine, ["actuator[speed].kv"], 5.0)])
    assert (fast.actuator("speed").gainprm[0], fast.actuator("speed").biasprm[2]) == (5.0, -5.0)


def test_mass_of_one_geom_among_several(machine):
    assert Address.parse("geom[heavy].mass").read(machine) == 0.7
    assert Address.parse("geom[x].mass").read(machine) == pytest.approx(8 * 0.1 * 0.05 * 0.04 * 1e3)
    edited = machine.compile([address_edit(machine, ["geom[x].mass"], 0.5)])
    assert edited.body("rod").mass[0] == pytest.approx(1.2)
    # centre of mass of 0.5 kg at 0.2 m and 0.7 kg at 0.4 m
    assert edited.body("rod").ipos[0] == pytest.approx((0.5 * 0.2 + 0.7 * 0.4) / 1.2)


@dataclass(frozen=True)
class Quantity:
    addresses: tuple[str, ...]
    apply: Literal["set", "scale", "add"] = "set"
    low: float = 0.0
    high: float = 1.0


def test_mass_of_a_geom_beside_a_body_that_weighs_by_a_bound_alone():
    model = Model.from_xml("""
    <mujoco><compiler boundmass="0.01" boundinertia="0.001"/><worldbody>
      <body name="cart"><joint type="slide"/>
        <body name="pole"><joint axis="0 1 0"/><geom name="bob" size=".1" mass="1"/>
          <geom size=".1" density="500"/></body></body>
    </worldbody></mujoco>""")
    assert Address.parse("geom[bob].mass").read(model) == 1.0
    own, other = model.compile(), model.compile([address_edit(model, ["geom[bob].mass"], 1.5)])
    np.testing.assert_allclose(other.body_mass - own.body_mass, [0, 0, 0.5], atol=1e-12)


def test_parameters_are_independent_of_their_order(machine):
    """A body's mass is what was asked for although sizes and inertias change as well."""
    quantities = [
        Quantity(("body[rod].inertia[0]",)),
        Quantity(("body[rod].mass",)),
        Quantity(("geom[x].size[0]",)),
        Quantity(("body[rod].ipos[2]",), "add"),
    ]
    mass = Address.parse("body[rod].mass").read(machine)
    inertia = Address.parse("body[rod].inertia[0]").read(machine)
    for values in ([0.97 * inertia, 1.02 * mass, 0.101, 0.01], [inertia, mass, 0.101, 0.01]):
        one = machine.compile(parameter_edits(machine, quantities, values))
        other = machine.compile(parameter_edits(machine, quantities[::-1], values[::-1]))
        for compiled in (one, other):
            assert compiled.body("rod").mass[0] == pytest.approx(values[1])
            assert compiled.body("rod").inertia[0] == pytest.approx(values[0])
            assert compiled.body("rod").ipos[2] == pytest.approx(0.01)
            assert compiled.geom("x").size[0] == 0.101


def test_tied_addresses_share_a_value_and_scale_their_own(machine):
    tied = ["joint[x].damping", "tendon[x].damping"]
    for apply, value, expected in (("set", 2.0, (2.0, 2.0)), ("scale", 2.0, (0.8, 0.6))):
        compiled = machine.compile([address_edit(machine, tied, value, apply)])
        assert (compiled.dof_damping[0], compiled.tendon_damping[0]) == expected
    compiled = machine.compile([address_edit(machine, tied, 0.1, "add")])
    assert compiled.dof_damping[0] == pytest.approx(0.5)
    assert compiled.tendon_damping[0] == pytest.approx(0.4)


def test_wildcards():
    model = Model.from_dm_control("cheetah", "run")
    count = {
        "joint[*].damping": 9,
        "joint[b*].damping": 3,
        "joint[?shin].stiffness[0]": 2,
        "geom[*].friction[0]": 9,
        "geom[*].mass": 8,  # the ground belongs to the world
        "geom[*].size[0]": 8,  # and is a plane
        "body[*].mass": 7,
        "actuator[*].gear[0]": 6,
        "joint[[bf]foot].armature": 2,
    }
    found = {text: len(Address.parse(text).matches(model)) for text in count}
    assert found == count
    assert Address.parse("joint[*shin].damping").matches(model) == (
        "joint[bshin].damping",
        "joint[fshin].damping",
    )


def test_an_exact_name_wins_over_a_pattern():
    text = '<mujoco><worldbody><body><joint name="a*" damping="1"/><geom size=".1"/></body>'
    text += '<body><joint name="ab" damping="2"/><geom size=".1"/></body></worldbody></mujoco>'
    assert Address.parse("joint[a*].damping").read(Model.from_xml(text)) == 1.0


def test_unnamed_elements_can_be_addressed():
    text = '<mujoco><worldbody><body><joint/><geom size=".1"/></body></worldbody></mujoco>'
    model = Model.from_xml(text)
    assert Address.parse("geom[*].friction[0]").matches(model) == ("geom[geom_0].friction[0]",)
    compiled = model.compile([address_edit(model, ["joint[joint_0].damping"], 0.5)])
    assert compiled.dof_damping[0] == 0.5


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("elbow damping", "must look like joint"),
        ("jiont[x].damping", "no kind of element 'jiont'; did you mean 'joint'"),
        ("joint[x].dampping", "did you mean 'damping'"),
        ("joint[x].name", "'name' is not a number"),
        ("joint[z].damping", "machine: .*no such joint; valid: 'x', 'y'"),
        ("joint[q*].damping", "no such joint"),
        ("joint[x].damping[3]", r"index out of range; damping\[0\] to damping\[2\] are valid"),
        ("joint[x].armature[0]", r"armature is a single number; leave out \[0\]"),
        ("geom[x].friction", r"needs an index, friction\[0\] to friction\[2\]"),
        ("geom[heavy].size[1]", "index out of range"),
        ("geom[heavy].density", "has an explicit mass"),
        ("geom[floor].mass", "its mass plays no role"),
        ("geom[floor].size[0]", "no size that matters"),
        ("geom[ballast].mass", r"address body\[x\]\.mass"),
        ("body[world].mass", "the world does not move"),
        ("actuator[x].kp", "is not a position servo"),
        ("actuator[servo].ctrlrange[1]", "the model has no ctrlrange; write both ends into it"),
        ("joint[y].range[0]", "the model has no range"),
        ("option.gravity", r"needs an index, gravity\[0\] to gravity\[2\]"),
        ("option[x].gravity[0]", r"must look like option\.gravity"),
        ("joint.damping", r"must look like joint\[name\]\.damping"),
    ],
)
def test_messages(machine, address, message):
    with pytest.raises(ModelError, match=message):
        Address.parse(address).matches(machine)


def test_messages_for_values(machine):
    with pytest.raises(ModelError, match="the value must be finite"):
        address_edit(machine, ["joint[x].damping"], float("nan"))
    with pytest.raises(ModelError, match=r"after the edits body\[rod\]\.mass set -1: mass"):
        machine.compile([address_edit(machine, ["body[rod].mass"], -1.0)])
    frame = Model.from_xml("""<mujoco><worldbody><body name="frame"><geom size=".1" mass="0"/>
      <body><joint/><geom size=".1"/></body></body></worldbody></mujoco>""")
    with pytest.raises(ModelError, match=r"'body\[frame\]\.mass': it has no mass; give it one"):
        frame.compile([address_edit(frame, ["body[frame].mass"], 0.5)])
    with pytest.raises(ModelError, match="matches 2 elements; name one"):
        Address.parse("joint[*].damping").read(machine)
    overlapping = [Quantity(("joint[*].damping",)), Quantity(("joint[x].damping[0]",))]
    with pytest.raises(ModelError, match=r"two parameters share joint\[x\]\.damping"):
        parameter_edits(machine, overlapping, [1.0, 2.0])


def test_inertial_of_the_edited_spec(machine):
    spec = machine.spec()
    spec.geom("heavy").mass = 1.4
    compiled = mujoco.MjModel.from_xml_string(MACHINE.replace('mass="0.7"', 'mass="1.4"'))
    found = inertial(spec, "rod")
    assert found.mass == pytest.approx(compiled.body("rod").mass[0])
    np.testing.assert_allclose(found.inertia, compiled.body("rod").inertia)
    with pytest.raises(ModelError, match="no body 'rood'; did you mean 'rod'"):
        inertial(spec, "rood")


def test_the_nominal_value_of_tied_addresses_is_their_mean() -> None:
    """A factor is 1 and a change 0 whatever the model has."""
    text = """<mujoco><worldbody>
      <body><joint name="a" damping="0.1"/><geom size=".1"/></body>
      <body><joint name="b" damping="0.3"/><geom size=".1"/></body></worldbody></mujoco>"""
    model = Model.from_xml(text)
    both = ("joint[a].damping", "joint[b].damping")
    told = {apply: nominal(model, Parameter("d", both, 0, 9, 3, apply)) for apply in APPLIES}
    assert told == {"set": pytest.approx(0.2), "scale": 1.0, "add": 0.0}
    assert nominal(model, Parameter("d", both[1:], 0, 9)) == 0.3


APPLIES = ("set", "scale", "add")
