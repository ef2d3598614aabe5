"""Single samples that leave both neighbours are told; what machines do is not."""

from collections.abc import Callable

import numpy as np
import pytest

from bo_sysid.checks.channels import channel_flags
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable, Recording
from bo_sysid.recording.mapping import to_recording
from bo_sysid.recording.outliers import find_outliers, in_words

RATES = (10, 20, 50, 200, 1000)
NOISE = (0.0, 3e-4, 1e-3)


def clock(rate: int) -> np.ndarray:
    return np.arange(max(3 * rate, 60)) / rate


def multisine(t: np.ndarray) -> np.ndarray:
    return 0.5 * np.sin(6 * t) + 0.2 * np.sin(23 * t + 1) + 0.1 * np.sin(41 * t + 2)


def bouncing(t: np.ndarray) -> np.ndarray:
    """Height of a ball that loses a fifth of its speed at each impact."""
    height, speed, now, dt, found = 1.0, 0.0, 0.0, 1e-3, []
    for until in t:
        while now < until:
            speed -= 9.81 * dt
            height += speed * dt
            if height < 0:
                height, speed = -height, -0.8 * speed
            now += dt
        found.append(height)
    return np.array(found)


def slipping(t: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(1)
    slips = (rng.random(t.size) < 0.05) * rng.uniform(-0.1, 0.1, t.size)
    return np.cumsum(slips)


def stepping(t: np.ndarray) -> np.ndarray:
    """A servo that overshoots, told to go and return each second."""
    since = t % 0.5
    rung = 1 - np.exp(-8 * since) * np.cos(40 * since)
    return np.where(t % 1 < 0.5, rung, 1 - rung)


def knocked(t: np.ndarray) -> np.ndarray:
    """A joint at rest that is struck, and back within a sample or two."""
    since = np.maximum(t - 1.02, 0)
    return since * np.exp(-60 * since) * 10


def pulsing(t: np.ndarray) -> np.ndarray:
    return np.where(t % 1 < 0.1, 1.0, 0.0)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("motion", [multisine, bouncing, slipping, stepping, knocked, pulsing])
def test_what_machines_do_is_no_outlier(motion: Callable, rate: int) -> None:
    t = clock(rate)
    for k, sigma in enumerate(NOISE if motion is not knocked else NOISE[1:]):
        x = motion(t) + sigma * np.random.default_rng(k).standard_normal(t.size)
        logs = {"plain": x, "quantised": np.round(x / 0.00153) * 0.00153, "coarse": x.round(2)}
        if motion is not slipping:  # a slip over the end of a turn is another jump
            logs |= {"wrapped": (5 * x + np.pi) % (2 * np.pi) - np.pi, "turns": (5 * x) % 1.0}
        for name, values in logs.items():
            assert find_outliers(t, values) == (), (name, sigma)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("motion", [multisine, bouncing, slipping, stepping, knocked])
def test_codes_and_spikes_are_found_at_any_rate(motion: Callable, rate: int) -> None:
    t = clock(rate)
    x = motion(t) + 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    x[[20, 40]] = -9999, 1e9
    if rate > 10:  # a fifth of a second is long enough to go and return
        x[41] = 1e9
    rows = [(o.first, o.last) for o in find_outliers(t, x)]
    assert rows == [(20, 20), (40, 41 if rate > 10 else 40)]


def test_dropouts_to_zero_are_found_within_the_range_of_the_motion() -> None:
    t = clock(200)
    x = 0.5 + multisine(t) + 3e-4 * np.random.default_rng(0).standard_normal(t.size)
    x[[100, 300]] = 0.0
    found = find_outliers(t, x)
    assert in_words(found, x, np.arange(600)) == "0 and back in rows 100, 300"


def test_many_places_are_counted() -> None:
    x = multisine(clock(200))
    x[50::100] = -1.0, -2.0, -3.0, -4.0, -4.0, -4.0
    x[50::100] *= 1e3
    told = in_words(find_outliers(clock(200), x), x, np.arange(600) + 7)
    assert told == "-1000, -2000, -3000, … and back in rows 57, 157, 257 and 3 more"


def with_code() -> dict[str, np.ndarray]:
    t = clock(200)
    degrees = np.rad2deg(multisine(t))
    degrees[[400, 401]] = -9999
    return {"time": t, "q": degrees}


def test_a_recording_notes_rows_and_values_of_the_file_and_alters_nothing() -> None:
    rules = {"qpos.a": {"from": "q", "unit": "deg"}}
    table = RawTable("log.csv", with_code())
    recording = to_recording(table, rules, name="log")
    told = "log: qpos.a jumps to -9999 and back in rows 400-401"
    assert any(n.startswith(told) for n in recording.notes)
    assert recording.channels["qpos.a"].values[400] == pytest.approx(np.deg2rad(-9999))
    with pytest.raises(RecordingError, match=rf"--strict.*{told}"):
        to_recording(table, rules, name="log", strict=True)


def test_a_check_flags_positions_and_no_commands() -> None:
    values = with_code()
    recording = Recording.from_arrays(
        values["time"], qpos={"a": values["q"]}, ctrl={"m": values["q"]}, name="log"
    )
    xml = "<mujoco><worldbody><body><joint name='a'/><geom size='.1'/></body></worldbody></mujoco>"
    flags = channel_flags(Model.from_xml(xml).compile(), [recording])
    assert [(f.kind, f.channels) for f in flags if f.kind == "outlier"] == [
        ("outlier", ("qpos.a",))
    ]
    assert "log: qpos.a jumps to -9999 and back at 2 s" in flags[0].sentence
