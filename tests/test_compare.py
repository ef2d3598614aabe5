"""Comparisons: what a run of an arm records, that a killed one goes on, and what is refused."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from comparing import record_of, small
from learning import pendulum
from test_learn_diagnosis import knowing, lacking

import bo_sysid.diagnosis
from bo_sysid.belief.stopping import StopRule
from bo_sysid.cli import main
from bo_sysid.compare.arms import Arm, ComparedProblem, arms_of, problems_of, slug
from bo_sysid.compare.compare import Comparison, compare, so_far
from bo_sysid.compare.inner import SearchJob, run_search
from bo_sysid.compare.outer import LearnJob, run_learn
from bo_sysid.compare.table import Table, TableJob, recorded, tabulate
from bo_sysid.compare.tables import Key, inner_paths
from bo_sysid.deviation import Deviation, Evaluation
from bo_sysid.errors import RecordingError, RunError, StudyError
from bo_sysid.identify.search import History, Rules, initial_rows, search
from bo_sysid.parameters import CandidateSet
from bo_sysid.policy.trainer import Trainer, TrainingIteration
from bo_sysid.runs import Run
from bo_sysid.study import Study


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Comparison]:
    folder = tmp_path_factory.mktemp("compare")
    study = Study.from_dict(small(), folder)
    place = folder / "run"
    with Run.open(place, study.resolved(relative_to=place), "compare") as run:
        return place, compare(study, run)


def seeded(folder: Path, seed: int) -> tuple[Study, Table]:
    posed = ComparedProblem("small", Study.from_dict(small(), folder))
    data = posed.seeded(seed)
    return Study.from_dict(data, folder), tabulate(TableJob(data, str(folder), seed))


def test_a_record_is_the_search_itself(compared: tuple[Path, Comparison], tmp_path: Path) -> None:
    records = record_of(compared[0])
    for seed in (0, 1):
        study, table = seeded(tmp_path, seed)
        problem, _ = recorded(study, seed)
        for arm in ("argmin-entropy", "greedy"):
            outcome = search(
                problem.candidates,
                lambda row, p=problem: p.deviation(p.candidates.points[[row]]),
                Rules(arm, StopRule(10, entropy=None), seed),
                History.empty(len(table.weight)),
            )
            record = records[f"records/small/{arm}/{seed:03d}.json"]
            assert record["row"] == outcome.history.rows.tolist()
            assert record["deviation"] == pytest.approx(outcome.history.evaluation.deviation)
            assert record["max_p"][-1] == outcome.belief.probabilities.max()
            assert record["entropy"][-1] == outcome.belief.entropy
            least = table.evaluation.deviation.min()
            best = table.evaluation.deviation[outcome.belief.best]
            assert record["right"][-1] == (best == least)
            assert record["lowest"] == least


def test_a_finished_comparison_goes_on_with_more_seeds(
    compared: tuple[Path, Comparison], tmp_path: Path
) -> None:
    one = small(compare={"arms": ["argmin-entropy", "greedy", "random"], "seeds": 1})
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(one))
    command = ["compare", str(tmp_path / "study.yaml"), "--out", str(tmp_path / "run")]
    assert main(command) == 0
    assert main([*command, "--set", "compare.seeds=2"]) == 0
    assert record_of(tmp_path / "run") == record_of(compared[0])
    assert json.loads((tmp_path / "run" / "comparison.json").read_text())["runs"] == 6
    assert main(command) == 2


def test_the_table_is_delta_and_counts_its_steps(tmp_path: Path) -> None:
    study, table = seeded(tmp_path, 3)
    problem, counter = recorded(study, 3)
    counter.steps = 0
    points = problem.candidates.points
    np.testing.assert_allclose(
        table.evaluation.deviation[[0, 20, 48]], problem.deviation(points[[0, 20, 48]]).deviation
    )
    windows = problem.deviation.windows
    assert counter.steps == 3 * len(windows) * windows.steps
    assert table.steps == len(windows) * windows.steps
    table.write(tmp_path / "table.npz")
    again = Table.read(tmp_path / "table.npz")
    assert again.steps == table.steps
    np.testing.assert_array_equal(again.row(7).contributions, table.row(7).contributions)


def test_arms_share_plant_and_initial_design_and_seeds_do_not(
    compared: tuple[Path, Comparison],
) -> None:
    found = compared[1]
    assert len(found.ends) == 6
    design = found.paths[~found.paths["chosen"]]
    for seed in (0, 1):
        rows = {
            tuple(part["row"])
            for _, part in design[design["seed"] == seed].groupby("arm", sort=False)
        }
        assert len(rows) == 1
    truths = {name: r["truth"] for name, r in record_of(compared[0]).items()}
    assert truths["records/small/greedy/000.json"] == truths["records/small/random/000.json"]
    assert truths["records/small/greedy/000.json"] != truths["records/small/greedy/001.json"]
    for mass, damping in truths.values():
        assert 0.65 <= mass <= 1.35
        assert 0.045 <= damping <= 0.255


@pytest.mark.parametrize("arm", ["greedy", "random"])
@pytest.mark.parametrize("size", [None, 3, 8])
def test_what_an_arm_chose_begins_where_the_design_of_its_search_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arm: str, size: int | None
) -> None:
    """Whatever design a search has: 2 d + 2 candidates now, others some day."""
    _, table = seeded(tmp_path, 0)
    designs = []

    def designed(candidates: CandidateSet, rules: Rules) -> np.ndarray:
        rows = initial_rows(candidates, rules) if size is None else 5 * np.arange(size)
        designs.append(np.sort(rows))
        return rows

    monkeypatch.setattr("bo_sysid.identify.search.initial_rows", designed)
    data = ComparedProblem("small", Study.from_dict(small(), tmp_path)).seeded(0)
    how = Arm(arm, arm, "argmax", "timeout", 1)
    record = run_search(SearchJob(data, str(tmp_path), how, 0, 0, table))
    path = inner_paths({Key("small", arm, 0): record})
    (design,) = designs
    assert path.loc[~path["chosen"], "row"].tolist() == design.tolist()
    assert path["chosen"].tolist() == [False] * len(design) + [True] * (10 - len(design))


@pytest.mark.parametrize(("seed", "threshold", "settles"), [(0, 0.03, False), (2, 0.3, True)])
def test_a_blind_arm_settles_by_the_studys_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, threshold: float, settles: bool
) -> None:
    stop = {"entropy": threshold, "last": 5}
    study = small(search={"budget": 25, "stop": stop})
    data = ComparedProblem("small", Study.from_dict(study, tmp_path)).seeded(seed)
    table = tabulate(TableJob(data, str(tmp_path), seed))
    arm = Arm("random", "random", "argmax", "timeout", 1)
    job = SearchJob(data, str(tmp_path), arm, seed, seed, table)
    blind = run_search(job)
    monkeypatch.setattr("bo_sysid.compare.inner.BLIND", ())  # looks after every evaluation
    seeing = run_search(job)
    assert blind["row"] == seeing["row"]
    looks = [k for k, entropy in enumerate(blind["entropy"]) if entropy is not None]
    spread = {k: np.ptp(seeing["entropy"][k - 5 : k + 1]) for k in looks if k >= 10}
    settled = [k + 1 for k, nats in spread.items() if nats < threshold]
    assert blind["settled"] == (settled[0] if settles else None)
    assert bool(settled) is settles


def test_a_blind_arm_may_use_up_all_of_b(tmp_path: Path) -> None:
    """Between two looks at the belief nothing is left to pick: it looks then, too."""
    parameters = [p | {"steps": n} for p, n in zip(small()["parameters"], (7, 3), strict=True)]
    study = small(parameters=parameters, search={"budget": 60})
    drawn = ComparedProblem("small", Study.from_dict(study, tmp_path)).seeded(0)
    last = dict(drawn["plant"]) | {"parameters": {"mass": 1.5, "damping": 0.3}}
    data = {**drawn, "plant": last}
    table = tabulate(TableJob(data, str(tmp_path), 0))
    arm = Arm("full-grid", "full-grid", "argmax", "timeout", 1)
    found = run_search(SearchJob(data, str(tmp_path), arm, 0, 0, table))
    assert sorted(found["row"]) == list(range(21))


def test_a_drawn_plant_has_one_of_the_categories(tmp_path: Path) -> None:
    mass, damping = small()["parameters"]
    kind = {**damping, "low": 0.0, "high": 0.2, "steps": 3, "ordered": False}
    posed = ComparedProblem("small", Study.from_dict(small(parameters=[mass, kind]), tmp_path))
    drawn = [posed.seeded(seed)["plant"]["parameters"] for seed in range(60)]
    counts = pd.Series([round(d["damping"], 12) for d in drawn]).value_counts()
    assert set(counts.index) == {0.0, 0.1, 0.2}
    assert counts.min() >= 10
    # the others stay what they were
    same = ComparedProblem("small", Study.from_dict(small(), tmp_path)).seeded(4)["plant"][
        "parameters"
    ]
    assert drawn[4]["mass"] == same["mass"]


def test_costs_follow_from_the_paths(compared: tuple[Path, Comparison]) -> None:
    place, found = compared
    runs = found.paths.set_index(["arm", "seed"])
    assert found.costs["reached"].any()
    for row in found.costs[found.costs["reached"]].itertuples():
        one = runs.loc[(row.arm, row.seed)]
        at = int(np.flatnonzero(one["regret"] <= row.level + 1e-12)[0])
        assert row.evaluations == at + 1
        assert row.steps == one["steps"].iloc[at]
        assert one["seconds"].is_monotonic_increasing
    pd.testing.assert_frame_equal(pd.read_parquet(place / "summary.parquet"), found.summary)
    assert set(found.paired["problem"]) == {"small"}


def test_a_killed_comparison_goes_on_to_the_same_result(
    compared: tuple[Path, Comparison], tmp_path: Path
) -> None:
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small()))
    command = [sys.executable, "-m", "bo_sysid.cli", "compare", "small.yaml", "--threads", "1"]
    environment = {**os.environ, "MUJOCO_GL": "disable"}
    process = subprocess.Popen(  # noqa: S603
        [*command, "--out", "run"], cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL
    )
    place = tmp_path / "run"
    for _ in range(1200):
        if len(list(place.glob("records/*/*/[0-9]*.json"))) >= 2 or process.poll() is not None:
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = {p: p.stat().st_mtime_ns for p in place.glob("records/*/*/[0-9]*.json")}
    assert 2 <= len(before) < 6
    done = subprocess.run(  # noqa: S603
        [*command, "--out", "run"], cwd=tmp_path, env=environment, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert record_of(place) == record_of(compared[0])
    assert "small: 6 runs of 3 arms." in done.stdout
    assert "evaluations over those of argmin-entropy on the same seeds" in done.stdout.lower()
    assert (place / "figures" / "regret.png").stat().st_size > 5_000
    pytest.importorskip("plotly", reason="the group report is not installed")
    assert main(["report", str(place)]) == 0
    page = (place / "report.html").read_text()
    assert "Arms against each other" in page
    assert "Regret against evaluations: medians and quartiles over seeds." in page
    assert "Evaluations until a regret is reached: means and intervals." in page


def test_a_large_set_is_searched_without_a_table(
    compared: tuple[Path, Comparison], tmp_path: Path
) -> None:
    settings = {**small()["compare"], "table": 48, "seeds": 1, "arms": ["greedy"]}
    study = Study.from_dict(small(compare=settings), tmp_path)
    place = tmp_path / "run"
    with Run.open(place, study.resolved(relative_to=place), "compare") as run:
        compare(study, run)
    assert not (place / "tables").exists()
    (own,) = record_of(place).values()
    table = record_of(compared[0])["records/small/greedy/000.json"]
    assert own["row"] == table["row"]
    assert own["steps"] == table["steps"]
    assert own["lowest"] is None


def test_outer_loops_are_compared_by_real_trajectories(tmp_path: Path) -> None:
    settings = {
        "loop": "outer",
        "seeds": 1,
        "regrets": [1.0],
        "arms": [{"choose": "argmax", "stop": "timeout"}, {"acquisition": "random"}],
    }
    study = Study.from_dict(pendulum(compare=settings), tmp_path)
    found = compare(study)
    assert list(found.paths["arm"].drop_duplicates()) == [
        "max-value-entropy, argmax, timeout",
        "random, sample, seed",
    ]
    first = found.paths[found.paths["arm"].str.startswith("max-value")]
    assert first["trajectories"].tolist() == [1, 2]
    assert first["steps"].tolist() == [800, 800]  # the same model again: nothing is trained
    assert (found.paths["regret"] >= 0).all()
    assert found.costs["trajectories"].tolist() == [1, 1]


def test_steps_are_those_that_were_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = []

    def counted(trainer: Trainer) -> TrainingIteration:
        batches.append(trainer.settings.batch)
        return iterate(trainer)

    iterate = Trainer.iterate
    monkeypatch.setattr(Trainer, "iterate", counted)
    policy = {"batch": 400, "steps": 1200, "hidden": [8], "draft": 400}
    study = pendulum(policy=policy, learn={"trajectories": 3, "episodes": 2})
    arm = Arm("one", "argmin-entropy", "argmax", "timeout", 1)
    job = LearnJob(study, str(tmp_path), arm, 0, str(tmp_path / "run"))
    steps = run_learn(job)["steps"]
    # one model thrice: its draft is taken over as it is, then gone on from
    assert steps == [400, 400, 1200]
    assert steps[-1] == sum(batches)


def test_evaluations_are_those_of_delta(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Known rows are evaluated again in every iteration, and a repaired model's from none."""
    asked = []

    def counted(deviation: Deviation, points: np.ndarray) -> Evaluation:
        asked.append(len(points))
        return evaluate(deviation, points)

    evaluate = Deviation.__call__
    monkeypatch.setattr(Deviation, "__call__", counted)
    monkeypatch.setattr(bo_sysid.diagnosis, "diagnose", knowing)
    study = lacking(trajectories=2)
    arm = Arm("one", "argmin-entropy", "argmax", "timeout", 1)
    job = LearnJob(study, str(tmp_path), arm, 0, str(tmp_path / "run"))
    told = run_learn(job)["evaluations"]
    assert told[-1] == sum(asked)
    run = tmp_path / "run" / "iterations"
    rows = [len(pd.read_parquet(run / name / "evaluations.parquet"))
            for name in ("01", "01/repaired", "02")]  # fmt: skip
    assert told == [rows[0] + rows[1], sum(rows)]
    assert run_learn(job)["evaluations"] == told  # read again


