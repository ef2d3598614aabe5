"""What acts once is told with its place and time, and noise is not."""

from itertools import count

import numpy as np
import pytest
from diagnosis_helpers import posed, record

from bo_sysid.diagnosis.answer.seen_once import seen_once
from bo_sysid.diagnosis.sets.refit import Effort, refit
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.recording import Recording


def said_of(recording: Recording) -> str:
    """Return what is said where nothing is named."""
    ready = prepare(posed(recording, horizon=150)[0])
    nominal = refit(ready.linear, (), (), effort=Effort(10, 1.0, final=True))
    return seen_once(ready.problem, ready.linear.Q, nominal)


def pushed(*begins: float) -> Recording:
    """Record 9 s in which a hand pushes the elbow for 50 ms at some times."""
    steps = count()

    def push(q: np.ndarray) -> np.ndarray:
        time = next(steps) * 0.0005
        return np.full(len(q), 0.2 * any(b <= time < b + 0.05 for b in begins))

    return record(duration=9.0, force=("elbow", push))


def test_a_push_is_told_with_its_time() -> None:
    said = said_of(pushed(3.1))
    assert said.startswith("arm 0, 3 to 3.3 s: there the model misses the recording by ")
    assert said.endswith("record that motion several times.")


def test_pushes_in_neighbouring_windows_are_one_place() -> None:
    assert said_of(pushed(3.1, 3.4)).startswith("arm 0, 3 to 3.6 s: ")
    assert said_of(pushed(3.1, 6.1)).startswith("arm 0, 3 to 3.3 s; arm 0, 6 to 6.3 s: ")


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_not_told(seed: int) -> None:
    assert said_of(record(duration=9.0, seed=seed)) == ""


def test_what_is_not_rare_is_not_told() -> None:
    assert said_of(pushed(*np.arange(0.1, 9.0, 0.6))) == ""
