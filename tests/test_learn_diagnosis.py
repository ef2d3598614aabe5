"""The diagnosis in the loop: called where no candidate will do, survived where it fails."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import yaml
from learning import learned, pendulum

import bo_sysid.diagnosis
import bo_sysid.excite.beside
from bo_sysid.effects import Site, survey
from bo_sysid.effects.beside import Beside, Placed
from bo_sysid.errors import StudyError, UserError
from bo_sysid.learn.iterate import value_candidates
from bo_sysid.learn.machine_source import MachineSource
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.values import Values, values
from bo_sysid.mjcf import address_edit
from bo_sysid.plants.build import build_plant
from bo_sysid.plants.load import make_environment
from bo_sysid.plants.tasks import Start
from bo_sysid.policy.network import GaussianPolicy, Network
from bo_sysid.policy.normalisation import Normaliser
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.recording import DATASETS, Dataset
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import Run
from bo_sysid.simulation import ForceLaw
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model, load_train


def lacking(noisy: bool = True, **learn: Any) -> dict[str, Any]:
    """Return a study whose plant has dry friction that its model lacks."""
    noise = {"qpos": 0.0005, "qvel": 0.005}
    effects = ["dry_friction", "viscous_damping", "joint_spring", "armature", "constant_force"]
    friction = {"effect": "dry_friction", "kind": "joint", "site": "hinge", "value": 0.25}
    return pendulum(
        recordings={"train": ["none.parquet"]},
        diagnosis={"effects": effects, "most": 2},
        learn={"trajectories": 1, "episodes": 2, "epsilon": 0.1, **learn},
        plant={
            "parameters": {"mass": 1.2, "damping": 0.8},
            "effects": [friction],
            "noise": noise if noisy else {},
        },
    )


def knowing(study: Study, run: Run, **_: Any) -> SimpleNamespace:
    """Stand in for a diagnosis that finds the plant's friction, with what it leaves in its run."""
    model = load_model(study)
    edit = address_edit(model, ["joint[hinge].frictionloss"], 0.25)
    model.export(run.path("model_repaired.xml"), [edit])
    data = study.resolved(relative_to=run.folder)
    assert len(load_train(study)) == 1
    data["model"] = {"file": "model_repaired.xml"}
    run.write_text("study_repaired.yaml", yaml.safe_dump(data))
    return SimpleNamespace(findings=pd.DataFrame({"effect": ["dry_friction"]}), sentences=("It.",))


def test_the_loop_goes_on_with_the_repaired_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bo_sysid.diagnosis, "diagnose", knowing)
    told = learned(tmp_path, lacking(trajectories=2, choose="argmax"))
    assert told.iterations["diagnosed"].tolist() == [True, False]
    unseen = "What was unseen is the last quarter by time of the same recordings."
    relative = "values of mass, damping are relative to the repaired model"
    assert told.notes == ("It.", unseen, relative)
    # with the friction in the model, what is left is what B can say
    assert told.chosen["mass"] == pytest.approx(1.2, abs=0.051)
    assert told.chosen["damping"] == pytest.approx(0.8, abs=0.11)
    assert (told.iterations["deviation"] < 1.1 * told.iterations["floor"]).all()
    monkeypatch.undo()
    again = learned(tmp_path, lacking(trajectories=2, choose="argmax"))
    pd.testing.assert_frame_equal(again.iterations, told.iterations)
    assert again.chosen == told.chosen


