"""The arms of a comparison, and the problems that they are compared on."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bo_sysid.errors import StudyError
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.study.source import KeyPath

_INSIDE = (0.15, 0.85)  # of the bounds, where the parameters of a drawn plant lie
_DRAW = 20_181  # separates the draw of a plant from the seeds of the search
_LONGEST = 60  # letters of a name in the names of files, of 1 to 4 bytes; systems take 255 bytes


@dataclass(frozen=True)
class Arm:
    """One way of searching.

    Attributes:
        name: unique in the comparison.
        acquisition: which candidate is tried next.
        choose: how the model for the policy is chosen from P.
        stop: rule that ends the outer loop.
        seeds: number of the paired seeds that it runs with.
    """

    name: str
    acquisition: str
    choose: str
    stop: str
    seeds: int


@dataclass(frozen=True)
class ComparedProblem:
    """A problem of a comparison.

    Attributes:
        name: unique in the comparison; names files.
        study: what is asked, on which recordings or which plant.
    """

    name: str
    study: Study

    @property
    def fresh(self) -> bool:
        """Whether every seed has recordings of its own."""
        return self.study.plant is not None

    def seeded(self, seed: int, truth: str = "drawn") -> dict[str, Any]:
        """Return the resolved study of one seed.

        Args:
            seed: draws the plant's parameters, uniform in the inner 70 % of their bounds; one
                without an order takes a value of its grid.
            truth: "stated" leaves them as the study states them.
        """
        data = self.study.resolved()
        if not self.fresh or truth == "stated":
            return data
        model = load_model(self.study)
        return {**data, "plant": _drawn(self.study, model, data["plant"], seed)}


def _drawn(study: Study, model: Model, plant: Mapping[str, Any], seed: int) -> dict[str, Any]:
    parameters = study.parameter_set(model)
    share = np.random.default_rng((_DRAW, seed)).uniform(*_INSIDE, size=len(parameters))
    values = {p.name: _value(p, u) for p, u in zip(parameters, share, strict=True)}
    return {**plant, "parameters": {**plant.get("parameters", {}), **values}}


def _value(parameter: Parameter, share: float) -> float:
    """Return the value at a share of the bounds; of categories each is as probable."""
    if parameter.ordered:
        return float(parameter.low + share * (parameter.high - parameter.low))
    low, high = _INSIDE
    row = int((share - low) / (high - low) * parameter.steps)
    return float(parameter.grid[min(row, parameter.steps - 1)])


def arms_of(study: Study) -> tuple[Arm, ...]:
    """Return the arms that a study compares; what an arm leaves open is as the study has it.

    Raises:
        StudyError: there is none, or two have one name.
    """
    settings = study.compare
    if not settings.arms:
        raise study.error(
            ("compare",),
            "names no arms; for instance arms: [argmin-entropy, greedy, random]",
        )
    found: dict[str, Arm] = {}
    for i, arm in enumerate(settings.arms):
        acquisition = arm.acquisition or study.search.acquisition
        choose, stop = arm.choose or study.learn.choose, arm.stop or study.learn.stop
        made_of = [acquisition, choose, stop] if settings.loop == "outer" else [acquisition]
        name = arm.name or ", ".join(made_of)
        if _slug(study, name, ("compare", "arms", i)) in {slug(n) for n in found}:
            raise study.error(
                ("compare", "arms", i), f"there is another arm {name!r}; name one of them"
            )
        seeds = min(arm.seeds or settings.seeds, settings.seeds)
        found[name] = Arm(name, acquisition, choose, stop, seeds)
    return tuple(found.values())


def problems_of(study: Study, *, trust_code: bool) -> tuple[ComparedProblem, ...]:
    """Return the problems of a comparison: the study itself, then those that it names.

    Args:
        study: with the key `compare`.
        trust_code: allow the studies that it names to name Python files, which run.

    Raises:
        StudyError: a study is missing or wrong, or two have one name.
    """
    problems = [ComparedProblem(_slug(study, study.name, ("name",)), study)]
    for i, pattern in enumerate(study.compare.problems or ()):
        key = ("compare", "problems", i)
        for file in study.files(pattern, key):
            other = Study.load(file, trust_code=trust_code)
            name = _slug(other, other.name, ("name",))
            if name in {p.name for p in problems}:
                raise study.error(
                    key,
                    f"{file.name} is called {other.name!r}, as another problem; give it another "
                    "name",
                )
            problems.append(ComparedProblem(name, other))
    for problem in problems:
        _require_uncertain(problem)
    return tuple(problems)


def _require_uncertain(problem: ComparedProblem) -> None:
    if not problem.study.parameters:
        raise problem.study.error(
            ("parameters",), "compare needs at least one uncertain parameter; the study has none"
        )


def remade(data: Mapping[str, Any], folder: str) -> Study:
    """Return the study of a job; its code was trusted when the job was made."""
    return Study.from_dict(data, folder, trust_code=True)


def slug(name: str) -> str:
    """Return a name as it is used in the names of files: its letters, of any script, and digits.

    Raises:
        StudyError: nothing is left of it.
    """
    made = re.sub(r"(?:[^\w.]|_)+", "-", name.lower()).strip("-.")
    if not made:
        raise StudyError(f"the name {name!r} has no letter or digit, and names files")
    if len(made) > _LONGEST:
        made = f"{made[:_LONGEST]}-{hashlib.sha256(made.encode()).hexdigest()[:8]}"
    return made


def _slug(study: Study, name: str, key: KeyPath) -> str:
    """Return `slug`, or raise with file and key where nothing is left of a name."""
    try:
        return slug(name)
    except StudyError as error:
        raise study.error(key, str(error)) from None
