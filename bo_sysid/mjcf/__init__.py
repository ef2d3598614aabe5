"""MJCF models and the addresses of their parameters.

Only this package and `effects` change an `MjSpec`. A `Model` hands out copies; an `Edit` changes
one in place; `Address` names a number in it.
"""

from bo_sysid.mjcf.address import Address
from bo_sysid.mjcf.edits import (
    AddressEdit,
    ParameterLike,
    address_edit,
    below_zero,
    nominal,
    parameter_edits,
    room_for_delays,
)
from bo_sysid.mjcf.inertia import Inertial, inertial, make_explicit, scale_mass
from bo_sysid.mjcf.loops import Loops
from bo_sysid.mjcf.model import Edit, Model

__all__ = [
    "Address",
    "AddressEdit",
    "Edit",
    "Inertial",
    "Loops",
    "Model",
    "ParameterLike",
    "address_edit",
    "below_zero",
    "inertial",
    "make_explicit",
    "nominal",
    "parameter_edits",
    "room_for_delays",
    "scale_mass",
]