def test_the_plant_is_told_what_the_repaired_model_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gain that is not known leaves less of the range that an effort allows."""

    def gaining(study: Study, run: Run, **_: object) -> SimpleNamespace:
        found = knowing(study, run)
        data = yaml.safe_load(run.path("study_repaired.yaml").read_text())
        gain = {"name": "gain", "address": "actuator[torque].gear[0]", "low": 1.0, "high": 1.6}
        data["parameters"].append({**gain, "steps": 3})
        run.write_text("study_repaired.yaml", yaml.safe_dump(data))
        return found

    monkeypatch.setattr(bo_sysid.diagnosis, "diagnose", gaining)
    limits = {"hinge": {"effort": 0.5}}
    told = learned(tmp_path, {**lacking(trajectories=2, choose="argmax"), "limits": limits})
    assert told.iterations["diagnosed"].tolist() == [True, False]
    first, second = (
        np.abs(pd.read_parquet(tmp_path / f"run/trajectories/0{k}.parquet")["ctrl.torque"])
        for k in (1, 2)
    )
    assert first.max() > 0.35
    assert 0 < second.max() <= 0.5 / 1.6 + 1e-12
    policy = LearnedPolicy.load(tmp_path / "run/iterations/01/policy.npz")
    assert policy.about["commands"] == {"low": [-0.5 / 1.6], "high": [0.5 / 1.6]}


@pytest.mark.parametrize("most", [0.1, 0.4])
def test_actions_are_those_that_give_the_commands_of_the_model(most: float) -> None:
    network = GaussianPolicy(Network((3, 4, 2)))
    theta = np.random.default_rng(0).normal(size=network.size).astype(np.float32)
    normaliser = Normaliser(np.zeros(3), np.ones(3), 5.0)
    own = {"low": [-0.2, 0.0], "high": [0.2, 1.0]}
    policy = LearnedPolicy(network, theta, normaliser, {"commands": own})
    seen = np.random.default_rng(1).normal(size=(50, 3))
    low, high = np.array([-most, -most]), np.array([most, 2.0])
    given = low + (policy.acting(low, high)(seen) + 1) / 2 * (high - low)
    wanted = np.array([-0.2, 0.0]) + (policy.act(seen) + 1) / 2 * np.array([0.4, 1.0])
    np.testing.assert_allclose(given, np.clip(wanted, low, high), atol=1e-7)
    assert policy.acting(np.array(own["low"]), np.array(own["high"])) == policy.act


def test_a_policy_is_valued_by_the_commands_that_it_learned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As that of the iteration before a repair, by which the rule of Zhu et al. ends a search."""
    asked = Mock(return_value=Values(np.zeros((2, 1))))
    monkeypatch.setattr("bo_sysid.learn.iterate.values", asked)
    network = GaussianPolicy(Network((3, 4, 1)))
    theta = np.random.default_rng(0).normal(size=network.size).astype(np.float32)
    own = {"commands": {"low": [-0.2], "high": [0.2]}}
    policy = LearnedPolicy(network, theta, Normaliser(np.zeros(3), np.ones(3)), own)
    seen = np.random.default_rng(1).normal(size=(50, 3))
    scene = Scene.of(Study.from_dict(pendulum(limits={"hinge": {"effort": 0.5}})))
    value_candidates(scene, policy, np.arange(2), 1)
    act = asked.call_args.args[2]
    np.testing.assert_allclose(0.5 * act(seen), 0.2 * policy.act(seen), atol=1e-7)


UPRIGHT = """
import numpy as np
from dm_control.suite import base

class Upright(base.Task):
    def initialize_episode(self, physics):
        physics.data.qpos[0] = self.random.uniform(1.0, 3.0)
        super().initialize_episode(physics)

    def get_observation(self, physics):
        return {"pose": np.concatenate([physics.data.qpos, physics.data.qvel])}

    def get_reward(self, physics):
        return float(np.cos(physics.data.qpos[0]))
"""


