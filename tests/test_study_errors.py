"""What is wrong with a study is said in one message, with line, key, rule and nearest choice."""

import time
from pathlib import Path

import pytest

from bo_sysid.errors import StudyError
from bo_sysid.study import Study, parse_override

BASE = """\
model: arm.xml
recordings:
  train: [log.csv]
"""


def message(folder: Path, text: str, **overrides: object) -> str:
    """Return what is said about a study, which must be wrong."""
    (folder / "arm.xml").write_text("<mujoco/>")
    (folder / "arm.yaml").write_text(text)
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    with pytest.raises(StudyError) as error:
        Study.load(folder / "arm.yaml", changes)
    return str(error.value).replace(f"{folder}/", "")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("serach: {budget: 3}", "arm.yaml, line 4: serach: unknown key; did you mean 'search'?"),
        (
            "unrecorded: {caster: null}",
            "arm.yaml, line 4: unrecorded: unknown key; did you mean 'recordings'? "
            "('unrecorded' is a key of model)",
        ),
        (
            "search: {stop: {budget: 3}}",
            "arm.yaml, line 4: search.stop.budget: unknown key; valid: 'entropy', 'last' "
            "('budget' is a key of search)",
        ),
        (
            "  columns: {qpos: {elbow: theta}}",
            "arm.yaml, line 4: recordings.columns.qpos.elbow: unknown key; a channel is one key: "
            "qpos.elbow",
        ),
        (
            "search:\n  seed: 3\n  budgett: 3",
            "arm.yaml, line 6: search.budgett: unknown key; did you mean 'budget'?",
        ),
        (
            "search: {stop: {entropi: 3}}",
            "arm.yaml, line 4: search.stop.entropi: unknown key; did you mean 'entropy'?",
        ),
        (
            "search: {candidates: {sobl: 3}}",
            "arm.yaml, line 4: search.candidates.sobl: unknown key; did you mean 'sobol'?",
        ),
        (
            "search: {candidates: gird}",
            "arm.yaml, line 4: search.candidates: must be grid or {sobol: <number>}, not 'gird'",
        ),
        (
            "search: {budget: many}",
            "arm.yaml, line 4: search.budget: must be a valid integer, not 'many'",
        ),
        ("search: {budget: yes}", "arm.yaml, line 4: search.budget: must be a number, not true"),
        (
            "search: {budget: 0}",
            "arm.yaml, line 4: search.budget: must be greater than or equal to 1, not 0",
        ),
        (
            "diagnosis: {known: [actuator_gain]}",
            "line 4: diagnosis.known.0: must be the address of a number of the model, such as "
            "\"body[base].mass\", not 'actuator_gain'; effects are left out with exclude",
        ),
        (
            "policy: {batch: 1}",
            "arm.yaml, line 4: policy.batch: must be greater than or equal to 2, not 1",
        ),
        ("search: 3", "arm.yaml, line 4: search: must be a mapping (key: value), not 3"),
        ("version: 2", "arm.yaml, line 4: version: must be 1, not 2"),
        (
            "name: 12",
            "arm.yaml, line 4: name: must be text (numbers, dates and yes/no need quotes), not 12",
        ),
        (
            "name: 2020-01-01",
            "line 4: name: must be text (numbers, dates and yes/no need quotes), not 2020-01-01",
        ),
        (
            "parameters:\n- {address: a, low: 0, high: 1}\n- {address: b, low: 2, high: 1}",
            "arm.yaml, line 6: parameters.1: low 2 must be below high 1",
        ),
        (
            "parameters:\n- address: a\n  low: 0\n  high: 1\n  apply: sett",
            "arm.yaml, line 8: parameters.0.apply: must be 'set', 'scale' or 'add', not 'sett'",
        ),
        (
            "parameters:\n- address: a\n  low: 0",
            "arm.yaml, line 5: parameters.0.high: this key is required",
        ),
        (
            "parameters: [{address: a, low: 0, high: .nan}]",
            "arm.yaml, line 4: parameters.0.high: must be a finite number, not nan",
        ),
        ("parameters: [{address: [], low: 0, high: 1}]", "parameters.0.address: must not be empty"),
        (
            "parameters: [{address: a, low: 0, high: 1, steps: 1}]",
            "arm.yaml, line 4: parameters.0: steps is 1; at least 2",
        ),
        (
            "limits: {elbow: {position: [2, -2]}}",
            "arm.yaml, line 4: limits.elbow.position: low 2 must be below high -2",
        ),
        (
            "limits: {elbow: {velocty: 3}}",
            "arm.yaml, line 4: limits.elbow.velocty: unknown key; did you mean 'velocity'?",
        ),
        (
            "deviation: {whiten: no thanks}",
            "arm.yaml, line 4: deviation.whiten: must be 'auto' or a mapping (key: value)",
        ),
        (
            "deviation: {whiten: {qpos: -1}}",
            "arm.yaml, line 4: deviation.whiten.qpos: must be greater than 0, not -1",
        ),
        (
            "compare: {arms: [{aquisition: random}]}",
            "compare.arms.0.aquisition: unknown key; did you mean 'acquisition'?",
        ),
        ("task: {file: reach.py}", "arm.yaml, line 4: task: file and class go together"),
        (
            "execution: {address: auto}",
            "arm.yaml, line 4: execution: address needs engine: ray",
        ),
        (
            "actuators: {elbow: {law: servo}}",
            "actuators.elbow.law: must be <file>.py:<name>, as in servo.py:duty, not 'servo'",
        ),
        ("search: {seed: 1}\nsearch: {seed: 2}", "arm.yaml, line 5: key 'search' is written twice"),
        ("search: {budget: 017}", "arm.yaml, line 4: YAML reads 017 as 15; write"),
        ("search: {budget: 1:30}", "arm.yaml, line 4: YAML reads 1:30 as 90; write the number"),
        ("search: {seed: 1, seed: 2}", "arm.yaml, line 4: key 'seed' is written twice, first in"),
        ("search: [1, 2", "arm.yaml, line 4: not YAML: "),
        ("search: &a [*a]", "arm.yaml, line 4: an alias contains itself"),
        ("search: !!python/name:os.system", "arm.yaml, line 4: not YAML: could not determine"),
    ],
)
def test_says_line_key_rule_and_choice(tmp_path: Path, text: str, expected: str) -> None:
    assert expected in message(tmp_path, BASE + text)


