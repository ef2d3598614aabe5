"""The Ray engine: results of the local one, and nothing lost or run twice when a node is killed."""

import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from comparing import record_of, small

from bo_sysid.cli import main
from bo_sysid.compare.compare import compare
from bo_sysid.errors import StudyError
from bo_sysid.execution import LocalEngine, Progress, RayEngine, map_jobs, open_engine
from bo_sysid.proof.conceal import conceal, suite_record
from bo_sysid.runs import Run
from bo_sysid.study import Study

ray = pytest.importorskip("ray", reason="the group ray is not installed")

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # Ray's own warnings


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Three nodes on this machine, one core each; this process is connected to the first."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # so that nodes find this module
    monkeypatch.setenv("RAY_DEDUP_LOGS", "0")
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    for _ in range(2):
        made.add_node(num_cpus=1)
    ray.init(address=made.address, log_to_driver=False)
    try:
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def where(job: tuple[str, float]) -> tuple[float, str]:
    """Note in a file that it runs, and return a square and the node that made it."""
    folder, x = job
    with open(Path(folder) / f"{x:g}", "a") as file:
        file.write("ran\n")
    time.sleep(0.4)
    if x == 5:
        raise ValueError("five")
    return x * x, ray.get_runtime_context().get_node_id()


def test_a_killed_node_loses_nothing_and_nothing_comes_twice(cluster: Any, tmp_path: Path) -> None:
    jobs = {f"job {k}": (str(tmp_path), float(k)) for k in range(14)}
    victim = cluster.list_all_nodes()[-1]
    outcomes = []
    for outcome in map_jobs(where, jobs, engine=RayEngine(cluster.address), done={"job 0"}):
        outcomes.append(outcome)
        if len(outcomes) == 3:
            cluster.remove_node(victim, allow_graceful=False)
    assert sorted(o.key for o in outcomes) == sorted(set(jobs) - {"job 0"})
    found = {o.key: o for o in outcomes}
    assert "ValueError: five" in str(found.pop("job 5").error)
    assert {k: o.result[0] for k, o in found.items()} == {k: jobs[k][1] ** 2 for k in found}
    assert len({o.result[1] for o in found.values()}) == 3
    assert not (tmp_path / "0").exists()


def test_a_comparison_is_the_local_one_and_survives_a_killed_node(
    cluster: Any, tmp_path: Path
) -> None:
    records = {}
    for engine in ("local", "ray"):
        study = Study.from_dict(small(execution={"engine": engine}), tmp_path)
        place = tmp_path / engine

        def progress(told: Progress, engine: str = engine) -> None:
            if engine == "ray" and told.of == 6 and told.step == 2:  # in the middle of the runs
                cluster.remove_node(cluster.list_all_nodes()[-1], allow_graceful=False)

        with Run.open(place, study.resolved(relative_to=place), "compare") as run:
            found = compare(study, run, progress=progress)
        records[engine] = record_of(place)
        assert len(found.ends) == 6
    assert records["ray"] == records["local"]


def test_concealed_cases_are_answered_on_a_cluster_as_they_are_here(
    cluster: Any, tmp_path: Path
) -> None:
    suite = Path(__file__).parents[1] / "studies" / "concealed" / "quick.yaml"
    few = {
        "cases": 2,
        "seconds": {"train": 4, "holdout": 1},
        "machines": ["machines/cart_pole.yaml"],
    }
    local, there = tmp_path / "local", tmp_path / "there"
    with Run.open(local, suite_record(suite, few), "conceal") as run:
        conceal(run, suite, overrides=few, seals=tmp_path / "sealed")
    shutil.copytree(local, there)
    assert main(["reveal", str(local), "--answers-only"]) == 0
    assert main(["reveal", str(there), "--answers-only", "--engine", "ray"]) == 0
    for case in ("case-1", "case-2"):
        name = f"answers/{case}/diagnosis.json"
        assert (there / name).read_text() == (local / name).read_text()


def test_without_a_cluster_the_message_says_how_to_start_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(StudyError, match=r"no Ray cluster at 'auto'.*ray start --head"):
        list(RayEngine("auto").run(abs, {"a": 1}))


def test_a_cluster_that_is_not_installed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(StudyError, match=r"not installed here: pip install .bo-sysid\[ray\]"):
        open_engine("ray", "auto")


def test_engines_by_name() -> None:
    assert isinstance(open_engine(), LocalEngine)
    assert open_engine("ray", "auto") == RayEngine("auto")
    with pytest.raises(StudyError, match="unknown engine 'rai'; did you mean 'ray'"):
        open_engine("rai")