def test_a_task_of_the_users_own_is_diagnosed_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its file is named relative to the study, and found from the folder of the diagnosis."""
    data = lacking(trajectories=1, choose="argmax")
    load_model(Study.from_dict(data, tmp_path)).export(tmp_path / "pole.xml", [])
    (tmp_path / "upright.py").write_text(UPRIGHT)
    data |= {"model": {"file": "pole.xml"}, "task": {"file": "upright.py", "class": "Upright"}}
    monkeypatch.setattr(bo_sysid.diagnosis, "diagnose", knowing)
    told = learned(tmp_path, data)
    assert told.iterations["diagnosed"].tolist() == [True]
    assert "It." in told.notes


@pytest.mark.slow
def test_the_diagnosis_itself_repairs_the_model(tmp_path: Path) -> None:
    told = learned(tmp_path, lacking())
    assert told.iterations["diagnosed"].tolist() == [True]
    assert any("hinge has dry friction of 0.2" in note for note in told.notes)
    assert told.chosen["dry friction of hinge"] == pytest.approx(0.25, abs=0.04)
    run = tmp_path / "run"
    before = json.loads((run / "iterations" / "01" / "identified.json").read_text())["floor"]
    repaired = run / "iterations" / "01" / "repaired" / "identified.json"
    after = json.loads(repaired.read_text())["floor"]
    assert before["deviation"] > 1.5 * before["noise"]
    assert after["deviation"] < 1.1 * after["noise"]


def test_a_plant_without_noise_is_diagnosed_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bo_sysid.diagnosis, "diagnose", knowing)
    told = learned(tmp_path, lacking(noisy=False, trajectories=1, choose="argmax"))
    assert told.iterations["diagnosed"].tolist() == [True]
    nothing = pendulum(learn={"trajectories": 1, "episodes": 2})
    nothing["recordings"] = {"train": ["none.parquet"]}
    nothing["plant"] = {"parameters": {"mass": 1.23, "damping": 0.84}}  # off the grid of B
    told = learned(tmp_path, nothing, "nothing")
    assert told.iterations["diagnosed"].tolist() == [False]


def test_without_diagnosis_the_loop_stays_with_the_model(tmp_path: Path) -> None:
    told = learned(tmp_path, lacking(diagnose="never"))
    assert told.iterations["diagnosed"].tolist() == [False]
    assert any("no candidate explains the recordings" in n and "auto" in n for n in told.notes)
    assert not (tmp_path / "run" / "diagnosis-01").exists()


def test_a_diagnosis_that_fails_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def fails(*arguments: Any, **keywords: Any) -> None:
        calls.append(arguments)
        raise UserError("nothing moves")

    monkeypatch.setattr(bo_sysid.diagnosis, "diagnose", fails)
    told = learned(tmp_path, lacking(trajectories=2))
    assert len(calls) == 1
    assert told.iterations["diagnosed"].tolist() == [True, False]
    (note,) = (n for n in told.notes if n.startswith("The diagnosis"))
    assert note == (
        "The diagnosis gave no study to go on with: nothing moves. The loop goes on as it was."
    )
    assert set(told.chosen) == {"mass", "damping"}


def beside(
    folder: Path,
    effect: str,
    value: float,
    site: Site = Site("joint", "hinge"),  # noqa: B008 - a frozen value
    **changed: Any,
) -> Study:
    """Return a study with an effect of the catalogue beside its model's file."""
    plain = Study.from_dict(pendulum(), folder)
    model = load_model(plain)
    model.export(folder / "model.xml", [])
    motion = build_plant(plain).record(np.sin(np.arange(200)[:, None] * 0.1))
    machine = survey(model.compile(), [motion])
    placed = Placed(effect, site, (value,))
    Beside(machine, (placed,)).write(folder / "model.json")
    data = pendulum(model={"file": "model.xml", "beside": ["model.json"]}, **changed)
    return Study.from_dict(data, folder)


def test_forces_beside_the_model_are_stepped_where_a_policy_is_learned(tmp_path: Path) -> None:
    scene = Scene.of(beside(tmp_path, "asymmetric_damping", 0.2))
    (law,) = scene.laws
    assert law.joint == "hinge"
    # the same effect, realised by a plant at the same parameters
    force = {"effect": "asymmetric_damping", "kind": "joint", "site": "hinge", "value": 0.2}
    plant = build_plant(Study.from_dict(pendulum(plant={"effects": [force]}), tmp_path))
    controls = np.sin(np.arange(300)[:, None] * 0.05)
    truth = plant.record(controls, start=Start(np.array([0.5])))
    moved = {}
    for name, laws in (("with", scene.laws), ("without", ())):
        environment = make_environment(
            scene.task, scene.compiled(np.array([1.0, 1.0])), 1, laws=laws
        )
        environment.begin([Start(np.array([0.5]))])
        for action in controls:
            environment.step(action[None])
        moved[name] = float(environment.sims.qpos[0, 0])
    assert moved["with"] == pytest.approx(truth.channels["qpos.hinge"].values[-1], abs=1e-9)
    assert abs(moved["without"] - moved["with"]) > 1e-3

    def push(observation: np.ndarray) -> np.ndarray:
        return np.ones((len(observation), 1))

    assert values(scene, [scene.compiled(np.array([1.0, 1.0]))], push).returns.shape == (1, 2)


