"""Recorded speeds against the rates of the positions that belong to them."""

from collections.abc import Mapping, Sequence
from math import pi

import numpy as np

from bo_sysid.checks.hypothesis import Units, Wire, WiringHypothesis
from bo_sysid.checks.traces import Traces
from bo_sysid.recording.noise import MOVES, noise_sigma

TURNING: Units = (("deg/s", pi / 180), ("rpm", 2 * pi / 60), ("mrad/s", 1e-3), ("turn/s", 2 * pi))
SLIDING: Units = (("mm/s", 1e-3), ("cm/s", 1e-2))
UNDONE: Mapping[str, Units] = {
    "rad/s": (("rad/s", 180 / pi), ("rad/s", 30 / pi)),
    "m/s": (("m/s", 1e3), ("m/s", 1e2)),
}
"""By SI unit, the ways back to it where deg/s, rpm, mm/s or cm/s was stated and is wrong."""
MIN_CORRELATION = 0.8  # correlation from which on a speed belongs to a position
_CLEAR = 0.03  # by which another position's rate must resemble it more
_SAME = 1.35  # ratio of a speed to the rate that is no unit
EXACT = 1.15
"""Ratio to a unit's factor within which it is that unit."""


def speed_wires(
    traces: Traces, hypothesis: WiringHypothesis, hinges: Sequence[str]
) -> tuple[Mapping[str, Wire], Mapping[str, float]]:
    """Return what each recorded speed is, and its correlation with the position's rate.

    A speed that resembles no rate keeps its place, with the best correlation that was found; none
    is told of a joint that rests.
    """
    names = [n for n in traces.recordings[0].channels if n.startswith("qvel.")]
    names = [n for n in names if all(n in r.channels for r in traces.recordings)]
    pairs = [(n, n.replace("qvel.", "qpos.", 1)) for n in names]
    pairs = [(v, q) for v, q in pairs if q in hypothesis.wires]
    if not pairs:
        return {}, {}
    speeds = {v: traces.column(v, held=False) for v, _ in pairs}
    wires, found = {}, {}
    for v, q in pairs:
        wire = hypothesis.wires[q]
        rate = wire.sign * wire.scale * traces.column(wire.source, held=False, order=1)
        correlation = {n: _correlation(s, rate) for n, s in speeds.items()}
        best = max(correlation, key=lambda n: abs(correlation[n]))
        source = v if abs(correlation[v]) > abs(correlation[best]) - _CLEAR else best
        found[v] = correlation[source]
        if abs(correlation[source]) < MIN_CORRELATION:
            wires[v] = Wire(v)
            if not moving(traces, v) and not moving(traces, wire.source):
                del found[v]
            continue
        sign = 1 if correlation[source] > 0 else -1
        factor = float(np.std(rate) / max(np.std(speeds[source]), 1e-300))
        units = TURNING if q.removeprefix("qpos.") in hinges else SLIDING
        stated = traces.recordings[0].channels[source].unit
        unit, scale = _unit(factor, (*units, *UNDONE.get(stated, ())))
        less = wire.less.replace("qpos.", "qvel.", 1)
        wires[v] = Wire(source, sign, scale, 0.0, unit, less if less in speeds else "")
    return wires, found


def moving(traces: Traces, name: str) -> bool:
    """Return whether a channel does more than its noise in any recording."""
    channels = [r.channels[name] for r in traces.recordings]
    return any(np.ptp(c.values) > MOVES * noise_sigma(c.time, c.values) for c in channels)


def _unit(factor: float, units: Units) -> tuple[str, float]:
    """Return the unit whose factor is nearest, or none where the ratio is no unit."""
    if 1 / _SAME < factor < _SAME:
        return "", 1.0
    name, scale = min(units, key=lambda u: abs(np.log(factor / u[1])))
    near = abs(np.log(factor / scale)) < np.log(EXACT)
    return (name, scale) if near else ("", 1.0)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    if a.std() == 0 or b.std() == 0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])
