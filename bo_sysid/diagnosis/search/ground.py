"""Friction of the ground in the place of friction at the joints, where a contact lasts."""

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.groups import subset
from bo_sysid.diagnosis.sets.refit import FINAL
from bo_sysid.mjcf.touching import can_touch, joints_to_contact

_GROUND = "contact_friction"


def slide(search: Search, leader: Fit) -> None:
    """Fit friction of each geom in the place of all that rubs at joints which move what touches.

    A runner that slides rubs as its joint would, under a constant load. Slopes at the one say
    little of the other: where a window sticks, neither has any.
    """
    machine = search.prepared.problem.machine
    if machine.impacts or not can_touch(machine.model):
        return
    moved = joints_to_contact(machine.model)
    rest = [
        k for k, c in enumerate(leader.members) if not (c.is_dry_friction and c.site.name in moved)
    ]
    if len(rest) == len(leader.members):
        return
    members, x = subset(leader, rest)
    grounds = {c.key: c for c in reversed(search.candidates) if c.effect.id == _GROUND}
    for key, c in grounds.items():
        if key not in {m.key for m in members}:
            search.refit(
                (*members, c), (*x, c.point[: c.size]), start=leader.start,
                guess=leader.hypothesis, effort=FINAL,
            )  # fmt: skip