def test_a_law_that_reads_what_is_recorded_only_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = beside(tmp_path, "asymmetric_damping", 0.2)
    law = ForceLaw("hinge", lambda m: m.signals["aux.voltage"])
    monkeypatch.setattr(bo_sysid.excite.beside, "study_laws", lambda *_: (law,))
    with pytest.raises(StudyError, match=r"beside.*depends on 'aux.voltage'"):
        Scene.of(study)


def test_what_changes_commands_beside_the_model_is_refused(tmp_path: Path) -> None:
    study = beside(tmp_path, "actuator_deadzone", 0.02, Site("actuator", "torque"))
    with pytest.raises(StudyError, match=r"model.beside: a policy cannot .* commands of torque"):
        Scene.of(study)


def test_recordings_of_policies_are_corrected_as_the_first_ones(tmp_path: Path) -> None:
    sensor = Site("channel", "qvel.hinge")
    study = beside(tmp_path, "sensor_scale", 0.25, sensor, plant=None,
                   recordings={"train": ["first.csv"], "holdout": ["first.csv"]})  # fmt: skip
    plant = build_plant(Study.from_dict(pendulum(), tmp_path))
    shown, later_on = (plant.record(np.full((100, 1), x)) for x in (0.2, -0.1))
    write_recording(shown, tmp_path / "first.csv")
    any_policy = Mock(spec=LearnedPolicy)
    scene = Scene.of(study)
    with Run.open(tmp_path / "run", study.resolved(relative_to=tmp_path), "learn") as run:
        source = MachineSource(scene, run)
        write_recording(later_on, run.path("recordings/trajectory-01.csv"))
        assert source.take(2, any_policy, scene) is None
        truths = [r.channels["qvel.hinge"].values / 1.25 for r in (shown, later_on)]
        for recording, truth in zip(source.recordings(study), truths, strict=True):
            np.testing.assert_allclose(recording.channels["qvel.hinge"].values, truth, atol=1e-9)
        (tmp_path / "later").mkdir()
        later = beside(tmp_path / "later", "sensor_scale", -0.2, sensor)  # as a repair may say
        for recording, truth in zip(source.recordings(later), truths, strict=True):
            np.testing.assert_allclose(recording.channels["qvel.hinge"].values, truth * 1.25 / 0.8)


def test_a_dataset_and_recordings_of_policies_are_diagnosed_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, later = (
        build_plant(Study.from_dict(pendulum(), tmp_path)).record(np.full((100, 1), x))
        for x in (0.2, -0.1)
    )
    public = Dataset("swing", lambda: (first,), lambda: (later,), "nobody")
    monkeypatch.setitem(DATASETS, "swing", lambda: public)
    noise = {"qpos": 0.01}
    asked = pendulum(plant=None, recordings={"dataset": "swing", "noise": noise})
    study = Study.from_dict(asked, tmp_path)
    scene = Scene.of(study)
    with Run.open(tmp_path / "run", study.resolved(relative_to=tmp_path), "learn") as run:
        source = MachineSource(scene, run)
        write_recording(later, run.path("recordings/trajectory-01.csv"))
        assert source.take(2, Mock(spec=LearnedPolicy), scene) is None
        told = {**study.resolved(), "recordings": {**source.training, "holdout": None}}
        both = load_train(Study.from_dict(told, run.folder))
        assert told["recordings"]["noise"] == noise
    for recording, truth in zip(both, (first, later), strict=True):
        seen, whole = recording.channels["qpos.hinge"].values, truth.channels["qpos.hinge"].values
        np.testing.assert_allclose(seen, whole[: len(seen)], atol=1e-12)
        assert len(seen) > 0.7 * len(whole)
