"""The study that goes on with a repaired model, beside parameters that the study had."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from diagnosis_helpers import ARM, arm, record

from bo_sysid.diagnosis.answer.findings import Finding
from bo_sysid.diagnosis.answer.repaired import MODEL, Written
from bo_sysid.diagnosis.answer.repaired_study import _parameters, study_text
from bo_sysid.effects import CATALOGUE, Site, survey
from bo_sysid.intervals import Quantity
from bo_sysid.mjcf import Address, Model, make_explicit, parameter_edits
from bo_sysid.recording import Recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model

FOUND = Finding(
    "viscous_damping", "joint", "elbow", Quantity(0.3, "N m s/rad", (0.29, 0.31)), 0.0, 0.3,
    {}, None, 0.98, (), "", (0.3,),
)  # fmt: skip


def damped(spec: mujoco.MjSpec) -> None:
    """Write what was found."""
    spec.joint("elbow").damping[0] = FOUND.after


def repaired(folder: Path, *parameters: dict[str, object]) -> list[dict[str, object]]:
    """Return the parameters of the repaired study of an arm whose elbow is damped."""
    write_recording(record(duration=1.0), folder / "train.parquet")
    content = {
        "version": 1, "name": "arm", "model": str(ARM), "recordings": {"train": ["train.parquet"]},
        "parameters": list(parameters),
    }  # fmt: skip
    (folder / "study.yaml").write_text(yaml.safe_dump(content))
    arm().export(folder / MODEL, [damped])
    text = study_text(Study.load(folder / "study.yaml"), [FOUND], folder, Written((), {}))
    (folder / "repaired.yaml").write_text(text)
    study = Study.load(folder / "repaired.yaml")
    model = load_model(study)
    held = study.parameter_set(model)
    parameter_edits(model, held, [p.high for p in held])  # no two share a number
    return [
        {"address": p.addresses, "holds": p.low <= FOUND.after <= p.high, "low": p.low}
        for p in held
    ]


def test_positions_weigh_by_the_noise_that_was_seen_unless_the_study_states_one(
    tmp_path: Path,
) -> None:
    write_recording(record(duration=1.0), tmp_path / "train.parquet")
    arm().export(tmp_path / MODEL, [damped])
    seen, none = {"qpos.shoulder": 4.56789e-4, "qpos.elbow": 5e-4}, Written((), {})
    for stated in ({}, {"qpos.elbow": 1e-3, "qvel": 0.1}, {"qpos": 1e-3}):
        content = {
            "version": 1, "name": "arm", "model": str(ARM),
            "recordings": {"train": ["train.parquet"], "noise": stated},
        }  # fmt: skip
        (tmp_path / "study.yaml").write_text(yaml.safe_dump(content))
        text = study_text(Study.load(tmp_path / "study.yaml"), [FOUND], tmp_path, none, seen)
        (tmp_path / "repaired.yaml").write_text(text)
        noise = Study.load(tmp_path / "repaired.yaml").recordings.noise
        own = {} if "qpos" in stated else {"qpos.shoulder": 4.57e-4, "qpos.elbow": 5e-4}
        assert noise == {**own, **stated}


def test_a_finding_becomes_a_parameter(tmp_path: Path) -> None:
    (made,) = repaired(tmp_path)
    assert made["address"] == ("joint[elbow].damping",)
    assert made["holds"]


@pytest.mark.parametrize("each", [False, True])
def test_a_parameter_at_the_same_number_holds_the_repaired_value(
    tmp_path: Path, each: bool
) -> None:
    address = "joint[*].damping" if each else "joint[elbow].damping"
    made = repaired(tmp_path, {"address": address, "low": 0.01, "high": 0.1, "each": each})
    assert len(made) == (2 if each else 1)
    own = next(p for p in made if "joint[elbow].damping" in p["address"])
    assert own["holds"]
    assert own["low"] == 0.01  # what the study asks for is still in it


def test_the_number_of_a_finding_leaves_a_tied_parameter(tmp_path: Path) -> None:
    tied, own = repaired(tmp_path, {"address": "joint[*].damping", "low": 0.01, "high": 0.1})
    assert tied["address"] == ("joint[shoulder].damping",)
    assert not tied["holds"]
    assert own["address"] == ("joint[elbow].damping",)
    assert own["holds"]


def test_a_parameter_that_scales_the_model_scales_what_was_repaired(tmp_path: Path) -> None:
    scale = {"address": "joint[elbow].damping", "low": 0.5, "high": 2.0, "apply": "scale"}
    (made,) = repaired(tmp_path, scale)
    assert (made["address"], made["low"]) == (("joint[elbow].damping",), 0.5)


SPRING = Finding(
    "joint_spring", "joint", "elbow", Quantity(4.0, "N m/rad", (3.9, 4.1)), 0.0, 4.0,
    {"rest angle": Quantity(0.5, "rad", (0.49, 0.51))}, None, 0.98, (), "", (4.0, 2.0),
)  # fmt: skip
LAG = Finding(
    "actuator_lag", "actuator", "elbow", Quantity(0.025, "s", (0.024, 0.026)), 0.0, 0.025,
    {}, None, 0.98, (), "", (0.025,),
)  # fmt: skip


def as_said(spec: mujoco.MjSpec) -> None:
    """Write a spring about 0.5 rad and a lag of 25 ms: MuJoCo adds half a step of 2 ms to it."""
    elbow = spec.joint("elbow")
    elbow.stiffness[0], elbow.springref = 4.0, np.degrees(0.5) if spec.compiler.degree else 0.5
    spec.actuator("elbow").dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
    spec.actuator("elbow").dynprm[0] = 0.024


def already_slow(spec: mujoco.MjSpec) -> None:
    """Write an actuator with a lag of its own; what was found stands beside the model."""
    as_said(spec)
    spec.actuator("elbow").dynprm[0] = 0.1


@pytest.mark.parametrize(("write", "lag"), [(as_said, True), (already_slow, False)])
def test_every_number_of_a_finding_is_a_parameter_where_the_model_has_it(
    tmp_path: Path, write: Callable[[mujoco.MjSpec], None], lag: bool
) -> None:
    write_recording(record(duration=1.0), tmp_path / "train.parquet")
    content = {
        "version": 1,
        "name": "arm",
        "model": str(ARM),
        "recordings": {"train": ["train.parquet"]},
    }
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(content))
    arm().export(tmp_path / MODEL, [write])
    study = Study.load(tmp_path / "study.yaml")
    text = study_text(study, [SPRING, LAG], tmp_path, Written((), {}))
    (tmp_path / "repaired.yaml").write_text(text)
    model, held = load_model(Study.load(tmp_path / "repaired.yaml")), yaml.safe_load(text)
    wanted = {"joint[elbow].stiffness": 4.0, "joint[elbow].springref": 0.5}
    wanted |= {"actuator[elbow].dynprm[0]": 0.024} if lag else {}
    assert {p["address"] for p in held["parameters"]} == set(wanted)
    for p in held["parameters"]:
        assert Address.parse(p["address"]).read(model) == pytest.approx(wanted[p["address"]])
        assert p["low"] < wanted[p["address"]] < p["high"]
    assert ("actuator_lag at elbow" in text) != lag  # what is no parameter is said
    assert "policy" not in held  # nor what stands at its default


def found(effect: str, kind: str, site: str, value: float, unit: str, **details: float) -> Finding:
    within = {d: Quantity(x, unit, (x - 0.02, x + 0.02)) for d, x in details.items()}
    q = Quantity(value, unit, (0.99 * value, 1.01 * value))
    return Finding(effect, kind, site, q, 0.0, value, within, None, 0.98, (), "", (value,))


def test_a_medium_that_a_model_has_is_a_parameter_with_what_is_beside_it() -> None:
    """The details of a finding are changes; a file has the whole."""
    xml = (
        '<mujoco><option density="400" viscosity=".3" wind="3 0 -2"/><worldbody><body>'
        '<joint name="j"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    model = Model.from_xml(xml)
    drag = found("fluid_drag", "world", "world", 300.0, "kg/m³", viscosity=0.2)
    moves = found("wind", "world", "world", 2.0, "m/s", x=2.0, y=0.0, z=0.0)
    made = [p for f in (replace(drag, after=400.0), moves) for p in _parameters(model, f)]
    middle = {p["address"]: (p["low"] + p["high"]) / 2 for p in made}
    assert middle["option.viscosity"] == pytest.approx(0.3)
    assert [middle[f"option.wind[{k}]"] for k in range(3)] == pytest.approx([3.0, 0.0, -2.0])


SERVO = '<position name="elbow" joint="elbow" kp="20" kv="1"/>'
IN_THE_MODEL = {
    "fluid_drag": found("fluid_drag", "world", "world", 900.0, "kg/m³", viscosity=0.01),
    "wind": found("wind", "world", "world", 3.0, "m/s", x=1.0, y=-2.0, z=2.0),
    "gravity_compensation": found("gravity_compensation", "body", "upper", 0.4, "fraction"),
    "servo_kp": found("servo_kp", "actuator", "elbow", 25.0, "N m/rad"),
    "servo_kd": found("servo_kd", "actuator", "elbow", 1.5, "N m s/rad"),
}
NUMBERS = {
    "option.density": 900.0, "option.viscosity": 0.01, "option.wind[0]": 1.0,
    "option.wind[1]": -2.0, "option.wind[2]": 2.0, "body[upper].gravcomp": 0.4,
    "body[forearm].gravcomp": 0.4, "actuator[elbow].kp": 25.0, "actuator[elbow].kv": 1.5,
}  # fmt: skip


def written(spec: mujoco.MjSpec) -> None:
    """Write what stands under `IN_THE_MODEL`."""
    spec.option.density, spec.option.viscosity, spec.option.wind = 900.0, 0.01, [1.0, -2.0, 2.0]
    for body in ("upper", "forearm"):
        spec.body(body).gravcomp = 0.4
    servo = spec.actuator("elbow")
    servo.gainprm[0], servo.biasprm[1], servo.biasprm[2] = 25.0, -25.0, -1.5


def study_on(folder: Path, findings: list[Finding], edit: Callable[[mujoco.MjSpec], None]) -> str:
    """Write the study on an arm with a servo that was repaired; return its text."""
    write_recording(record(duration=1.0), folder / "train.parquet")
    text = ARM.read_text().replace('<motor name="elbow" joint="elbow" gear="1"/>', SERVO)
    (folder / "arm.xml").write_text(text)
    content = {
        "version": 1, "name": "arm", "model": "arm.xml", "recordings": {"train": ["train.parquet"]},
    }  # fmt: skip
    (folder / "study.yaml").write_text(yaml.safe_dump(content))
    study = Study.load(folder / "study.yaml")
    load_model(study).export(folder / MODEL, [edit])
    made = study_text(study, findings, folder, Written((), {}))
    (folder / "repaired.yaml").write_text(made)
    return made


def test_what_stands_in_the_model_is_a_parameter_and_the_study_loads(tmp_path: Path) -> None:
    text = study_on(tmp_path, list(IN_THE_MODEL.values()), written)
    study = Study.load(tmp_path / "repaired.yaml")
    model = load_model(study)
    held = study.parameter_set(model)
    own = {a: p for p in held for a in p.addresses}
    assert set(own) == set(NUMBERS)
    for address, value in NUMBERS.items():
        assert Address.parse(address).read(model) == pytest.approx(value)
        assert own[address].low < value < own[address].high
    for ends in ([p.low for p in held], [p.high for p in held]):
        model.compile(parameter_edits(model, held, ends))
    assert own["option.viscosity"].low == 0
    assert "# no parameter" not in text


@pytest.mark.parametrize(
    ("finding", "why"),
    [
        (found("timestep", "world", "world", 0.001, "s"), "are cut for the time step"),
        (found("actuator_saturation", "actuator", "elbow", 2.0, "N m"), "limits either way"),
        (found("actuator_delay", "actuator", "elbow", 0.02, "s"), "no more of the past"),
        (found("armature", "joint", "elbow", 3e-9, "kg m²"), "no one number of the repaired"),
        (found("com_shift", "body", "fore\nmodel: arm", 0.1, "m"), "no one number of the repaired"),
    ],
)
def test_what_is_no_parameter_says_why(tmp_path: Path, finding: Finding, why: str) -> None:
    first, *rest = study_on(tmp_path, [finding], lambda spec: None).splitlines()
    assert first.startswith(f"# no parameter: {finding.effect} at {' '.join(finding.site.split())}")
    assert why in first
    assert rest[0] == "version: 1"
    assert "parameters" not in yaml.safe_load("\n".join(rest))


def test_a_spring_that_went_whole_has_no_rest_angle(tmp_path: Path) -> None:
    gone = found("joint_spring", "joint", "elbow", -1.0, "N m/rad")
    assert "# no parameter: joint_spring at elbow" in study_on(tmp_path, [gone], lambda spec: None)
    left = replace(gone, before=5.0, after=4.0)
    text = study_on(tmp_path, [left], lambda spec: spec.joint("elbow").stiffness.__setitem__(0, 4))
    (parameter,) = yaml.safe_load(text)["parameters"]
    assert parameter["address"] == "joint[elbow].stiffness"


def test_what_was_written_says_that_it_steps_finer() -> None:
    assert Written((), {}, (0.0005, 0.001)).notes == (
        "model_repaired.xml steps at 0.0005 s, since 0.001 s shows in the recordings",
    )
    assert Written((), {}, (0.001, 0.001)).notes == ()
    (note,) = Written((), {"arm_play": "arm"}, (0.001, 0.001)).notes
    assert note.startswith("arm_play is a joint of model_repaired.xml that nothing measures")


def test_a_parameter_gives_way_to_bristles_that_stand_for_its_friction(tmp_path: Path) -> None:
    level, both = (0.1, 1.0, 8e-4), ["joint[shoulder].frictionloss", "joint[elbow].frictionloss"]
    found = Finding(
        "dry_friction", "joint", "elbow", Quantity(0.1, "N m", (0.09, 0.11)), 0.0, 0.1,
        {}, None, 0.98, (), "", level,
    )  # fmt: skip
    recorded = record(duration=1.0)
    write_recording(recorded, tmp_path / "train.parquet")
    content = {
        "version": 1, "name": "arm", "model": str(ARM), "recordings": {"train": ["train.parquet"]},
        "parameters": [
            {"address": both, "low": 0.0, "high": 1.0},
            {"address": "joint[elbow].damping", "low": 0.0, "high": 1.0},
        ],
    }  # fmt: skip
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(content))
    machine = survey(arm().compile(), [recorded])
    bend = CATALOGUE["dry_friction"].apply
    edits = [lambda spec: bend(spec, Site("joint", "elbow"), np.array(level), machine)]
    arm().export(tmp_path / MODEL, edits)
    study, written = Study.load(tmp_path / "study.yaml"), Written((), {})
    (tmp_path / "repaired.yaml").write_text(text := study_text(study, [found], tmp_path, written))
    first, rest = text.split("\n", 1)
    assert first.startswith("# no parameter: joint[elbow].frictionloss, since the law")
    assert "#" not in rest
    named = [p.address for p in Study.load(tmp_path / "repaired.yaml").parameters]
    bristles = tuple(f"actuator[elbow_friction].biasprm[{k}]" for k in (3, 4))
    assert named == [("joint[shoulder].frictionloss",), ("joint[elbow].damping",), bristles]


def moved(spec: mujoco.MjSpec) -> None:
    """Write a centre of mass that was found to be elsewhere."""
    make_explicit(spec, "forearm").ipos[0] += 0.01


def moved_study(folder: Path, body: str, parameters: list[dict[str, object]]) -> str:
    """Return the repaired study of a link with such geoms whose centre of mass was found."""
    text = f"""<mujoco><worldbody><body name="forearm"><joint name="elbow" axis="0 1 0"/>{body}
    </body></worldbody></mujoco>"""
    (folder / "link.xml").write_text(text)
    log = Recording.from_arrays(t := np.arange(0.0, 1.0, 0.01), qpos={"elbow": np.sin(t)})
    write_recording(log, folder / "train.parquet")
    content = {
        "version": 1, "name": "link", "model": "link.xml",
        "recordings": {"train": ["train.parquet"]}, "parameters": parameters,
    }  # fmt: skip
    (folder / "study.yaml").write_text(yaml.safe_dump(content))
    study = Study.load(folder / "study.yaml")
    load_model(study).export(folder / MODEL, [moved])
    com = found("com_shift", "body", "forearm", 0.01, "m")
    return study_text(study, [com], folder, Written((), {}))


MASS = {"name": "mass", "address": "geom[tube].mass", "low": 0.3, "high": 0.5}


@pytest.mark.parametrize("address", ["geom[tube].mass", "geom[*].mass"])
def test_the_mass_of_a_bodys_only_geom_becomes_that_of_the_body(
    tmp_path: Path, address: str
) -> None:
    tube = '<geom name="tube" size=".02" pos="0 0 -.1" mass=".4"/>'
    text = moved_study(tmp_path, tube, [MASS | {"address": address}])
    (tmp_path / "repaired.yaml").write_text(text)
    study = Study.load(tmp_path / "repaired.yaml")
    model = load_model(study)
    (held,) = study.parameter_set(model)
    assert held.addresses == ("body[forearm].mass",)
    heavy = model.compile(parameter_edits(model, study.parameter_set(model), [0.5]))
    assert heavy.body("forearm").mass[0] == pytest.approx(0.5)
    assert heavy.body("forearm").ipos == pytest.approx([0.01, 0, -0.1])


def test_a_parameter_that_the_repaired_model_lacks_is_left_out_with_the_reason(
    tmp_path: Path,
) -> None:
    geoms = '<geom name="tube" size=".02" mass=".4"/><geom name="tip" size=".01" mass=".1"/>'
    damping = {"address": "joint[elbow].damping", "low": 0.0, "high": 1.0}
    text = moved_study(tmp_path, geoms, [MASS, damping])
    assert text.startswith("# no parameter: ")
    assert "'geom[tube].mass': body 'forearm' has an <inertial>" in text.splitlines()[0]
    (kept,) = yaml.safe_load(text)["parameters"]
    assert kept["address"] == "joint[elbow].damping"
