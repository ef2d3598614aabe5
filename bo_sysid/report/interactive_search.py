"""Figures of a search and of learning as Plotly objects, for the page and for notebooks."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from bo_sysid.intervals import half_width
from bo_sysid.report.bins import bin_edges
from bo_sysid.report.look import EQUIVALENT, IDENTIFIED, NOMINAL, SECOND
from bo_sysid.report.plotly_style import dressed, escaped, in_unit, light

_TICKS = 15
_DECADES = 3  # of an axis below which it has room for 1, 2 and 5 of each; Plotly writes 1 to 9


def marginal(belief: pd.DataFrame, parameter: str, unit: str, nominal: float) -> go.Figure:
    """Return the marginals of P and P_boot of one parameter.

    Args:
        belief: one row a candidate: the parameters, P and P_boot.
        parameter: which.
        unit: of it.
        nominal: the model's own value.
    """
    figure = go.Figure()
    edges = bin_edges(belief[parameter].to_numpy(float))
    for column, colour, share, label in (  # one in front of the other: both are seen
        ("P_boot", SECOND, 1.0, "P_boot: what the recordings say about the machine"),
        ("P", IDENTIFIED, 0.5, "P: where the minimum lies on these recordings"),
    ):
        mass = np.histogram(belief[parameter], edges, weights=belief[column])[0]
        figure.add_bar(
            x=((edges[:-1] + edges[1:]) / 2).astype(np.float32), y=mass.astype(np.float32),
            width=(share * np.diff(edges)).astype(np.float32), name=label,
            marker={"color": colour},
        )  # fmt: skip
    figure.add_vline(x=nominal, line={"dash": "dash", "color": NOMINAL}, annotation_text="nominal")
    figure.update_layout(barmode="overlay")
    figure.update_xaxes(title=escaped(parameter + in_unit(unit)))
    figure.update_yaxes(title="probability")
    return dressed(figure, 320)


def pair(belief: pd.DataFrame, first: str, second: str, units: Mapping[str, str]) -> go.Figure:
    """Return P_boot over two parameters, all others summed over.

    Args:
        belief: one row a candidate: the parameters and P_boot.
        first: parameter on the vertical axis.
        second: the one on the horizontal axis.
        units: of the parameters, by name.
    """
    one, other, weight = (belief[n].to_numpy(float) for n in (first, second, "P_boot"))
    across, up = bin_edges(other), bin_edges(one)
    mass = np.histogram2d(one, other, (up, across), weights=weight)[0]
    figure = go.Figure()
    figure.add_heatmap(
        x=across.astype(np.float32), y=up.astype(np.float32),
        z=mass.astype(np.float32), colorscale="Cividis", colorbar={"title": "P_boot"},
    )  # fmt: skip
    figure.update_layout(showlegend=False)
    figure.update_xaxes(title=escaped(second + in_unit(units[second])))
    figure.update_yaxes(title=escaped(first + in_unit(units[first])))
    return dressed(figure, 360)


def progress(evaluations: pd.DataFrame) -> go.Figure:
    """Return deviation and entropy of P over the evaluations."""
    figure = make_subplots(2, 1, shared_xaxes=True, vertical_spacing=0.08)
    number = np.arange(1, len(evaluations) + 1)
    deviation = evaluations["deviation"]
    dots = {"color": SECOND, "size": 6}
    figure.add_scatter(
        x=number, y=light(deviation), mode="markers", name="evaluated", marker=dots, row=1, col=1
    )
    line = {"color": IDENTIFIED, "shape": "hv"}
    figure.add_scatter(
        x=number, y=light(deviation.cummin()), name="lowest so far", line=line, row=1, col=1
    )
    decades = np.log10(deviation.max() / deviation.min()) if deviation.min() > 0 else np.inf
    figure.update_yaxes(
        type="log", title="deviation [scaled]", row=1, dtick="D2" if decades < _DECADES else None
    )
    if "entropy" in evaluations:
        figure.add_scatter(
            x=number, y=light(evaluations["entropy"]), name="entropy of P",
            line={"color": EQUIVALENT}, row=2, col=1,
        )  # fmt: skip
    figure.update_yaxes(title="entropy of P [nats]", row=2)
    figure.update_xaxes(title="evaluation", row=2)
    return dressed(figure, 420)


def learning(iterations: pd.DataFrame) -> go.Figure:
    """Return the return of the policies against the number of real trajectories.

    Args:
        iterations: trajectories, episodes, model_return, model_error, plant_return, plant_error.
    """
    figure = go.Figure()
    for kind, colour, size, label in (
        ("model", IDENTIFIED, 12, "on the identified model"),  # seen around what lies on it
        ("plant", NOMINAL, 6, "on the plant"),
    ):
        mean = iterations[f"{kind}_return"].astype(float)
        if mean.notna().any():
            known = iterations[f"{kind}_error"].astype(float).fillna(0.0)
            error = pd.Series(half_width(known, iterations.get("episodes", np.inf)))
            figure.add_scatter(
                x=light(iterations["trajectories"]), y=light(mean), name=label,
                mode="lines+markers", line={"color": colour}, marker={"size": size},
                error_y={"array": light(error), "color": colour, "width": size - 2},
            )  # fmt: skip
    several = len(iterations) and iterations["trajectories"].max() > _TICKS
    figure.update_xaxes(title="real trajectories", dtick=None if several else 1)
    figure.update_yaxes(title="return (95 % interval)")
    return dressed(figure, 360)


def training(rounds: pd.DataFrame) -> go.Figure:
    """Return the return of training batches against simulated control steps, a curve a round.

    Args:
        rounds: learned (the round), steps, batch_return.
    """
    figure = go.Figure()
    for k, (number, part) in enumerate(rounds.groupby("learned", sort=True)):
        shade = 0.35 + 0.65 * (k + 1) / rounds["learned"].nunique()
        figure.add_scatter(
            x=light(part["steps"]), y=light(part["batch_return"]), name=f"round {number}",
            line={"color": IDENTIFIED, "width": 2}, opacity=shade,
        )  # fmt: skip
    figure.update_xaxes(title="simulated control steps")
    figure.update_yaxes(title="mean reward of a batch<br>× steps of an episode")
    return dressed(figure, 320)
