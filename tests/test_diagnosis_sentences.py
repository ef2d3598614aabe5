"""What is said of an effect that the nominal model has, too."""

from dataclasses import replace

import mujoco
import numpy as np
import pandas as pd
import pytest

from bo_sysid.diagnosis.answer.findings import Finding
from bo_sysid.diagnosis.answer.quantities import details_of
from bo_sysid.diagnosis.answer.sentences import disagreements, found_sentences
from bo_sysid.diagnosis.answer.unexplained import Unexplained
from bo_sysid.diagnosis.answer.wording import sentence
from bo_sysid.diagnosis.windows.candidate import candidates
from bo_sysid.effects import CATALOGUE, Component, Extent, Machine, Site, survey
from bo_sysid.effects.contract import Effect
from bo_sysid.intervals import Quantity
from bo_sysid.recording import Recording
from bo_sysid.report.diagnosis_text import diagnosis_text, errors_table, verdict_text

PENDULUM = """<mujoco><worldbody><body name="bob" gravcomp="{gravcomp}">
<joint name="hinge" axis="0 1 0" stiffness="{stiffness}" springref="{rest}"/>
<geom name="ball" type="sphere" size=".1" pos="0 0 -1" mass="2"/>
</body></worldbody><compiler angle="radian"/></mujoco>"""


def machine(gravcomp: float = 0.0, stiffness: float = 0.0, rest: float = 0.0) -> Machine:
    text = PENDULUM.format(gravcomp=gravcomp, stiffness=stiffness, rest=rest)
    time = np.arange(0.0, 4.0, 0.01)
    model = mujoco.MjSpec.from_string(text).compile()
    return survey(model, [Recording.from_arrays(time, qpos={"hinge": np.sin(time)})])


def said(effect: str, made: Machine, change: float) -> str:
    own: Effect = CATALOGUE[effect]
    found = next(c for c in candidates([own], made))
    before = own.nominal(found.site, made)
    quantity = Quantity(change, own.unit, (change - 0.03, change + 0.03))
    return sentence(found, quantity, before, before)


def test_a_place_is_told_without_what_rounding_leaves() -> None:
    """The end of a capsule that was turned onto the x axis lies at -1e-17 in z."""
    text = """<mujoco><worldbody><body name="hand"><joint name="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .1 0 0" size=".02" mass=".3"/></body></worldbody></mujoco>"""
    time = np.arange(0.0, 4.0, 0.01)
    recorded = [Recording.from_arrays(time, qpos={"hinge": np.sin(time)})]
    made = survey(mujoco.MjSpec.from_string(text).compile(), recorded)
    assert "It is taken to lie at (0.1, 0, 0) m in the frame of the hand." in said(
        "payload", made, 0.15
    )


def test_compensation_that_a_model_has_is_told_as_what_it_is() -> None:
    assert said("gravity_compensation", machine(1.0), -0.2) == (
        "Gravity compensation at body bob is 0.80 ± 0.03, not 1 as in the model."
    )
    assert said("gravity_compensation", machine(), 0.3) == (
        "Of the weight of body bob and all it carries, 0.30 ± 0.03 is compensated."
    )


def test_a_share_of_the_load_is_said_as_a_share() -> None:
    (load,) = (CATALOGUE["load_dependent_friction"],)
    quantity = Quantity(0.25, load.unit, (0.23, 0.27))
    (found,) = (c for c in candidates([CATALOGUE["armature"]], machine()))
    like = type(found)(load, found.site, found.extent, found.point)
    assert sentence(like, quantity, 0.0, 0.0) == (
        "The hinge loses 0.25 ± 0.02 of its drive's torque to friction."
    )


@pytest.mark.parametrize(
    ("effect", "site", "words"),
    [
        ("servo_kp", Site("actuator", "y_servo"),
         "The proportional gain of the y servo differs from the model's by 630 ± 30 N/m."),
        ("servo_kd", Site("actuator", "y2"),
         "The derivative gain of actuator y2 differs from the model's by 630 ± 30 N/m."),
        ("constant_force", Site("joint", "y_axis"),
         "A constant force of 630 ± 30 N/m that the model lacks acts on the y axis."),
        ("wind", Site("world", "world"),
         "The medium moves at 630 ± 30 N/m against the model's."),
    ],
)  # fmt: skip
def test_a_site_is_said_once_and_sentences_begin_with_what_acts(
    effect: str, site: Site, words: str
) -> None:
    (like,) = candidates([CATALOGUE["armature"]], machine())
    found = type(like)(CATALOGUE[effect], site, like.extent, like.point)
    assert sentence(found, Quantity(633.0, "N/m", (599.0, 667.0)), 0.0, 0.0) == words


