"""Effects of a plant: what the study says is what the machine does, or a clear refusal."""

from typing import get_args

import numpy as np
import pytest

from bo_sysid.effects.contract import SiteKind
from bo_sysid.errors import StudyError
from bo_sysid.mjcf import Model, address_edit
from bo_sysid.plants.build import build_plant
from bo_sysid.plants.plant import Plant
from bo_sysid.plants.tasks import find_task
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.study.outer import PlantEffect

CARTPOLE = {"dm_control": {"domain": "cartpole", "task": "swingup"}}
SERVO = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def study(effects, **more):
    return Study.from_dict(
        {
            "model": CARTPOLE,
            "recordings": {"train": ["none.parquet"]},
            "plant": {"effects": effects},
            **more,
        }
    )


def matrix(recording, kind):
    return np.stack([c.values for c in recording.of_kind(kind).values()], axis=1)


def controls(plant, rows=100):
    return np.sin(np.arange(rows) * 0.2)[:, None] * 0.5


@pytest.mark.parametrize(
    ("effect", "address", "tolerance"),
    [  # a force law is held over a step, which the model's Runge-Kutta steps do not do
        (
            {"effect": "joint_spring", "kind": "joint", "site": "slider", "value": 3.0},
            "stiffness",
            1e-3,
        ),
        (
            {"effect": "viscous_damping", "kind": "joint", "site": "slider", "value": 0.7},
            "damping",
            1e-10,
        ),
        (
            {"effect": "armature", "kind": "joint", "site": "slider", "value": 0.4},
            "armature",
            1e-10,
        ),
    ],
)
def test_a_plant_with_an_effect_moves_as_the_edited_model(effect, address, tolerance):
    plant = build_plant(study([effect]), seed=3)
    model = load_model(study([effect]))
    edit = address_edit(model, [f"joint[slider].{address}"], effect["value"], "add")
    task = find_task("cartpole", "swingup")
    edited = Plant(model, [edit], task=task, seed=3).record(controls(plant))
    nominal = Plant(model, task=task, seed=3).record(controls(plant))
    recorded = plant.record(controls(plant))
    np.testing.assert_allclose(matrix(recorded, "qpos"), matrix(edited, "qpos"), atol=tolerance)
    assert np.abs(matrix(recorded, "qpos") - matrix(nominal, "qpos")).max() > 0.02

    def act(observation):
        return np.tanh(observation[:, :1])

    same = Plant(model, [edit], task=task, seed=3).evaluate(act, 3, seed=1)
    np.testing.assert_allclose(plant.evaluate(act, 3, seed=1), same, rtol=20 * tolerance)


@pytest.mark.parametrize(
    ("plant", "message"),
    [
        ({"noise": {"qpox": 0.1}}, r"plant.noise: noise of 'qpox'; did you mean 'qpos'"),
        ({"timestep": 0.0033}, r"plant.timestep: the time step of 0.0033 s must divide 0.01 s"),
    ],
)
def test_what_is_wrong_with_a_plant_has_its_key(tmp_path, plant, message):
    (tmp_path / "arm.xml").write_text(SERVO)
    data = {"model": "arm.xml", "recordings": {"train": ["none.parquet"]}, "plant": plant}
    with pytest.raises(StudyError, match=message):
        build_plant(Study.from_dict(data, tmp_path))


def test_a_force_that_mjcf_cannot_say_is_stepped(tmp_path):
    (tmp_path / "arm.xml").write_text(SERVO)
    data = {
        "model": "arm.xml",
        "recordings": {"train": ["none.parquet"]},
        "plant": {
            "effects": [
                {"effect": "asymmetric_damping", "kind": "joint", "site": "hinge", "value": 0.6}
            ]
        },
    }
    plant = build_plant(Study.from_dict(data, tmp_path))
    recording = plant.record(np.full((40, 1), 0.3), warmstart=True)
    model = Model.from_xml(SERVO, name="arm")
    plain = Plant(model).record(np.full((40, 1), 0.3))
    v = matrix(recording, "qvel")[:, 0]
    assert (v[1:] > 0).sum() > 10
    # half the difference either way: a drag of 0.3 v forward, the opposite backward
    compiled = model.compile()
    inertia = float(compiled.body_inertia[1].max() + 1.0 * 0.25**2)
    first = matrix(plain, "qvel")[2, 0] - v[2]
    expected = 0.01 * 0.3 * abs(v[1]) / (inertia + 0.01 * 0.1)
    assert abs(first) == pytest.approx(expected, rel=0.02)


