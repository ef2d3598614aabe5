"""Whether a part of the leading set is enough, once the time step is corrected there."""

import numpy as np
import pytest
from test_diagnosis_added_joints import JOINT, SIGMA, record

from bo_sysid.diagnosis.search.final import leading
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.simpler import at_a_part
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model

SOFT = np.array([0.01, 0.001, 0.4])


def searched(corrected_at: float) -> Search:
    """A search for a soft gear, corrected as beside a lag in [s], which the machine has not."""
    recording = record("joint_compliance", [*SOFT, 0.0], 3, 4.0)
    effects = [CATALOGUE[e] for e in ("joint_compliance", "actuator_lag")]
    evidence = make_evidence(
        Model.from_xml(JOINT), [recording], effects=effects, noise={"qpos": SIGMA}, threads=1
    )
    candidates = list(evidence.candidates)
    soft, lag = (next(c for c in candidates if c.effect is e) for e in effects)
    at = Hypothesis((soft, lag), (SOFT[: soft.size], np.array([corrected_at])), numerics=0.0)
    search = Search.on(prepare(windows_of(evidence, 150, 0.002), at), candidates, 2, None)
    members: list[Candidate] = []
    for c, x in ((soft, SOFT[: soft.size]), (lag, np.array([0.001]))):
        members.append(c)
        search.fit(members, [SOFT[: soft.size], x][: len(members)])
    return search


def test_what_stands_for_the_correction_at_another_set_is_no_name() -> None:
    search = searched(corrected_at=0.05)
    assert leading(search).names == {("joint_compliance", "hinge"), ("actuator_lag", "hinge")}
    found = leading(at_a_part(search))
    assert found.names == {("joint_compliance", "hinge")}
    assert found.x[0][0] == pytest.approx(SOFT[0], rel=0.02)
    assert found.rms < 1.0


def test_a_leader_without_parts_that_are_near_stays_as_it_was_found() -> None:
    search = searched(corrected_at=0.002)
    assert leading(search).names == {("joint_compliance", "hinge")}
    assert at_a_part(search) is search