def test_a_medium_is_told_with_both_of_its_numbers() -> None:
    (drag,) = candidates([CATALOGUE["fluid_drag"]], machine())
    density = Quantity(20.0, "kg/m³", (-30.0, 70.0))
    viscosity = {"viscosity": Quantity(15.6, "Pa s", (15.4, 15.8))}
    assert sentence(drag, density, 0.0, 0.0, viscosity) == (
        "The machine moves in a medium denser than the model's by 20 ± 50 kg/m³, which may be "
        "nothing, and more viscous by 15.6 ± 0.2 Pa s."
    )
    water = Quantity(1000.0, "kg/m³", (990.0, 1010.0))
    viscosity = {"viscosity": Quantity(0.005, "Pa s", (-0.003, 0.013))}
    assert sentence(drag, water, 0.0, 0.0, viscosity) == (
        "The machine moves in a medium denser than the model's by 1000 ± 10 kg/m³, "
        "and more viscous by 0.005 ± 0.008 Pa s, which may be nothing."
    )


def test_a_sentence_of_ones_own_may_ask_for_any_component() -> None:
    """The value by its name, and a shape that is as it usually is."""
    own = replace(
        CATALOGUE["viscous_damping"],
        components=(Component("level", "N m"), Component("speed", "rad/s")),
        shapes=1,
        extent=lambda site, made: Extent((0.1, 2.0), (0.0, 1.0), (10.0, 3.0)),
        sentence="{site} has a drag of {level} above {speed}.",
    )
    (drag,) = candidates([own], machine())
    told = details_of(drag, np.array([1.0]), np.array([[1e-4]]), np.zeros(1), machine())
    assert sentence(drag, told["level"], 0.0, 0.0, told) == (
        "The hinge has a drag of 1.00 ± 0.02 N m above 2.000 ± 0.020 rad/s."
    )


@pytest.mark.parametrize("periods", [0.857, 77.0])
def test_an_interval_holds_its_value_also_beyond_the_bounds_of_a_shape(periods: float) -> None:
    """Finer shapes are tried beside those of the grid: .857 was told with 1 to 2.1."""
    made = machine()
    cogging = candidates([CATALOGUE["cogging"]], made)[0].with_shapes(np.array([periods]))
    told = details_of(cogging, np.array([0.1, 0.1]), 1e-6 * np.eye(2), np.array([0.05]), made)
    low, high = told["periods"].interval
    assert low <= told["periods"].value <= high


def test_a_spring_that_a_model_has_is_told_as_the_spring() -> None:
    assert said("joint_spring", machine(stiffness=2.0), 1.5) == (
        "The spring at the hinge is 3.50 ± 0.03 N m/rad, not 2 as in the model."
    )


def test_what_is_all_taken_away_is_nothing() -> None:
    """A bound leaves a trifle below 0, which was said as -0.00."""
    assert said("joint_spring", machine(stiffness=2.0), -2.0 - 1e-12) == (
        "The spring at the hinge is 0.00 ± 0.03 N m/rad, not 2 as in the model."
    )


def test_what_no_effect_explains_is_said_with_where_it_acts() -> None:
    (said_of_joint,) = Unexplained(0.5, "joint", "y_axis", ("speed",)).sentences
    assert said_of_joint == (
        "Something acts on the y axis that no known effect explains; it depends on how fast it "
        "moves. A learned force law stands for it in the repaired model."
    )
    (said_of_all,) = Unexplained(0.5, "world", "world").sentences
    assert said_of_all.startswith("Something acts on the machine that no known effect explains. ")
    assert "noise in recorded commands" in said_of_all
    (said_of_a_base,) = Unexplained(0.5, "world", "world", sought=False).sentences
    assert "there is none. Nothing stands for it" in said_of_a_base
    (said_of_much,) = Unexplained(1.0, "world", "world", much=True).sentences
    assert "diagnosis: {most: …}" in said_of_much
    assert said_of_much.endswith("stands for a part of it in the repaired model.")
    assert Unexplained(0.5).sentences == ()


