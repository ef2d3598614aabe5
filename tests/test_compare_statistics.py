"""The statistics of comparisons, against values worked out by hand and known properties."""

import numpy as np
import pandas as pd
import pytest

from bo_sysid.compare.statistics import agreement, bootstrap, costs, paired, share, summary
from bo_sysid.compare.tables import Key, inner_paths, outer_paths


def path(arm: str, seed: int, regret: list[float], problem: str = "p") -> pd.DataFrame:
    count = np.arange(1, len(regret) + 1)
    return pd.DataFrame(
        {
            "problem": problem,
            "arm": arm,
            "seed": seed,
            "regret": regret,
            "evaluations": count,
            "steps": 100.0 * count,
        }
    )


def test_costs_are_those_of_the_first_step_at_the_level_or_of_the_longest_run() -> None:
    paths = pd.concat([path("a", 0, [1, 0.5, 0.1, 0]), path("b", 0, [1, 0.4, 0.4])])
    found = costs(paths, [0.5, 0.1], ["evaluations", "steps"])
    assert found[["arm", "level", "reached", "evaluations", "steps"]].to_numpy().tolist() == [
        ["a", 0.5, True, 2, 200.0],
        ["a", 0.1, True, 3, 300.0],
        ["b", 0.5, True, 2, 200.0],
        ["b", 0.1, False, 4, 400.0],
    ]


def test_a_summary_has_shares_and_means() -> None:
    paths = pd.concat([path("a", 0, [1, 0]), path("a", 1, [1, 1, 1, 0]), path("a", 2, [1, 1])])
    (row,) = summary(costs(paths, [0], ["evaluations"]), ["evaluations"]).to_dict("records")
    assert row["runs"] == 3
    assert row["reached"] == pytest.approx(2 / 3)
    assert row["evaluations"] == pytest.approx(10 / 3)
    half = 4.302653 * np.sqrt(4 / 3 / 3)  # Student's t of two degrees of freedom; of 2, 4 and 4
    assert row["evaluations_low"] == pytest.approx(10 / 3 - half)
    assert row["evaluations_high"] == pytest.approx(10 / 3 + half)


def test_a_level_that_is_stated_twice_is_no_second_run() -> None:
    paths = pd.concat([path(a, s, [1, 1, 0][: s + 1]) for a in "ab" for s in range(3)])
    once, twice = (costs(paths, levels, ["evaluations"]) for levels in ([0, 0.5], [0, 0.5, 0.0]))
    pd.testing.assert_frame_equal(twice, once, check_dtype=False)
    assert summary(twice, ["evaluations"])["runs"].tolist() == [3] * 4
    assert paired(twice, ["evaluations"], "a")["pairs"].tolist() == [3, 3]


def test_wilsons_interval_of_eight_in_ten() -> None:
    # Wilson's closed form: (k + z²/2 ± z √(k (n - k)/n + z²/4)) / (n + z²), z = 1.959964
    z = 1.959964
    root = z * np.sqrt(8 * 2 / 10 + z**2 / 4)
    expected = [(8 + z**2 / 2 - root) / (10 + z**2), (8 + z**2 / 2 + root) / (10 + z**2)]
    assert share(8, 10) == pytest.approx((0.8, *expected), abs=1e-6)
    assert np.isnan(share(0, 0)).all()


@pytest.mark.parametrize("count", [2, 5, 9])
def test_intervals_of_few_values_cover_the_mean_as_often_as_they_say(count: int) -> None:
    draws = np.random.default_rng(count).normal(1.0, 2.0, (2_000, count))
    told = np.array([bootstrap(values) for values in draws])
    covered = np.count_nonzero((told[:, 1] <= 1.0) & (told[:, 2] >= 1.0))
    assert 1_870 <= covered <= 1_930  # 95 % by three standard deviations
    np.testing.assert_allclose(told[:, 0], draws.mean(axis=1))


def test_the_bootstrap_interval_covers_the_mean_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for k in range(200):
        _, low, high = bootstrap(rng.normal(1.0, 2.0, 30), seed=k)
        covered += low <= 1.0 <= high
    assert 178 <= covered <= 198  # percentile intervals of 30 values cover about 94 %
    assert np.isnan(bootstrap(np.array([1.0]))[1:]).all()


