"""Every effect, at every site where it applies, on every small machine, inherits these tests."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from effect_machines import XML, case, cases, edited, predict

from bo_sysid.effects import CATALOGUE, Effect, Filter, Force, Hidden, Reading, unit_at
from bo_sysid.mjcf.compiling import differ

# every id that a study can name and its kind of site
KINDS = {
    "joint": """dry_friction viscous_damping quadratic_damping stribeck_friction
        load_dependent_friction asymmetric_friction asymmetric_damping joint_spring constant_force
        cogging armature backlash joint_compliance encoder_offset encoder_scale unknown""",
    "body": "payload link_mass com_shift link_inertia gravity_compensation",
    "world": "gravity_tilt fluid_drag wind contact_softness contact_restitution timestep",
    "geom": "contact_friction",
    "actuator": """actuator_gain servo_kp servo_kd actuator_saturation actuator_lag actuator_delay
        actuator_deadzone command_rate back_emf voltage_sag""",
    "channel": "sensor_delay sensor_offset sensor_scale sensor_sign channel_swap",
}
EFFECTS = {id: kind for kind, ids in KINDS.items() for id in ids.split()}
OWN = [e for e in CATALOGUE.values() if e.apply.__module__.startswith("bo_sysid.effects.")]
TYPES = (Force, Filter, Reading, Hidden)


def test_the_catalogue_has_every_id_at_its_kind_of_site() -> None:
    assert {e.id: e.kind for e in OWN} == EFFECTS


@pytest.mark.parametrize("effect", OWN, ids=lambda e: e.id)
class TestWords:
    def test_sentence_and_evidence(self, effect: Effect) -> None:
        more = {c.name: "0.2" for c in effect.components}
        words = {**more, "site": "the elbow", "value": "0.1 N m", "interval": "", "details": ""}
        said = effect.sentence.format_map(words)
        assert effect.discrete or "0.1 N m" in said
        assert effect.sentence[0].isupper() or effect.sentence.startswith("{site}")
        assert said.endswith(".")
        assert effect.kind == "world" or "the elbow" in said
        for text in (effect.evidence, effect.separation, effect.noun, effect.form):
            assert text
        assert not effect.evidence.endswith(".")

    def test_components(self, effect: Effect) -> None:
        assert 0 <= effect.shapes < len(effect.components)
        assert 1 <= effect.vector <= effect.linear
        assert effect.nested is None or effect.nested in CATALOGUE
        assert all(c.unit and c.name for c in effect.components)

    def test_it_applies_somewhere(self, effect: Effect) -> None:
        assert any(case(name).sites(effect) for name in cases())


@pytest.mark.parametrize("name", cases())
@pytest.mark.parametrize("effect", OWN, ids=lambda e: e.id)
class TestConformance:
    def test_bounds_probe_and_units(self, effect: Effect, name: str) -> None:
        c = case(name)
        for site in c.sites(effect):
            extent = effect.extent(site, c.machine)
            assert len(extent.probe) == len(effect.components)
            assert np.isfinite([extent.probe, extent.low, extent.high]).all()
            assert all(low <= 0 <= high for low, high in _linear(effect, extent))
            for x in [np.array(extent.probe), *c.points(effect, site)]:
                assert ((x >= extent.low) & (x <= extent.high)).all(), (site, x)
                assert np.any(x[: effect.linear])
                assert np.isfinite(effect.value(x))
                if effect.details is not None:
                    details = effect.details(x, c.machine, site)
                    assert all(np.isfinite(v) and u for v, u in details.values())
            assert unit_at(effect.unit, site, c.machine) or site.name.startswith("sensor.")
            assert np.isfinite(effect.nominal(site, c.machine))

    def test_magnitude_zero_changes_nothing_to_the_last_bit(
        self, effect: Effect, name: str
    ) -> None:
        c, nominal = case(name), _nominal(name)
        for site in c.some(effect, 1):
            for x in c.points(effect, site)[:1]:
                zero = np.where(np.arange(len(x)) < effect.linear, 0.0, x)
                for channel, values in predict(c, effect, site, zero).items():
                    np.testing.assert_array_equal(values, nominal[channel])

    def test_a_small_magnitude_changes_little(self, effect: Effect, name: str) -> None:
        if effect.discrete or effect.hidden or effect.id in SUDDEN:
            return
        c, nominal = case(name), _nominal(name)
        for site in c.some(effect):
            x = c.points(effect, site)[0]
            little = np.where(np.arange(len(x)) < effect.linear, 1e-4 * x, x)
            most = _moved(predict(c, effect, site, x), nominal)
            assert _moved(predict(c, effect, site, little), nominal) <= 0.02 * most + 1e-12, site

    def test_a_probe_moves_the_prediction_and_keeps_what_the_recording_needs(
        self, effect: Effect, name: str
    ) -> None:
        c, nominal = case(name), _nominal(name)
        moved = []
        for site in c.some(effect):
            for x in c.points(effect, site)[-1:]:
                if effect.hidden:  # of the stiffest: a loop closed behind a soft one is unstable
                    x = min((p for p in c.points(effect, site) if p[-1] == x[-1]), key=list)
                model, parts = edited(c, effect, site, x)
                hidden = [p for p in parts if isinstance(p, Hidden)]
                assert all(isinstance(p, TYPES) for p in parts)
                assert model.nu == c.machine.model.nu
                assert model.na == c.machine.model.na
                assert (model.nq, model.nv) == (
                    c.machine.model.nq + len(hidden),
                    c.machine.model.nv + len(hidden),
                )
                assert bool(hidden) == effect.hidden
                moved.append((_moved(predict(c, effect, site, x), nominal), site, x))
        assert all(np.isfinite(m) for m, *_ in moved), moved
        assert all(m > 0.0 for m, *_ in moved), moved


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize(
    ("effect", "name"),
    [*itertools.product(OWN, XML), (CATALOGUE["payload"], "cheetah")],
    ids=lambda x: getattr(x, "id", x),
)
def test_what_is_written_into_a_file_moves_the_same_in_plain_mujoco(
    effect: Effect, name: str, tmp_path: Path
) -> None:
    c = case(name)
    for site in c.some(effect, 1):
        x = c.points(effect, site)[0]
        if not differ(edited(c, effect, site, x, written=True)[0], c.machine.model):
            continue  # not in MJCF
        inside = predict(c, effect, site, x, written=True)
        outside = predict(c, effect, site, x, written=True, file=tmp_path / "model.xml")
        for channel, values in outside.items():
            scale = max(float(np.abs(values).max()), 1e-3)
            np.testing.assert_allclose(values, inside[channel], atol=2e-6 * scale)


# a ramp takes a step at least; with another time step a command may come in the next step
SUDDEN = ("command_rate", "timestep")
_CACHE: dict[str, object] = {}


def _nominal(name: str):
    if name not in _CACHE:
        _CACHE[name] = predict(case(name))
    return _CACHE[name]


def _moved(one, other) -> float:
    return max(float(np.abs(one[n] - other[n]).max()) for n in one)


def _linear(effect: Effect, extent):
    return zip(extent.low[: effect.linear], extent.high[: effect.linear], strict=True)
