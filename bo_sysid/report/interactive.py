"""Figures of a run as Plotly objects, for the page and for notebooks; they compute nothing."""

import html
from collections.abc import Sequence

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from jaxtyping import Float
from plotly.subplots import make_subplots
from scipy.spatial import ConvexHull, QhullError

from bo_sysid.report.look import (
    COLOURS,
    EQUIVALENT,
    GREY,
    IDENTIFIED,
    MODELS,
    NOMINAL,
    SECOND,
    left_words,
    set_colour,
    sure,
    with_gaps,
)
from bo_sysid.report.robot import Posed, Site, ball, view

_POINTS = 6_000  # of all channels of a page together
_LEAST_POINTS = 400  # of a curve
_TICKS = 15
_DASHES = {"refitted": "dot"}
_MARK = 0.09  # of the robot's size: radius of a mark
_STEEL = "#9FB0C3"


def held_out(traces: pd.DataFrame, channel: str, unit: str = "rad") -> go.Figure:
    """Return recorded, nominal, refitted and repaired of one channel, and the residuals.

    Args:
        traces: recording, time [s], window, channel, recorded, nominal, refitted, repaired.
        channel: which.
        unit: of the channel.
    """
    most = max(_POINTS // traces["channel"].nunique(), _LEAST_POINTS)
    part = with_gaps(_thinned(traces[traces["channel"] == channel], most))
    figure = make_subplots(2, 1, shared_xaxes=True, row_heights=[0.62, 0.38], vertical_spacing=0.06)
    time, recorded = _light(part["time"]), part["recorded"]
    line = {"color": GREY, "width": 5}
    figure.add_scatter(x=time, y=_light(recorded), name="recorded", line=line, row=1, col=1)
    for model in (m for m in MODELS if m in part):
        error = recorded - part[model]
        rms = float(np.sqrt(np.nanmean(np.square(error))))
        line = {"color": COLOURS[model], "width": 1.8, "dash": _DASHES.get(model, "solid")}
        name = f"{MODELS[model]} (off by {rms:.2g} {unit} rms)".replace("  ", " ")
        shared = {"x": time, "line": line, "name": name, "legendgroup": model}
        figure.add_scatter(y=_light(part[model]), row=1, col=1, **shared)
        figure.add_scatter(y=_light(error), row=2, col=1, showlegend=False, **shared)
    figure.update_yaxes(title=_said(channel + _in(unit)), row=1, range=_range(recorded))
    figure.update_yaxes(title=f"recorded - forecast{_in(unit)}", row=2)
    figure.update_xaxes(title="time [s]", row=2)
    return _dressed(figure, 520)


def forces(pieces: pd.DataFrame, joint: str) -> go.Figure:
    """Return the force that the models lack at one joint, against time, position and speed.

    Args:
        pieces: joint, time, position, speed, unit, nominal, repaired, sigma.
        joint: which.
    """
    part = sure(pieces[pieces["joint"] == joint])
    unit = str(part["unit"].iloc[0])
    place, what = ("rad", "torque") if unit == "N m" else ("m", "force")
    across = {
        "speed": f"speed [{place}/s]",
        "position": f"position [{place}]",
        "time": "time [s]",
    }
    figure = make_subplots(1, 3, shared_yaxes=True, horizontal_spacing=0.03)
    for k, (column, label) in enumerate(across.items(), start=1):
        for model, symbol in (("nominal", "circle"), ("repaired", "square")):
            figure.add_scatter(
                x=_light(part[column]),
                y=_light(part[model]),
                mode="markers",
                marker={"color": COLOURS[model], "size": 6, "symbol": symbol, "opacity": 0.75},
                name=MODELS[model],
                legendgroup=model,
                showlegend=k == 1,
                row=1,
                col=k,
            )
        figure.update_xaxes(title=label, col=k)
    figure.update_yaxes(title=f"missing {what} [{unit}]", col=1)
    return _dressed(figure, 360)


def evidence(sets: pd.DataFrame) -> go.Figure:
    """Return what each of the best explanations leaves unexplained, and its probability.

    Args:
        sets: set, effects, probability, rms [sensor sigma], best, equivalent.
    """
    shown = sets.iloc[::-1]
    place = np.arange(len(shown))
    figure = go.Figure()
    figure.add_bar(
        x=_light(shown["rms"].fillna(1.0)),
        y=place,
        orientation="h",
        marker={"color": [set_colour(row) for row in shown.itertuples()]},
        text=[left_words(r["rms"], r["probability"], r.get("p_boot", np.nan))
              for r in shown.to_dict("records")],
        textposition="outside",
        cliponaxis=False,
        name="",
    )  # fmt: skip
    figure.add_vline(x=1.0, line={"dash": "dash", "color": GREY})
    figure.update_layout(showlegend=False)
    largest = float(np.log10(max(float(shown["rms"].max()), 2.0)))
    figure.update_xaxes(
        type="log", range=[-0.15, 1.7 * largest + 0.3], title="unexplained [sensor sigma, rms]"
    )
    labels = [_said(s).replace(" + ", "<br>+ ") for s in shown["set"]]
    figure.update_yaxes(automargin=True, tickvals=place, ticktext=labels)
    lines = sum(str(s).count(" + ") + 1 for s in shown["set"])
    return _dressed(figure, 130 + 18 * len(shown) + 18 * lines)


def robot(posed: Posed, sites: Sequence[tuple[Site, str]]) -> go.Figure:
    """Return the robot in three dimensions, to be turned, with the guilty sites marked.

    Args:
        posed: the model in a pose.
        sites: each with what is said of it.
    """
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
            figure.add_scatter3d(
                x=x, y=y, z=z, mode="text", textposition=side,
                text=[_said(words).replace("\n", "<br>")],
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
    return _dressed(figure, 420)


def marginal(belief: pd.DataFrame, parameter: str, unit: str, nominal: float) -> go.Figure:
    """Return the marginals of P and P_boot of one parameter.

    Args:
        belief: one row a candidate: the parameters, P and P_boot.
        parameter: which.
        unit: of it.
        nominal: the model's own value.
    """
    figure = go.Figure()
    for column, colour, label in (
        ("P_boot", SECOND, "P_boot: what the recordings say about the machine"),
        ("P", IDENTIFIED, "P: where the minimum lies on these recordings"),
    ):
        mass = _marginal(belief, [parameter], column)
        figure.add_bar(
            x=_light(mass.index.to_series()), y=_light(mass), name=label, marker={"color": colour},
            opacity=0.85,
        )  # fmt: skip
    figure.add_vline(x=nominal, line={"dash": "dash", "color": NOMINAL}, annotation_text="nominal")
    figure.update_layout(barmode="overlay")
    figure.update_xaxes(title=_said(parameter + _in(unit)))
    figure.update_yaxes(title="probability")
    return _dressed(figure, 320)


def pair(belief: pd.DataFrame, first: str, second: str) -> go.Figure:
    """Return P_boot over two parameters, all others summed over."""
    mass = _marginal(belief, [first, second], "P_boot").unstack().fillna(0.0)  # noqa: PD010
    figure = go.Figure()
    figure.add_heatmap(
        x=_light(mass.columns.to_series()), y=_light(mass.index.to_series()),
        z=mass.to_numpy(np.float32), colorscale="Cividis", colorbar={"title": "P_boot"},
    )  # fmt: skip
    figure.update_layout(showlegend=False)
    figure.update_xaxes(title=_said(second))
    figure.update_yaxes(title=_said(first))
    return _dressed(figure, 360)


def progress(evaluations: pd.DataFrame) -> go.Figure:
    """Return deviation and entropy of P over the evaluations."""
    figure = make_subplots(2, 1, shared_xaxes=True, vertical_spacing=0.08)
    number = np.arange(1, len(evaluations) + 1)
    deviation = evaluations["deviation"]
    dots = {"color": SECOND, "size": 6}
    figure.add_scatter(
        x=number, y=_light(deviation), mode="markers", name="evaluated", marker=dots, row=1, col=1
    )
    line = {"color": IDENTIFIED, "shape": "hv"}
    figure.add_scatter(
        x=number, y=_light(deviation.cummin()), name="lowest so far", line=line, row=1, col=1
    )
    figure.update_yaxes(type="log", title="deviation [scaled]", row=1)
    if "entropy" in evaluations:
        figure.add_scatter(
            x=number, y=_light(evaluations["entropy"]), name="entropy of P",
            line={"color": EQUIVALENT}, row=2, col=1,
        )  # fmt: skip
    figure.update_yaxes(title="entropy of P [nats]", row=2)
    figure.update_xaxes(title="evaluation", row=2)
    return _dressed(figure, 420)


def learning(iterations: pd.DataFrame) -> go.Figure:
    """Return the return of the policies against the number of real trajectories.

    Args:
        iterations: trajectories, model_return, model_error, plant_return, plant_error.
    """
    figure = go.Figure()
    for kind, colour, label in (
        ("model", IDENTIFIED, "on the identified model"),
        ("plant", NOMINAL, "on the plant"),
    ):
        mean = iterations[f"{kind}_return"].astype(float)
        if mean.notna().any():
            error = 1.96 * iterations[f"{kind}_error"].astype(float).fillna(0.0)
            figure.add_scatter(
                x=_light(iterations["trajectories"]), y=_light(mean), name=label,
                mode="lines+markers", line={"color": colour},
                error_y={"array": _light(error), "color": colour},
            )  # fmt: skip
    several = len(iterations) and iterations["trajectories"].max() > _TICKS
    figure.update_xaxes(title="real trajectories", dtick=None if several else 1)
    figure.update_yaxes(title="return (95 % interval)")
    return _dressed(figure, 360)


def training(rounds: pd.DataFrame) -> go.Figure:
    """Return the return of training batches against simulated control steps, a curve a round.

    Args:
        rounds: learned (the round), steps, batch_return.
    """
    figure = go.Figure()
    for k, (number, part) in enumerate(rounds.groupby("learned", sort=True)):
        shade = 0.35 + 0.65 * (k + 1) / rounds["learned"].nunique()
        figure.add_scatter(
            x=_light(part["steps"]), y=_light(part["batch_return"]), name=f"round {number}",
            line={"color": IDENTIFIED, "width": 2}, opacity=shade,
        )  # fmt: skip
    figure.update_xaxes(title="simulated control steps")
    figure.update_yaxes(title="return of a batch")
    return _dressed(figure, 320)


def _said(text: str) -> str:
    """Return text that Plotly shows as it is: it takes some HTML in its labels."""
    return html.escape(text, quote=False)


def _in(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _dressed(figure: go.Figure, height: int) -> go.Figure:
    """Give a figure its size and a background that suits light and dark pages."""
    low = 55 if figure.layout.showlegend is False else 90
    figure.update_layout(
        template="none",
        height=height,
        margin={"l": 70, "r": 20, "t": 34, "b": low},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        font={"family": "system-ui, sans-serif", "size": 13, "color": "#777777"},
        legend={"orientation": "h", "yanchor": "bottom", "y": 0, "yref": "container", "x": 0},
        hovermode="closest",
        modebar={"bgcolor": "rgba(0,0,0,0)", "color": "#999999", "activecolor": IDENTIFIED},
    )
    lines = {"gridcolor": "rgba(128,128,128,0.25)", "zerolinecolor": "rgba(128,128,128,0.5)"}
    figure.update_xaxes(title_font_size=13, title_standoff=6, **lines)
    figure.update_yaxes(title_font_size=13, **lines)
    return figure


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


def _marginal(belief: pd.DataFrame, names: list[str], column: str) -> pd.Series:
    """Return the probability summed over all other parameters; many values are put into bins."""
    keys = []
    for name in names:
        values = belief[name]
        if values.nunique() > 60:
            edges = np.linspace(values.min(), values.max(), 41)
            middle = (edges[:-1] + edges[1:]) / 2
            values = pd.Series(middle[np.clip(np.searchsorted(edges, values) - 1, 0, 39)])
            values.index = belief.index
        keys.append(values.rename(name))
    return belief[column].groupby(keys).sum()


def _thinned(part: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return every so many-th row, so that a page stays small."""
    return part.iloc[:: max(-(-len(part) // most), 1)]


def _light(values: pd.Series) -> Float[np.ndarray, " n"]:
    return values.to_numpy(np.float32)


def _range(recorded: pd.Series) -> list[float]:
    """Return the range of an axis: a forecast that leaves is cut off."""
    low, high = float(recorded.min()), float(recorded.max())
    margin = 0.5 * max(high - low, 1e-9)
    return [low - margin, high + margin]
