"""How much more does a planned trajectory tell than random tones?

Three machines, each with limits on position, speed and effort. The rival is a random multisine in
the same band, as large as the same limits allow; the plan has its length and no more than its
energy. Figures are the widest predicted interval of the rival (median over seeds) over that of the
plan, and whether any of 24 machines within the parameters' bounds exceeds a limit.
"""

import numpy as np
from common import Cases, benchmark
from wrong_logs import MODELS

from bo_sysid.excite.excite import Designer
from bo_sysid.excite.limits import Limits
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.study.outer import Limit

RANDOM, BUDGET, QUICK = 9, 600, 60
MACHINES = {
    "two_link_arm": ("geom[forearm].mass", {"shoulder": (1.5, 8, 3), "elbow": (2, 10, 3)}),
    "cart_pole": ("geom[pole].mass", {"slider": (0.8, 3, 10), "hinge": (1.2, 10, 1)}),
    "rotary_pendulum": ("geom[pendulum].mass", {"arm": (1.5, 8, 0.1), "pendulum": (1.5, 15, 1)}),
}


def designer(name: str) -> Designer:
    """Return what judges trajectories of a machine: a mass, and what its joints may lack."""
    model = Model.from_file(MODELS / f"{name}.xml")
    compiled = model.compile()
    mass, bounds = MACHINES[name]
    parameters = [Parameter("mass", (mass,), 0.8, 1.2, apply="scale")]
    for j, joint in enumerate(model.joints):
        inertia = float(compiled.dof_M0[j])
        for what, high in (("frictionloss", 0.5), ("damping", 0.5), ("armature", 0.2)):
            address = f"joint[{joint}].{what}"
            parameters.append(Parameter(address, (address,), 0.0, high * inertia, apply="add"))
    limits = {
        joint: Limit(position=(-q, q), velocity=v, effort=e) for joint, (q, v, e) in bounds.items()
    }
    noise = dict.fromkeys(model.qpos_channels, 1e-3)
    return Designer(model, parameters, Limits.of(model, limits), noise, seconds=8.0, interval=0.01)


def compare(name: str, budget: int) -> dict[str, float]:
    """Return the widest intervals of random tones and of the plan."""
    d = designer(name)
    random = [d.safe(d.random(1_000 + k)) for k in range(RANDOM)]
    widest = [float(d.information(u).sigma.max()) for u in random]
    energy = float(np.median([d.energy(u) for u in random]))
    plan = d.design(budget, 0, energy=energy)
    machines = np.vstack([d.point[None], d.draws[:24]])
    return {
        "random": float(np.median(widest)),
        "random_best": min(widest),
        "plan": float(d.information(plan).sigma.max()),
        "energy_ratio": d.energy(plan) / energy,
        "exceeded": d.violation(plan, machines, 1.0),
    }


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Compare on every machine."""
    budget = QUICK if quick else BUDGET
    rows = {n: cases.get(f"{n} {budget}", lambda n=n: compare(n, budget)) for n in MACHINES}
    return {
        **{f"{n}_gain": r["random"] / r["plan"] for n, r in rows.items()},
        "least_gain": min(r["random"] / r["plan"] for r in rows.values()),
        "exceeded": max(r["exceeded"] for r in rows.values()),
        "rows": rows,
    }


if __name__ == "__main__":
    benchmark("excite", run)
