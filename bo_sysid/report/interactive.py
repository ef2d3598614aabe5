"""Figures of a diagnosis as Plotly objects, for the page and notebooks; they compute nothing."""

from collections.abc import Mapping, Sequence
from math import gcd

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from jaxtyping import Float
from plotly.subplots import make_subplots
from scipy.spatial import ConvexHull, QhullError

from bo_sysid.report.look import (
    COLOURS,
    GREY,
    MODELS,
    NOMINAL,
    in_a_row,
    left_words,
    rms,
    set_colour,
    since_start,
    sure,
    time_label,
    with_gaps,
    worst_channels,
)
from bo_sysid.report.plotly_style import dressed, escaped, in_unit, light
from bo_sysid.report.robot import Posed, Site, ball, view

_POINTS = 6_000  # of all channels of a page together
_LEAST_POINTS = 400  # of a curve
_DASHES = {"refitted": "dot"}
_MARK = 0.09  # of the robot's size: radius of a mark
_SPELLED_OUT = 3  # marked sites beside which there is room for what is said of them
_STEEL = "#9FB0C3"


def held_out(traces: pd.DataFrame, channel: str, unit: str = "rad", beside: int = 0) -> go.Figure:
    """Return recorded, nominal, refitted and repaired of one channel, and the residuals.

    Args:
        traces: time [s], begin, window, channel, recorded, nominal, refitted, repaired.
            Of one recording.
        channel: which.
        unit: of the channel.
        beside: how many figures share the page's points; otherwise one a channel.
    """
    most = max(_POINTS // (beside or traces["channel"].nunique()), _LEAST_POINTS)
    traces = since_start(traces)
    whole = traces[traces["channel"] == channel]
    part = with_gaps(_thinned(whole, most))
    figure = make_subplots(2, 1, shared_xaxes=True, row_heights=[0.62, 0.38], vertical_spacing=0.06)
    time, recorded = light(part["time"]), part["recorded"]
    line = {"color": GREY, "width": 5}
    figure.add_scatter(x=time, y=light(recorded), name="recorded", line=line, row=1, col=1)
    for model in (m for m in MODELS if m in part):
        error, off = recorded - part[model], rms(whole["recorded"] - whole[model])
        line = {"color": COLOURS[model], "width": 1.8, "dash": _DASHES.get(model, "solid")}
        words = f"off by {off:.2g} {unit} rms" if np.isfinite(off) else "no prediction"
        name = f"{MODELS[model]} ({words})".replace("  ", " ")
        shared = {"x": time, "line": line, "name": name, "legendgroup": model}
        figure.add_scatter(y=light(part[model]), row=1, col=1, **shared)
        figure.add_scatter(y=light(error), row=2, col=1, showlegend=False, **shared)
    figure.update_yaxes(title=escaped(channel + in_unit(unit)), row=1, range=_range(recorded))
    figure.update_yaxes(title=f"recorded - forecast{in_unit(unit)}", row=2)
    figure.update_xaxes(title="time [s]", row=2)
    return dressed(figure, 520)


def all_held_out(traces: pd.DataFrame, units: Mapping[str, str], most: int) -> dict[str, go.Figure]:
    """Return a figure of each channel, the worst first; of each recording where there are several.

    All of them begin at time 0: in one figure their lines would cross.

    Args:
        traces: recording and what `held_out` takes.
        units: of the channels.
        most: how many figures a page may have.
    """
    recordings = list(dict.fromkeys(traces["recording"]))[:most]
    chosen = worst_channels(traces)[: max(most // len(recordings), 1)]
    parts = {
        (c, r): own
        for c in chosen
        for r in recordings
        if len(own := traces[(traces["channel"] == c) & (traces["recording"] == r)])
    }
    return {
        c if len(recordings) == 1 else f"{c}, {r}": held_out(own, c, units.get(c, ""), len(parts))
        for (c, r), own in parts.items()
    }


def forces(pieces: pd.DataFrame, joint: str) -> go.Figure:
    """Return the force that the models lack at one joint, against time, position and speed.

    Args:
        pieces: recording, time, begin, joint, position, speed, unit, nominal, repaired, sigma.
        joint: which.
    """
    pieces, begins = in_a_row(pieces)
    part = sure(pieces[pieces["joint"] == joint])
    unit = str(part["unit"].iloc[0])
    place, what = ("rad", "torque") if unit == "N m" else ("m", "force")
    across = {
        "speed": f"speed [{place}/s]",
        "position": f"position [{place}]",
        "time": time_label(begins),
    }
    figure = make_subplots(1, 3, shared_yaxes=True, horizontal_spacing=0.03)
    for k, (column, label) in enumerate(across.items(), start=1):
        for model, symbol in (("nominal", "circle"), ("repaired", "square")):
            figure.add_scatter(
                x=light(part[column]),
                y=light(part[model]),
                mode="markers",
                marker={"color": COLOURS[model], "size": 6, "symbol": symbol, "opacity": 0.75},
                name=MODELS[model],
                legendgroup=model,
                showlegend=k == 1,
                row=1,
                col=k,
            )
        figure.update_xaxes(title=label, col=k)
    for begin in begins[1:]:
        figure.add_vline(begin, col=3, line={"dash": "dot", "color": GREY, "width": 1})
    figure.update_yaxes(title=f"missing {what} [{unit}]", col=1)
    return dressed(figure, 360)


def evidence(sets: pd.DataFrame) -> go.Figure:
    """Return what each of the best explanations leaves unexplained, and its probability.

    A narrow page takes the words of `customdata` and the range of `meta`.

    Args:
        sets: set, effects, probability, rms [sensor sigma], best, equivalent.
    """
    shown = sets.iloc[::-1]
    place = np.arange(len(shown))
    words = [" " + left_words(r["rms"], r["probability"], r.get("p_boot", np.nan))
             for r in shown.to_dict("records")]  # fmt: skip
    figure = go.Figure()
    figure.add_bar(
        x=light(shown["rms"]),
        y=place,
        orientation="h",
        marker={"color": [set_colour(row) for row in shown.itertuples()]},
        name="",
    )
    figure.add_scatter(  # words alone where nothing is known of what is left
        x=light(shown["rms"].fillna(1.0)),
        y=place,
        mode="text",
        text=words,
        customdata=[w.replace(", P_boot", "<br> P_boot") for w in words],
        textposition="middle right",
        cliponaxis=False,
        hoverinfo="skip",
    )  # fmt: skip
    figure.add_vline(x=1.0, line={"dash": "dash", "color": GREY})
    largest = float(np.log10(max(float(shown["rms"].max()), 2.0)))
    figure.update_layout(showlegend=False, meta={"narrow": [-0.15, 3.4 * largest + 0.3]})
    figure.update_xaxes(
        type="log", range=[-0.15, 1.7 * largest + 0.3], title="unexplained [sensor sigma, rms]"
    )
    labels = [escaped(s).replace(" + ", "<br>+ ") for s in shown["set"]]
    figure.update_yaxes(automargin=True, tickvals=place, ticktext=labels)
    lines = sum(str(s).count(" + ") + 1 for s in shown["set"])
    return dressed(figure, 130 + 18 * len(shown) + 18 * lines)


def robot(posed: Posed, sites: Sequence[tuple[Site, str]]) -> go.Figure:
    """Return the robot in three dimensions, to be turned, with the guilty sites marked.

    Args:
        posed: the model in a pose.
        sites: each with what is said of it; beside many of them only the names are written.
    """
    many = len(sites) > _SPELLED_OUT
    guilty = {g for site, _ in sites for g in site.geoms}
    right, up = view(posed)
    toward = np.cross(right, up)
    surfaces = {g: posed.surface(g) for g in posed.geoms}
    whole = np.concatenate([*surfaces.values(), np.zeros((int(not surfaces), 3))])
    size, middle = float(np.ptp(whole, axis=0).max()), whole.mean(axis=0)
    figure = go.Figure()
    for geom, points in surfaces.items():
        figure.add_trace(_mesh(points, NOMINAL if geom in guilty else _STEEL))
    for site, words in sites:
        if site.point is not None:
            figure.add_trace(_mesh(site.point + _MARK * size * ball(), NOMINAL, 0.6))
            outside = 1.0 if right @ (site.point - middle) >= 0 else -1.0
            beside = _MARK * (up + 1.5 * outside * right) + 0.3 * toward
            x, y, z = (site.point + size * beside)[:, None]
            side = "middle right" if outside > 0 else "middle left"
            shown = words.partition(":")[0] if many else words
            figure.add_scatter3d(
                x=x, y=y, z=z, mode="text", textposition=side,
                text=[escaped(shown).replace("\n", "<br>")],
                customdata=[escaped(words.partition(":")[0])],
                textfont={"color": NOMINAL, "size": 15}, hoverinfo="skip",
            )  # fmt: skip
    from_here = 1.7 * toward + 0.25 * up + 0.2 * right
    eye = dict(zip("xyz", from_here.tolist(), strict=True))
    hidden = {"visible": False}
    figure.update_layout(
        scene={
            "aspectmode": "data", "xaxis": hidden, "yaxis": hidden, "zaxis": hidden,
            "camera": {"eye": eye, "up": dict(zip("xyz", up.tolist(), strict=True)),
                       "projection": {"type": "orthographic"}},
        },
        showlegend=False,
    )  # fmt: skip
    return dressed(figure, 420)


def _mesh(points: Float[np.ndarray, "P 3"], colour: str, opacity: float = 1.0) -> go.Mesh3d:
    """Return the hull of some points as a solid."""
    try:
        i, j, k = ConvexHull(points).simplices.T.astype(np.int32)
    except QhullError:  # flat: a fan of triangles
        i, j, k = np.array([[0, n, n + 1] for n in range(1, len(points) - 1)], np.int32).T
    x, y, z = points.T.astype(np.float32)
    return go.Mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k, color=colour, opacity=opacity, flatshading=True,
        hoverinfo="skip", lighting={"ambient": 0.75, "diffuse": 0.6, "specular": 0.05},
    )  # fmt: skip


def _thinned(part: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return every so many-th row, so that a page stays small.

    They are not the same instants of each window, of which the first ones are predicted best.
    """
    each, instants = max(-(-len(part) // most), 1), int(part.groupby("window").size().max())
    while gcd(each, instants) > 1:
        each += 1
    return part.iloc[::each]


def _range(recorded: pd.Series) -> list[float]:
    """Return the range of an axis: a forecast that leaves is cut off."""
    known = recorded.dropna()
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    margin = 0.5 * max(high - low, 1e-9)
    return [low - margin, high + margin]