@pytest.mark.parametrize(("stiffness", "rest"), [(0.0, 0.0), (10.0, 0.1), (10.0, -0.3)])
def test_a_spring_rests_where_both_springs_together_do(stiffness: float, rest: float) -> None:
    """The zero of -k₀(q - q₀) - k q + f, found by MuJoCo's own passive force."""
    made, x = machine(stiffness=stiffness, rest=rest), np.array([0.5, 0.8])
    site = Site("joint", "hinge")
    details = CATALOGUE["joint_spring"].details
    assert details is not None
    (angle, _) = details(x, made, site)["rest angle"]
    text = PENDULUM.format(gravcomp=0.0, stiffness=stiffness, rest=rest)
    spec = mujoco.MjSpec.from_string(text)
    CATALOGUE["joint_spring"].apply(spec, site, x, made)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = angle
    mujoco.mj_forward(model, data)
    assert data.qfrc_spring[0] == pytest.approx(0.0, abs=1e-9)


def test_springs_that_cancel_rest_nowhere() -> None:
    details = CATALOGUE["joint_spring"].details
    assert details is not None
    assert not details(np.array([-10.0, 0.5]), machine(stiffness=10.0), Site("joint", "hinge"))


def rubbing(site: str, value: float, before: float = 0.0, group: str | None = None) -> Finding:
    quantity = Quantity(value, "N m", (value - 0.03, value + 0.03))
    said = f"The {site} is not as in the model." if before else f"{site} rubs that the model lacks."
    return Finding(
        "dry_friction", "joint", site, quantity, before, before + value, {}, group, 0.9, (),
        said, (value,),
    )  # fmt: skip


def test_a_group_of_three_is_said_in_one_sentence_and_two_in_two() -> None:
    three = [
        rubbing(j, v, group="dry friction on 3 joints") for j, v in {"a": 1, "b": 2, "c": 4}.items()
    ]
    assert found_sentences(three) == [
        "Dry friction on 3 joints, which the model lacks: a 1.00 ± 0.03 N m, b 2.00 ± 0.03 N m, "
        "c 4.00 ± 0.03 N m."
    ]
    more = [rubbing(j, -0.2, 0.5, "dry friction on 3 joints") for j in "abc"]
    assert found_sentences(more)[0].startswith(
        "Dry friction on 3 joints differs from the model's by: a -0.20 ± 0.03 N m, b"
    )
    two = [rubbing(j, 1.0, group="dry friction on 2 joints") for j in "ab"]
    assert found_sentences([*two, rubbing("c", 2.0)]) == [
        "a rubs that the model lacks.",
        "b rubs that the model lacks.",
        "c rubs that the model lacks.",
    ]


@pytest.mark.parametrize(
    ("nominal", "refitted", "begins"),
    [
        (8.16, 1.06, "The model needs what was fitted"),
        (1.27, 1.25, "These recordings show nothing"),
    ],
)
def test_parameters_that_stand_for_what_is_missing_are_not_called_nothing(
    nominal: float, refitted: float, begins: str
) -> None:
    """A study of `init` fits friction: 0 in the model, .15 at the machine."""
    forecast = {"nominal": nominal, "refitted": refitted}
    answer = {"verdict": "nothing-missing", "holdout": {"forecast": forecast}}
    assert verdict_text(answer).startswith(begins)
    assert verdict_text(answer, {"parameters": ["friction"]}).startswith(begins)
    if nominal > 2 * refitted:  # nothing but the step was fitted
        alone = verdict_text(answer, {"parameters": []})
        assert alone.startswith("The model needs a finer time step")
    plain = "These recordings show nothing that is missing from the model."
    assert verdict_text({**answer, "holdout": {}}) == plain


