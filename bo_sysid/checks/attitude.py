"""Recorded orientations against the angular velocities that belong to them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bo_sysid.checks.flags import Flag
from bo_sysid.checks.hypothesis import Wire
from bo_sysid.mjcf.joints import BALL, FREE
from bo_sysid.recording import Recording

_SPAN = 0.05  # [s] over which an orientation turns by what its rates say
_GAP = 2.0  # intervals of a clock that are a pause
_OFF = 0.5  # share of the rates that an orientation misses where it is not what it is called
_FITS = 0.2  # that it misses at most where it is
_ALIKE = 2.0  # ratio of what two conventions miss within which the simpler one is taken
_W_LAST = (3, 0, 1, 2)  # where w, x, y and z stand in x, y, z, w


@dataclass(frozen=True, order=True)
class Convention:
    """How an orientation may be written, beside w, x, y, z and rates in the body's frame.

    Attributes:
        w_last: its numbers are x, y, z, w.
        inverse: it turns the world into the body.
        world: its angular velocity is in the world's frame.
    """

    w_last: bool = False
    inverse: bool = False
    world: bool = False

    @property
    def faults(self) -> int:
        """Number of ways in which it is not MuJoCo's."""
        return self.w_last + self.inverse + self.world


CONVENTIONS = tuple(
    sorted((Convention(*c) for c in product((False, True), repeat=3)), key=lambda c: c.faults)
)


def find_attitudes(
    model: mujoco.MjModel, recordings: Sequence[Recording]
) -> tuple[dict[str, Wire], tuple[Flag, ...]]:
    """Return what recorded orientations really are, where their rates tell, and what to say of it.

    Orientation and angular velocity describe one motion: no model of forces is needed. Without
    rates a note says that nothing was tested; nothing is said of a joint whose seven channels are
    not on one clock, or that hardly turns.

    Args:
        model: gives the ball joints and floating bodies.
        recordings: the recordings.

    Returns:
        By channel what it is, for those that are not what they are called, and one flag a joint.
    """
    wires: dict[str, Wire] = {}
    flags = []
    for joint, turned, rates in _orientations(model):
        misses = _misses(recordings, turned, rates)
        if not misses:
            flags += _untested(recordings, joint, turned, rates)
            continue
        least = min(misses.values())
        best = next(c for c in CONVENTIONS if misses[c] <= _ALIKE * least)
        if misses[Convention()] < _OFF or misses[best] > _FITS:
            continue
        wires |= {n: w for n, w in _wires(turned, best).items() if not w.plain(n)}
        flags.append(_flag(joint, turned, rates, best, misses))
    return wires, tuple(flags)


def _untested(
    recordings: Sequence[Recording], joint: str, turned: Sequence[str], rates: Sequence[str]
) -> list[Flag]:
    """Return a note where an orientation was recorded without its rates."""
    known = {n for r in recordings for n in r.channels}
    if not known.issuperset(turned) or known.intersection(rates):
        return []
    sentence = (
        f"Whether {turned[0]} to {turned[3]} are w, x, y, z, w first, and turn {joint} and not the "
        f"world was not tested: that needs the angular velocity, {rates[0]} to {rates[2]}."
    )
    return [Flag("note", "order", tuple(turned), sentence)]


def _orientations(
    model: mujoco.MjModel,
) -> Iterator[tuple[str, tuple[str, ...], tuple[str, ...]]]:
    """Yield each joint with an orientation, its four channels and those of its three rates."""
    for j in range(model.njnt):
        kind, name = int(model.jnt_type[j]), model.joint(j).name
        if kind in (BALL, FREE):
            first = 3 if kind == FREE else 0
            yield (
                name,
                tuple(f"qpos.{name}.{first + k}" for k in range(4)),
                tuple(f"qvel.{name}.{first + k}" for k in range(3)),
            )


