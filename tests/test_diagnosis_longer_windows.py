"""What short windows cannot show is seen in longer ones, and noise in neither."""

import pytest
from diagnosis_helpers import arm, posed, record

from bo_sysid.diagnosis.answer.longer_windows import shows_more, too_short
from bo_sysid.diagnosis.answer.unexplained import Unexplained
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis


@pytest.mark.parametrize(("friction", "more"), [(0.0, False), (0.2, True)])
def test_longer_windows_show_friction_and_no_noise(friction: float, more: bool) -> None:
    missing = [("dry_friction", "joint", "elbow", [friction])] if friction else []
    evidence = make_evidence(arm(), [record(missing, duration=5.0)], threads=1)
    left = shows_more(evidence, Hypothesis(), arm().compile().opt.timestep)
    assert (left > 20.0) == more
    said = Unexplained(1.0, "world", "world", longer=left).sentences
    assert said[0].startswith("Something is missing that the short windows") == more


def test_nothing_is_said_of_recordings_that_are_not_that_long() -> None:
    evidence = make_evidence(arm(), [record(duration=5.0)], threads=1)
    short = [r.between(0.0, 0.2) for r in evidence.recordings]
    cut = make_evidence(arm(), short, threads=1)
    assert shows_more(cut, Hypothesis(), 0.002) == 0.0


@pytest.mark.parametrize(("instants", "short"), [(50, True), (100, False)])
def test_windows_are_short_below_half_of_those_of_a_hold_out(instants: int, short: bool) -> None:
    assert too_short(posed(record(duration=3.0), horizon=instants)[0]) == short
