"""The last simulations, which fits, line searches and linear models ask for again."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.kept_fits import digest
from bo_sysid.simulation import State

_MOST = 8  # that are held
T = TypeVar("T")


class Recent(Generic[T]):
    """Results of the last few simulations, by what they were made from.

    Of a two-link arm's diagnosis one in ten repeats one of the eight before it to the last bit.
    """

    def __init__(self) -> None:
        self._found: OrderedDict[str, tuple[Hypothesis, T]] = OrderedDict()

    def of(
        self,
        hypothesis: Hypothesis,
        start: State,
        inputs: tuple[object, ...],
        make: Callable[[], T],
    ) -> T:
        """Return what a hypothesis does from these starts, or simulate it.

        Args:
            hypothesis: what is simulated; `numerics` is no part of that.
            start: the starts of the windows.
            inputs: what else the simulation hangs on: numbers, text, arrays, tuples of these.
            make: simulates.
        """
        *edits, _ = hypothesis.identity
        # two learned laws may look alike; the hypothesis is held, so that no id is given again
        effects = tuple(id(c.effect) for c in hypothesis.members)
        key = digest((tuple(edits), effects, tuple(start.arrays.items()), inputs))
        if key not in self._found:
            self._found[key] = hypothesis, make()
            if len(self._found) > _MOST:
                self._found.popitem(last=False)
        self._found.move_to_end(key)
        return self._found[key][1]
