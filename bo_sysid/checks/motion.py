"""How the joints moved: how far, how fast, in which band, and whether within their ranges."""

from collections.abc import Sequence

import mujoco
import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.signal import welch

from bo_sysid.checks.flags import Flag
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf.joints import HINGE, SLIDE
from bo_sysid.recording import Channel, Recording, noise_sigma
from bo_sysid.recording.alignment import stretches
from bo_sysid.recording.noise import MOVES

_FEWEST = 5  # samples on an even grid that tell how a joint moved
_WIDTHS = (0.02, 0.04, 0.08, 0.16)  # [s] of the mean whose rate is a speed
_NOISY = 0.15  # of a speed, that may be noise
_BAND = (0.05, 0.95)  # shares of the power of the speed that bound the band
BEYOND = 0.1  # of a joint's range, by which a position may lie outside it
_MANY = 3.0  # times a range, from which a motion tells that it is read in degrees
_MOTION = [
    "recording", "joint", "range", "net", "speed", "fastest", "reversals", "low_hz", "high_hz",
    "noise", "unit",
]  # fmt: skip


def excitation(recordings: Sequence[Recording], model: mujoco.MjModel) -> pd.DataFrame:
    """Return one row a recording and joint: how it moved.

    Columns: recording, joint, range, net (the last position less the first), speed (root mean
    square), fastest, reversals, low_hz and high_hz (between them lie 90 % of the power of the
    speed), noise, unit.

    Raises:
        RecordingError: a recording is too short to tell.
    """
    rows = []
    for r in recordings:
        for j in range(model.njnt):
            joint = model.joint(j)
            channel = r.channels.get(f"qpos.{joint.name}")
            if channel is not None:
                slides = int(joint.type[0]) == SLIDE
                unit = channel.unit or ("m" if slides else "rad")
                moved = _moved(channel, r.name, joint.name)
                rows.append({"recording": r.name, "joint": joint.name, **moved, "unit": unit})
    return pd.DataFrame(rows, columns=_MOTION)


@np.errstate(over="ignore", invalid="ignore")  # squares of absurd values
def _moved(channel: Channel, recording: str, joint: str) -> dict[str, object]:
    dt = float(np.median(np.diff(channel.time)))
    ends = [(channel.time[s.start], channel.time[s.stop - 1]) for s in stretches(channel.time)]
    first, last = max(ends, key=lambda both: both[1] - both[0])  # pauses are no motion
    grid = np.arange(first, last, dt)
    if len(grid) < _FEWEST:
        raise RecordingError(
            f"{recording}: {len(channel.time)} samples of qpos.{joint} tell nothing of how it "
            f"moves; at least {_FEWEST + 1} are needed; leave the recording out"
        )
    q = np.interp(grid, channel.time, channel.values)
    noise = noise_sigma(channel.time, channel.values)
    smooth, speed = _smoothed(q, dt, noise)
    frequency, power = welch(speed, 1 / dt, nperseg=min(len(speed), round(8 / dt) or 1))
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    low, high = (float(frequency[np.searchsorted(share, b).clip(0, len(share) - 1)]) for b in _BAND)
    return {
        "range": float(np.ptp(channel.values)),
        "net": float(smooth[-1] - smooth[0]),
        "speed": float(np.sqrt(np.mean(speed**2))),
        "fastest": float(np.abs(speed).max()),
        "reversals": _reversals(smooth, max(5 * noise, 0.01 * float(np.ptp(smooth)))),
        "low_hz": low,
        "high_hz": high,
        "noise": noise,
    }


