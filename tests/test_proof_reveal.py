"""Sealing, freezing and revealing: whatever is tampered with is caught."""

import hashlib
import json
import os

import pytest

from bo_sysid.errors import RunError, StudyError
from bo_sysid.proof.answer import answer, freeze
from bo_sysid.proof.conceal import concealed_run, seals_of
from bo_sysid.proof.reveal import reveal
from bo_sysid.proof.seal import Seal, file_digest, write_json
from bo_sysid.runs import Run, canonical, digest

SHOWN = ("model.xml", "study.yaml", "train.parquet", "holdout.parquet")

NAMES = ("case-1", "case-2")
ANSWER = {"verdict": "nothing-missing", "findings": [], "alternatives": [], "holdout": {}}


def truth(name, files):
    return {"name": name, "tier": 2, "effects": [], "files": files}


@pytest.fixture
def folder(tmp_path):
    """A run with two answered cases, its seals beside it; nothing was opened."""
    folder = tmp_path / "run"
    seals = seals_of(folder)
    cases = {}
    with Run.open(folder, {"suite": {}}, "conceal"):
        for name in NAMES:
            for file in SHOWN:
                path = folder / "cases" / name / file
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(f"{file} of {name}")
            files = {f: file_digest(folder / "cases" / name / f) for f in SHOWN}
            seal = Seal.of(truth(name, files))
            write_json(seals / f"{name}.json", seal.plain())
            cases[name] = {"sha256": seal.commitment, "files": files}
        write_json(folder / "commitments.json", {"format": 1, "cases": cases})
    for name in NAMES:
        write_json(folder / "answers" / name / "diagnosis.json", ANSWER)
        (folder / "answers" / name / "model_repaired.xml").write_text("<mujoco/>")
        freeze(folder, name, 1.0, None)
    return folder


def revealed(folder, **options):
    with concealed_run(folder) as run:
        return reveal(run, **options)


def rewrite(path, **changes):
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, **changes}))


def test_a_seal_is_the_hash_of_nonce_and_canonical_json():
    seal = Seal.of({"b": 1, "a": [0.1, "é"]})
    assert canonical(seal.answer) == b'{"a":[0.1,"\\u00e9"],"b":1}'
    whole = bytes.fromhex(seal.nonce) + canonical(seal.answer)
    assert seal.commitment == hashlib.sha256(whole).hexdigest()
    assert len(bytes.fromhex(seal.nonce)) == 16
    assert Seal.of(seal.answer).commitment != seal.commitment
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})


def test_a_commitment_that_was_published_stays_what_it_was():
    seal = Seal("00ff" * 8, {"b": [1, 0.1, -2.5e-9], "a": {"é": None, "known": True}})
    text = b'{"a":{"known":true,"\\u00e9":null},"b":[1,0.1,-2.5e-09]}'
    assert seal.commitment == hashlib.sha256(b"\x00\xff" * 8 + text).hexdigest()
    assert digest(seal.answer) == hashlib.sha256(text).hexdigest()


def test_an_honest_run_is_revealed_and_can_be_revealed_again(folder):
    told = revealed(folder, published=file_digest(folder / "commitments.json"))
    assert [r.name for r in told] == list(NAMES)
    assert told[0].answer == ANSWER
    assert told[0].truth["tier"] == 2
    assert revealed(folder) == told


def test_seals_are_opened_in_instalments(folder):
    (folder / "answers" / "case-2.json").unlink()
    (told,) = revealed(folder, first=1)
    assert told.name == "case-1"
    freeze(folder, "case-2", 1.0, None)
    assert [r.name for r in revealed(folder)] == list(NAMES)
    openings = json.loads((folder / "opened.json").read_text())["openings"]
    assert [list(o["answers"]) for o in openings] == [["case-1"], ["case-2"]]
    assert revealed(folder)[0] == told


@pytest.mark.parametrize("at", ["run", "seals"])
def test_an_instalment_that_was_interrupted_goes_on(folder, at):
    revealed(folder, first=1)
    before = (folder / "opened.json").read_text()
    told = revealed(folder)
    place = folder if at == "run" else seals_of(folder)
    (place / "opened.json").write_text(before)
    assert revealed(folder) == told
    assert json.loads((place / "opened.json").read_text()) != json.loads(before)


def test_an_answer_whose_seal_was_opened_cannot_be_given_anew(folder):
    revealed(folder, first=1)
    (folder / "answers" / "case-1.json").unlink()
    with concealed_run(folder) as run, pytest.raises(RunError, match="seals of 1 cases without"):
        answer(run)
    freeze(folder, "case-1", 2.0, None)
    with pytest.raises(RunError, match=r"case-1.json: came after its seal was opened"):
        revealed(folder)