def test_says_all_problems_at_once(tmp_path: Path) -> None:
    text = BASE + "search:\n  budget: many\n  sed: 3\nlimits: 7\n"
    assert message(tmp_path, text).splitlines() == [
        "arm.yaml: 3 problems",
        "  line 5: search.budget: must be a valid integer, not 'many'",
        "  line 6: search.sed: unknown key; did you mean 'seed'?",
        "  line 7: limits: must be a mapping (key: value), not 7",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "a study is a mapping with the keys model and recordings, not empty"),
        ("- 1\n", "a study is a mapping with the keys model and recordings, not list"),
        ("model: arm.xml\n", "arm.yaml, line 1: recordings: this key is required"),
        (
            "model: amr.xml\nrecordings: {dataset: emps}\n",
            "arm.yaml, line 1: model: no file 'amr.xml'",
        ),
        (
            "model: {file: arm.xml, menagerie: ur5e}\nrecordings: {dataset: emps}\n",
            "line 1: model: needs exactly one of file, dm_control, menagerie; found file and mena",
        ),
        (
            "model: arm.xml\nrecordings: {}\n",
            "arm.yaml, line 2: recordings: needs exactly one of train, dataset; found none",
        ),
        (
            "model: arm.xml\nrecordings: {dataset: emps, columns: {qpos.elbow: theta}}\n",
            "arm.yaml, line 2: recordings: dataset brings its own columns; leave columns out",
        ),
        (
            "model: {dm_control: {domian: cheetah, task: run}}\nrecordings: {dataset: emps}\n",
            "model.dm_control.domian: unknown key; did you mean 'domain'?",
        ),
    ],
)
def test_says_what_a_study_needs(tmp_path: Path, text: str, expected: str) -> None:
    assert expected in message(tmp_path, text)


