"""Real machines: what the diagnosis says, what is published, and the held-out errors.

Each study in `studies/real` has a nominal model without the physics that is known to be there, and
is diagnosed from the raw files of its authors. Findings, verdict and held-out errors (forecast from
the past alone; fit with starts inside the window; in units of the sensors' sigma) are stored for
the nominal model, the best one without new physics, the repaired one and the learned residual.
Recordings are looked for under $BO_SYSID_DATA; a machine whose files are not there is skipped, and
the reason is stored.

EMPS also has the error of the force, as its authors compute it: the position is filtered (4th-order
Butterworth at 100 Hz, forwards and backwards) and differentiated; forces and regressors pass one
decimation filter (8th-order Chebyshev, forwards and backwards) and every tenth sample is kept; the
error is the norm of what remains over that of the force. The magnitudes that the diagnosis found
are compared with least squares of the same structure on the estimation file, under that filter.
"""

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from common import Cases, benchmark
from jaxtyping import Float
from scipy.signal import butter, decimate, filtfilt

from bo_sysid.diagnosis import diagnose
from bo_sysid.errors import RecordingError
from bo_sysid.recording import Recording, load_dataset
from bo_sysid.runs import Run
from bo_sysid.study import Study

STUDIES = Path(__file__).parents[1] / "studies" / "real"
RUNS = Path(__file__).parents[1] / "runs"
FORCE_PER_VOLT = 35.1507  # N/V, of the EMPS bench
CUTOFF, DECIMATION, EDGE = 100.0, 10, 50  # Hz; samples kept one of; samples left out at the ends
Findings = Mapping[tuple[str, str], float]
"""Magnitudes by effect and site."""


@dataclass(frozen=True)
class Machine:
    """A study of a real machine and what its authors publish.

    Attributes:
        study: file under `studies/real`.
        published: in words.
        overrides: of the study.
        wanted: what the findings must hold, by name.
        unwanted: effects that must not be among them.
        values: published magnitude by effect and site.
    """

    study: str
    published: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    wanted: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    unwanted: tuple[str, ...] = ()
    values: Findings = field(default_factory=dict)


_EMPS = {
    ("viscous_damping", "x"): 203.5034,
    ("dry_friction", "x"): 20.3935,
    ("constant_force", "x"): 3.1648,
}
MACHINES = {
    "emps": Machine(
        "emps_bare.yaml",
        "viscous 203.50 N s/m, Coulomb 20.39 N, a constant force of 3.16 N",
        wanted={k[0]: k for k in _EMPS},
        values=_EMPS,
    ),
    "emps_five": Machine(
        "emps_bare.yaml",
        "viscous 166.7 forwards and 240.4 N s/m backwards, Coulomb 20.14 and 20.63 N",
        {"diagnosis.most": 5},
        wanted={k: (k, "x") for k in ("viscous_damping", "dry_friction", "asymmetric_damping")},
        values={("asymmetric_damping", "x"): 166.7 - 240.4},
    ),
    "qube": Machine(
        "qube.yaml",
        "22 % more inertia of the arm, dry friction of about 0.001 N m at the arm",
        wanted={"armature": ("armature", "arm"), "dry_friction": ("dry_friction", "arm")},
        unwanted=("joint_spring",),
    ),
    "cube_toss": Machine(
        "cube_toss.yaml",
        "friction 0.18, restitution 0.125; the model has 1.0 and 0.135",
    ),
    "double_pendulum": Machine(
        "double_pendulum.yaml",
        "dry friction 0.16 and 0.12 N m, rotors of 0.0023 kg m² at each joint; a scale error of "
        "the torque of 1.2 to 1.45 is plausible",
        wanted={f"dry_friction {j}": ("dry_friction", j) for j in ("shoulder", "elbow")}
        | {f"armature {j}": ("armature", j) for j in ("shoulder", "elbow")},
    ),
    "xl330": Machine(
        "xl330_open_loop.yaml",
        "friction grows with load; models M3 to M6 of the authors; Stribeck on top",
        wanted={"load_dependent_friction": ("load_dependent_friction", "pendulum")},
    ),
}


def diagnosed(name: str, machine: Machine) -> dict[str, Any]:
    """Diagnose a machine; return the answer and what is compared, or why there is none."""
    began = time.perf_counter()
    study = Study.load(STUDIES / machine.study, machine.overrides, trust_code=True)
    try:
        folder = RUNS / f"real-{name}"
        with Run.open(folder, study.resolved(relative_to=folder), "diagnose") as run:
            found = diagnose(study, run)
    except RecordingError as error:
        return {"skipped": str(error)}
    told = found.as_json()
    holdout = told["holdout"]
    values = {(f["effect"], f["site"]): float(f["value"]) for f in told["findings"]}
    nuisances = found.frozen.outcome.repaired
    out = {
        "verdict": told["verdict"],
        "findings": [_shown(f) for f in told["findings"]],
        "published": machine.published,
        "named": {n: key in values for n, key in machine.wanted.items()},
        "not_to_be_named": {u: any(u == e for e, _ in values) for u in machine.unwanted},
        "off_published": {
            f"{e} {s}": values[e, s] / v - 1
            for (e, s), v in machine.values.items()
            if (e, s) in values
        },
        "sigma": found.frozen.evidence.sigma,
        "parameters": {
            c.site.name: float(x[0])
            for c, x in zip(nuisances.nuisances, nuisances.nuisance_x, strict=True)
        },
        "forecast": holdout["forecast"],
        "fit": holdout["fit"],
        "free_run": {k: v for k, v in holdout["free_run"].items() if k != "channels"},
        "repaired_over_refitted": _ratio(holdout["forecast"]),
        "repaired_over_refitted_fit": _ratio(holdout["fit"]),
        "left_unexplained": told["unexplained"],
        "alternatives": [_set(a) for a in told["alternatives"]],
        "equivalents": [_names(e) for f in told["findings"] for e in f["equivalents"]],
        "next_experiment": told["next_experiment"],
        "seconds": time.perf_counter() - began,
    }
    if name.startswith("emps"):
        out["force"] = force_errors(
            values, float(found.frozen.evidence.machine.model.body_mass.sum())
        )
    return out