def test_fewer_cases_than_were_opened_are_no_result(folder):
    revealed(folder)
    with pytest.raises(RunError, match="says that 2 cases were opened, not 1"):
        revealed(folder, first=1)


def test_what_a_killed_process_left_in_an_answer_is_no_part_of_it(folder):
    left = folder / "answers" / "case-1" / ".tmp-1-diagnosis.json"
    left.write_text("half of it")
    (folder / "answers" / "case-1.json").unlink()
    freeze(folder, "case-1", 3.0, "no answer within 3 s")
    left.unlink()  # as the next call does that opens the run
    assert revealed(folder)[0].error == "no answer within 3 s"


def test_nothing_counts_as_opened_where_the_seals_are_not(folder, tmp_path):
    with pytest.raises(RunError, match=r"elsewhere/case-1.json: the seal is missing"):
        revealed(folder, seals=tmp_path / "elsewhere")
    assert not (folder / "opened.json").exists()
    assert not (tmp_path / "elsewhere").exists()
    assert len(revealed(folder, first=1)) == 1


@pytest.mark.parametrize("limit", [0.0, -1.0, float("inf"), float("nan"), 1e13, 1e-9])
def test_a_limit_that_no_clock_keeps_is_refused_before_anything_is_answered(folder, limit):
    (folder / "answers" / "case-1.json").unlink()
    with concealed_run(folder) as run, pytest.raises(StudyError, match="time for a case must be"):
        answer(run, limit=limit)
    assert not (folder / "answers" / "case-1.json").exists()


@pytest.mark.parametrize("first", [0, 3])
def test_there_must_be_so_many_cases(folder, first):
    with pytest.raises(StudyError, match=f"--first {first}: .* has 2 cases"):
        revealed(folder, first=first)


def _append(path):
    path.write_bytes(path.read_bytes() + b" ")


