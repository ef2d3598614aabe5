"""The whole proof on three small cases, by its commands, through an interruption."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml

from bo_sysid.cli import main
from bo_sysid.errors import StudyError
from bo_sysid.proof.conceal import conceal, seals_of, suite_record
from bo_sysid.proof.develop import develop
from bo_sysid.report.page import page
from bo_sysid.report.text import run_text
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_train

SUITES = Path(__file__).parent.parent / "studies" / "concealed"
QUICK = SUITES / "quick.yaml"
SHORT = {"seconds": {"train": 4, "holdout": 1}, "machines": ["machines/cart_pole.yaml"]}


@pytest.fixture(scope="module")
def concealed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("proof") / "run"
    changes = [f"--set={k}={json.dumps(v)}" for k, v in SHORT.items()]
    assert main(["conceal", str(QUICK), "--out", str(folder), *changes]) == 0
    return folder


def test_what_is_shown_is_what_a_person_would_have_and_no_more(concealed):
    cases = sorted((concealed / "cases").iterdir())
    assert [c.name for c in cases] == ["case-1", "case-2", "case-3"]
    keys = set()
    for case in cases:
        shown = sorted(p.name for p in case.iterdir())
        assert shown == ["holdout.parquet", "model.xml", "study.yaml", "train.parquet"]
        study = yaml.safe_load((case / "study.yaml").read_text())
        assert study.pop("name") == case.name
        keys.add(tuple(study))
        table = pq.read_table(case / "train.parquet")
        assert set(table.column_names) == {"time", "qpos.slider", "qpos.hinge", "ctrl.belt"}
        about = json.loads(table.schema.metadata[b"bo_sysid"])
        assert about == {"format": 1, "name": "train", "notes": []}
        (recording,) = load_train(Study.load(case / "study.yaml"))
        assert np.ptp(recording.channels["qpos.slider"].values) > 0.05
    assert len(keys) == 1
    assert len({c.joinpath("model.xml").read_bytes() for c in cases}) == 1
    stamps = {p.stat().st_mtime for p in (concealed / "cases").rglob("*")}
    assert len(stamps) == 1


def test_the_run_holds_nothing_of_the_answers(concealed):
    seals = seals_of(concealed)
    truths = [json.loads((seals / f"case-{k}.json").read_text())["answer"] for k in (1, 2, 3)]
    secrets = [str(t["seed"]) for t in truths]
    secrets += [repr(e["value"]) for t in truths for e in t["effects"]]
    assert len(secrets) > 3
    for path in concealed.rglob("*"):
        if path.is_file() and path.suffix != ".parquet":
            text = path.read_text()
            assert not [s for s in secrets if s in text], path
    said = json.loads((concealed / "commitments.json").read_text())["cases"]
    assert {tuple(sorted(c)) for c in said.values()} == {("files", "sha256")}


def test_an_interrupted_concealment_goes_on_with_the_same_cases(concealed, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(concealed, folder)
    shutil.copytree(seals_of(concealed), seals_of(folder))
    before = json.loads((folder / "commitments.json").read_text())
    (folder / "commitments.json").unlink()
    shutil.rmtree(folder / "cases")
    (seals_of(folder) / "commitment-case-2.json").unlink()
    (seals_of(folder) / "case-2" / ".tmp-1-train.parquet").write_text("half of it")
    with Run.open(folder, suite_record(QUICK, SHORT), "conceal") as run:
        after = conceal(run, QUICK, overrides=SHORT)
    for name in ("case-1", "case-3"):
        assert after["cases"][name] == before["cases"][name]
    assert after["cases"]["case-2"]["files"] == before["cases"]["case-2"]["files"]
    assert after["cases"]["case-2"]["sha256"] != before["cases"]["case-2"]["sha256"]


def test_a_concealment_that_other_code_began_is_not_gone_on_with(concealed, tmp_path):
    """What is published says which version drew the cases: one, not two."""
    folder = tmp_path / "run"
    shutil.copytree(concealed, folder)
    shutil.copytree(seals_of(concealed), seals_of(folder))
    (folder / "commitments.json").unlink()
    plan = seals_of(folder) / "plan.json"
    content = json.loads(plan.read_text())
    plan.write_text(json.dumps({**content, "versions": {"bo-sysid": "another"}}))
    with (
        Run.open(folder, suite_record(QUICK, SHORT), "conceal") as run,
        pytest.raises(StudyError, match="was begun by other versions"),
    ):
        conceal(run, QUICK, overrides=SHORT)


@pytest.mark.slow
def test_three_cases_are_answered_revealed_and_scored(concealed, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(concealed, folder)
    shutil.copytree(seals_of(concealed), seals_of(folder))
    assert "Concealed; no seal is open yet." in page(folder)
    assert "Concealed cases: 3, with an answer: 0. Go on with: bo-sysid reveal" in run_text(folder)
    assert main(["reveal", str(folder), "--answers-only", "--published", "0" * 64]) == 2
    assert not list(folder.glob("answers/*.json"))
    assert main(["reveal", str(folder), "--answers-only"]) == 0
    assert not (folder / "opened.json").exists()
    stale = {"versions": {"bo-sysid": "another"}, "errors": {"case-1": 123.0}}
    (folder / "oracle.json").write_text(json.dumps(stale))
    assert main(["reveal", str(folder)]) == 0
    assert "false alarms" in capsys.readouterr().out
    cases = pd.read_parquet(folder / "cases.parquet")
    assert len(cases) == 3
    assert cases.answered.all()
    assert cases.missing.sum() == 2
    assert (cases.oracle < 1.15 * cases.noise_floor).any()
    assert not (cases.oracle == 123).any()
    assert "answered by" in (folder / "proof.html").read_text()
    assert "<svg" in (folder / "proof.html").read_text()
    assert "with an answer: 3. All scores are in" in run_text(folder)
    shown = page(folder)
    assert "No result yet" not in shown
    assert "Seals were opened, and their answers scored." in shown
    assert '<a href="proof.html">' in shown
    assert str(folder / "proof.html") not in shown  # the page is mailed
    victim = folder / "cases" / "case-1" / "train.parquet"
    victim.write_bytes(victim.read_bytes() + b"x")
    assert main(["reveal", str(folder)]) == 2
    assert "was changed since" in capsys.readouterr().err


@pytest.mark.slow
def test_a_diagnosis_that_hangs_is_ended_and_the_run_goes_on(concealed, tmp_path, capsys):
    """Every diagnosis takes longer than a twentieth of a second."""
    folder = tmp_path / "run"
    shutil.copytree(concealed, folder)
    shutil.copytree(seals_of(concealed), seals_of(folder))
    assert main(["reveal", str(folder), "--limit", "0.05"]) == 0
    assert "3 of 3     diagnoses that failed" in capsys.readouterr().out
    for name in ("case-1", "case-2", "case-3"):
        record = json.loads((folder / "answers" / f"{name}.json").read_text())
        assert record["error"] == "no answer within 0.05 s"
        where = (folder / "answers" / name / "hung.txt").read_text()  # a dump from outside
        assert where.startswith("Timeout")
        assert "File" in where
    cases = pd.read_parquet(folder / "cases.parquet")
    assert not cases.answered.any()
    assert not cases["right"].any()


def test_development_cases_come_with_answers_and_the_proof_does_not(tmp_path):
    changes = {**SHORT, "cases": 3, "seed": 9}
    with pytest.raises(StudyError, match="has no seed; only development suites"):
        next(develop(QUICK, tmp_path / "cases"))
    (study, truth), *rest = develop(QUICK, tmp_path / "cases", cases=[0], overrides=changes)
    assert not rest
    assert study.name == truth["name"] == "case-1"
    again = next(develop(QUICK, tmp_path / "cases", cases=[0], overrides=changes))
    assert again[1] == truth


def test_what_is_no_suite_is_refused(tmp_path, capsys):
    (tmp_path / "suite.yaml").write_text("version: 1\ncases: 4\nmachines: [x.yaml]\nnothing: 0\n")
    assert main(["conceal", str(tmp_path / "suite.yaml"), "--out", str(tmp_path / "run")]) == 2
    assert "nothing" in capsys.readouterr().err
    assert main(["reveal", str(tmp_path)]) == 2
    assert "not a run folder" in capsys.readouterr().err


def test_all_suites_of_the_package_load():
    from bo_sysid.proof.suite import load_suite

    sizes = {p.stem: load_suite(p).suite.cases for p in SUITES.glob("*.yaml")}
    assert sizes["proof"] >= 350
    assert sizes["quick"] == 3
    proof = load_suite(SUITES / "proof.yaml")
    assert proof.suite.seed is None
    assert len(proof.machines) >= 5
    assert any(m.file.contact for m in proof.machines.values())