def test_what_an_arm_leaves_open_is_as_the_study_has_it(tmp_path: Path) -> None:
    data = small(compare={"arms": [{"name": "own"}, {"name": "other", "stop": "seed"}, "random"]})
    data["search"] = {**data["search"], "acquisition": "thompson"}
    data["learn"] = {"choose": "argmax", "stop": "timeout"}
    own, other, blind = arms_of(Study.from_dict(data, tmp_path))
    assert (own.acquisition, own.choose, own.stop) == ("thompson", "argmax", "timeout")
    assert (other.acquisition, other.choose, other.stop) == ("thompson", "argmax", "seed")
    assert (blind.name, blind.acquisition, blind.choose) == ("random", "random", "argmax")


def test_what_is_wrong_is_told(tmp_path: Path) -> None:
    def posed(**settings: object) -> Study:
        return Study.from_dict(small(compare=settings), tmp_path)

    with pytest.raises(StudyError, match=r"compare: names no arms; for instance arms: \["):
        arms_of(posed())
    with pytest.raises(StudyError, match=r"compare.arms.1: there is another arm 'greedy'; name o"):
        arms_of(posed(arms=["greedy", "greedy"]))
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(small()))
    with pytest.raises(
        StudyError, match=r"compare.problems.0: 'oter.yaml' matches no file.*'other.yaml'"
    ):
        problems_of(posed(arms=["greedy"], problems="oter.yaml"), trust_code=False)
    with pytest.raises(StudyError, match=r"compare.problems.0: other.yaml is called 'small', as a"):
        problems_of(posed(arms=["greedy"], problems="other.yaml"), trust_code=False)
    with pytest.raises(StudyError, match=r"compare.lop: unknown key; did you mean 'loop'"):
        posed(arms=["greedy"], lop="outer")
    with pytest.raises(StudyError, match=r"compare.arms.0: the name '∞' has no letter or digit"):
        arms_of(posed(arms=[{"name": "∞", "acquisition": "greedy"}]))


