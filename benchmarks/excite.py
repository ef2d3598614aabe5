"""How much more does a planned trajectory tell than random tones?

Machines with limits on position, speed and effort; 8 s, samples and controls every 10 ms, 1 mrad
(mm) of noise. Unknown are masses within 20 %, damping from nothing to twice the model's and the
stiffness of springs within 20 % ("machine"), and for three machines what a joint may lack as well:
dry friction, damping, armature ("effects").

The rival is a random-phase multisine: all lines k / T in a band, of equal amplitude, actuators
moving by the same share of their ranges, as large as the limits of the nominal machine and 24 drawn
ones allow. Its band is 0.1 to 10 Hz ("full"), which says nothing about the machine; 0.2 to 2.5 Hz
("low"), where machines of this size move; or all lines up to half the sampling rate ("white").
Plans have its length, its limits and no more than the median energy of the full band; the other
two bands have what energy the limits allow them.

Figures are the widest predicted interval of a rival (median over seeds) over that of a plan (median
over seeds of the search; lowest and highest beside it), and by how much any of 25 machines within
the parameters' bounds exceeds a limit, at the model's own step.
"""

import time
from functools import partial

import numpy as np
from common import Cases, benchmark
from multisine import multisines
from wrong_logs import MODELS

from bo_sysid.excite.design import design
from bo_sysid.excite.limits import Limits
from bo_sysid.excite.trial import Trial
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.study.outer import Limit

RANDOM, PLANS, BUDGET, QUICK = 9, 2, 2400, 240
BANDS = {"full": (0.1, 10.0), "low": (0.2, 2.5), "white": (0.0, 49.9)}
_HEAD = """<option timestep="0.002" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="0"/></default>"""
DRIVE = f"""<mujoco model="two-mass drive">{_HEAD}<worldbody><body>
<joint name="motor" axis="0 0 1" damping="0.01"/>
<geom name="motor" type="cylinder" size="0.1 0.02" mass="2"/><body>
<joint name="shaft" axis="0 0 1" stiffness="7" damping="0.004"/>
<geom name="load" type="cylinder" size="0.1 0.04" mass="4"/>
</body></body></worldbody>
<actuator><motor name="motor" joint="motor" gear="2"/></actuator></mujoco>"""
FLEXIBLE = f"""<mujoco model="arm with a flexible joint">{_HEAD}<worldbody><body>
<joint name="rotor" axis="0 1 0" damping="0.2"/>
<geom name="rotor" type="cylinder" size="0.08 0.02" euler="90 0 0" mass="3"/><body>
<joint name="spring" axis="0 1 0" stiffness="30" damping="0.02"/>
<geom name="link" type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="1"/>
</body></body></worldbody>
<actuator><motor name="motor" joint="rotor" gear="5"/></actuator></mujoco>"""
CRANE = f"""<mujoco model="crane">{_HEAD}<worldbody><body>
<joint name="trolley" type="slide" axis="1 0 0" damping="1"/>
<geom name="trolley" type="box" size=".1 .1 .05" mass="4"/><body>
<joint name="swing" axis="0 1 0" damping="0.01"/>
<geom name="load" type="sphere" pos="0 0 -.8" size=".05" mass="1"/>
</body></body></worldbody>
<actuator><motor name="trolley" joint="trolley" gear="20"/></actuator></mujoco>"""
BARE = {"two_mass_drive": DRIVE, "flexible_joint": FLEXIBLE, "crane": CRANE}
MACHINES = {
    "two_link_arm": ("upper forearm", {"shoulder": (1.5, 8, 3), "elbow": (2, 10, 3)}),
    "cart_pole": ("cart pole", {"slider": (0.8, 3, 10), "hinge": (1.2, 10, 1)}),
    "rotary_pendulum": ("arm pendulum", {"arm": (1.5, 8, 0.1), "pendulum": (1.5, 15, 1)}),
    "two_mass_drive": ("motor load", {"motor": (2, 10, 1.5), "shaft": (0.3, 20, 3)}),
    "flexible_joint": ("rotor link", {"rotor": (2, 10, 5), "spring": (0.3, 20, 9)}),
    "crane": ("trolley load", {"trolley": (0.6, 2, 20), "swing": (0.6, 3, 9)}),
    "six_joint_arm_servos": (
        "shoulder_link elbow_link roll_link pitch_link flange_link",
        {
            "base": (2, 8, 40), "shoulder": (1.2, 6, 120), "elbow": (2, 8, 60),
            "roll": (2.5, 12, 18), "pitch": (1.8, 12, 12), "flange": (3, 15, 4),
        },
    ),
}  # fmt: skip
EFFECTS = {"two_link_arm": "forearm", "cart_pole": "pole", "rotary_pendulum": "pendulum"}


