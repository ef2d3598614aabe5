"""Models x starts x controls to predictions at the recorded instants."""

from bo_sysid.simulation.cutting import cut
from bo_sysid.simulation.lockstep import Controller, ForceLaw, Law, LawInputs
from bo_sysid.simulation.rollout import Engine
from bo_sysid.simulation.simulator import MujocoSimulator, Prediction, Simulator
from bo_sysid.simulation.state import State, Trajectory, tangent_difference
from bo_sysid.simulation.windows import Layout, Windows, predicted

__all__ = [
    "Controller",
    "Engine",
    "ForceLaw",
    "Law",
    "LawInputs",
    "Layout",
    "MujocoSimulator",
    "Prediction",
    "Simulator",
    "State",
    "Trajectory",
    "Windows",
    "cut",
    "predicted",
    "tangent_difference",
]