def test_names_in_any_script_and_of_any_length_name_files() -> None:
    assert slug("Cart-pole, 2 parameters_a") == "cart-pole-2-parameters-a"
    assert slug("Маятник 1") == "маятник-1"
    one, other = slug("倒" * 300 + "a"), slug("倒" * 300 + "b")
    assert one != other
    assert len(f"{one}.parquet".encode()) < 255


def test_problems_may_be_named_by_a_pattern(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / f"p_{name}.yaml").write_text(yaml.safe_dump({**small(), "name": name}))
    study = small(compare={"arms": ["greedy"], "problems": ["p_*.yaml"]})
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(study))
    found = problems_of(Study.load(tmp_path / "small.yaml"), trust_code=False)
    assert [p.name for p in found] == ["small", "one", "two"]


def test_an_unknown_acquisition_has_its_nearest_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = small(compare={"arms": ["gredy"]})
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(study))
    assert main(["compare", str(tmp_path / "small.yaml"), "--out", str(tmp_path / "run")]) == 2
    assert "unknown acquisition 'gredy'; did you mean 'greedy'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_code_of_another_problem_runs_only_when_trusted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ran = tmp_path / "ran"
    (tmp_path / "law.py").write_text(
        f"open({str(ran)!r}, 'w').close()\ndef law(u):\n    return u\n"
    )
    other = {**small(actuators={"torque": {"law": "law.py:law"}}), "name": "other"}
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(other))
    settings = {"arms": ["random"], "seeds": 1, "problems": ["other.yaml"]}
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small(compare=settings)))
    command = ["compare", str(tmp_path / "small.yaml"), "--out", str(tmp_path / "run")]
    assert main([*command, "--threads", "1"]) == 2
    told = capsys.readouterr().err
    assert re.search(r"other.yaml.*\(law.py\), which runs only with --trust-code", told)
    assert not ran.exists()
    with pytest.raises(StudyError, match="--trust-code"):
        so_far(Study.load(tmp_path / "small.yaml"), tmp_path / "run")
    main([*command, "--threads", "1", "--trust-code"])
    assert ran.exists()


