"""Sets of which a motor that is late and a small effect at its joint may be a gap in the gear."""

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.effects import Machine, Site

LATE = ("actuator_lag", "actuator_delay")
_SMALL = 0.15  # of a motor's lag: another effect at its joint no larger than that may mean a gap


def backlash_suspects(best: Fit, machine: Machine) -> tuple[str, ...]:
    """Return the joints whose motor is late beside another effect there that is small.

    A gap in the gear is crossed at every reversal, which makes a joint late; what it does beside
    that is little, and looks like one more effect.
    """
    sizes: dict[str, list[tuple[bool, float]]] = {}
    for c, size in zip(best.members, best.unique, strict=True):
        late = c.effect.id in LATE
        for name in joints_at(c.site, machine):
            sizes.setdefault(name, []).append((late, size))
    found = []
    for name, there in sizes.items():
        lags = [size for late, size in there if late]
        others = [size for late, size in there if not late]
        if lags and others and max(others) < _SMALL * max(lags):
            found.append(name)
    return tuple(found)


def joints_at(site: Site, machine: Machine) -> list[str]:
    """Return the joint on which a site acts, or those by which a body moves."""
    if site.kind == "body":
        model, body = machine.model, machine.model.body(site.name)
        own = range(int(body.jntadr[0]), int(body.jntadr[0] + body.jntnum[0]))
        return [model.joint(j).name for j in own]
    joint = machine.joint_of(site.kind, site.name)
    return [] if joint is None else [joint.name]
