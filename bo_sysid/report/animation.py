"""Recording and simulation on top of each other, before and after the repair, as a moving GIF."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from bo_sysid.mjcf import Model
from bo_sysid.report.look import COLOURS, MODELS
from bo_sysid.report.robot import Posed, depth_order, outline, view

_COMPARED = ("nominal", "repaired")  # columns
_PANEL = 300  # pixels, of a side
_FINER = 2  # drawn larger and shrunk, for smooth edges
_RATE = 20  # pictures a second
_MOST = 60  # pictures
_PAUSE = 1_000  # [ms] on the last picture
_COLOURS = 48
_FILL, _EDGE, _PAPER = "#CDD3DA", "#8A949E", "#FFFFFF"
_FAR = 4.0  # times its own size, that a robot may travel before it is followed
_MARGIN = 0.12  # of a panel


def write_animation(path: Path, model: Model, traces: pd.DataFrame) -> bool:
    """Write recorded motion (grey) with each model's forecast (outlined), one panel a model.

    The piece in which the first model is worst is shown, in real time.

    Args:
        path: the GIF file.
        model: whose joints the traces are of.
        traces: recording, time [s], window, channel, recorded and one column for each model.

    Returns:
        Whether there is anything to show: the traces have positions of the model's joints, and the
        model has geoms.
    """
    piece = _worst(traces[traces["channel"].isin(model.qpos_channels)], _COMPARED[0])
    if piece.empty:
        return False
    instants = _shown(piece["time"])
    poses = {m: _poses(piece, m, instants) for m in ("recorded", *_COMPARED)}
    posed = Posed.of(model, poses["recorded"][0])
    if not len(posed.geoms):
        return False
    onto = view(posed)
    shapes = {m: [_shapes(posed, pose, onto) for pose in poses[m]] for m in poses}
    shown, place = _placed(shapes)
    frames = [
        _frame([(m, shown["recorded"][k], shown[m][k]) for m in _COMPARED], place)
        for k in range(len(poses["recorded"]))
    ]
    times = [*_durations(instants), _PAUSE]
    few = [f.quantize(_COLOURS) for f in frames]
    few[0].save(path, "GIF", save_all=True, append_images=few[1:], duration=times, loop=0)
    return True


def _worst(traces: pd.DataFrame, model: str) -> pd.DataFrame:
    """Return the piece with the largest error of a model, as far as all models predict it."""
    finite = traces.dropna(subset=["recorded", *_COMPARED])
    if finite.empty:
        return finite
    error = (finite["recorded"] - finite[model]).abs().groupby(finite["window"]).max()
    return finite[finite["window"] == error.idxmax()]


def _shown(time: pd.Series) -> Float[np.ndarray, " T"]:
    """Return the instants of a piece that get a picture."""
    times = np.unique(time)
    wanted = np.arange(times[0], times[-1] + 1e-9, 1 / _RATE)[:_MOST]
    return np.unique(times[np.minimum(np.searchsorted(times, wanted), len(times) - 1)])


def _durations(instants: Float[np.ndarray, " T"]) -> list[int]:
    """Return how long each picture but the last is shown, in [ms]: whole hundredths of a second."""
    ends = 10 * np.rint(100 * (instants - instants[0]))
    return [int(d) for d in np.diff(ends)]


def _poses(
    piece: pd.DataFrame, column: str, times: Float[np.ndarray, " T"]
) -> list[dict[str, float]]:
    """Return one pose for each instant, by position channel.

    Where a channel has a clock of its own, what is drawn lies on a line between its samples.
    """
    table = piece.pivot_table(index="time", columns="channel", values=column)
    table = table.interpolate("index", limit_direction="both").loc[times]
    return [{str(k): float(v) for k, v in row.items()} for row in table.to_dict("records")]


def _shapes(
    posed: Posed, pose: Mapping[str, float], onto: Float[np.ndarray, "2 3"]
) -> list[Float[np.ndarray, "n 2"]]:
    """Return the outlines of a robot in a pose, farthest first."""
    posed.move(pose)
    order = depth_order(posed, posed.geoms, onto)
    return [outline(posed.surface(int(g)), onto) for g in order]


_Shapes = Mapping[str, list[list[Float[np.ndarray, "n 2"]]]]
"""Outlines by model, picture and geom."""


def _placed(shapes: _Shapes) -> tuple[_Shapes, "_Place"]:
    """Return the outlines, and a place that holds them; a robot that travels far is followed."""
    own = [np.concatenate(frame) for frame in shapes["recorded"]]
    size = max(float(np.ptp(points, axis=0).max()) for points in own)
    travelled = float(np.ptp(np.concatenate(own), axis=0).max())
    if travelled < _FAR * size:
        return shapes, _Place.of(_all(shapes))
    middle = [(points.min(axis=0) + points.max(axis=0)) / 2 for points in own]
    followed = {
        m: [[s - at for s in frame] for frame, at in zip(frames, middle, strict=True)]
        for m, frames in shapes.items()
    }
    side = min(2 * float(np.abs(_all(followed)).max()), _FAR * size)
    return followed, _Place(np.full(2, -side / 2), side)


def _all(shapes: _Shapes) -> Float[np.ndarray, "P 2"]:
    return np.concatenate([s for frames in shapes.values() for frame in frames for s in frame])


class _Place:
    """Where the world's points lie in a panel."""

    def __init__(self, low: Float[np.ndarray, " 2"], size: float) -> None:
        self._low, self._size = low, size

    @classmethod
    def of(cls, points: Float[np.ndarray, "P 2"]) -> "_Place":
        low, high = points.min(axis=0), points.max(axis=0)
        size = max(float((high - low).max()), 1e-9)
        return cls(0.5 * (low + high) - 0.5 * size, size)

    def pixels(self, points: Float[np.ndarray, "n 2"]) -> list[tuple[float, float]]:
        """Return pixels of a panel; up is up."""
        side = _PANEL * _FINER
        at = (points - self._low) / self._size * (1 - 2 * _MARGIN) + _MARGIN
        return [(x * side, (1 - y) * side) for x, y in at]


def _frame(
    panels: Sequence[tuple[str, Sequence[np.ndarray], Sequence[np.ndarray]]], place: _Place
) -> Image.Image:
    side = _PANEL * _FINER
    image = Image.new("RGB", (side * len(panels), side), _PAPER)
    for k, panel in enumerate(panels):
        image.paste(_panel(*panel, place), (k * side, 0))
    return image.resize((_PANEL * len(panels), _PANEL), Image.Resampling.LANCZOS)


def _panel(
    name: str, recorded: Sequence[np.ndarray], forecast: Sequence[np.ndarray], place: _Place
) -> Image.Image:
    """Return one panel; what lies beyond it is cut off."""
    image = Image.new("RGB", (_PANEL * _FINER,) * 2, _PAPER)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(13 * _FINER)
    for shape in recorded:
        draw.polygon(place.pixels(shape), fill=_FILL, outline=_EDGE)
    for shape in forecast:
        draw.polygon(place.pixels(shape), outline=COLOURS[name], width=2 * _FINER)
    draw.text((8 * _FINER, 6 * _FINER), MODELS[name], fill=COLOURS[name], font=font)
    draw.text((8 * _FINER, 22 * _FINER), "recorded", fill=_EDGE, font=font)
    return image