def test_strict_refuses_a_log_with_a_gap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"{k * 0.02:.2f},{np.sin(0.1 * k):.5f},{np.cos(k)}" for k in range(100)]
    log = "\n".join(["time,qpos.hinge,ctrl.torque", *rows[:40], *rows[60:]]) + "\n"
    (tmp_path / "log.csv").write_text(log)
    study = small(
        name="logged",
        recordings={"train": ["log.csv"], "noise": {"qpos": 0.001}},
        compare={"arms": ["random"], "seeds": 1},
    )
    del study["plant"]
    (tmp_path / "logged.yaml").write_text(yaml.safe_dump(study))
    command = ["compare", str(tmp_path / "logged.yaml"), "--threads", "1"]
    assert main([*command, "--out", str(tmp_path / "run")]) == 0
    for run in ("run", "other"):  # also where it goes on
        assert main([*command, "--out", str(tmp_path / run), "--strict"]) == 2
        assert re.search(r"log.csv: refused because of --strict.*gap", capsys.readouterr().err)


def test_a_dataset_that_is_not_to_be_had_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("BO_SYSID_DATA", raising=False)
    real = {**small(), "name": "real", "recordings": {"dataset": "quanser_qube"}}
    del real["plant"]
    (tmp_path / "real.yaml").write_text(yaml.safe_dump(real))
    settings = {"arms": ["greedy"], "seeds": 1, "problems": ["real.yaml"]}
    study = Study.from_dict(small(compare=settings), tmp_path)
    place = tmp_path / "run"
    with Run.open(place, study.resolved(relative_to=place), "compare") as run:
        found = compare(study, run)
    assert list(found.skipped) == ["real"]
    assert re.search(r"quanser_qube: .*\$BO_SYSID_DATA is not set", found.skipped["real"])
    assert set(found.paths["problem"]) == {"small"}
    again = so_far(study, place)
    assert again.skipped == found.skipped
    pd.testing.assert_frame_equal(again.costs, found.costs)
    with pytest.raises(RecordingError, match="BO_SYSID_DATA is not set"):
        compare(Study.from_dict({**real, "compare": {"arms": ["greedy"]}}, tmp_path))


