"""What Plotly figures of the page and of notebooks have in common."""

import html

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from jaxtyping import Float

from bo_sysid.report.look import IDENTIFIED


def escaped(text: str) -> str:
    """Return text that Plotly shows as it is: it takes some HTML in its labels."""
    return html.escape(text, quote=False)


def in_unit(unit: str) -> str:
    """Return a unit as it stands behind a label."""
    return f" [{unit}]" if unit else ""


def dressed(figure: go.Figure, height: int) -> go.Figure:
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
        hoverlabel={"namelength": -1},
        modebar={"bgcolor": "rgba(0,0,0,0)", "color": "#999999", "activecolor": IDENTIFIED},
    )
    lines = {"gridcolor": "rgba(128,128,128,0.25)", "zerolinecolor": "rgba(128,128,128,0.5)"}
    lines["hoverformat"] = ".4~g"
    figure.update_xaxes(title_font_size=13, title_standoff=6, **lines)
    figure.update_yaxes(title_font_size=13, **lines)
    return figure


def light(values: pd.Series) -> Float[np.ndarray, " n"]:
    """Return values in single precision, which keeps a page small."""
    return values.to_numpy(np.float32)