def machine(name: str, effects: bool) -> Trial:
    """Return what judges trajectories of a machine."""
    text = BARE.get(name)
    model = Model.from_xml(text) if text else Model.from_file(MODELS / f"{name}.xml")
    links, bounds = MACHINES[name]
    parameters = _lacking(model, EFFECTS[name]) if effects else _own(model, links.split())
    limits = {
        joint: Limit(position=(-q, q), velocity=v, effort=e) for joint, (q, v, e) in bounds.items()
    }
    noise = dict.fromkeys(model.qpos_channels, 1e-3)
    return Trial(model, parameters, Limits.of(model, limits), noise, seconds=8.0, interval=0.01)


def _mass(link: str) -> Parameter:
    return Parameter(f"{link} mass", (f"geom[{link}].mass",), 0.8, 1.2, apply="scale")


def _own(model: Model, links: list[str]) -> list[Parameter]:
    """Return masses, damping, and stiffness where there is any."""
    compiled = model.compile()
    parameters = [_mass(link) for link in links]
    for j, joint in enumerate(model.joints):
        own = {"damping": compiled.dof_damping[j], "stiffness": compiled.jnt_stiffness[j]}
        for what, low, high in (("damping", 0.0, 2.0), ("stiffness", 0.8, 1.2)):
            value = float(own[what])
            if value > 0:
                address = f"joint[{joint}].{what}"
                parameters.append(Parameter(address, (address,), low * value, high * value))
    return parameters


def _lacking(model: Model, link: str) -> list[Parameter]:
    """Return a mass, and what joints may lack in units of their inertia."""
    compiled = model.compile()
    parameters = [_mass(link)]
    for j, joint in enumerate(model.joints):
        inertia = float(compiled.dof_M0[j])
        for what, high in (("frictionloss", 0.5), ("damping", 0.5), ("armature", 0.2)):
            address = f"joint[{joint}].{what}"
            parameters.append(Parameter(address, (address,), 0.0, high * inertia, apply="add"))
    return parameters


def compare(name: str, effects: bool, budget: int, plans: int) -> dict[str, object]:
    """Return the widest intervals of random tones and of plans."""
    d = machine(name, effects)
    tones = {b: multisines(d, RANDOM, 1_000, band) for b, band in BANDS.items()}
    rivals = {b: [_widest(d, u)[0] for u in us] for b, us in tones.items()}
    energy = float(np.median(d.energy(tones["full"])))
    started = time.perf_counter()
    planned = [design(d, budget, seed, energy=energy) for seed in range(plans)]
    seconds = (time.perf_counter() - started) / plans
    told = [_widest(d, u) for u in planned]
    return {
        "plan": [w for w, _ in told],
        **rivals,
        "weakest": sorted({n for _, n in told}),
        "weakest_of_full": _widest(d, tones["full"][0])[1],
        "energy_ratio": [float(d.energy(u)) / energy for u in planned],
        "exceeded": max(d.violation(u, d.machines, 1.0) for u in planned),
        "seconds": seconds,
    }


def _widest(d: Trial, controls: np.ndarray) -> tuple[float, str]:
    """Return the widest interval, in units of its range, and whose it is."""
    sigma = d.information(controls).sigma
    worst = int(np.argmax(sigma))
    return float(sigma[worst]), d.parameters[worst].name


def figures(row: dict[str, object]) -> dict[str, object]:
    """Return the gains of a case: the median, and those of the worst and the best plan."""
    plan = np.array(row["plan"])
    gains = {
        b: [
            round(float(np.median(row[b]) / p), 2)
            for p in (np.median(plan), plan.max(), plan.min())
        ]
        for b in BANDS
    }
    spread = {f"{b}_spread": [min(row[b]), max(row[b])] for b in BANDS}
    medians = {b: float(np.median(row[b])) for b in BANDS}
    rest = ("weakest", "weakest_of_full", "energy_ratio", "exceeded", "seconds")
    return {
        **{f"gain_{b}": g for b, g in gains.items()},
        "plan": float(np.median(plan)),
        **medians,
        **spread,
        **{k: row[k] for k in rest},
    }


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Compare on every machine."""
    budget, plans = (QUICK, 1) if quick else (BUDGET, PLANS)
    todo = [(n, False) for n in MACHINES] + [(n, True) for n in EFFECTS]
    todo.sort(key=lambda t: t[0].startswith("six"))  # what takes longest is last
    rows = {}
    for name, effects in todo:
        key = f"{name} {'effects' if effects else 'machine'}"
        if cases.stored and f"{key} {budget} {plans}" not in cases:
            continue
        job = partial(compare, name, effects, budget, plans)
        rows[key] = figures(cases.get(f"{key} {budget} {plans}", job))
    return {
        "gains_full_band": {k: r["gain_full"][0] for k, r in rows.items()},
        "gains_low_band": {k: r["gain_low"][0] for k, r in rows.items()},
        "gains_white": {k: r["gain_white"][0] for k, r in rows.items()},
        "exceeded": max(r["exceeded"] for r in rows.values()),
        "rows": rows,
    }


if __name__ == "__main__":
    benchmark("excite", run, partial=True)