@pytest.mark.parametrize(("cheaper", "p"), [(6, 2 / 2**6), (5, 4 / 2**6), (0, 2 / 2**6)])
def test_p_is_the_share_of_signs_that_are_as_one_sided(cheaper: int, p: float) -> None:
    """Six pairs: of 2^6 signs two are all alike, two more have the smallest difference alone."""
    pairs = [(10, 10 + (k if k > 6 - cheaper else -k)) for k in range(1, 7)]
    rows = [
        {"problem": "p", "arm": arm, "seed": seed, "level": 0.0, "reached": True, "evaluations": n}
        for seed, pair in enumerate(pairs)
        for arm, n in zip(("own", "reference"), pair, strict=True)
    ]
    found = paired(pd.DataFrame(rows), ["evaluations"], "reference").set_index("problem")
    assert found.loc["p", "p"] == pytest.approx(p)


def test_ratios_are_geometric_means_of_pairs() -> None:
    rng = np.random.default_rng(1)
    rows = []
    for problem in ("p", "q"):
        for seed in range(12):
            base = int(rng.integers(8, 30))
            noise = int(rng.integers(-2, 3))
            for arm, count in (("one", 2 * base), ("half", base + noise), ("same", 2 * base)):
                rows.append(
                    {
                        "problem": problem,
                        "arm": arm,
                        "seed": seed,
                        "level": 0.0,
                        "reached": (arm, seed) != ("half", 3),
                        "evaluations": count,
                    }
                )
    spent = pd.DataFrame(rows)
    found = paired(spent, ["evaluations"], "one").set_index(["arm", "problem"])
    wide = spent.pivot_table(index=["problem", "seed"], columns="arm", values="evaluations")
    logs = np.log(wide["half"] / wide["one"])
    both = found.loc[("half", "all")]
    assert (both["pairs"], both["unreached"]) == (24, 2)
    assert both["ratio"] == pytest.approx(np.exp(logs.mean()))
    assert both["low"] < both["ratio"] < both["high"] < 0.7
    assert both["p"] < 1e-4
    assert found.loc[("half", "p"), "pairs"] == 12
    same = found.loc[("same", "all")]
    assert same[["ratio", "low", "high", "p"]].tolist() == [1, 1, 1, 1]


def test_agreement_by_hand() -> None:
    picks = {
        ("a", 0): [9, 1, 2, 3], ("b", 0): [9, 1, 2, 3, 4], ("c", 0): [9, 1, 3, 2],
        ("a", 1): [9, 5, 6, 7], ("b", 1): [9, 5, 8, 9],
    }  # fmt: skip
    paths = pd.concat(
        pd.DataFrame(
            {"problem": "p", "arm": a, "seed": s, "row": r, "chosen": np.arange(len(r)) > 0}
        )
        for (a, s), r in picks.items()
    )
    found = agreement(paths).set_index(["arm", "other"])
    ab, ac = found.loc[("a", "b")], found.loc[("a", "c")]
    assert (ab["pairs"], ab["identical"], ab["step"]) == (2, 0.5, 2)
    assert ab["overlap"] == pytest.approx((1 + 1 / 3) / 2)
    assert (ac["pairs"], ac["identical"], ac["step"], ac["overlap"]) == (1, 0, 2, 1)


def test_regret_is_a_share_of_the_median_excess() -> None:
    record = {
        "row": [0, 1], "deviation": [3.0, 2.0], "lowest": 1.0, "median": 5.0, "entropy": [None, 1],
        "max_p": [None, 0.5], "right": [None, True], "steps": [1, 2], "seconds": [1, 2],
        "parameters": [],
    }  # fmt: skip
    found = inner_paths({Key("p", "a", 0): record})
    assert found["regret"].tolist() == [0.5, 0.25]
    unknown = {**record, "lowest": None, "median": None, "right": [None, None]}
    better = {**unknown, "deviation": [3.0, 1.0]}
    found = inner_paths({Key("p", "a", 0): unknown, Key("p", "b", 0): better})
    assert found["regret"].tolist() == pytest.approx([4 / 3, 2 / 3, 4 / 3, 0])


def test_the_regret_of_policies_is_measured_from_the_best_with_the_same_plant() -> None:
    record = {
        "trajectories": [1, 2], "evaluations": [9, 21], "steps": [100, 200], "plant_error": [1, 1],
        "model_return": [0, 0],
    }  # fmt: skip
    records = {
        Key("p", "a", 0): {**record, "plant_return": [50.0, 40.0]},
        Key("p", "b", 0): {**record, "plant_return": [80.0, 100.0]},
        Key("p", "a", 1): {**record, "plant_return": [5.0, 10.0]},
    }
    assert outer_paths(records)["regret"].tolist() == pytest.approx([0.5, 0.5, 0.2, 0, 0.5, 0])