def test_a_missing_study_names_its_neighbours(tmp_path: Path) -> None:
    (tmp_path / "pendulum.yaml").write_text("")
    with pytest.raises(StudyError, match=r"no such file; did you mean 'pendulum.yaml'"):
        Study.load(tmp_path / "pendulm.yaml")
    with pytest.raises(StudyError, match="is a folder, not a study file"):
        Study.load(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\x89HDF\x00\xff")
    with pytest.raises(StudyError, match="not a text file"):
        Study.load(tmp_path / "binary.yaml")


class TestOverrides:
    @pytest.fixture
    def study(self, tmp_path: Path) -> Path:
        (tmp_path / "arm.xml").write_text("<mujoco/>")
        path = tmp_path / "arm.yaml"
        path.write_text(
            BASE + "  noise: {qpos.elbow: 0.1}\n"
            "parameters:\n- {address: a, low: 0, high: 1}\n- {address: b, low: 0, high: 1}\n"
        )
        return path

    def test_replace_and_add(self, study: Path) -> None:
        changes = {
            "search.budget": 20,
            "parameters.1.low": 0.5,
            "recordings.noise.qpos.elbow": 0.2,
            "search.candidates": {"sobol": 64},
        }
        result = Study.load(study, changes)
        assert result.search.budget == 20
        assert [p.low for p in result.parameters] == [0, 0.5]
        assert result.recordings.noise == {"qpos.elbow": 0.2}
        assert result.search.candidates.sobol == 64
        assert Study.load(study).search.budget == 60

    def test_a_text_that_stands_for_a_mapping_is_kept(self, study: Path) -> None:
        columns = "  columns: {qpos.elbow: theta2}\n  clocks: {qpos: t}\n"
        arms = "compare: {arms: [random, sobol]}\n"
        study.write_text(BASE + columns + arms)
        changes = {
            "model.base": "fixed",
            "recordings.columns.qpos.elbow.sign": -1,
            "recordings.clocks.qpos.shift": 0.1,
            "compare.arms.1.seeds": 3,
        }
        result = Study.load(study, changes)
        assert (result.model.file, result.model.base) == ("arm.xml", "fixed")
        column, clock = result.recordings.columns["qpos.elbow"], result.recordings.clocks["qpos"]
        assert (column.source, column.sign) == ("theta2", -1)
        assert (clock.source, clock.shift) == ("t", 0.1)
        assert [(a.acquisition, a.seeds) for a in result.compare.arms] == [
            ("random", None),
            ("sobol", 3),
        ]

    def test_errors_name_the_option(self, study: Path) -> None:
        with pytest.raises(
            StudyError, match=r"arm.yaml, --set search.budgett: search.budgett: unk"
        ):
            Study.load(study, {"search.budgett": 20})
        with pytest.raises(
            StudyError, match=r"line 7 with --set parameters.1.low: parameters.1: l"
        ):
            Study.load(study, {"parameters.1.low": 3})
        with pytest.raises(StudyError, match=r"parameters.2.low: there is no entry 2; there are 2"):
            Study.load(study, {"parameters.2.low": 3})

    @pytest.mark.parametrize(
        ("text", "key", "value"),
        [
            ("search.budget=20", "search.budget", 20),
            ("search.candidates={sobol: 64}", "search.candidates", {"sobol": 64}),
            ("policy.steps=1e5", "policy.steps", 1e5),
            ("parameters.0.low=-.5E-3", "parameters.0.low", -5e-4),
            ("name=1e", "name", "1e"),
            ("name=a=b", "name", "a=b"),
            ("diagnosis.exclude=[]", "diagnosis.exclude", []),
        ],
    )
    def test_are_parsed_as_yaml(self, text: str, key: str, value: object) -> None:
        assert parse_override(text) == (key, value)

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("budget", "must be key=value"),
            ("a=[1", "the value is not YAML"),
            ("a=2024-13-45", "the value is not YAML"),
            ("a=017", "--set a=017, line 1: YAML reads 017 as 15"),
            ("a=" + 3000 * "[", "the value is not YAML"),
        ],
    )
    def test_that_are_none_are_refused(self, text: str, expected: str) -> None:
        with pytest.raises(StudyError, match=expected):
            parse_override(text)


def test_a_digit_of_another_script_is_no_number(tmp_path: Path) -> None:
    text = BASE + "parameters: [{address: 'body[a].mass', low: 1, high: 2}]\n"
    assert "parameters" in message(tmp_path, text, **{"parameters.².low": 1})


def test_a_study_that_is_nested_without_end_is_refused(tmp_path: Path) -> None:
    assert "nested too deeply" in message(tmp_path, "model: " + 5000 * "[")


def test_many_aliases_are_read_at_once(tmp_path: Path) -> None:
    levels = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 8)]
    began = time.perf_counter()
    found = message(tmp_path, BASE + "a0: &a0 [1]\n" + "\n".join(levels) + "\n")
    assert "a7: unknown key" in found
    assert time.perf_counter() - began < 20  # 9^7 aliases would take minutes
