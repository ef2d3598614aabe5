"""What an identification is not sure of, and how it says so."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from bo_sysid.belief.stopping import StopReason
from bo_sysid.identify import Identification, identify
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.recording import Recording
from bo_sysid.study import Study

RAIL = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="rail" type="slide" axis="1 0 0" damping="{damping}"/>
      <geom name="cart" size="0.1" mass="{mass}"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail" ctrlrange="-20 20"/></actuator>
</mujoco>
"""
MASS, DAMPING = 1.0, 1.0


def rail_study(
    folder: Path, noise: float, seed: int, *, steps: int = 21, **changes: object
) -> Study:
    """A cart on a rail whose speed is measured with noise; the model lacks nothing."""
    model = mujoco.MjModel.from_xml_string(RAIL.format(mass=MASS, damping=DAMPING))
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(seed), []
    for _ in range(3000):
        data.ctrl[0] = 2.0 * np.sin(2.3 * data.time) + np.sin(5.9 * data.time + seed)
        rows.append([data.time, data.qpos[0], data.qvel[0], data.ctrl[0]])
        mujoco.mj_step(model, data)
    time, place, speed, push = np.array(rows).T
    Recording.from_arrays(
        time,
        qpos={"rail": place + 1e-3 * rng.standard_normal(len(time))},
        qvel={"rail": speed + noise * rng.standard_normal(len(time))},
        ctrl={"push": push},
    ).to_frame().to_parquet(folder / "log.parquet")
    (folder / "rail.xml").write_text(RAIL.format(mass=0.9, damping=0.5))
    study = {
        "model": "rail.xml",
        "recordings": {"train": ["log.parquet"]},
        "parameters": [
            {"name": "mass", "address": "geom[cart].mass", "low": 0.6, "high": 1.4, "steps": steps},
            {"name": "rub", "address": "joint[rail].damping", "low": 0, "high": 4, "steps": steps},
        ],
        "deviation": {"horizon": 10},
        "search": {"budget": 40, "seed": seed},
    }
    return Study.from_dict({**study, **changes}, folder)


@pytest.mark.parametrize("seed", [0, 1])
def test_what_noise_of_measured_starts_moves_is_said_with_what_fits_from_fitted_ones(
    tmp_path: Path, seed: int
) -> None:
    """More damping makes the noise of a measured speed die out, and seems to fit better."""
    noisy = identify(rail_study(tmp_path, 0.3, seed))
    rub = noisy.parameters.set_index("name").loc["rub"]
    assert rub["low95"] > DAMPING, "the interval leaves the truth out"
    other = noisy.fitted_starts
    assert other is not None
    assert np.abs(other.values - [MASS, DAMPING]).max() < 0.15
    assert (np.abs(other.values - [MASS, DAMPING]) < 3 * other.sigma).all()
    (said,) = (s for s in noisy.unsure if "With the start of every window fitted" in s)
    assert "rub about " in said
    assert f"`deviation: {{starts: fitted, horizon: {other.horizon}}}`" in said
    again = {"starts": "fitted", "horizon": other.horizon}
    fitted = identify(rail_study(tmp_path, 0.3, seed, deviation=again))
    rub = fitted.parameters.set_index("name").loc["rub"]
    assert rub["low95"] < DAMPING < rub["high95"]
    assert not [s for s in fitted.unsure if "would fit best" in s]


@pytest.mark.parametrize(("seed", "missed"), [(3, []), (4, ["mass"])])
def test_candidates_that_are_too_far_apart_for_what_recordings_tell_are_said(
    tmp_path: Path, seed: int, missed: list[str]
) -> None:
    """A rotor's interval of .00084 to .0011 left out its .00113, in silence."""
    search = {"budget": 40, "candidates": {"sobol": 40}, "seed": seed}
    again = {"starts": "fitted", "horizon": 20}
    found = identify(rail_study(tmp_path, 1e-3, 0, deviation=again, search=search))
    table, truth = found.parameters, np.array([MASS, DAMPING])
    outside = (table["low95"] > truth) | (truth > table["high95"])
    assert table["name"][outside].tolist() == missed
    said = [s for s in found.unsure if "would fit best" in s]
    assert [s.split(" about ")[0] for s in said] == [f"Between the candidates {n}" for n in missed]
    assert found.fitted_starts is not None
    assert np.abs(found.fitted_starts.values - truth).max() < 0.02


def test_starts_that_are_measured_well_are_no_doubt(tmp_path: Path) -> None:
    found = identify(rail_study(tmp_path, 1e-3, 0))
    assert not [s for s in found.unsure if "start" in s]
    assert found.fitted_starts is not None
    assert np.abs(found.fitted_starts.values - [MASS, DAMPING]).max() < 0.02


def test_a_model_that_lies_between_the_candidates_is_said_to_fit_better(tmp_path: Path) -> None:
    """The machine is as the model; no candidate is."""
    study = rail_study(tmp_path, 1e-3, 0, steps=4)
    (tmp_path / "rail.xml").write_text(RAIL.format(mass=MASS, damping=DAMPING))
    found = identify(study)
    assert found.unsure[0].startswith("The model as it is ")
    assert "fits the training recordings better than every candidate" in found.unsure[0]
    finer = rail_study(tmp_path, 1e-3, 0, steps=4, search={"budget": 80, "refine": True})
    (tmp_path / "rail.xml").write_text(RAIL.format(mass=MASS, damping=DAMPING))
    refined = identify(finer)
    assert not [s for s in refined.unsure if "The model as it is" in s]


def undecided(reason: StopReason, most: float) -> Identification:
    """A search whose P_boot spreads over all of B."""
    grid = CandidateSet.from_grid([Parameter("x", ("a",), 0.0, 1.0, 11)])
    p = np.full(11, (1 - most) / 10)
    p[5] = most
    table = pd.DataFrame({"name": ["x"], "low95": [0.1], "high95": [0.9], "nominal": [0.5]})
    return Identification(
        "wide", grid.points[5], table, grid, p, np.full(11, 1 / 11),
        pd.DataFrame({"deviation": [1.0]}), pd.DataFrame(), pd.DataFrame(), reason.sentence, (),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("reason", "most", "whose"),
    [
        (StopReason.BUDGET, 0.69, "The search ended before it was sure of the minimum"),
        (StopReason.BUDGET, 0.97, "These recordings say little about x"),
        (StopReason.ENTROPY, 0.69, "These recordings say little about x"),
    ],
)
def test_a_search_that_was_cut_short_is_not_blamed_on_the_recordings(
    reason: StopReason, most: float, whose: str
) -> None:
    """Sixty of 114 660 candidates left intervals as wide as B, of recordings that tell all."""
    (said,) = undecided(reason, most).unsure
    assert said.startswith(whose)
    assert "80%" in said


def test_numbers_that_nobody_reads_are_written_in_short() -> None:
    errors = pd.DataFrame(
        {"recordings": ["train"], "kind": ["fit"], "channel": ["qpos.a"], "unit": ["m"],
         "nominal": [1e30], "identified": [1e29]}
    )  # fmt: skip
    found = replace(
        undecided(StopReason.CONVERGED, 1.0), errors=errors, noise={"qpos.a": 1e-3}
    ).unsure[0]
    assert "by 1e+32 standard deviations" in found
