"""How often the diagnosis is right, and how well its repaired models forecast.

Cases are drawn with fixed seeds (`diagnosis_cases.py`): the nominal model with effects in it,
stepped at 50 µs, seen through noisy joint positions. Each figure is a share,
the number of its cases and its 95 % interval; "singles", "pairs" and "logs" (singles in logs of
50 to 1000 Hz, one of them uneven) count sizes from 2 sigma up, "contact" (dm-control's cheetah and
hopper) from 3 sigma up, "geared" a six-joint arm that lacks friction, damping and rotors at all
joints, as a URDF does, "masses" the same where the links' masses are off by up to a fifth and
parameters of the study, "load" a load anywhere about a body, "unknown" what the training recordings
show at all. Cases are computed in parallel, one thread each. BO_SYSID_SUITES=unknown,pair computes
no other suites; figures are made of all cases that are there.
"""

import os
from collections.abc import Sequence

import numpy as np
from common import Cases, benchmark
from diagnosis_judge import computed, plan
from scipy.stats import binomtest

from bo_sysid.execution import map_jobs

_SHOWN = 1.02  # [sigma] that a nominal model leaves of recordings that show something


def summary(rows: list[dict]) -> dict[str, object]:
    """Return the figures of the acceptance, with their numbers of cases."""

    def share(chosen: list[dict], value) -> list[float | None]:
        return _share([bool(value(r)) for r in chosen])

    of = lambda *suites: [r for r in rows if r["suite"] in suites]  # noqa: E731
    seen = lambda rs: [r for r in rs if r["smallest"] >= 2]  # noqa: E731
    strange = [r for r in of("unknown") if r["nominal_rms"] > _SHOWN]
    good = lambda r: r["forecasts"]["0.08"][1] <= 1.15 * r["forecasts"]["0.08"][2]  # noqa: E731
    longer = lambda r: r["forecasts"]["0.3"][1] <= 1.15 * r["forecasts"]["0.3"][2]  # noqa: E731
    right = lambda r: r["class"] and not r["flagged"]  # noqa: E731
    none = lambda r: not r["found"] and not r["flagged"]  # noqa: E731
    inside = [i for r in of("single", "pair") for i in r["inside"]]
    closed = lambda r: _closed(r["forecasts"]["0.08"]) >= 0.8  # noqa: E731
    return {
        "singles": share(seen(of("single")), right),
        "pairs": share(seen(of("pair")), right),
        "nothing": share(of("nothing"), none),
        "nothing_off": share(of("off"), none),
        "unknown_flagged": share(strange, lambda r: r["flagged"]),
        "unknown_located": share(strange, lambda r: r["site"] == r["planted"].get("site")),
        "unknown_closed": share(strange, closed),
        "unknown_named": share(strange, lambda r: bool(r["found"]) and not r["flagged"]),
        "groups": share(of("group"), lambda r: r["right"]),
        "groups_within_10": share(of("group"), _near),
        "geared": share(of("geared"), lambda r: r["right"] and not r["flagged"]),
        "geared_within_10": share(of("geared"), _near),
        "masses": share(of("masses"), lambda r: r["right"] and not r["flagged"]),
        "masses_within_10": share(of("masses"), _near),
        "loads": share(seen(of("load")), right),
        "loads_place_inside_95": _share([i for r in of("load") for i in r["place_inside"]]),
        "noisy": share([r for r in of("noisy") if r["truth"]], right),
        "noisy_nothing": share([r for r in of("noisy") if not r["truth"]], none),
        "noisy_inside_95": _share([i for r in of("noisy") for i in r["inside"]]),
        "forecast_noisy_80ms": share(of("noisy"), good),
        "inside_95": _share(inside),
        "forecast_80ms": share(of("single", "pair"), good),
        "forecast_300ms": share(of("single", "pair"), longer),
        "logs": share(seen(of("log")), right),
        "forecast_logs_80ms": share(of("log"), good),
        "contact": share(of("contact"), right),
        "contact_nothing": share(of("contact_nothing"), none),
        "forecast_lugre_80ms": share(of("lugre"), good),
        "lugre_right": share(of("lugre"), right),
        "cpu_median_s": round(float(np.median([r["cpu"] for r in rows])), 1) if rows else None,
    }


def _share(marks: Sequence[bool]) -> list[float | None]:
    """Return a share, its number of cases and its 95 % interval (Clopper and Pearson)."""
    if not marks:
        return [None, 0, None, None]
    found = binomtest(sum(marks), len(marks))
    low, high = found.proportion_ci()
    return [round(found.statistic, 4), len(marks), round(low, 3), round(high, 3)]


def _near(row: dict) -> bool:
    """Whether every planted magnitude was found within 10 %."""
    found = {(e, s): x for e, s, x in row["found"]}
    return all(abs(found.get((e, s), np.inf) / x - 1) < 0.1 for e, s, x, _ in row["truth"])


def _closed(errors: list[float]) -> float:
    nominal, repaired, floor = errors
    return (nominal - repaired) / max(nominal - floor, 1e-9)


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Diagnose every case that is not there yet; return the figures."""
    jobs = {f"{j[0]} {j[1][0]} {j[2]} {j[3]}".strip(): j for j in plan(quick)}
    if not cases.stored:
        waiting = {key: job for key, job in jobs.items() if key not in cases and _wanted(job[0])}
        for outcome in map_jobs(computed, waiting):
            if outcome.error is not None:
                print(f"    {outcome.key} failed: {outcome.error}", flush=True)
                continue
            _told(cases.get(outcome.key, lambda found=outcome.result: found))
    rows = [cases.get(key, dict) for key in jobs if key in cases]
    return summary([r for r in rows if r is not None])


def _wanted(suite: str) -> bool:
    chosen = os.environ.get("BO_SYSID_SUITES")
    return chosen is None or suite in chosen.split(",")


def _told(row: dict | None) -> None:
    if row is not None and not row["class"]:
        print(f"    planted {row['truth'] or row['planted']}, found {row['found']}", flush=True)


if __name__ == "__main__":
    benchmark("diagnosis", run, partial=True)
