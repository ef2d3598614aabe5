"""What acts once, or in a part, is told with its place and time, and noise is not."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from diagnosis_helpers import SIGMA, posed, record

from bo_sysid.diagnosis.answer.seen_once import seen_in_a_part, seen_once
from bo_sysid.diagnosis.sets.refit import Effort, refit
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.recording import Recording


def said_of(recording: Recording, said: Callable[..., str] = seen_once) -> str:
    """Return what is said where nothing is named."""
    ready = prepare(posed(recording, horizon=150)[0])
    nominal = refit(ready.linear, (), (), effort=Effort(10, 1.0, final=True))
    return said(ready.problem, ready.linear.Q, nominal)


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


def pulled(begins: float, ends: float = 9.0) -> Recording:
    """Record 9 s in which a spring pulls the elbow from some time on."""
    steps = count()

    def pull(q: np.ndarray) -> np.ndarray:
        return -0.3 * q * (begins <= next(steps) * 0.0005 < ends)

    return record(duration=9.0, force=("elbow", pull))


def test_what_acts_from_some_time_on_is_told_with_that_time() -> None:
    said = said_of(pulled(4.5), seen_in_a_part)
    assert said.startswith("arm 0, 4.5 to 8.7 s: there the model misses the recording by ")
    assert said.endswith("elsewhere. Something differs in that part, such as a load that was "
                         "picked up: diagnose it as a recording of its own.")  # fmt: skip
    assert said_of(pulled(3.0, 6.0), seen_in_a_part).startswith("arm 0, 3 to 6 s: ")
    assert said_of(pulled(4.5)) == ""  # it is not rare


def test_what_always_acts_is_no_part() -> None:
    assert said_of(pulled(0.0), seen_in_a_part) == ""
    assert said_of(pulled(9.0), seen_in_a_part) == ""


def test_what_is_missing_of_the_motion_shows_in_no_rest() -> None:
    """An arm that hangs for as long as it moves then."""
    moved, time = pulled(0.0), np.arange(0, 9.0, 0.002)
    noise = SIGMA * np.random.default_rng(1).normal(size=(len(time), 2))
    hung = {
        n: np.concatenate([noise[:, k], moved.channels[f"qpos.{n}"].values])
        for k, n in enumerate(("shoulder", "elbow"))
    }
    ctrl = {
        n.removeprefix("ctrl."): np.concatenate([0 * time, c.values])
        for n, c in moved.channels.items()
        if n.startswith("ctrl.")
    }
    both = Recording.from_arrays(np.concatenate([time, 9.0 + time]), qpos=hung, ctrl=ctrl)
    assert said_of(both, seen_in_a_part) == ""


def test_what_one_joint_lacks_is_no_part_where_the_other_moved_alone() -> None:
    """A shoulder that moves all the time, and an elbow with a spring that moves later."""
    moved = pulled(0.0)
    first = moved.channels["qpos.elbow"].values[:2250]
    still = SIGMA * np.random.default_rng(1).normal(size=len(first))
    elbow = np.concatenate([still, moved.channels["qpos.elbow"].values[2250:]])
    channels = dict(moved.channels)
    channels["qpos.elbow"] = replace(channels["qpos.elbow"], values=elbow)
    ready = prepare(posed(replace(moved, channels=channels), horizon=150)[0])
    nominal = refit(ready.linear, (), (), effort=Effort(10, 1.0, final=True))
    quiet = replace(nominal, residual=nominal.residual * (np.arange(29) >= 15)[:, None])
    assert seen_in_a_part(ready.problem, ready.linear.Q, quiet) == ""
