"""What is supposed to be missing: candidates, and how large they are."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.windows.candidate import Candidate, slices_of
from bo_sysid.effects import Machine, Part
from bo_sysid.effects.guard import as_study_error
from bo_sysid.mjcf import Edit

_AT_BOUND = 1e-6  # of a parameter's range, within which it is at its end


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Candidates with their magnitudes, and the nuisances beside them.

    Attributes:
        members: what is missing.
        x: the magnitudes of each member.
        nuisances: the study's parameters, as candidates.
        nuisance_x: their change from the nominal model.
        numerics: how much of the difference to a finer time step the recordings show.
    """

    members: tuple[Candidate, ...] = ()
    x: tuple[Float[np.ndarray, " _"], ...] = ()
    nuisances: tuple[Candidate, ...] = ()
    nuisance_x: tuple[Float[np.ndarray, " _"], ...] = ()
    numerics: float = 0.0

    @property
    def identity(self) -> tuple[object, ...]:
        """Members, parameters and magnitudes, for `FitCache`."""
        held = tuple(c.identity for c in (*self.members, *self.nuisances))
        return held, self.x, self.nuisance_x, self.numerics

    @property
    def free(self) -> bool:
        """Whether it has magnitudes or parameters."""
        return bool(self.members or self.nuisances)

    @property
    def bound(self) -> tuple[bool, ...]:
        """Whether each parameter is at one of its bounds, so that it can give way no further."""
        return tuple(
            bool(np.isclose(x, [c.low, c.high], rtol=0, atol=_AT_BOUND * (c.high - c.low)).any())
            for c, x in zip(self.nuisances, self.nuisance_x, strict=True)
        )

    @property
    def rigid(self) -> "Hypothesis":
        """The same without members that add a joint."""
        pairs = [p for p in zip(self.members, self.x, strict=True) if not p[0].effect.hidden]
        return replace(self, members=tuple(c for c, _ in pairs), x=tuple(x for _, x in pairs))

    @property
    def slices(self) -> tuple[slice, ...]:
        """Where each member, then each parameter, stands in a vector of all magnitudes."""
        return slices_of((*self.members, *self.nuisances))

    @property
    def terms(self) -> tuple[tuple[Candidate, Float[np.ndarray, " _"]], ...]:
        """Candidates with magnitudes, parameters first: their edits set what effects change."""
        pairs = zip((*self.nuisances, *self.members), (*self.nuisance_x, *self.x), strict=True)
        return tuple(pairs)


def edits_and_parts(
    hypothesis: Hypothesis, machine: Machine, *, written: Collection[Candidate] = ()
) -> tuple[list[Edit], list[Part]]:
    """Return the edits of a hypothesis; the list of parts is filled when they are applied.

    Args:
        hypothesis: what is edited in.
        machine: the scales of its sites.
        written: members that are edited as for a model file, where plain MJCF may say more than
            is simulated here.

    The edits raise `StudyError` where the function of an effect raises anything else.
    """
    parts: list[Part] = []
    made: dict[int, tuple[Part, ...]] = {}

    def edit_of(number: int, c: Candidate, x: Float[np.ndarray, " l"]) -> Edit:
        make = c.effect.write if c in written else c.effect.parts

        def edit(spec: mujoco.MjSpec) -> None:
            if c.tied and not x.any():
                c.effect.apply(spec, c.site, x, machine)
            with as_study_error(f"effect {c.effect.id!r} at {c.site}"):
                made[number] = make(spec, c.site, c.full(x), machine)  # again, if edited twice
            parts[:] = [part for k in sorted(made) for part in made[k]]

        return edit

    h = hypothesis
    own = sorted(zip(h.nuisances, h.nuisance_x, strict=True), key=lambda term: term[0].stage)
    # laws of what actuators do, and joints that close their loops, with what others changed of
    # them; the parts keep the order of the members
    members = sorted(
        enumerate(zip(h.members, h.x, strict=True)), key=lambda term: term[1][0].effect.turn
    )
    edits = [edit_of(-1, c, x) for c, x in own]
    return edits + [edit_of(k, c, x) for k, (c, x) in members], parts
