"""An effect of a user's own that is wrong is told with its name, its file and the line."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from bo_sysid.effects import Effect, Extent, Force, Machine, Site, extent_at, survey
from bo_sysid.effects.registry import listing, load_effects
from bo_sysid.errors import StudyError
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation.lockstep import LawInputs

OWN = Path(__file__).parents[1] / "studies" / "effects" / "my_effect.py"
LAW = "        return -x[0] * near * np.tanh(v / (0.02 * joint.speed))\n"
SITE = Site("joint", "slide")
MODEL = Model.from_xml(
    '<mujoco><worldbody><body><joint name="slide" type="slide"/><geom size=".1" mass="1"/></body>'
    "</worldbody></mujoco>"
)


@pytest.fixture(scope="module")
def machine() -> Machine:
    time = np.arange(0.0, 4.0, 0.01)
    log = Recording.from_arrays(time, qpos={"slide": np.sin(3.0 * time)})
    return survey(MODEL.compile(), [log])


def motion(q: np.ndarray) -> LawInputs:
    return LawInputs(np.zeros_like(q), {"slide": q}, {"slide": np.ones_like(q)}, {}, {}, 0.002, {})


def part(machine: Machine, folder: Path, old: str = "", new: str = "") -> Force:
    """Return what the example of an effect makes, with some of its text replaced."""
    text = OWN.read_text()
    assert old in text
    (folder / "mine.py").write_text(text.replace(old, new) if old else text)
    (effect,) = load_effects(folder / "mine.py")
    (made,) = effect.parts(mujoco.MjSpec(), SITE, np.array([0.5, 0.1]), machine)
    return made


def test_a_law_that_is_right_gives_what_it_gave(machine, tmp_path: Path) -> None:
    q = np.linspace(-0.5, 0.5, 7)
    own = machine.joints["slide"]
    near = np.exp(-(((q - 0.1) / (0.06 * own.span)) ** 2))
    expected = -0.5 * near * np.tanh(1.0 / (0.02 * own.speed))
    np.testing.assert_allclose(part(machine, tmp_path).law(motion(q)), expected, rtol=1e-12)
    assert listing(load_effects(tmp_path / "mine.py"))["source"].tolist() == [
        str(tmp_path / "mine.py")
    ]
    same = part(machine, tmp_path, LAW, "        return -x[0]\n").law(
        motion(q)
    )  # one for all simulations
    np.testing.assert_array_equal(same, np.full(7, -0.5))


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ("1 / 0", r"its law fails: ZeroDivisionError: division by zero \(mine.py, line 50\)"),
        ("np.zeros(3)", r"its law fails: ValueError: .*\(3,\).*\(7,\).*mine.py"),
        ("np.nan * q", r"its law gives a force that is no finite number \(mine.py\)"),
    ],
)
def test_a_law_that_is_wrong_names_the_effect_and_the_line(machine, tmp_path, law, message) -> None:
    made = part(machine, tmp_path, LAW, f"        return {law}\n")
    with pytest.raises(StudyError, match=rf"effect 'worn_spot' at .*slide.*: {message}"):
        made.law(motion(np.linspace(-0.5, 0.5, 7)))


def test_what_a_law_makes_of_a_simulation_that_diverged_is_no_fault_of_it(
    machine, tmp_path
) -> None:
    made = part(machine, tmp_path, LAW, "        return q - q**2\n")
    q = np.array([0.5, np.nan, 1e300])
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(made.law(motion(q)), [0.25, np.nan, -np.inf])


@pytest.mark.parametrize(
    ("new", "message"),
    [
        (
            "    return 3.0\n",
            r"returns 3.0 \(mine.py\); it may return None, or one or a tuple of F",
        ),
        (
            "    return Force('slid', law)\n",
            r"\(mine.py\) returns a force at 'slid'; .* no such joint; did you mean 'slide'",
        ),
        ("    spec.joint('no').damping = 1\n", r"fails: AttributeError: .* \(mine.py, line 52\)"),
    ],
)
def test_an_effect_that_makes_nothing_that_is_known_is_refused(
    machine, tmp_path, new, message
) -> None:
    with pytest.raises(StudyError, match=rf"effect 'worn_spot' at .*slide {message}"):
        part(machine, tmp_path, "    return Force(site.name, law)\n", new)


def written(folder: Path, body: str, fields: str = "") -> Effect:
    """Return an effect whose file has a body of its function and fields of its own."""
    (folder / "mine.py").write_text(
        "from bo_sysid.effects import Component, Extent, Filter, effect\n"
        "@effect('mine', kind='joint', components=(Component('size', 'N m'),), noun='x',\n"
        "    extent=lambda site, machine: Extent((0.1,), (0.0,), (1.0,)),\n"
        f"    sentence='', evidence='', separation='', {fields})\n"
        "def mine(spec, site, x, machine):\n"
        f"    {body}\n"
    )
    (effect,) = load_effects(folder / "mine.py")
    return effect


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("c.value", r"its filter fails: AttributeError: .*'value' \(mine.py, line 6\)"),
        ("c.values", r"its filter returns array.* and no channel \(mine.py\)"),
    ],
)
def test_a_filter_that_is_wrong_names_the_effect_and_the_line(
    machine, tmp_path, change, message
) -> None:
    effect = written(tmp_path, f"return Filter('motor', lambda c, dt: {change})")
    (made,) = effect.parts(mujoco.MjSpec(), SITE, np.ones(1), machine)
    channel = Channel(np.arange(3.0), np.zeros(3))
    with pytest.raises(StudyError, match=rf"effect 'mine' at slide: {message}"):
        made.change(channel, 0.002)


@pytest.mark.parametrize(
    ("force", "message"),
    [
        ("1 / 0", r"its force fails: ZeroDivisionError: .* \(mine.py, line 4\)"),
        ("lambda motion: 1 / 0", r"its law fails: ZeroDivisionError: .* \(mine.py, line 4\)"),
    ],
)
def test_a_law_beside_an_edit_names_the_effect_and_the_line(
    machine, tmp_path, force, message
) -> None:
    effect = written(tmp_path, "pass", f"force=lambda site, x, machine: {force}")
    with pytest.raises(StudyError, match=rf"effect 'mine' at slide: {message}"):
        effect.force(SITE, np.ones(1), machine)(motion(np.zeros(7)))


@pytest.mark.parametrize(
    ("field", "what", "order"),
    [
        ("nominal", "nominal value", "site, machine"),
        ("details", "details", "x, machine, site"),
        ("absolute", "value", "x, machine, site"),
    ],
)
def test_what_is_told_of_an_effect_after_a_search_names_it_and_the_line(
    machine, tmp_path, field, what, order
) -> None:
    effect = written(tmp_path, "pass", f"{field}=lambda {order}: 1 / 0")
    given = {"site": SITE, "machine": machine, "x": np.ones(1)}
    message = rf"effect 'mine' at slide: its {what} fails: ZeroDiv.* \(mine.py, line 4\)"
    with pytest.raises(StudyError, match=message):
        getattr(effect, field)(*(given[n] for n in order.split(", ")))


def test_an_extent_that_fails_names_the_line(machine, tmp_path) -> None:
    text = OWN.read_text().replace("    joint = machine.joints[site.name]\n    probe", "    probe")
    (tmp_path / "mine.py").write_text(text)
    (effect,) = load_effects(tmp_path / "mine.py")
    with pytest.raises(StudyError, match=r"slide: its extent fails: NameE.*\(mine.py, line 18\)"):
        extent_at(effect, SITE, machine)


def test_an_extent_has_finite_probes() -> None:
    with pytest.raises(ValueError, match=r"probe \(nan,\) must be finite numbers"):
        Extent((np.nan,), (0.0,), (1.0,))


def test_an_extent_is_an_extent(machine, tmp_path: Path) -> None:
    text = OWN.read_text().replace("extent=extent,", "extent=lambda site, machine: 3.0,")
    (tmp_path / "mine.py").write_text(text)
    (effect,) = load_effects(tmp_path / "mine.py")
    with pytest.raises(StudyError, match=r"effect 'worn_spot' .*its extent is 3.0; it must be an"):
        extent_at(effect, SITE, machine)
