"""What the findings leave unexplained, in words."""

from dataclasses import dataclass

from bo_sysid.diagnosis.answer.wording import spoken
from bo_sysid.diagnosis.unexplained.unknown import Unknown
from bo_sysid.diagnosis.windows.forecast import LONGER
from bo_sysid.effects import Site

_WORDS = {
    "position": "where the joint is",
    "speed": "how fast it moves",
    "control": "what is commanded",
    "load": "the torque it carries",
    "time": "the time since the recording began",
    "other_joint": "where another joint is",
}


@dataclass(frozen=True)
class Unexplained:
    """What the findings leave unexplained.

    Attributes:
        share: of what the nominal model left unexplained.
        kind: kind of site where it sits, None where nothing is flagged.
        site: name of the site.
        depends_on: what it depends on: position, speed, control, load, time, other_joint.
        learned: whether a learned law stands for it, if it is known what it depends on.
        much: whether far more is left than a law at one joint explains.
        sought: whether there is a hinge or slide at which a law could act.
        longer: what longer windows leave in [sigma], where those of the search show nothing.
    """

    share: float = 0.0
    kind: str | None = None
    site: str | None = None
    depends_on: tuple[str, ...] = ()
    learned: bool = True
    much: bool = False
    sought: bool = True
    longer: float = 0.0

    @property
    def flagged(self) -> bool:
        """Whether something stays unexplained that is more than noise."""
        return self.kind is not None

    @property
    def sentences(self) -> tuple[str, ...]:
        """The same in words."""
        if self.site is None:
            return ()
        if self.longer:
            return (
                "Something is missing that the short windows of this diagnosis do not show: "
                f"nothing is left in them, and {self.longer:.3g} sensor sigmas in windows of "
                f"{LONGER:g} s. Positions that were not recorded, if there are any, follow "
                "anything for so short a time: record them, or hold the base.",
            )
        where = spoken(Site("world" if self.kind == "world" else "joint", self.site))
        text = f"Something acts on {where} that no known effect explains"
        if self.depends_on:
            text += f"; it depends on {' and '.join(_WORDS[d] for d in self.depends_on)}"
        elif self.much:
            text += (
                ". No force law at one joint explains most of it: more effects may be missing at "
                "once than were looked for (diagnosis: {most: …})"
            )
        elif not self.sought:
            text += ". Force laws are looked for at hinges and slides alone, and there is none"
        else:
            text += (
                ". No force law of position, speed, command, load or time predicts it, as is so of "
                "disturbances and of noise in recorded commands"
            )
        stands = "Nothing stands for it"
        if self.learned and (self.depends_on or self.much):
            stands = f"A learned force law stands for {'a part of ' if self.much else ''}it"
        return (f"{text}. {stands} in the repaired model.",)


def unexplained_of(unknown: Unknown) -> Unexplained:
    """Return what an examination amounts to."""
    if not unknown.flagged:
        return Unexplained(unknown.share)
    if unknown.law is None:
        return Unexplained(unknown.share, "world", "world", ())
    if not unknown.law.tells:
        return Unexplained(unknown.share, "world", "world", (), much=True)
    return Unexplained(unknown.share, "joint", unknown.law.joint, unknown.law.depends_on)
