"""What the recordings that were never used say, in words and as JSON."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from bo_sysid.diagnosis.answer.wording import spoken
from bo_sysid.diagnosis.windows.forecast import AHEAD, LONGER
from bo_sysid.effects import Site

_ALIKE = 0.02  # by which two errors differ in words
_WORSE = 0.2  # of an error, by which a repair makes longer windows worse
_AT_FLOOR = 1.5  # of the floor, below which a forecast is as good as the sensors


@dataclass(frozen=True)
class Holdout:
    """Errors on the hold-out.

    Attributes:
        table: columns measure, horizon_s, model, error, unit; one row each.
        free_runs: free-run error by channel for each model.
        traces: what was recorded and what the models forecast, over the longest horizon.
        note: why some of it is not there, where that is so.
        parameters: whether the study has parameters, which `refitted` differs by.
        beyond: by joint, the share of the instants in which it is where no training recording was.
        short: names of recordings that are shorter than a forecast and what it begins from.
        rates: how it is sampled otherwise than the training recordings, in words; else empty.
        units: of the free-run errors, by channel.
    """

    table: pd.DataFrame
    free_runs: Mapping[str, Mapping[str, float]]
    traces: pd.DataFrame
    note: str = ""
    parameters: bool = True
    beyond: Mapping[str, float] = field(default_factory=dict)
    short: tuple[str, ...] = ()
    rates: str = ""
    units: Mapping[str, str] = field(default_factory=dict)

    def error(self, measure: str, horizon: float, model: str) -> float | None:
        """Return one error, None where it was not computed."""
        t = self.table
        rows = t[(t.measure == measure) & (t.horizon_s == horizon) & (t.model == model)]
        return None if rows.empty else float(rows.error.iloc[0])

    @property
    def sentences(self) -> tuple[str, ...]:
        """The proof in words."""
        before = self.error("forecast", AHEAD, "refitted")
        after = self.error("forecast", AHEAD, "repaired")
        floor = self.error("forecast", AHEAD, "noise_floor")
        if before is None or after is None or floor is None:
            return (self.note,) if self.note else ()
        nominal = self.error("forecast", AHEAD, "nominal") or before
        refitted = abs(nominal - before) > _ALIKE * before  # by parameters or the time step
        verb, first = "falls" if after < (1 - _ALIKE) * nominal else "goes", _figure(nominal)
        if refitted and after != before:
            done = "the study's parameters fitted" if self.parameters else "a finer time step"
            first += f" ({_figure(before)} with {done})"
        text = (
            f"Forecast error on the unseen recording {verb} from {first} to "
            f"{_figure(after)} sensor sigmas; the noise floor is {_figure(floor)}."
        )
        if after > _AT_FLOOR * floor and self.rates:
            conclusion = f"{self.rates} What is left may be that: record both at one rate."
        elif after > max((1 + _ALIKE) * min(before, nominal), _AT_FLOOR * floor):
            conclusion = "The unseen recording does not confirm the repair."
        elif after > _AT_FLOOR * floor:
            conclusion = (
                "The floor is not reached: these recordings do not show all that is missing."
            )
        elif longer := self._longer:
            conclusion = longer
        else:
            return (text,)
        return (text, conclusion, *self._elsewhere)

    @property
    def _longer(self) -> str:
        """What longer windows say against the repair, in words; empty where they say nothing."""
        missed = ""
        for measure, does in (("fit", "follows"), ("forecast", "forecasts")):
            models = ("refitted", "repaired", "noise_floor")
            errors = [self.error(measure, LONGER, m) for m in models]
            if None in errors:
                continue
            before, after, floor = (float(e or 0.0) for e in errors)
            if after > max((1 + _WORSE) * before, _AT_FLOOR * floor):
                return (
                    f"Over {LONGER:g} s the repaired model {does} the unseen recording worse than "
                    f"without what was found ({_figure(after)} for {_figure(before)} sensor "
                    "sigmas), which does not confirm the repair."
                )
            if after > _AT_FLOOR * floor:
                missed = (
                    f"Over {LONGER:g} s {_figure(after)} sensor sigmas are left, where the floor "
                    f"is {_figure(floor)}: these recordings do not show all that is missing."
                )
        return missed

    @property
    def _elsewhere(self) -> tuple[str, ...]:
        """Where the hold-out goes and the training recordings do not, in words."""
        if not self.beyond:
            return ()
        shares = " and ".join(
            f"{spoken(Site('joint', joint))} in {share:.0%} of it"
            for joint, share in self.beyond.items()
        )
        return (f"The unseen recording goes where no training recording was: {shares}.",)

    def as_json(self) -> dict[str, Any]:
        """Return the part of `diagnosis.json` about the hold-out."""
        if self.table.empty:
            return {"forecast": {}, "fit": {}, "free_run": {}}
        out: dict[str, Any] = {}
        for measure in ("forecast", "fit"):
            rows = self.table[self.table.measure == measure]
            if rows.empty:
                out[measure] = {}
                continue
            horizon = float(rows.horizon_s.min())
            errors = rows[rows.horizon_s == horizon].set_index("model").error
            names = ("nominal", "refitted", "repaired", "learned_residual", "noise_floor")
            values = {n: _number(errors.get(n)) for n in names}
            out[measure] = {"unit": "sensor sigma", "horizon_s": horizon, **values}
        free = self.table[self.table.measure == "free_run"]
        if len(free):
            errors = free.set_index("model").error
            out["free_run"] = {
                "horizon_s": float(free.horizon_s.iloc[0]),
                "unit": str(free.unit.iloc[0]),
                **{n: _number(errors.get(n)) for n in ("nominal", "refitted", "repaired")},
                "channels": {m: dict(c) for m, c in self.free_runs.items()},
                "units": dict(self.units),
            }
        else:
            out["free_run"] = {}
        return out


def _figure(value: float) -> str:
    """Return three figures without an exponent: 14,700."""
    return f"{float(f'{value:.3g}'):,.0f}" if value >= 1000 else f"{value:.3g}"


def _number(value: Any) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
