"""Recordings cut into the windows of a diagnosis."""

from collections.abc import Mapping, Sequence

import numpy as np

from bo_sysid.deviation.measure import blocks_of
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.channel_noise import noise_of
from bo_sysid.diagnosis.windows.compared import at_positions
from bo_sysid.diagnosis.windows.kept_fits import NO_CACHE, FitCache
from bo_sysid.diagnosis.windows.problem import BLOCKS, Problem
from bo_sysid.effects import Machine
from bo_sysid.effects.learned import ELAPSED
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Controller, Engine, ForceLaw
from bo_sysid.simulation.cutting import cut
from bo_sysid.simulation.windows import Layout


def cut_problem(
    model: Model,
    machine: Machine,
    recordings: Sequence[Recording],
    sigma: dict[str, float],
    nuisances: Sequence[Candidate],
    *,
    horizon: int | Sequence[int],
    lead: Sequence[int] | None = None,
    keep_every: int = 1,
    timestep: float | None = None,
    engine: Engine,
    laws: Sequence[Controller | ForceLaw] = (),
    kept: FitCache = NO_CACHE,
    input_noise: Mapping[str, float] | None = None,
) -> Problem:
    """Cut recordings into windows.

    Args:
        model: the nominal model.
        machine: the scales of its sites.
        recordings: to cut.
        sigma: noise of each observed channel; others are not observed.
        nuisances: the study's parameters.
        horizon: instants in a window, of observed channels and positions; one number for all
            recordings, or one for each.
        lead: instants of each recording before those, from where its windows begin on; what they
            show is compared in the window before.
        keep_every: keep each so-many-th of the disjoint windows.
        timestep: of the simulation in [s]; by default the model's.
        engine: simulates.
        laws: controllers and force laws that belong to the nominal model.
        kept: long fits of a diagnosis that was killed.
        input_noise: σ of what recorded controls show and the machine did not get, by actuator.
    """
    each = [horizon] * len(recordings) if isinstance(horizon, int) else horizon
    before = np.array(lead or [0] * len(recordings))
    windows = cut(
        model,
        at_positions(model, recordings, sigma),
        horizon=[h + int(b) for h, b in zip(each, before, strict=True)],
        stride=each,
        timestep=timestep,
        signals=(*machine.inputs, ELAPSED),
        controlled=[w.actuator for w in laws if isinstance(w, Controller)],
    )
    windows = windows.rows(np.arange(0, len(windows), keep_every)).among(sigma)
    recorded = {n.removeprefix("qpos.") for n in windows.channels}
    compared = np.arange(windows.observed.shape[1]) >= before[windows.recording, None]
    seen = np.isfinite(windows.observed) & compared[..., None]
    weight = seen / noise_of(windows, recordings, sigma)
    return Problem(
        model=model,
        machine=machine,
        recordings=tuple(recordings),
        windows=windows,
        layout=Layout.of(model, machine.model),
        weight=weight,
        block=blocks_of(windows.recording, BLOCKS)[0],
        nuisances=tuple(nuisances),
        correction=None,
        engine=engine,
        laws=tuple(laws),
        loops=model.loops.released(model.loops.yielding & recorded),
        kept=kept,
        input_noise=input_noise or {},
    )
