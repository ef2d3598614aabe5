"""Does `check` name what is wrong with a log?

Logs of four machines that the model knows only roughly (masses 10 % off, friction and damping that
it lacks, a fourth of its step), spoilt in one way or two (wrong_logs.py). A log counts as named
right where every channel is to be read as it was spoilt, from the right column with the right sign
and unit, the zero within 0.05 rad, the delay within 2 ms, and nothing else is proposed. A clean log
on which anything is to be corrected is a false alarm. Thresholds were tuned on the first half of
the seeds; the headline is the second half.
"""

import time

import numpy as np
from common import Cases, benchmark
from scipy.stats import beta
from wrong_logs import MACHINES, make

from bo_sysid.checks.wiring import find_wiring

COUNT, QUICK = 200, 24
_ZERO, _LATE = 0.05, 2e-3


def judge(seed: int, *, clean: bool) -> dict[str, object]:
    """Return how one log was judged."""
    log = make(seed, clean=clean)
    model = MACHINES[log.machine].model().compile()
    started = time.perf_counter()
    found = find_wiring(model, [log.recording])
    seconds = time.perf_counter() - started
    right = set(found.wires) == set(log.rules) and all(
        (wire.source, wire.sign) == log.rules[name][:2]
        and abs(wire.scale / log.rules[name][2] - 1) < 0.01
        and abs(wire.offset - log.rules[name][3]) < _ZERO
        and not wire.less
        for name, wire in found.wires.items()
    )
    return {
        "wrong": list(log.wrong),
        "wires_right": right,
        "delay_error": abs(found.delay - log.shift),
        "right": right and abs(found.delay - log.shift) < _LATE,
        "alarm": any(f.level == "wrong" for f in found.flags),
        "seconds": seconds,
    }


def interval(hits: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of Clopper and Pearson for a share."""
    low = float(beta.ppf(0.025, hits, count - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, count - hits)) if hits < count else 1.0
    return low, high


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Judge the logs; the first half was tuned on."""
    count = QUICK if quick else COUNT
    rows = {
        (seed, clean): cases.get(
            f"{'clean' if clean else 'wrong'} {seed}", lambda s=seed, c=clean: judge(s, clean=c)
        )
        for seed in range(count)
        for clean in (False, True)
    }
    figures: dict[str, object] = {}
    for half, seeds in (("tuned_on", range(count // 2)), ("", range(count // 2, count))):
        wrong = [rows[s, False] for s in seeds]
        clean = [rows[s, True] for s in seeds]
        named = sum(bool(r["right"]) for r in wrong)
        alarms = sum(bool(r["alarm"]) for r in clean)
        prefix = f"{half}_" if half else ""
        figures |= {
            f"{prefix}logs": len(wrong),
            f"{prefix}named_right": named / len(wrong),
            f"{prefix}named_right_interval": interval(named, len(wrong)),
            f"{prefix}false_alarms": alarms,
            f"{prefix}false_alarm_interval": interval(alarms, len(clean)),
        }
    errors = [1e3 * float(r["delay_error"]) for r in rows.values()]
    figures["delay_error_p95_ms"] = float(np.percentile(errors, 95))
    figures["seconds_median"] = float(np.median([float(r["seconds"]) for r in rows.values()]))
    figures["seconds_worst"] = max(float(r["seconds"]) for r in rows.values())
    return figures


if __name__ == "__main__":
    benchmark("check", run)