def test_a_plant_goes_on_after_an_interruption_as_if_there_had_been_none():
    asked = study([{"effect": "joint_spring", "kind": "joint", "site": "slider", "value": 1.0}])
    whole, resumed = build_plant(asked, seed=1), build_plant(asked, seed=1)
    third = [whole.record(controls(whole)) for _ in range(3)][2]
    resumed.resume(whole.trajectories[:2])
    again = resumed.record(controls(resumed))
    np.testing.assert_array_equal(matrix(again, "qpos"), matrix(third, "qpos"))
    assert again.name == third.name
    assert len(resumed.trajectories) == 3


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        ({"effect": "dry_frction", "kind": "joint", "site": "slider"}, "mean 'dry_friction'"),
        ({"effect": "dry_friction", "kind": "body", "site": "slider"}, "acts on a joint, not body"),
        ({"effect": "dry_friction", "kind": "joint", "site": "slidr"}, "did you mean 'slider'"),
        (
            {"effect": "backlash", "kind": "joint", "site": "slider"},
            "(?s)effects.*(adds a joint|is a hidden)",
        ),
        (
            {"effect": "sensor_delay", "kind": "channel", "site": "qpos.slider"},
            "a reading of recorded data",
        ),
        (
            {"effect": "voltage_sag", "kind": "actuator", "site": "slide"},
            "(does not apply|reads the recorded input)",
        ),
        (
            {
                "effect": "payload",
                "kind": "body",
                "site": "pole_1",
                "details": {"weight": 1.0},
            },
            "no component 'weight'",
        ),
        (
            {"effect": "payload", "kind": "body", "site": "pole_1"},
            "7 observations instead of 5",
        ),
        (
            {"effect": "dry_friction", "kind": "joint", "site": "slider", "value": -0.1},
            r"effects\.0\.value: dry_friction: level is -0.1; it must be at least 0$",
        ),
        (
            {
                "effect": "stribeck_friction",
                "kind": "joint",
                "site": "slider",
                "details": {"coulomb": -0.2},
            },
            r"effects\.0\.details: stribeck_friction: coulomb is -0.2; it must be at least 0$",
        ),
    ],
)
def test_what_a_plant_cannot_have_is_said(effect, message):
    with pytest.raises(StudyError, match=message):
        build_plant(study([{"value": 0.1, **effect}]))


def test_a_negative_magnitude_may_take_away_what_the_model_has_or_push_the_other_way(tmp_path):
    (tmp_path / "arm.xml").write_text(SERVO)

    def built(effect, value):
        asked = {"effect": effect, "kind": "joint", "site": "hinge", "value": value}
        data = {"recordings": {"train": ["none.csv"]}, "plant": {"effects": [asked]}}
        return build_plant(Study.from_dict({"model": "arm.xml", **data}, tmp_path))

    built("viscous_damping", -0.1)  # all of the model's own
    built("constant_force", -100.0)  # a direction; the range of a search binds no plant
    with pytest.raises(StudyError, match=r"coefficient is -0.11; it must be at least -0.1$"):
        built("viscous_damping", -0.11)


def test_a_plant_may_have_a_motor_that_does_nothing(tmp_path):
    """No search goes as far as -95 %, and -100 % is a machine all the same."""
    (tmp_path / "arm.xml").write_text(SERVO)

    def built(value):
        asked = {"effect": "actuator_gain", "kind": "actuator", "site": "motor", "value": value}
        data = {"recordings": {"train": ["none.csv"]}, "plant": {"effects": [asked]}}
        return build_plant(Study.from_dict({"model": "arm.xml", **data}, tmp_path))

    built(-1.0)
    with pytest.raises(StudyError, match=r"change is -1.1; it must be at least -1$"):
        built(-1.1)


def test_a_study_offers_the_kinds_of_site_that_effects_have():
    assert get_args(PlantEffect.model_fields["kind"].annotation) == get_args(SiteKind)