@pytest.mark.parametrize(
    ("forecast", "fit", "begins"),
    [
        (1.1, 1.0, "These recordings show nothing"),
        (1.1, 5.0, "These recordings show nothing"),  # a hopper of which nothing is
        (1.1, 328.0, "Nothing was found to be missing, but"),
        (4.0, 1.0, "Nothing was found to be missing, but"),
    ],
)
def test_an_unseen_recording_contradicts_that_nothing_is_missing(
    forecast: float, fit: float, begins: str
) -> None:
    left = {"forecast": forecast, "fit": fit}
    holdout = {m: {"repaired": e, "noise_floor": 1.0} for m, e in left.items()}
    answer = {"verdict": "nothing-missing", "findings": [], "holdout": holdout}
    assert verdict_text(answer).startswith(begins)


@pytest.mark.parametrize(
    ("instead", "begins"),
    [
        ("actuator_gain", "Either the model or what was measured is off"),
        ("sensor_delay", "The model is right"),
        (None, "The model is right"),
    ],
)
def test_a_reading_that_a_motor_may_stand_for_leaves_the_model_in_doubt(instead, begins) -> None:
    equivalents = [[{"effect": instead, "site": "my"}]] if instead else []
    found = [{"effect": "encoder_scale", "site": "y", "equivalents": equivalents}]
    answer = {"verdict": "sensing", "holdout": {}, "findings": found}
    assert verdict_text(answer).startswith(begins)


def test_an_answer_without_names_says_what_it_may_be_and_once_what_to_record() -> None:
    after = "To learn what acts on the machine: vary one thing at a time."
    unknown = {"effect": "unknown", "site": "world", "value": 0.0}
    answer = {
        "verdict": "unknown-physics", "findings": [], "holdout": {},
        "next_experiment": {"sentence": after},
        "alternatives": [{"findings": [unknown], "probability": 0.9},
                         {"findings": [], "probability": 0.1}],
    }  # fmt: skip
    summary = {"sentences": ["Something acts.", after], "notes": []}
    text = diagnosis_text(answer, summary, None)
    assert text.count(after) == 1
    assert text.index("What it may be:") < text.index("something unknown")
    assert text.index("something unknown") < text.index("nothing is missing")
    assert diagnosis_text(answer, {"sentences": ["Something acts."]}, None).count(after) == 1


def test_a_free_run_of_metres_and_radians_is_told_channel_by_channel() -> None:
    """Their mean has no unit."""
    channels = {"nominal": {"qpos.rail": 0.2, "qpos.hinge": 1.0}, "repaired": {"qpos.rail": 0.1}}
    part = {"horizon_s": 2.0, "unit": "SI", "nominal": 0.7, "repaired": 0.1, "channels": channels}
    units = {"qpos.rail": "m", "qpos.hinge": "rad"}
    table = errors_table({"free_run": {**part, "units": units}})
    words = "free run from the past alone"
    assert table.measure.tolist() == [f"{words}, qpos.rail", f"{words}, qpos.hinge"]
    assert table.unit.tolist() == ["m", "rad"]
    assert table.nominal.tolist() == [0.2, 1.0]
    assert table.repaired.tolist()[0] == 0.1
    (whole,) = errors_table({"free_run": {**part, "unit": "rad"}}).to_dict("records")
    assert (whole["measure"], whole["nominal"]) == (words, 0.7)


def test_magnitudes_that_differ_between_recordings_are_told_with_their_values() -> None:
    """Where their intervals lie apart, by more than a fifth of the magnitude."""
    (rubs, *_) = candidates([CATALOGUE["dry_friction"]], machine())
    columns = ("recording", "effect", "site", "value", "low", "high", "unit")

    def table(*values: float) -> pd.DataFrame:
        rows = [
            (f"day{k}", "dry_friction", "hinge", v, v - 0.01, v + 0.01, "N m")
            for k, v in enumerate(values, 1)
        ]
        return pd.DataFrame(rows, columns=columns)

    (told,) = disagreements([rubs], table(0.166, 0.13, 0.064))
    assert told == (
        "The recordings do not agree on dry friction at the hinge: 0.166 in day1, 0.13 in day2, "
        "0.064 in day3 (N m)."
    )
    assert disagreements([rubs], table(0.166, 0.17, 0.15)) == []  # within their intervals
    assert disagreements([rubs], table(1.0, 1.05)) == []  # a trifle
    (long,) = disagreements([rubs], table(0.1, 0.2, 0.3, 0.4, 0.5))
    assert long.endswith("0.2 in day2, 0.3 in day3, 0.5 in day5 (N m).")