def _smoothed(
    q: Float[np.ndarray, " T"], dt: float, noise: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " n"]]:
    """Return a mean that moves along a position, and its rate, over which noise has little say.

    The mean of k samples moves by (q[i + k] - q[i]) / k from one to the next, of which noise of
    deviation σ is √2 σ / k.
    """
    for width in _WIDTHS:
        count = int(np.clip(round(width / dt), 1, len(q) // 2))
        smooth = np.convolve(q, np.ones(count) / count, mode="valid")
        speed = np.diff(smooth) / dt
        if np.sqrt(2.0) * noise / (count * dt) <= _NOISY * np.sqrt(np.mean(speed**2)):
            break
    return smooth, speed


def _reversals(q: np.ndarray, least: float) -> int:
    """Return how often a position turned back by more than `least`."""
    count, direction, extreme = 0, 0, q[0]
    for x in q:
        if (direction >= 0 and x > extreme) or (direction <= 0 and x < extreme):
            extreme = x
        if abs(x - extreme) > least:
            turned = 1 if x > extreme else -1
            count += direction != 0
            direction, extreme = turned, x
        elif direction == 0 and abs(x - q[0]) > least:
            direction = 1 if x > q[0] else -1
    return count


def resting(table: pd.DataFrame) -> frozenset[str]:
    """Return the joints that moved by no more than their noise in any recording."""
    most = table.loc[table.groupby("joint")["range"].idxmax()]
    still = most["range"] < np.maximum(MOVES * most["noise"], 1e-9)
    return frozenset(most["joint"][still])


def excitation_flags(table: pd.DataFrame) -> list[Flag]:
    """Return the joints that hardly moved in any recording, or never turned back."""
    flags, at_rest = [], resting(table)
    for joint, part in table.groupby("joint", sort=False):
        k = int(np.argmax(part["range"].to_numpy()))
        moved, noise = (float(part[c].to_numpy()[k]) for c in ("range", "noise"))
        if str(joint) in at_rest:
            unit = "mm" if part["unit"].to_numpy()[k] == "m" else "mrad"
            flags.append(
                Flag(
                    "look",
                    "excitation",
                    (str(joint),),
                    f"{joint} moved by {1e3 * moved:.2g} {unit}, its noise is "
                    f"{1e3 * noise:.2g} {unit}: nothing can be said about it.",
                    {"range": moved, "noise": noise},
                )
            )
        elif not _turns_back(part):
            flags.append(
                Flag(
                    "look",
                    "excitation",
                    (str(joint),),
                    f"{joint} never turns back: dry friction and a constant force look alike.",
                    {"reversals": 0},
                )
            )
    return flags


def _turns_back(part: pd.DataFrame) -> bool:
    """Whether a joint moves in both directions, in one recording or in several."""
    net = part["net"].to_numpy()[part["range"] >= MOVES * part["noise"]]
    return int(part["reversals"].sum()) > 0 or bool((net > 0).any() and (net < 0).any())


def beyond_range(
    model: mujoco.MjModel, recordings: Sequence[Recording]
) -> dict[str, tuple[float, float]]:
    """Return the joints that moved farther than the model lets them, and from where to where."""
    found = {}
    for j in range(model.njnt):
        name = model.joint(j).name
        moved = [r.channels[n].values for r in recordings if (n := f"qpos.{name}") in r.channels]
        if not model.jnt_limited[j] or not moved:
            continue
        low, high = model.jnt_range[j]
        least, most = min(float(q.min()) for q in moved), max(float(q.max()) for q in moved)
        if max(low - least, most - high) > BEYOND * (high - low):
            found[name] = (least, most)
    return found


def turned_inside(model: mujoco.MjModel, recordings: Sequence[Recording]) -> list[str]:
    """Return the joints that moved farther than the model lets them, and would not, turned."""
    found = []
    for name, (least, most) in beyond_range(model, recordings).items():
        low, high = model.joint(name).range
        if max(low + most, -least - high) <= BEYOND * (high - low):
            found.append(name)
    return found


def _in_degrees(low: float, high: float, least: float, most: float) -> bool:
    """Whether a motion many times as wide as a range in [rad] is within it, read in [deg]."""
    inside = np.rad2deg(low) <= least and most <= np.rad2deg(high)
    return bool(inside and most - least > _MANY * (high - low))


def range_flags(model: mujoco.MjModel, recordings: Sequence[Recording]) -> list[Flag]:
    """Return the joints that moved farther than the model lets them."""
    flags, turned = [], turned_inside(model, recordings)
    for name, (least, most) in beyond_range(model, recordings).items():
        low, high = (float(v) for v in model.joint(name).range)
        hinge = int(model.joint(name).type[0]) == HINGE
        sentence = (
            f"{name} moved from {least:.3g} to {most:.3g}, but the model's range is {low:.3g} to "
            f"{high:.3g} {'rad' if hinge else 'm'}: its stops would act on it."
        )
        if name in turned:
            sentence += " With its sign turned it would stay inside."
        elif hinge and _in_degrees(low, high, least, most):
            sentence += (
                ' A range that is written in radians needs <compiler angle="radian"/> in the MJCF.'
            )
        evidence = {"low": low, "high": high, "least": least, "most": most}
        flags.append(Flag("wrong", "range", (f"qpos.{name}",), sentence, evidence))
    return flags
