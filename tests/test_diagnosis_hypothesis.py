"""Hypotheses as edits and parts."""

import numpy as np
from effect_machines import case

from bo_sysid.diagnosis.hypothesis import Hypothesis, candidates, edits_and_parts
from bo_sysid.effects import CATALOGUE, Force, Reading


def test_each_part_comes_once_however_often_a_model_is_edited() -> None:
    # dm-control's cheetah uses settotalmass: an edit that moves no mass is applied twice
    c = case("cheetah")
    effects = [CATALOGUE[i] for i in ("asymmetric_damping", "encoder_scale")]
    found = candidates(effects, c.machine)
    force = next(f for f in found if f.effect.id == "asymmetric_damping")
    scale = next(f for f in found if f.effect.id == "encoder_scale")
    hypothesis = Hypothesis((force, scale), (force.probe, np.array([0.1])))
    edits, parts = edits_and_parts(hypothesis, c.machine)
    for _ in range(2):
        c.model.compile(edits)
        assert [type(p) for p in parts] == [Force, Reading, Reading]
