"""When each control acts, where they do not act alike."""

from collections.abc import Mapping, Sequence

import mujoco

from bo_sysid.checks.proposal import Rule, proposed_clocks
from bo_sysid.checks.search import SUSPICIOUS
from bo_sysid.checks.wiring import Wiring
from bo_sysid.recording import Recording
from bo_sysid.starter.matching import Guess
from bo_sysid.starter.movers import evidence_of

_APART = 5e-3  # [s] from which on one control's delay is told apart from the others'
_CERTAIN = 4.0  # standard deviations
_LIKELY, _GUESSED = 0.7, 0.6


def guess_clocks(
    model: mujoco.MjModel, recordings: Sequence[Recording], wiring: Wiring
) -> tuple[dict[str, Rule], dict[str, Guess]]:
    """Return the clocks of the controls with their reasons; one a control where they differ.

    Args:
        model: the compiled model.
        recordings: as the corrected columns read them, without clocks.
        wiring: what the motion says.
    """
    apart = _apart(model, recordings, wiring)
    table = wiring.delays
    if not apart:
        clocks = proposed_clocks({}, "ctrl", wiring.delay)
        sigma = float(table["sigma"].iloc[0]) if clocks else 0.0
        late = {"ctrl": (wiring.delay, sigma, _LIKELY)} if clocks else {}
    else:
        late = {
            str(name): (apart.get(str(name), wiring.delay), float(sigma), _GUESSED)
            for name, sigma in zip(table["control"], table["sigma"], strict=True)
        }
        late = {n: t for n, t in late.items() if 1e3 * abs(t[0]) > _CERTAIN * t[1]}
        clocks = {n: r for n, t in late.items() for n, r in proposed_clocks({}, n, t[0]).items()}
    guesses = {
        f"clocks.{n}": Guess(f"clocks.{n}", "", "", _late(delay, sigma), sure)
        for n, (delay, sigma, sure) in late.items()
    }
    return clocks, guesses


def _apart(
    model: mujoco.MjModel, recordings: Sequence[Recording], wiring: Wiring
) -> Mapping[str, float]:
    """Return the delays of controls that balance their joint with their own delay alone."""
    evidence = evidence_of(model, recordings) if len(wiring.delays) > 1 else None
    if evidence is None:
        return {}
    found = {}
    columns = (wiring.delays[c] for c in ("control", "delay", "sigma"))
    for name, delay, sigma in zip(*columns, strict=True):
        own = 1e-3 * float(delay)
        shares = evidence.shares(evidence.identity(), [wiring.delay, own])[:, evidence.dof(name)]
        far = abs(own - wiring.delay) > max(_APART, 6e-3 * float(sigma))
        if far and shares[1] <= min(SUSPICIOUS, 0.5 * shares[0]):
            found[name] = own
    return found


def _late(delay: float, sigma: float) -> str:
    """Return when controls act, in words."""
    told = f"{1e3 * abs(delay):.1f} ms (± {sigma:.1f})"
    if delay > 0:
        return f"{told} later than stamped"
    return f"{told} earlier than stamped; a command that changes between samples looks so"