def test_runs_that_fail_are_told_and_the_others_kept(tmp_path: Path) -> None:
    plant = {**small()["plant"], "parameters": {"mess": 1.0}}
    broken = {**small(plant=plant), "name": "broken"}
    (tmp_path / "broken.yaml").write_text(yaml.safe_dump(broken))
    settings = {"arms": ["greedy"], "seeds": 1, "problems": ["broken.yaml"], "truth": "stated"}
    study = Study.from_dict(small(compare=settings), tmp_path)
    place = tmp_path / "run"
    with (
        pytest.raises(RunError, match=r"1 of 2 runs failed.*no parameter 'mess'; did you mean"),
        Run.open(place, study.resolved(relative_to=place), "compare") as run,
    ):
        compare(study, run)
    assert json.loads((place / "run.json").read_text())["status"] == "failed"
    assert len(list(place.glob("tables/*/*.npz"))) == 1


def divide(_: TableJob) -> Table:
    raise ZeroDivisionError("division by zero")


def test_a_defect_in_a_job_is_not_laid_to_the_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("bo_sysid.compare.plan.tabulate", divide)
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small()))
    assert main(["compare", str(tmp_path / "small.yaml"), "--out", str(tmp_path / "run")]) == 1
    told = capsys.readouterr().err
    assert "2 of 2 runs failed" in told
    assert "ZeroDivisionError: division by zero" in told


