"""The drawing of a robot with the guilty sites marked, as a Matplotlib object."""

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke

from bo_sysid.report.look import NOMINAL
from bo_sysid.report.robot import Posed, Site, depth_order, outline, view

_FILL, _EDGE = "#D9DEE4", "#5A6673"
_GUILTY = "#F4B183"
_WIDTH, _TALLEST, _LOWEST = 6.0, 6.0, 3.2  # inches
_NAMED = 8  # joints whose names are written
_NEAR = 26.0  # points between a joint and a mark, from which on its name keeps away
_FEW, _LIST = 3, 3.6  # sites whose words are written large; inches of their list


def robot(posed: Posed, sites: Sequence[tuple[Site, str]]) -> Figure:
    """Return the robot with sites marked.

    Args:
        posed: the model in a pose.
        sites: each with its words; they stand in a list, and their numbers at the sites.
    """
    onto = view(posed)
    shapes = {g: outline(posed.surface(g), onto) for g in posed.geoms}
    box = _box(posed, shapes.values(), onto)
    tall = float(np.ptp(box[:, 1]) / np.ptp(box[:, 0])) * _WIDTH
    widths = [_WIDTH, _LIST] if sites else [_WIDTH]
    figure = Figure(figsize=(sum(widths), float(np.clip(tall, _LOWEST, _TALLEST)) + 0.4))
    figure.set_layout_engine("constrained")
    axis, *beside = figure.subplots(1, len(widths), squeeze=False, width_ratios=widths)[0]
    guilty = {g for site, _ in sites for g in site.geoms}
    for g in depth_order(posed, posed.geoms, onto):
        colour = _GUILTY if int(g) in guilty else _FILL
        axis.add_patch(Polygon(shapes[int(g)], facecolor=colour, edgecolor=_EDGE, linewidth=1.0))
    _joints(
        axis, posed, onto, [s for s, _ in sites], 72 * _WIDTH / float(np.ptp(box, axis=0).max())
    )
    if beside:
        _numbers(axis, sites, onto)
        _list(beside[0], sites)
    _gravity(axis, posed, onto)
    axis.set_xlim(*box[:, 0])
    axis.set_ylim(*box[:, 1])
    axis.set_aspect("equal")
    axis.set_axis_off()
    return figure


def _box(
    posed: Posed, shapes: Collection[np.ndarray], onto: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "2 2"]:
    """Return the lowest and the highest corner of the picture, with room for words."""
    places = [posed.data.xanchor @ onto.T, *shapes, np.zeros((1, 2))[: not shapes]]
    points = np.concatenate([p for p in places if len(p)])
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float((high - low).max()), 1e-6)
    grow = np.maximum(0.16 * size, 0.5 * (0.75 * size - (high - low)))
    return np.array([low - grow, high + grow])


def _joints(
    axis: Axes, posed: Posed, onto: Float[np.ndarray, "2 3"], marked: Sequence[Site], scale: float
) -> None:
    """Draw each joint as a small ring, with its name where there are few; marks are listed.

    Args:
        axis: of the drawing.
        posed: the model in a pose.
        onto: the picture's directions.
        marked: the sites that get a mark, which names shall not touch.
        scale: points of the picture in a metre.
    """
    places = posed.data.xanchor @ onto.T
    for j in posed.feet:
        axis.plot(*places[j], "s", color=_EDGE, markersize=13, alpha=0.5)
    axis.plot(*places.T, "o", markerfacecolor="white", markeredgecolor=_EDGE, markersize=5)
    labels = {s.label for s in marked}
    rings = [onto @ s.point for s in marked if s.point is not None]
    names = [posed.model.joint(j).name for j in range(posed.model.njnt)]
    if len(names) > _NAMED:
        return
    for name, place in zip(names, places, strict=True):
        if f"joint {name}" not in labels:
            near = [r for r in rings if np.linalg.norm(r - place) * scale < _NEAR]
            below = any(r[1] > place[1] + 1e-9 for r in near)
            axis.annotate(
                name,
                place,
                (16 if near else 9, -12 if below else 7),
                textcoords="offset points",
                fontsize="small",
                color=_EDGE,
                path_effects=[withStroke(linewidth=2.5, foreground="white")],
            )


def _gravity(axis: Axes, posed: Posed, onto: Float[np.ndarray, "2 3"]) -> None:
    """Draw where gravity pulls, where the picture's plane shows it."""
    pull = onto @ posed.model.opt.gravity
    if np.linalg.norm(pull) < 1.0:
        return
    tip = 0.09 * pull / np.linalg.norm(pull)
    axis.annotate(
        "gravity",
        (0.07 + tip[0], 0.16 + tip[1]),
        xytext=(0.07, 0.16),
        xycoords="axes fraction",
        ha="center",
        va="bottom",
        fontsize="small",
        color=_EDGE,
        arrowprops={"arrowstyle": "-|>", "color": _EDGE},
    )


def _numbers(axis: Axes, sites: Sequence[tuple[Site, str]], onto: Float[np.ndarray, "2 3"]) -> None:
    """Ring each site, and write its number there; those of one place beside each other."""
    at: dict[tuple[float, float], list[str]] = {}
    for k, (site, _) in enumerate(sites, start=1):
        if site.point is not None:
            x, y = np.round(onto @ site.point, 3).tolist()
            at.setdefault((x, y), []).append(str(k))
    for place, numbers in at.items():
        axis.plot(*place, "o", markersize=22, markerfacecolor="white", markeredgecolor=NOMINAL,
                  markeredgewidth=3)  # fmt: skip
        size = "medium" if len(numbers) == 1 else "small"
        axis.annotate(", ".join(numbers), place, ha="center", va="center_baseline", fontsize=size)


def _list(axis: Axes, sites: Sequence[tuple[Site, str]]) -> None:
    """Write the words of all sites under each other, by number."""
    axis.set_axis_off()
    lines = [
        f"{k}  " + words.replace("\n", "\n     ") for k, (_, words) in enumerate(sites, start=1)
    ]
    size = "medium" if len(sites) <= _FEW else "small"
    axis.text(0.0, 0.5, "\n".join(lines), transform=axis.transAxes, va="center", fontsize=size,
              linespacing=1.35)  # fmt: skip