def _shown(f: Mapping[str, Any]) -> str:
    low, high = f["interval"]
    return (
        f"{f['effect']} at {f['site']}: {f['value']:.4g} ({low:.4g} to {high:.4g}) {f['unit']}, "
        f"probability {f['probability']:.2g}"
    )


def _set(alternative: Mapping[str, Any]) -> str:
    return f"{_names(alternative['findings'])}: {alternative['probability']:.2g}"


def _names(findings: list[Mapping[str, Any]]) -> str:
    return " + ".join(f"{f['effect']} at {f['site']}" for f in findings) or "nothing"


def _ratio(errors: Mapping[str, Any]) -> float | None:
    repaired, refitted = errors.get("repaired"), errors.get("refitted")
    return repaired / refitted if repaired and refitted else None


def regressors(recording: Recording) -> tuple[dict[str, np.ndarray], Float[np.ndarray, " n"]]:
    """Return the filtered, decimated terms of the force of EMPS, and the force itself [N]."""
    time_ = recording.channels["qpos.x"].time
    dt = float(np.median(np.diff(time_)))
    b, a = butter(4, CUTOFF * 2 * dt)
    q = filtfilt(b, a, recording.channels["qpos.x"].values)
    v = np.gradient(q, dt)
    terms = {
        "mass": np.gradient(v, dt),
        "forwards": np.maximum(v, 0.0),
        "backwards": np.minimum(v, 0.0),
        "dry": np.sign(v),
        "sign of v, absolute": np.abs(np.sign(v)),
        "one": np.ones_like(v),
    }
    force = FORCE_PER_VOLT * recording.channels["ctrl.vir"].values
    kept = slice(EDGE, -EDGE)
    return {k: decimate(x[kept], DECIMATION) for k, x in terms.items()}, decimate(
        force[kept], DECIMATION
    )


def force_errors(values: Findings, mass: float) -> dict[str, Any]:
    """Return the force errors of the found magnitudes and of least squares, in per cent."""
    get: Callable[[str], float] = lambda effect: values.get((effect, "x"), 0.0)  # noqa: E731
    directed = ("asymmetric_damping", "x") in values or ("asymmetric_friction", "x") in values
    viscous, half = get("viscous_damping"), 0.5 * get("asymmetric_damping")
    found = {
        "mass": mass,
        "forwards": viscous + half,
        "backwards": viscous - half,
        "dry": get("dry_friction"),
        "sign of v, absolute": 0.5 * get("asymmetric_friction"),
        "one": -get("constant_force"),
    }
    data = load_dataset("emps")
    out: dict[str, Any] = {"magnitudes": found}
    fitted: dict[str, float] | None = None
    for part, recording in (("estimation", data.train[0]), ("pulses", data.holdout[0])):
        terms, force = regressors(recording)
        fitted = fitted or _least_squares(terms, force, directed)
        own = _least_squares(terms, force, directed)
        errors = [_error(terms, force, theta) for theta in (found, fitted, own)]
        out[part] = {
            "found": errors[0],
            "least_squares": errors[1],
            "least_squares_on_this_file": errors[2],
            "ratio": errors[0] / errors[1],
        }
    return {**out, "least_squares": fitted}


def _least_squares(
    terms: Mapping[str, np.ndarray], force: np.ndarray, directed: bool
) -> dict[str, float]:
    """Return the least-squares magnitudes of a structure; undirected: one viscous coefficient."""
    if directed:
        columns = dict(terms)
    else:
        columns = {k: terms[k] for k in ("mass", "dry", "one")}
        columns["viscous"] = terms["forwards"] + terms["backwards"]
    theta, *_ = np.linalg.lstsq(np.stack(list(columns.values()), axis=1), force, rcond=None)
    out = {k: float(x) for k, x in zip(columns, theta, strict=True)}
    if not directed:
        out["forwards"] = out["backwards"] = out.pop("viscous")
    return out


def _error(terms: Mapping[str, np.ndarray], force: np.ndarray, theta: Mapping[str, float]) -> float:
    told = sum(theta[k] * terms[k] for k in theta)
    return 100.0 * float(np.linalg.norm(force - told) / np.linalg.norm(force))


def run(quick: bool, cases: Cases) -> dict[str, Any]:
    """Diagnose every machine whose recordings are there; --quick takes EMPS alone.

    $BO_SYSID_MACHINES may name some of them, separated by commas.
    """
    if not os.environ.get("BO_SYSID_DATA"):
        print("  $BO_SYSID_DATA is not set: recordings without a public address are skipped")
    wanted = os.environ.get("BO_SYSID_MACHINES", "emps" if quick else ",".join(MACHINES)).split(",")
    chosen = {k: m for k, m in MACHINES.items() if k in wanted}
    return {
        name: cases.get(name, lambda n=name, m=machine: diagnosed(n, m))
        for name, machine in chosen.items()
    }


if __name__ == "__main__":
    benchmark("real", run)
