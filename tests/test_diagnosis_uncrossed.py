"""A play under a load that never reverses is told from one that is crossed."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_helpers import candidate, posed, record

from bo_sysid.diagnosis.answer.uncrossed import uncrossed_plays, uncrossed_sentence
from bo_sysid.diagnosis.sets.refit import refit
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.windowing import prepare


@pytest.mark.parametrize(("load", "uncrossed"), [(0.0, ()), (8.0, ("elbow",)), (-8.0, ("elbow",))])
def test_a_load_that_never_reverses_holds_the_play_at_one_end(
    load: float, uncrossed: tuple[str, ...]
) -> None:
    """The elbow's own torques are some tenths of a newton metre, to and fro."""
    problem, machine = posed(record(duration=4.0))
    play = candidate(machine, "backlash", "elbow")
    push = candidate(machine, "constant_force", "elbow")
    nominal = refit(prepare(problem).linear, (), ())
    x = np.array([0.005, *play.probe[1:]])
    both = Hypothesis(members=(play, push), x=(x, np.array([load])))
    assert uncrossed_plays(problem, replace(nominal, hypothesis=both)) == uncrossed
    alone = Hypothesis(members=(push,), x=(np.array([load]),))
    assert uncrossed_plays(problem, replace(nominal, hypothesis=alone)) == ()


def test_the_sentence_names_the_joint_and_what_would_tell() -> None:
    said = uncrossed_sentence(("elbow",))
    assert said.startswith("The play at the elbow ")
    assert said.endswith("motions on which the load reverses would.")
