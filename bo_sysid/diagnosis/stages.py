"""How far a diagnosis is."""

from bo_sysid.execution import OnProgress, Progress

_STAGES = 4  # short windows, long ones, the final fits, what is said; or more
# of the work that is done by the ends of the first ones
_SHARES, _SHARES_IN_CONTACT = (0.03, 0.4, 0.5), (0.02, 0.1, 0.15)


class Stages:
    """Counts the stages of a diagnosis for its progress.

    Args:
        report: is called at each.
        contact: whether the machine touches anything, where the first stages are a smaller share.
    """

    def __init__(self, report: OnProgress, *, contact: bool) -> None:
        self._report, self._done = report, 0
        self._shares = _SHARES_IN_CONTACT if contact else _SHARES

    def __call__(self, text: str) -> None:
        """Say that one more stage is done."""
        self._done += 1
        share = self._shares[min(self._done, len(self._shares)) - 1]
        self._report(Progress(self._done, max(_STAGES, self._done + 1), text, share=share))

    def warn(self, text: str) -> None:
        """Say something before the first stage."""
        self._report(Progress(0, _STAGES, text))

    def doing(self, text: str) -> None:
        """Say how far a stage is."""
        self._report(Progress(self._done, max(_STAGES, self._done + 1), text, passing=True))

    def finished(self, text: str) -> None:
        """Say what was found."""
        done = max(_STAGES, self._done + 1)
        self._report(Progress(done, done, text))