@pytest.mark.parametrize("changed", ["model.xml", "ball.obj", "first.csv"])
def test_a_comparison_does_not_go_on_with_another_model_or_other_logs(
    tmp_path: Path, changed: str
) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.1
    faces = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    files = {
        "ball.obj": "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + faces,
        "model.xml": '<mujoco><asset><mesh name="b" file="ball.obj"/></asset><worldbody><body>'
        '<joint name="hinge" damping=".01"/><geom name="ball" type="mesh" mesh="b" pos="0 .5 0"/>'
        '</body></worldbody><actuator><motor name="torque" joint="hinge"/></actuator></mujoco>',
        "first.csv": "time,qpos.hinge,ctrl.torque\n"
        + "".join(f"{k * 0.02:.2f},{0.1 * np.sin(k):.5f},{np.cos(k):.5f}\n" for k in range(40)),
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    damping = {"name": "d", "address": "joint[hinge].damping", "low": 0.0, "high": 0.3, "steps": 5}
    data = small(model="model.xml", recordings={"train": "*.csv"}, parameters=[damping],
                 compare={"arms": ["random"], "seeds": 1}, search={"budget": 5})  # fmt: skip
    del data["plant"]
    study = Study.from_dict(data, tmp_path)
    place = tmp_path / "run"
    with Run.open(place, study.resolved(relative_to=place), "compare") as run:
        first = compare(study, run)
        pd.testing.assert_frame_equal(compare(study, run).paths, first.paths)
        text = files[changed].replace(".01", ".02").replace("0.1 ", "0.2 ").replace("0.04", "0.05")
        assert text != files[changed]
        (tmp_path / changed).write_text(text)
        what = "first.csv" if changed == "first.csv" else "the model"
        with pytest.raises(RunError, match=rf"'small' changed .*\({what} is another\); use"):
            compare(study, run)
        (tmp_path / changed).write_text(files[changed])
        os.utime(tmp_path / changed, (0, 0))  # MuJoCo keeps a mesh whose file is of the same second
        pd.testing.assert_frame_equal(compare(study, run).paths, first.paths)