TAMPERING = {
    "a recording changed": (
        lambda f, s: _append(f / "cases" / "case-1" / "train.parquet"),
        r"case-1/train.parquet: was changed since",
    ),
    "a model changed": (
        lambda f, s: _append(f / "cases" / "case-2" / "model.xml"),
        r"case-2/model.xml: was changed since",
    ),
    "a study changed": (
        lambda f, s: _append(f / "cases" / "case-2" / "study.yaml"),
        r"study.yaml: was changed since",
    ),
    "a file added to a case": (
        lambda f, s: (f / "cases" / "case-2" / "hint.txt").write_text("friction"),
        r"hint.txt: this file was not published",
    ),
    "a file removed from a case": (
        lambda f, s: (f / "cases" / "case-2" / "holdout.parquet").unlink(),
        r"holdout.parquet: this file is missing",
    ),
    "a case added": (
        lambda f, s: (f / "cases" / "case-3").mkdir(),
        r"case-3: this case was not published",
    ),
    "an answer changed": (
        lambda f, s: rewrite(f / "answers" / "case-1" / "diagnosis.json", verdict="sensing"),
        r"diagnosis.json: was changed after the answer was frozen",
    ),
    "a repaired model changed": (
        lambda f, s: _append(f / "answers" / "case-1" / "model_repaired.xml"),
        r"model_repaired.xml: was changed after the answer was frozen",
    ),
    "an answer's file removed": (
        lambda f, s: (f / "answers" / "case-1" / "model_repaired.xml").unlink(),
        r"model_repaired.xml: not as it was when the answer was frozen",
    ),
    "a file added to an answer": (
        lambda f, s: (f / "answers" / "case-1" / "second.json").write_text("{}"),
        r"second.json: not as it was when the answer was frozen",
    ),
    "a record removed": (
        lambda f, s: (f / "answers" / "case-2.json").unlink(),
        r"case case-2 has no answer",
    ),
    "a record of another case": (
        lambda f, s: rewrite(f / "answers" / "case-2.json", case="case-1"),
        r"case-2.json: is damaged",
    ),
    "a record from the future": (
        lambda f, s: rewrite(f / "answers" / "case-2.json", frozen="2999-01-01T00:00:00+00:00"),
        r"frozen at a time that is yet to come",
    ),
    "the truth changed": (
        lambda f, s: rewrite(s / "case-1.json", answer=truth("case-1", {})),
        r"sealed/case-1.json: is not what was committed to",
    ),
    "the nonce changed": (
        lambda f, s: rewrite(s / "case-1.json", nonce="0" * 32),
        r"case-1.json: is not what was committed to",
    ),
    "the nonce shortened": (
        lambda f, s: rewrite(s / "case-1.json", nonce="00"),
        r"the nonce must have 128 bits",
    ),
    "a seal removed": (lambda f, s: (s / "case-1.json").unlink(), r"the seal is missing"),
    "seals exchanged": (
        lambda f, s: [
            os.replace(s / a, s / b)
            for a, b in (
                ("case-1.json", "other"), ("case-2.json", "case-1.json"), ("other", "case-2.json"),
            )
        ],
        r"case-1.json: is not what was committed to",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", TAMPERING)
def test_tampering_is_caught(folder, what):
    tamper, message = TAMPERING[what]
    tamper(folder, seals_of(folder))
    with pytest.raises(RunError, match=message):
        revealed(folder)


@pytest.mark.parametrize("what", TAMPERING)
def test_tampering_after_the_opening_is_caught_as_well(folder, what):
    revealed(folder)
    tamper, _ = TAMPERING[what]
    tamper(folder, seals_of(folder))
    with pytest.raises(RunError):
        revealed(folder)


def commit_anew(folder, **changes):
    """Replace truth, seal and commitment together, as whoever holds all of them could."""
    name, seals = "case-1", seals_of(folder)
    said = json.loads((folder / "commitments.json").read_text())
    seal = Seal.of({**truth(name, said["cases"][name]["files"]), **changes})
    write_json(seals / f"{name}.json", seal.plain())
    said["cases"][name]["sha256"] = seal.commitment
    write_json(folder / "commitments.json", said)


def test_new_commitments_do_not_fit_the_answers(folder):
    commit_anew(folder, tier=3)
    with pytest.raises(RunError, match="answers other commitments"):
        revealed(folder)


def test_new_commitments_and_records_do_not_fit_what_was_published(folder):
    published = file_digest(folder / "commitments.json")
    commit_anew(folder, tier=3)
    for name in NAMES:
        freeze(folder, name, 1.0, None)
    with pytest.raises(RunError, match="not the commitments that were published"):
        revealed(folder, published=published)


def test_a_seal_must_be_about_its_case_and_its_files(folder):
    commit_anew(folder, name="case-2")
    for name in NAMES:
        freeze(folder, name, 1.0, None)
    with pytest.raises(RunError, match="is the seal of another case"):
        revealed(folder)
    commit_anew(folder, files={})
    for path in (folder, seals_of(folder)):
        (path / "opened.json").unlink()
    for name in NAMES:
        freeze(folder, name, 1.0, None)
    with pytest.raises(RunError, match="is not the case that was sealed"):
        revealed(folder)


def test_an_answer_after_the_opening_is_refused(folder):
    revealed(folder)
    rewrite(folder / "answers" / "case-1" / "diagnosis.json", verdict="missing-physics")
    freeze(folder, "case-1", 1.0, None)
    with pytest.raises(RunError, match=r"case-1.json: came after its seal was opened"):
        revealed(folder)


def test_that_seals_were_opened_cannot_be_hidden(folder):
    told = revealed(folder)
    for place in (folder, seals_of(folder)):
        (place / "opened.json").unlink()
        assert revealed(folder) == told  # as after an interruption between the two
        (place / "opened.json").unlink()
        before = (folder / "answers" / "case-2.json").read_bytes()
        freeze(folder, "case-2", 9.0, None)
        with pytest.raises(RunError, match="came after its seal was opened"):
            revealed(folder)
        (folder / "answers" / "case-2.json").write_bytes(before)


def test_the_two_records_of_the_opening_must_agree(folder):
    revealed(folder)
    rewrite(folder / "opened.json", openings=[{"opened": "2026-01-01", "answers": {}}])
    with pytest.raises(RunError, match="differs from its copy beside the seals"):
        revealed(folder)


def test_a_failed_diagnosis_is_an_answer(folder):
    (folder / "answers" / "case-1" / "diagnosis.json").unlink()
    freeze(folder, "case-1", 2.5, "ModelError: no")
    told = revealed(folder)[0]
    assert told.answer is None
    assert told.error == "ModelError: no"


def test_a_record_without_an_answer_is_caught(folder):
    (folder / "answers" / "case-1" / "diagnosis.json").unlink()
    freeze(folder, "case-1", 2.5, None)
    with pytest.raises(RunError, match="says that there is an answer; there is none"):
        revealed(folder)


def test_answering_again_leaves_frozen_answers_alone(folder):
    before = (folder / "answers" / "case-1.json").read_bytes()
    with concealed_run(folder) as run:
        answer(run)
    assert (folder / "answers" / "case-1.json").read_bytes() == before


def test_only_a_run_of_conceal_is_revealed(tmp_path):
    with Run.open(tmp_path / "other", {}, "identify"):
        pass
    with pytest.raises(RunError, match="not a finished run of conceal"):
        concealed_run(tmp_path / "other")
    with pytest.raises(RunError, match="not a run folder"):
        concealed_run(tmp_path)