def _misses(
    recordings: Sequence[Recording], turned: Sequence[str], rates: Sequence[str]
) -> dict[Convention, float]:
    """Return by convention how much of the recorded rates an orientation misses, as a share.

    Empty where nothing is known of it.
    """
    missed, size = dict.fromkeys(CONVENTIONS, 0.0), 0.0
    for recording in recordings:
        found = _differences(recording, turned, rates)
        if found is None:
            continue
        size += float((found[0] ** 2).sum())
        for convention, difference in found[1].items():
            missed[convention] += float((difference**2).sum())
    return {c: float(np.sqrt(m / size)) for c, m in missed.items()} if size else {}


def _differences(
    recording: Recording, turned: Sequence[str], rates: Sequence[str]
) -> tuple[Float[np.ndarray, "n 3"], dict[Convention, Float[np.ndarray, "n 3"]]] | None:
    """Return the recorded rates in [rad/s], and what each convention's turning differs by."""
    channels = [recording.channels.get(n) for n in (*turned, *rates)]
    if any(c is None for c in channels):
        return None
    recorded = [c for c in channels if c is not None]
    time = recorded[0].time
    if len(time) < 2 or any(not np.array_equal(c.time, time) for c in recorded[1:]):
        return None
    values = np.stack([c.values for c in recorded], axis=1)
    usual = float(np.median(np.diff(time)))
    ahead = min(max(round(_SPAN / usual), 1), len(time) - 1)
    lasts = time[ahead:] - time[:-ahead]
    whole = np.isfinite(values).all(axis=1) & (np.linalg.norm(values[:, :4], axis=1) > 0)
    near = np.flatnonzero((lasts <= _GAP * ahead * usual) & whole[:-ahead] & whole[ahead:])
    if not near.size:
        return None
    rate = 0.5 * (values[near, 4:] + values[near + ahead, 4:])
    made = {c: _turning(values[:, :4], near, ahead, c) / lasts[near, None] for c in CONVENTIONS}
    return rate, {c: turning - rate for c, turning in made.items()}


def _turning(
    values: Float[np.ndarray, "n 4"], near: np.ndarray, ahead: int, convention: Convention
) -> Float[np.ndarray, "k 3"]:
    """Return by how much an orientation turns, in [rad], in the frame in which rates are told."""
    written = values[:, _W_LAST] if convention.w_last else values
    placed = Rotation.from_quat(written[near], scalar_first=True)
    later = Rotation.from_quat(written[near + ahead], scalar_first=True)
    if convention.inverse:
        placed, later = placed.inv(), later.inv()
    turned = later * placed.inv() if convention.world else placed.inv() * later
    return np.asarray(turned.as_rotvec())


def _wires(turned: Sequence[str], convention: Convention) -> dict[str, Wire]:
    """Return what the four channels of an orientation should be read from."""
    sources = [turned[k] for k in _W_LAST] if convention.w_last else list(turned)
    signs = (1, -1, -1, -1) if convention.inverse else (1, 1, 1, 1)
    return {n: Wire(s, sign) for n, s, sign in zip(turned, sources, signs, strict=True)}


def _flag(
    joint: str,
    turned: Sequence[str],
    rates: Sequence[str],
    best: Convention,
    misses: Mapping[Convention, float],
) -> Flag:
    """Say how an orientation is written."""
    wrong = []
    if best.w_last:
        wrong.append(f"{turned[0]} to {turned[3]} are x, y, z, w, and MuJoCo has w first")
    if best.inverse:
        wrong.append("the orientation is that of the world in the body, and MuJoCo has the inverse")
    if best.world:
        wrong.append(
            f"{rates[0]} to {rates[2]} are in the world's frame, and MuJoCo has those of the body: "
            "leave them out of the log, for they follow from the orientation"
        )
    return Flag(
        "wrong",
        "order" if best.w_last else "sign",
        (*turned, *rates),
        f"Orientation of {joint}: {'; '.join(wrong)}. Share of the angular velocity that it misses "
        f"as it was → corrected: {misses[Convention()]:.2g} → {misses[best]:.2g}.",
        {"as it was": misses[Convention()], "corrected": misses[best]},
    )
