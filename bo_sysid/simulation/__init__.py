"""Models x starts x controls to predictions at the recorded instants."""

from bo_sysid.simulation.lockstep import Controller, ForceLaw, Law, LawInputs
from bo_sysid.simulation.rollout import Engine
from bo_sysid.simulation.state import State, Trajectory, tangent_difference

__all__ = [
    "Controller",
    "Engine",
    "ForceLaw",
    "Law",
    "LawInputs",
    "State",
    "Trajectory",
    "tangent_difference",
]
