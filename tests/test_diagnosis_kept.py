"""What a diagnosis that was killed finds again: the same fits, and from them the same answer."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, record
from test_cli_diagnose import MODEL, STUDY

from bo_sysid.cli import main
from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.kept_fits import FitCache, digest
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.effects import CATALOGUE
from bo_sysid.runs import FITS, Run, read_json

RUBS = [("dry_friction", "joint", "elbow", [0.05])]


@pytest.fixture
def every_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep short fits as well."""
    monkeypatch.setattr("bo_sysid.diagnosis.windows.kept_fits._LONG", 0.0)


@pytest.fixture
def rubbing() -> Evidence:
    effects = [CATALOGUE[e] for e in ("dry_friction", "viscous_damping")]
    recorded = (record(RUBS, duration=4.0),)
    return make_evidence(arm(), recorded, effects=effects, noise={"qpos": SIGMA}, threads=1)


@pytest.mark.parametrize(
    "other",
    [
        (np.array([1.0, 2.5]), "a", (1, None)),
        (np.array([[1.0, 2.0]]), "a", (1, None)),
        (np.array([1, 2]), "a", (1, None)),
        (np.array([1.0, 2.0]), "b", (1, None)),
        (np.array([1.0, 2.0]), "a", (1.0, None)),
        (np.array([1.0, 2.0]), "a", 1, None),
    ],
)
def test_a_hash_tells_inputs_apart(other: tuple[object, ...]) -> None:
    inputs = (np.array([1.0, 2.0]), "a", (1, None))
    assert digest(inputs) == digest((np.array([1.0, 2.0]), "a", (1, None)))
    assert digest(inputs) != digest(other)


def test_what_has_no_hash_of_its_own_is_refused() -> None:
    with pytest.raises(TypeError, match="function has no hash"):
        digest((lambda: None,))


@pytest.mark.usefixtures("every_fit")
def test_a_damaged_file_is_made_again(tmp_path: Path) -> None:
    kept, times = FitCache(tmp_path), []

    def make() -> dict[str, np.ndarray]:
        times.append(1)
        return {"x": np.arange(3.0)}

    for _ in range(2):
        np.testing.assert_array_equal(kept.arrays(("a",), make)["x"], [0, 1, 2])
    assert len(times) == 1
    (file,) = tmp_path.glob("*.npz")
    file.write_bytes(file.read_bytes()[:60])
    np.testing.assert_array_equal(kept.arrays(("a",), make)["x"], [0, 1, 2])
    assert len(times) == 2


@pytest.mark.usefixtures("every_fit")
def test_what_was_fitted_is_found_again_to_the_last_bit(
    tmp_path: Path, rubbing: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated, simulate = [], Problem.simulate
    monkeypatch.setattr(
        Problem, "simulate", lambda *a, **k: simulated.append(1) or simulate(*a, **k)
    )
    fits, counts = [], []
    for evidence in (rubbing, *2 * [replace(rubbing, kept=FitCache(tmp_path))]):
        simulated.clear()
        fits.append(locate(evidence).decision.best)
        counts.append(len(simulated))
    assert counts[1] == counts[0]
    assert counts[2] < 0.5 * counts[1]
    assert [c.effect.id for c in fits[0].members] == ["dry_friction"]
    for again in fits[1:]:
        assert again.key == fits[0].key
        assert again.rss == fits[0].rss
        np.testing.assert_array_equal(again.covariance, fits[0].covariance)


@pytest.mark.slow
@pytest.mark.usefixtures("every_fit")
def test_a_killed_diagnosis_goes_on_to_the_same_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pendulum.xml").write_text(MODEL)
    Path("pendulum.yaml").write_text(STUDY)
    assert main(["record", "pendulum.yaml", "--out", "made"]) == 0

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("bo_sysid.diagnosis.answer.explain.examine", killed)
        assert main(["diagnose", "pendulum.yaml", "--out", "killed"]) == 130
    assert list(Path("killed", FITS).glob("*.npz"))
    assert main(["diagnose", "pendulum.yaml", "--out", "killed"]) == 0
    assert main(["diagnose", "pendulum.yaml", "--out", "whole"]) == 0
    assert not Path("killed", FITS).exists()
    assert read_json("killed", "diagnosis.json") == read_json("whole", "diagnosis.json")


@pytest.mark.usefixtures("every_fit")
def test_fits_of_other_files_are_dropped(tmp_path: Path) -> None:
    with Run.open(tmp_path / "run", {"name": "a"}, "diagnose") as run:
        FitCache.of(run, {"files": "old"}).arrays(("a",), lambda: {"x": np.zeros(1)})
        assert list((run.folder / FITS).glob("*.npz"))
        FitCache.of(run, {"files": "old"})
        assert list((run.folder / FITS).glob("*.npz"))
        FitCache.of(run, {"files": "new"})
        assert not list((run.folder / FITS).glob("*.npz"))
