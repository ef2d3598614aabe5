"""Studies: every key of the file, its defaults, its paths and what it names."""

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml

from bo_sysid.diagnosis.gather import gather
from bo_sysid.effects.learned import ELAPSED
from bo_sysid.effects.registry import CATALOGUE
from bo_sysid.effects.units import at_slide
from bo_sysid.errors import RecordingError, StudyError
from bo_sysid.excite.excite import excite
from bo_sysid.identify.problem import make_problem
from bo_sysid.plants.build import study_task
from bo_sysid.recording import Recording
from bo_sysid.recording.columns import ClockRule, ColumnRule
from bo_sysid.recording.writers import write_recording
from bo_sysid.simulation import cut
from bo_sysid.study import Study, inputs, schema
from bo_sysid.study.base import Section
from bo_sysid.study.inputs import (
    fingerprints,
    load_function,
    load_holdout,
    load_model,
    load_train,
    require_holdout,
)
from bo_sysid.study.overview import overview
from bo_sysid.study.requirements import require_known, require_limits, require_scales
from bo_sysid.study.sections import Clock, Column
from bo_sysid.yaml_text import Loader, dumped

STUDIES = [
    path
    for path in sorted((Path(__file__).parents[1] / "studies").rglob("*.yaml"))
    if "concealed" not in path.parts  # suites and their machines, which are no studies
]
ARM = """
<mujoco>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0"/>
      <geom name="upper" type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass="1"/>
      <body name="forearm" pos="0 0 -.3">
        <joint name="elbow" axis="0 1 0"/>
        <geom name="forearm" type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".6"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="elbow" joint="elbow"/></actuator>
</mujoco>
"""
# every key that a study can have
FULL = """
version: 1
name: two-link arm with something missing
model: models/arm.xml
recordings:
  train: [data/arm-*.csv]
  holdout: [data/check.csv]
  columns:
    qpos.elbow: {from: theta2, unit: deg, sign: -1, unwrap: true}
    aux.voltage: {from: bus_voltage, unit: V}
  clocks: {ctrl: {from: t_command, hold: zero}}
  noise: {qpos: 0.001}
actuators:
  elbow: {law: servo.py:duty, uses: [aux.voltage, goal.elbow]}
parameters:
  - {name: forearm mass, address: "geom[forearm].mass", apply: set, low: 0.4, high: 0.8, steps: 21,
     unit: kg}
  - {address: "joint[*].armature", each: true, low: 0, high: 0.05}
deviation: {horizon: 1, starts: measured, whiten: auto}
search: {candidates: grid, acquisition: argmin-entropy, budget: 60, stop: {entropy: 0.01, last: 5},
         seed: 0, refine: true}
diagnosis: {effects: all, exclude: [], known: ["body[base].mass"], most: 3, effect_files: []}
limits: {elbow: {position: [-2, 2], velocity: 4, effort: 8}}
task: {dm_control: {domain: cheetah, task: run}}
policy: {algorithm: trpo, batch: 20000}
learn: {choose: sample, stop: seed, epsilon: 0.05, r: 0.05, trajectories: 10, diagnose: auto}
compare: {arms: [random, {acquisition: argmin-entropy, stop: zhu}], seeds: 30}
execution: {engine: local}
plant: {parameters: {torso mass: 1.07},
        effects: [{effect: dry_friction, kind: joint, site: bshin, value: 1.0}],
        noise: {qpos: 0.001}, timestep: 0.00125}
"""
LOG = "time,theta2,bus_voltage,t_command,ctrl.elbow\n" + "".join(
    f"{k / 100},{k},12,{k / 100 - 0.002},{k % 3}\n" for k in range(40)
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the study above and everything that it names."""
    files = {
        "arm.yaml": FULL,
        "models/arm.xml": ARM,
        "servo.py": "def duty(inputs):\n    return inputs\n",
        "data/arm-1.csv": LOG,
        "data/arm-2.csv": LOG,
        "data/check.csv": LOG,
    }
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
    return tmp_path


def load(folder: Path, **overrides: object) -> Study:
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    return Study.load(folder / "arm.yaml", changes, trust_code=True)


def minimal(folder: Path, **keys: object) -> Study:
    data = {"model": "models/arm.xml", "recordings": {"train": "data/arm-*.csv"}}
    return Study.from_dict({**data, **keys}, folder)


def test_every_key_is_read(folder: Path) -> None:
    study = load(folder)
    assert study.model.file == "models/arm.xml"
    assert study.recordings.columns["qpos.elbow"].source == "theta2"
    assert study.recordings.columns["qpos.elbow"].sign == -1
    assert study.recordings.clocks["ctrl"].hold == "zero"
    assert study.actuators["elbow"].uses == ("aux.voltage", "goal.elbow")
    assert study.parameters[0].steps == 21
    assert study.parameters[1].each
    assert study.search.candidates.sobol is None
    assert study.limits["elbow"].position == (-2, 2)
    assert study.task is not None
    assert study.task.dm_control is not None
    assert study.task.dm_control.domain == "cheetah"
    assert [a.acquisition for a in study.compare.arms] == ["random", "argmin-entropy"]
    assert study.plant is not None
    assert study.plant.effects[0].site == "bshin"
    assert study.plant.timestep == 0.00125


def test_only_model_and_recordings_are_required(folder: Path) -> None:
    study = minimal(folder)
    assert study.search.budget == 60
    assert study.search.acquisition == "max-value-entropy"  # needs least in benchmarks/selection
    assert study.deviation.starts == "measured"
    assert study.diagnosis.most == 3
    with pytest.raises(StudyError, match=r"(?s)2 problems.*model: .*required.*recordings: .*requi"):
        Study.from_dict({})


def test_a_section_that_was_emptied_is_as_if_left_out(folder: Path) -> None:
    """As `init` asks for: remove from the parameters what the diagnosis is to look for."""
    train = "model: models/arm.xml\nrecordings:\n  train: [data/arm-1.parquet]\n"
    (folder / "plain.yaml").write_text(f"{train}name: a\n")
    emptied = "  columns:\n  holdout:\nparameters:\nlimits:\nsearch: {budget: }\nname: a\n"
    (folder / "emptied.yaml").write_text(train + emptied)
    emptied_study, plain = (Study.load(folder / f"{n}.yaml") for n in ("emptied", "plain"))
    assert emptied_study.resolved() == plain.resolved()
    (folder / "emptied.yaml").write_text(f"{train}parameterz:\n")
    with pytest.raises(StudyError, match="line 4: parameterz: unknown key; did you mean 'paramete"):
        Study.load(folder / "emptied.yaml")
    (folder / "emptied.yaml").write_text("model:\nrecordings:\n")
    with pytest.raises(StudyError, match="line 1: model: this key is required"):
        Study.load(folder / "emptied.yaml")


def test_a_study_cannot_be_changed(folder: Path) -> None:
    with pytest.raises(ValueError, match="frozen"):
        minimal(folder).name = "other"


def test_the_name_is_the_files_where_left_out(folder: Path) -> None:
    (folder / "short.yaml").write_text("model: models/arm.xml\nrecordings: {dataset: emps}\n")
    assert Study.load(folder / "short.yaml").name == "short"
    assert load(folder).name == "two-link arm with something missing"


@pytest.mark.parametrize("candidates", ["grid", {"sobol": 2000}])
def test_resolved_is_a_study_that_resolves_to_itself(folder: Path, candidates: object) -> None:
    study = load(folder, search__candidates=candidates)
    resolved = study.resolved()
    assert resolved["search"]["candidates"] == candidates
    text = yaml.safe_dump(resolved, sort_keys=False)
    (folder / "again.yaml").write_text(text)
    again = Study.load(folder / "again.yaml", trust_code=True)
    assert again.resolved() == resolved
    assert again.sha256 == study.sha256
    assert load(folder, search__candidates=candidates, search__budget=61).sha256 != study.sha256
    assert json.loads(json.dumps(resolved)) == resolved


def test_resolved_for_another_folder_names_the_same_files(folder: Path) -> None:
    study = load(folder)
    run = folder / "runs" / "arm-identify"
    run.mkdir(parents=True)
    moved = study.resolved(relative_to=run)
    assert moved["model"]["file"] == "../../models/arm.xml"
    assert moved["actuators"]["elbow"]["law"] == "../../servo.py:duty"
    (run / "study.yaml").write_text(yaml.safe_dump(moved))
    again = Study.load(run / "study.yaml", trust_code=True)
    resolve = [p.resolve() for p in again.train_files]
    assert resolve == [p.resolve() for p in study.train_files]


@pytest.mark.parametrize("named", ["arm-*.csv", "arm-1.csv", "arm [1].csv", "../st[1]/arm*1.csv"])
def test_a_folder_with_brackets_is_no_part_of_a_pattern(tmp_path: Path, named: str) -> None:
    folder, run = tmp_path / "st[1]", tmp_path / "runs [a-z]*" / "r"
    run.mkdir(parents=True)
    for place in (folder, tmp_path / "st1"):
        place.mkdir()
        for name in ("arm-1.csv", "arm-2.csv", "arm [1].csv"):
            (place / name).write_text(LOG)
    (folder / "arm.xml").write_text(ARM)
    study = Study.from_dict({"model": "arm.xml", "recordings": {"train": named}}, folder)
    moved = study.resolved(relative_to=run)
    again = Study.from_dict(moved, run)
    assert again.model.file == "../../st[1]/arm.xml"
    assert [p.resolve() for p in again.train_files] == [p.resolve() for p in study.train_files]
    back = Study.from_dict(again.resolved(relative_to=tmp_path), tmp_path)
    assert [p.resolve() for p in back.train_files] == [p.resolve() for p in study.train_files]


def test_globs_are_expanded_in_order(folder: Path) -> None:
    study = load(folder)
    assert [p.name for p in study.train_files] == ["arm-1.csv", "arm-2.csv"]
    assert [p.name for p in study.holdout_files] == ["check.csv"]
    absolute = str(folder / "data" / "arm-2*.csv")
    study = minimal(folder, recordings={"train": [absolute, "data/arm-*.csv"]})
    assert [p.name for p in study.train_files] == ["arm-2.csv", "arm-1.csv"]


def test_a_pattern_without_files_names_the_nearest(folder: Path) -> None:
    study = load(folder, recordings__train=["data/amr-1.csv"])
    with pytest.raises(StudyError, match=r"'data/amr-1.csv' matches no file.*'arm-1.csv'"):
        _ = study.train_files
    study = load(folder, recordings__train=["dat/arm-1.csv"])
    with pytest.raises(StudyError, match="no dat in"):
        _ = study.train_files


@pytest.mark.parametrize(
    ("pattern", "told"),
    [
        (".", "'.' matches no file; it is a folder; name the files in it"),
        ("./", "it is a folder"),
        ("data", "it is a folder"),
        ("/", "it is a folder"),
        ("data/**.csv", r"\*\* stands for folders and must be alone .*'data/\*\*/\*.csv'"),
    ],
)
def test_a_pattern_of_no_files_is_told_what_it_is(folder: Path, pattern: str, told: str) -> None:
    study = load(folder, recordings__train=[pattern])
    with pytest.raises(StudyError, match=rf"recordings.train.0: .*{told}"):
        _ = study.train_files


@pytest.mark.parametrize("spelled", ["data/*.csv", "data/../data/arm-1.csv", "linked.csv"])
def test_a_file_for_training_and_holdout_is_refused(folder: Path, spelled: str) -> None:
    (folder / "linked.csv").symlink_to(folder / "data" / "arm-1.csv")
    study = load(folder, recordings__holdout=[spelled])
    with pytest.raises(StudyError, match=r"holdout: \S+.csv is among the files of train"):
        _ = study.holdout_files


def test_a_holdout_that_is_not_there_is_said_before_anything_is_computed(folder: Path) -> None:
    study = load(folder, recordings__holdout=["data/nothere.csv"])
    with pytest.raises(StudyError, match=r"holdout.*nothere"):
        require_holdout(study)


def test_a_file_that_is_named_twice_is_read_once(folder: Path) -> None:
    study = load(folder, recordings__train=["data/arm-1.csv", "data/../data/arm-1.csv"])
    assert [p.name for p in study.train_files] == ["arm-1.csv"]


def test_a_name_with_brackets_is_that_of_a_file(folder: Path) -> None:
    (folder / "data" / "arm-1.csv").rename(folder / "data" / "arm [1].csv")
    study = load(folder, recordings__train=["data/arm [1].csv"])
    assert [p.name for p in study.train_files] == ["arm [1].csv"]


def test_recordings_are_mapped_as_the_study_says(folder: Path) -> None:
    (train, _), (check,) = load_train(load(folder)), load_holdout(load(folder))
    assert set(train.channels) == {"qpos.elbow", "aux.voltage", "ctrl.elbow"}
    assert train.channels["qpos.elbow"].values[10] == pytest.approx(-10 * 3.141592653589793 / 180)
    assert train.channels["ctrl.elbow"].time[1] == pytest.approx(0.008)
    assert check.channels["qpos.elbow"].values.size == 40


def test_without_holdout_the_last_quarter_is_set_aside(folder: Path) -> None:
    columns = {"qpos.elbow": "theta2"}
    study = minimal(folder, recordings={"train": "data/arm-1.csv", "columns": columns})
    (train,), (holdout,) = load_train(study), load_holdout(study)
    assert train.channels["qpos.elbow"].time[-1] == pytest.approx(0.29)
    assert holdout.channels["qpos.elbow"].time[0] == pytest.approx(0.30)
    assert "0.2925 s" in train.notes[-1]
    assert holdout.channels["qpos.elbow"].time[-1] == pytest.approx(0.39)


def test_what_has_a_memory_goes_on_in_the_last_quarter(tmp_path: Path) -> None:
    """As if it had been cut from the whole log: the clock of a law, and a motor that lags."""
    lags = '<general name="m" joint="a" dyntype="filterexact" dynprm=".2"/>'
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="a"/><geom size=".1" pos=".1 0 0"/></body>'
        f"</worldbody><actuator>{lags}</actuator></mujoco>"
    )
    t = np.arange(0, 4, 0.01)
    u = np.sign(np.sin(3 * t))
    whole = Recording.from_arrays(t, qpos={"a": np.sin(t)}, qvel={"a": np.cos(t)}, ctrl={"m": u})
    write_recording(whole, tmp_path / "log.parquet")
    study = minimal(tmp_path, model="arm.xml", recordings={"train": "log.parquet"})
    parts = whole, *load_train(study), *load_holdout(study)
    model = load_model(study)
    all_, train, held = (cut(model, [r], horizon=5, signals=(ELAPSED,)) for r in parts)
    for windows in (train, held):
        same = np.flatnonzero(np.isin(all_.time, windows.time))
        assert len(same) == len(windows) > 0
        np.testing.assert_array_equal(windows.signals[ELAPSED], all_.signals[ELAPSED][same])
        np.testing.assert_allclose(windows.start.act, all_.start.act[same], atol=1e-12)
    assert np.abs(held.start.act).max() > 0.1
    assert held.signals[ELAPSED][0, 0] >= 2.9


def test_the_model_is_loaded(folder: Path) -> None:
    assert load_model(load(folder)).joints == ("shoulder", "elbow")
    suite = minimal(folder, model={"dm_control": {"domain": "pendulum", "task": "swingup"}})
    assert load_model(suite).joints == ("hinge",)


def test_parameters_follow_the_model(folder: Path) -> None:
    study = load(folder)
    mass, *armatures = study.parameter_set(load_model(study))
    assert mass.name == "forearm mass"
    assert mass.addresses == ("geom[forearm].mass",)
    assert (mass.low, mass.high, mass.steps, mass.unit) == (0.4, 0.8, 21, "kg")
    assert [p.name for p in armatures] == ["joint[shoulder].armature", "joint[elbow].armature"]
    tied = minimal(folder, parameters=[{"address": "joint[*].damping", "low": 0, "high": 1}])
    (damping,) = tied.parameter_set(load_model(tied))
    assert damping.addresses == ("joint[shoulder].damping", "joint[elbow].damping")
    assert damping.name == "joint[*].damping"


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("joint[elbw].damping", r"parameters\.0\.address: .*did you mean 'elbow'"),
        ("joint[elbow].dmping", r"parameters\.0\.address: .*did you mean 'damping'"),
        ("elbow", r"parameters\.0\.address: "),
    ],
)
def test_an_address_that_is_not_there_is_refused(folder: Path, address: str, expected: str) -> None:
    study = minimal(folder, parameters=[{"address": address, "low": 0, "high": 1}])
    with pytest.raises(StudyError, match=expected):
        study.parameter_set(load_model(study))


def test_the_time_step_is_no_parameter(folder: Path) -> None:
    damping = {"address": "joint[*].damping", "low": 0, "high": 1}
    step = {"name": "step", "address": "option.timestep", "low": 0.001, "high": 0.004}
    study = minimal(folder, parameters=[damping, step])
    with pytest.raises(StudyError, match=r"parameters\.1\.address: option.timestep is no"):
        study.parameter_set(load_model(study))


def test_what_is_certain_must_be_a_number_of_the_model(folder: Path) -> None:
    columns = {"qpos.elbow": "theta2"}
    logs = {"train": "data/arm-1.csv", "columns": columns}
    for known, expected in (
        ("joint[elbw].damping", r"diagnosis\.known\.1: .*did you mean 'elbow'"),
        ("joint[elbow].dmping", r"diagnosis\.known\.1: .*did you mean 'damping'"),
    ):
        certain = {"known": ["joint[elbow].damping", known]}
        study = minimal(folder, recordings=logs, diagnosis=certain)
        with pytest.raises(StudyError, match=expected):
            overview(study)


def test_two_parameters_of_one_name_are_refused(folder: Path) -> None:
    entry = {"address": "joint[elbow].damping", "low": 0, "high": 1}
    study = minimal(folder, parameters=[entry, entry])
    with pytest.raises(StudyError, match=r"parameters\.1: there is another parameter 'joint\[elb"):
        study.parameter_set(load_model(study))


@pytest.mark.parametrize(
    ("apply", "low", "high", "expected"),
    [
        ("set", -1, 2, r"parameters\.1\.low: .*geom\[upper\]\.mass set -1: mass.* negative"),
        ("scale", -2, -1, r"parameters\.1\.low: .*negative"),
        ("add", -3, -2, r"parameters\.1\.low: .*negative"),
        ("add", -0.5, 1, ""),
    ],
)
def test_a_bound_with_which_the_model_does_not_compile_is_refused(
    folder: Path, apply: str, low: float, high: float, expected: str
) -> None:
    damping = {"address": "joint[*].damping", "each": True, "low": 0, "high": 1}
    mass = {"address": "geom[upper].mass", "apply": apply, "low": low, "high": high}
    study = minimal(folder, parameters=[damping, mass])
    if expected:
        with pytest.raises(StudyError, match=expected):
            study.parameter_set(load_model(study))
    else:
        assert len(study.parameter_set(load_model(study))) == 3


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "unit: deg,",
            "unit: degre,",
            r"columns\.qpos\.elbow: unknown unit 'degre' \(did you mean",
        ),
        ("aux.voltage: {", "ax.voltage: {", r"columns\.ax\.voltage: a channel is called .*'aux'"),
        ("{ctrl: {from", "{ctlr: {from", r"clocks\.ctlr: names no kind .*did you mean 'ctrl'"),
    ],
)
def test_a_wrong_rule_for_a_channel_is_told_with_its_line(
    folder: Path, old: str, new: str, expected: str
) -> None:
    assert old in FULL
    (folder / "arm.yaml").write_text(FULL.replace(old, new))
    with pytest.raises(StudyError, match=rf"arm\.yaml, line \d+: recordings\.{expected}"):
        load_train(load(folder))


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ({"file": "models/arm.xml", "hold": ["elbw"]}, r"hold: .*arm\.xml: no joint .*'elbow'"),
        ({"file": "models/arm.xml", "unrecorded": {"elbw": None}}, r"unrecorded: .*'elbow'"),
        ({"dm_control": {"domain": "cheeta", "task": "run"}}, r"dm_control: .*'cheetah'"),
        ({"dm_control": {"domain": "cheetah", "task": "rnu"}}, r"dm_control: .*'run'"),
    ],
)
def test_what_the_model_lacks_is_told_with_the_key_that_names_it(
    folder: Path, model: dict[str, object], expected: str
) -> None:
    with pytest.raises(StudyError, match=rf"model\.{expected}"):
        load_model(minimal(folder, model=model))


def test_two_parameters_of_one_number_are_told_with_their_entries(folder: Path) -> None:
    first = {"name": "all", "address": "joint[*].damping", "low": 0, "high": 1}
    second = {"address": "joint[elbow].damping", "low": 0, "high": 1}
    study = minimal(folder, parameters=[first, second])
    with pytest.raises(
        StudyError,
        match=r"parameters\.1\.address: joint\[elbow\]\.damping is parameters\.0, 'all', already",
    ):
        study.parameter_set(load_model(study))


ACTUATORS = (
    '<motor name="late" joint="shoulder" delay=".01" nsample="5"/>'
    '<general name="lag" joint="shoulder" dyntype="filter" dynprm=".1"/>'
    '<general name="own" joint="shoulder" dyntype="user" actdim="1" dynprm=".1"/>'
)


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (
            {"address": "joint[elbow].frictionloss", "low": -1},
            r"joint\[elbow\]\.frictionloss would be -1, and a friction loss is never negative; "
            "at least 0",
        ),
        ({"address": "joint[*].armature", "low": -1}, "an armature is never negative"),
        (
            {"address": "joint[shoulder].armature", "low": -0.3, "apply": "add"},
            "would be -0.1, and an armature is never negative; at least -0.2",
        ),
        (
            {"address": "joint[shoulder].armature", "low": -1, "apply": "scale"},
            "would be -0.2, and an armature is never negative; at least 0",
        ),
        ({"address": "geom[upper].friction[0]", "low": -1}, "a coefficient of friction is never"),
        ({"address": "option.viscosity", "low": -1}, "a viscosity is never negative"),
        ({"address": "actuator[late].delay", "low": -0.01}, "a delay is never negative"),
        ({"address": "actuator[lag].dynprm[0]", "low": -0.01}, "a time constant is never"),
        ({"address": "joint[shoulder].armature", "low": -0.2, "apply": "add"}, ""),
        ({"address": "actuator[own].dynprm[0]", "low": -0.01}, ""),
        ({"address": "joint[elbow].damping", "low": -1}, ""),
        ({"address": "joint[elbow].stiffness", "low": -1}, ""),
        ({"address": "joint[elbow].frictionloss", "low": 0}, ""),
    ],
)
def test_a_bound_below_zero_is_refused_where_it_means_nothing(
    folder: Path, entry: dict[str, object], expected: str
) -> None:
    text = ARM.replace('name="shoulder"', 'name="shoulder" armature=".2"')
    text = text.replace("</actuator>", f"{ACTUATORS}</actuator>")
    (folder / "models" / "arm.xml").write_text(text)
    study = minimal(folder, parameters=[{**entry, "high": 1}])
    if expected:
        with pytest.raises(StudyError, match=rf"parameters\.0\.low: .*{expected}"):
            study.parameter_set(load_model(study))
    else:
        assert study.parameter_set(load_model(study))


def test_a_wrong_bound_is_told_with_its_line(folder: Path) -> None:
    text = FULL.replace("apply: set, low: 0.4", "apply: set, low: -0.4")
    (folder / "arm.yaml").write_text(text)
    study = load(folder)
    with pytest.raises(StudyError, match=r"arm.yaml, line \d+: parameters\.0\.low: "):
        study.parameter_set(load_model(study))


@pytest.mark.parametrize("name", ["P", "row", "level", "deviation", "entropy", "mean"])
def test_a_parameter_has_no_name_of_a_column(folder: Path, name: str) -> None:
    entry = {"name": name, "address": "joint[elbow].damping", "low": 0, "high": 1}
    study = minimal(folder, parameters=[entry])
    with pytest.raises(StudyError, match=rf"parameters\.0\.name: '{name}' is a column .*P_boot"):
        study.parameter_set(load_model(study))


@pytest.mark.parametrize(
    ("section", "scales", "expected"),
    [
        ("noise", {"qpoz": 0.5}, r"recordings\.noise\.qpoz: .*did you mean 'qpos'"),
        ("noise", {"qpos.elbw": 0.5}, r"recordings\.noise\.qpos.elbw: .*did you mean 'qpos.elbow'"),
        ("whiten", {"qpoz": 1.0}, r"deviation\.whiten\.qpoz: .*did you mean 'qpos'"),
    ],
)
def test_scales_of_what_is_not_measured_are_refused(
    folder: Path, section: str, scales: dict[str, float], expected: str
) -> None:
    keys = {"noise": "recordings__noise", "whiten": "deviation__whiten"}
    for good in ({"qpos": 0.1}, {"qvel.elbow": 0.1}):
        study = load(folder, **{keys[section]: good})
        require_scales(study, load_model(study))
    study = load(folder, **{keys[section]: scales})
    with pytest.raises(StudyError, match=expected):
        overview(study)
    with pytest.raises(StudyError, match=expected):
        make_problem(study)


def test_limits_of_a_joint_that_is_not_there_are_refused(folder: Path) -> None:
    mass = {"address": "geom[forearm].mass", "low": 0.4, "high": 0.8}
    study = minimal(folder, limits={"elbw": {"velocity": 3}}, parameters=[mass])
    for look in (excite, lambda study: gather(study, ())):
        with pytest.raises(StudyError, match=r"limits\.elbw: .*did you mean 'elbow'"):
            look(study)
    study = load(folder, limits={"elbw": {"velocity": 3}})
    with pytest.raises(StudyError, match=r"arm\.yaml, --set limits: limits\.elbw: "):
        overview(study)
    study = load(folder, model__hold=["elbow"], limits={"elbow": {"velocity": 3}})
    with pytest.raises(StudyError, match=r"limits\.elbow: .*since it is held"):
        require_limits(study, load_model(study))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("actuators", {"elbow": {"law": "servo.py:duty"}}),
        ("diagnosis", {"effect_files": ["servo.py"]}),
        ("task", {"file": "servo.py", "class": "Reach"}),
    ],
)
def test_code_runs_only_where_it_is_trusted(folder: Path, key: str, value: object) -> None:
    with pytest.raises(StudyError, match=rf"{key}.*servo\.py.*--trust-code"):
        minimal(folder, **{key: value})


def test_code_is_loaded_by_name(folder: Path) -> None:
    study = load(folder)
    assert load_function(study, "servo.py:duty")(3) == 3
    with pytest.raises(
        StudyError, match=r"law: servo.py has no function or class 'dutty'; did you mean 'd"
    ):
        load_function(study, "servo.py:dutty")
    (folder / "servo.py").write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\n\n\n"
        "@dataclass\nclass Gain:\n    kp: float\n\n\ndef duty(x):\n    return Gain(2.0).kp * x\n"
    )
    assert load_function(study, "servo.py:duty")(3) == 6
    (folder / "servo.py").write_text("1 / 0\n")
    with pytest.raises(StudyError, match=r"law: servo.py fails: ZeroDivisionError: division"):
        load_function(study, "servo.py:duty")


def test_names_are_checked_against_registries(folder: Path) -> None:
    study = load(folder)
    study.check_names()
    study.check_names(acquisitions=["random", "argmin-entropy"])
    with pytest.raises(StudyError, match=r"arms\.0\.acquisition: unknown acquisition 'random'"):
        study.check_names(acquisitions=["argmin-entropy"])
    with pytest.raises(StudyError, match=r"unknown effect 'dry_friction'; did you mean 'friction'"):
        study.check_names(effects=["friction"])
    with pytest.raises(StudyError, match=r"stop: unknown stop rule 'zhu'"):
        study.check_names(stops=["seed"])


def test_the_suite_names_the_nearest_task(folder: Path) -> None:
    wrong = {"dm_control": {"domain": "cheetah", "task": "rum"}}
    study = minimal(folder, model=wrong, task=wrong)
    with pytest.raises(StudyError, match=r"model\.dm_control: .*no task 'rum'; did you mean 'run'"):
        load_model(study)
    with pytest.raises(StudyError, match=r"no 'cheetah rum' .*did you mean 'cheetah run'"):
        study_task(study, load_model(minimal(folder)))


def test_columns_and_clocks_have_the_keys_of_the_rules() -> None:
    assert set(Column.model_fields) == set(ColumnRule.__dataclass_fields__)
    assert set(Clock.model_fields) == set(ClockRule.__dataclass_fields__)
    defaults = {n: f.default for n, f in Column.model_fields.items()}
    assert defaults == {n: f.default for n, f in ColumnRule.__dataclass_fields__.items()}


class TestSchema:
    full = schema(
        acquisitions=["argmin-entropy", "random"],
        choices=["sample"],
        stops=["seed", "zhu"],
        effects=["dry_friction"],
        datasets=["emps"],
    )

    def test_is_a_schema(self) -> None:
        jsonschema.Draft202012Validator.check_schema(self.full)

    @pytest.mark.parametrize("path", STUDIES, ids=lambda p: p.stem)
    def test_takes_every_study_of_the_project(self, path: Path) -> None:
        jsonschema.validate(yaml.safe_load(path.read_text()), schema())

    def test_takes_the_full_study_and_what_it_resolves_to(self, folder: Path) -> None:
        jsonschema.validate(yaml.safe_load(FULL), self.full)
        jsonschema.validate(load(folder).resolved(), self.full)

    @pytest.mark.parametrize(
        ("key", "value"),
        [
            ("search", {"budgett": 3}),
            ("search", {"budget": 0}),
            ("search", {"acquisition": "argmin-entropi"}),
            ("search", {"candidates": "gird"}),
            ("parameters", [{"address": "joint[*].damping", "low": 0}]),
            ("learn", {"stop": "sed"}),
            ("recordings", {"dataset": "emsp"}),
            ("modle", "arm.xml"),
        ],
    )
    def test_rejects_a_typo(self, key: str, value: object) -> None:
        study = {"model": "arm.xml", "recordings": {"dataset": "emps"}}
        jsonschema.validate(study, self.full)
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**study, key: value}, self.full)

    def test_lets_effects_of_ones_own_pass(self) -> None:
        study = {"model": "arm.xml", "recordings": {"dataset": "emps"}}
        jsonschema.validate({**study, "diagnosis": {"exclude": ["sticky_grease"]}}, self.full)
        choices = self.full["$defs"]["Diagnosis"]["properties"]["exclude"]["items"]["anyOf"]
        assert choices[0] == {"enum": ["dry_friction"]}

    def test_describes_every_key(self) -> None:
        sections = [Section]
        for section in sections:
            sections += section.__subclasses__()
            for name, field in section.model_fields.items():
                assert field.description, f"{section.__name__}.{name}"


def test_a_log_that_is_a_folder_is_known_by_all_that_is_in_it(folder: Path) -> None:
    """Such as a bag: its content counts, and the names of its files."""
    study = minimal(folder)
    bag = folder / "bag"
    bag.mkdir()

    def told(name: str, content: str) -> str:
        for old in bag.iterdir():
            old.unlink()
        (bag / name).write_text(content)
        return inputs._content(bag)

    first = told("a.bin", "1")
    assert told("a.bin", "1") == first
    assert len({first, told("a.bin", "2"), told("b.bin", "1")}) == 3
    assert set(fingerprints(study, recorded=False)) == {"the model"}


def test_a_channel_that_ends_before_what_is_set_aside_is_told_before_the_search(
    tmp_path: Path,
) -> None:
    lines = ["time,qpos.shoulder,qpos.elbow,ctrl.elbow"]
    lines += [f"{k / 100},{k},{k if k < 60 else ''},0" for k in range(100)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    (tmp_path / "arm.xml").write_text(ARM)
    columns = {"qpos.elbow": {"missing": "skip"}}
    content = {"model": "arm.xml", "recordings": {"train": ["log.csv"], "columns": columns}}
    with pytest.raises(RecordingError, match=r"'qpos.elbow' ends at 0.59 s.*name one under"):
        load_train(Study.from_dict(content, tmp_path))


def test_the_motion_of_a_joint_that_is_held_is_not_used(tmp_path: Path) -> None:
    lines = ["time,qpos.shoulder,qpos.elbow", *(f"{k / 100},{k},{k}" for k in range(100))]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    (tmp_path / "arm.xml").write_text(ARM)
    model = {"file": "arm.xml", "hold": ["elbow"]}
    content = {"model": model, "recordings": {"train": ["log.csv"]}}
    (recording,) = load_train(Study.from_dict(content, tmp_path))
    assert set(recording.channels) == {"qpos.shoulder"}
    assert any("qpos.elbow is not used: its joint is held" in n for n in recording.notes)


def test_a_column_called_like_another_joint_is_read_as_the_study_says(tmp_path: Path) -> None:
    lines = ["time,qpos.shoulder,qpos.elbow_deg", *(f"{k / 100},{k},{k % 7}" for k in range(100))]
    lines[50] = lines[50].rpartition(",")[0] + ","
    (tmp_path / "log.csv").write_text("\n".join(lines))
    (tmp_path / "arm.xml").write_text(ARM)
    elbow = {"from": "qpos.elbow_deg", "unit": "deg", "missing": "skip"}
    tied = {"from": "qpos.shoulder"}  # the model has it: it is itself as well
    recordings = {"train": ["log.csv"], "holdout": ["log.csv"]}
    recordings["columns"] = {"qpos.elbow": elbow, "aux.shown": tied}
    study = Study.from_dict({"model": "arm.xml", "recordings": recordings}, tmp_path)
    (recording,) = load_train(study)
    require_known(load_model(study), recording)
    assert set(recording.channels) == {"qpos.shoulder", "qpos.elbow", "aux.shown"}
    assert recording.channels["qpos.elbow"].values.max() == pytest.approx(np.radians(6))


def test_a_joint_of_the_log_that_the_model_lacks_can_be_left_out_as_is_said(tmp_path: Path) -> None:
    lines = ["time,qpos.shoulder,qpos.elbow,qpos.hand", *(f"{k / 100},{k},1,{k}" for k in range(9))]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    (tmp_path / "arm.xml").write_text(ARM)

    def reading(columns: dict[str, object]) -> None:
        recordings = {"train": ["log.csv"], "holdout": ["log.csv"], "columns": columns}
        study = Study.from_dict({"model": "arm.xml", "recordings": recordings}, tmp_path)
        (recording,) = load_train(study)
        require_known(load_model(study), recording)

    with pytest.raises(RecordingError, match=r"'qpos\.hand' is not in the model") as caught:
        reading({})
    advice = str(caught.value).partition("recordings: columns: ")[2]
    assert advice == "{aux.hand: {from: qpos.hand}}"
    reading(yaml.safe_load(advice))
    with pytest.raises(RecordingError, match=r"'qpos\.elbw' is not .* or 'qpos.shoulder'\?$"):
        reading({"qpos.elbw": {"from": "qpos.elbow"}})


@pytest.mark.parametrize(("unit", "apply"), [("deg", "set"), ("rad", None), ("deg", "scale")])
def test_bounds_in_another_unit_than_the_models_are_refused(
    folder: Path, unit: str, apply: str | None
) -> None:
    entry = {"address": "joint[elbow].springref", "low": -1, "high": 1, "unit": unit}
    study = load(folder, parameters=[entry | {"apply": apply or "set"}])
    if (unit, apply) == ("deg", "set"):
        with pytest.raises(
            StudyError, match=r"parameters.0.unit: deg, and .*write low and high, .* with rad"
        ):
            study.parameter_set(load_model(study))
    else:
        study.parameter_set(load_model(study))


@pytest.mark.parametrize(
    ("unit", "si"),
    [
        ("lb", "kg"),
        ("Inch", "m"),
        ("psi", "Pa"),
        ("kg cm²", "m"),
        ("N mm/deg", "m"),
        ("V/rpm", "rad/s"),
    ],
)
def test_units_and_products_of_them_that_are_not_si_are_refused(
    folder: Path, unit: str, si: str
) -> None:
    entry = {"address": "geom[upper].mass", "low": 1, "high": 2, "unit": unit}
    study = load(folder, parameters=[entry])
    with pytest.raises(StudyError, match=f"bounds are in SI units: .* with {si}$"):
        study.parameter_set(load_model(study))


def test_units_of_effects_and_words_of_ones_own_are_no_other_units(folder: Path) -> None:
    own = {c.unit for e in CATALOGUE.values() for c in e.components}
    own |= {at_slide(unit) for unit in own}
    for unit in (*own, "", "1", "m/s²", "N m/V", "kg*m^2", "banana", "ticks"):
        entry = {"address": "geom[upper].mass", "low": 1, "high": 2, "unit": unit}
        study = load(folder, parameters=[entry])
        assert study.parameter_set(load_model(study))[0].unit == unit


def test_recordings_that_are_called_alike_have_the_names_of_their_folders(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="h"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        for name in ("log", day):
            (tmp_path / day / f"{name}.csv").write_text("time,qpos.h\n0,0\n1,1\n2,0\n")
    study = Study.from_dict({"model": "arm.xml", "recordings": {"train": ["*/*.csv"]}}, tmp_path)
    names = sorted(
        r.name for r in inputs.read_files(study, sorted(tmp_path.glob("*/*.csv")), False)
    )
    assert names == ["monday", "monday/log", "tuesday", "tuesday/log"]


@pytest.mark.parametrize("name", ["5e10", "2e3", "-1E5", ".5e-3", "1e", "e5", "1e5x", "12", "yes"])
def test_a_name_that_reads_as_a_number_is_written_as_the_text_that_it_is(
    folder: Path, name: str
) -> None:
    resolved = load(folder).resolved() | {"name": name}
    (folder / "again.yaml").write_text(dumped(resolved))
    assert Study.load(folder / "again.yaml", trust_code=True).name == name
    kept = {name: [1e-5, 1e5, 123456789.0, True, None, name]}
    assert Loader(dumped(kept, flow=True)).get_single_data() == kept
