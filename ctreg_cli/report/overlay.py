"""A slice with what was found in it, as a picture for human eyes. Pure: nothing is opened, nothing is written.

Left the whole slice; where the spots fill only a part of it, right a magnified view of that part. Labels stand outside
the ring of spots, never on a spot and never on each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ctreg_cli.arrays import FloatArray
from ctreg_cli.imaging.slice import Slice
from ctreg_cli.imaging.spots import Spots

#: side of a panel, height of the title and legend lines, space about panels; picture pixels
PANEL, LINE, MARGIN = 720, 26, 10
#: shown black: this share of the pixels; white: what lies above this share of the pixels and of the range beyond black
BLACK_QUANTILE, WHITE_QUANTILE, WHITE_OF_RANGE = 0.02, 0.995, 0.5
#: the magnified view is worth its place from this magnification on
MIN_MAGNIFICATION = 1.6
#: what is left about the spots in the magnified view, as a share of their extent and at least in px
CROP_BORDER, CROP_BORDER_PX = 0.2, 12.0
#: least radius of a ring drawn about a spot, picture pixels
MIN_RING = 6.0
FONT_SIZE = 15
#: rejected neighbours with one reason are named once within this distance, picture pixels
SAME_REASON_APART = 90.0

Colour = tuple[int, int, int]
GROUND: Colour = (18, 18, 20)
TEXT: Colour = (235, 235, 235)
MATCHED: Colour = (90, 230, 110)
UNMATCHED: Colour = (255, 205, 60)
MISSING: Colour = (255, 90, 90)
REJECTED: Colour = (130, 160, 200)

Box = tuple[float, float, float, float]


def draw_overlay(
    slice_: Slice,
    spots: Spots,
    *,
    labels: Mapping[int, str] | None = None,
    predicted_px: FloatArray | None = None,
    predicted_names: Sequence[str] = (),
    title: str = "",
    show_rejected: bool = False,
    label_word: str = "labelled",
) -> Image.Image:
    """Draw spots, their rods and the rods not seen over a slice.

    Args:
        slice_: the image; shown between two quantiles of its values, padding black.
        spots: rings of the spots' size and direction; green with a label, yellow without.
        labels: spot index → rod id.
        predicted_px: (r, 2) places where a rod should be seen and no spot was matched: red crosses.
        predicted_names: their names, r of them, or none.
        title: one line above the picture.
        show_rejected: also mark rejected candidates, with the reason.
        label_word: what the legend calls spots that have a label.

    Returns:
        An RGB picture, about 720 or 1450 pixels wide.
    """
    labels = dict(labels or {})
    predicted = np.asarray(predicted_px if predicted_px is not None else np.empty((0, 2)), dtype=float).reshape(-1, 2)
    names = [*predicted_names, *([""] * len(predicted))][: len(predicted)]
    marks = [
        *_spot_marks(spots, labels),
        *(_Mark(uv=uv, colour=MISSING, text=name, cross=True) for uv, name in zip(predicted, names, strict=True)),
    ]
    if show_rejected:
        marks += [
            _Mark(uv=np.array([r.u_px, r.v_px]), colour=REJECTED, text=r.reason, small=True) for r in spots.rejected
        ]
    grey = _grey(slice_)
    crops = _crops(slice_, spots, labels, predicted)
    width = MARGIN + len(crops) * (PANEL + MARGIN)
    canvas = Image.new("RGB", (width, PANEL + 2 * LINE + 2 * MARGIN), GROUND)
    views = [_view(grey, crop) for crop in crops]  # what the close-up shows is named there, all else in the whole slice
    closest = views[-1][1]
    for i, (panel, view) in enumerate(views):
        named = marks if view is closest else [mark for mark in marks if not closest.shows(mark.uv)]
        _draw_marks(panel, view, marks, named)
        canvas.paste(panel, (MARGIN + i * (PANEL + MARGIN), LINE + MARGIN))
    draw, font = ImageDraw.Draw(canvas), _font(FONT_SIZE)
    draw.text((MARGIN, MARGIN // 2 + 2), title, fill=TEXT, font=font)
    counts = [
        (len(labels), label_word, MATCHED),
        (len(spots) - len(labels), "other spots" if labels else "spots", UNMATCHED),
        (len(predicted), "missing", MISSING),
        (sum(spots.n_rejected.values()) if show_rejected else 0, "rejected", REJECTED),
    ]
    _draw_legend(draw, font, counts, PANEL + LINE + 2 * MARGIN)
    return canvas


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Mark:
    """Something to draw at ``uv`` (2,), px."""

    uv: FloatArray
    colour: Colour
    text: str
    #: (major, minor) full lengths, px, and direction, rad; None: a ring of the least size
    axes: tuple[float, float, float] | None = None
    cross: bool = False
    small: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class _View:
    """How image coordinates become panel coordinates."""

    u0: float
    v0: float
    zoom: float

    def __call__(self, uv: FloatArray) -> tuple[float, float]:
        return (float(uv[0] - self.u0) * self.zoom, float(uv[1] - self.v0) * self.zoom)

    def shows(self, uv: FloatArray) -> bool:
        """Whether a place of the image, px, lies in the panel."""
        return all(0 <= c < PANEL for c in self(uv))


def _spot_marks(spots: Spots, labels: Mapping[int, str]) -> list[_Mark]:
    marks = []
    for i, uv in enumerate(spots.uv_px):
        shape = (float(spots.major_px[i]), float(spots.minor_px[i]), float(spots.angle_rad[i]))
        marks.append(
            _Mark(
                uv=uv,
                colour=MATCHED if i in labels else UNMATCHED,
                text=labels.get(i, ""),
                axes=shape if np.isfinite(shape).all() else None,
            )
        )
    return marks


def _grey(slice_: Slice) -> Image.Image:
    """The slice as an 8-bit picture."""
    values = slice_.values()
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, [BLACK_QUANTILE, WHITE_QUANTILE]) if known.size else (0.0, 1.0)
    if known.size:
        high = max(high, low + WHITE_OF_RANGE * (known.max() - low), low + np.finfo(np.float32).eps)
    return Image.fromarray(np.uint8(255 * np.clip((np.nan_to_num(values, nan=low) - low) / (high - low), 0, 1)))


def _crops(slice_: Slice, spots: Spots, labels: Mapping[int, str], predicted: FloatArray) -> list[Box]:
    """Parts of the slice to show, (left, top, right, bottom) in px: all of it, and the frame if that is far smaller."""
    rows, columns = slice_.stored.shape
    whole = (-0.5, -0.5, columns - 0.5, rows - 0.5)
    shown = spots.uv_px[sorted(labels)] if labels else spots.uv_px
    points = np.concatenate([shown, predicted[np.isfinite(predicted).all(axis=1)]])
    if not len(points):
        return [whole]
    low, high = points.min(axis=0), points.max(axis=0)
    side = float((high - low).max())
    side = min(side + 2 * max(CROP_BORDER * side, CROP_BORDER_PX), float(min(rows, columns)))
    if max(rows, columns) / side < MIN_MAGNIFICATION:
        return [whole]
    left, top = (low + high - side) / 2
    left, top = np.clip(left, -0.5, columns - 0.5 - side), np.clip(top, -0.5, rows - 0.5 - side)
    return [whole, (float(left), float(top), float(left) + side, float(top) + side)]


def _view(grey: Image.Image, crop: Box) -> tuple[Image.Image, _View]:
    """A panel filled with a part of the slice (in the panel's middle), and the way from image to panel coordinates."""
    left, top, right, bottom = crop
    zoom = PANEL / max(right - left, bottom - top)
    size = (round((right - left) * zoom), round((bottom - top) * zoom))
    # PIL counts from the corner of the first pixel, we from its centre
    part = grey.resize(size, Image.Resampling.BICUBIC, box=(left + 0.5, top + 0.5, right + 0.5, bottom + 0.5))
    panel = Image.new("RGB", (PANEL, PANEL), GROUND)
    corner = ((PANEL - size[0]) // 2, (PANEL - size[1]) // 2)
    panel.paste(part.convert("RGB"), corner)
    return panel, _View(u0=left - corner[0] / zoom, v0=top - corner[1] / zoom, zoom=zoom)


def _draw_marks(panel: Image.Image, view: _View, marks: Sequence[_Mark], named: Sequence[_Mark]) -> None:
    """Draw all ``marks``, and write what the ``named`` of them are."""
    draw = ImageDraw.Draw(panel)
    inside = [m for m in marks if view.shows(m.uv)]
    rings = [_ring(m, view) for m in inside]
    for mark, ring in zip(inside, rings, strict=True):
        x, y = view(mark.uv)
        if mark.cross:
            r = MIN_RING + 2
            draw.line([(x - r, y - r), (x + r, y + r)], fill=mark.colour, width=2)
            draw.line([(x - r, y + r), (x + r, y - r)], fill=mark.colour, width=2)
        elif mark.small:
            draw.ellipse([x - 3, y - 3, x + 3, y + 3], outline=mark.colour)
        else:
            draw.line([*ring, ring[0]], fill=mark.colour, width=2)
    _draw_texts(draw, view, inside, [_bounds(ring) for ring in rings], named)


def _ring(mark: _Mark, view: _View) -> list[tuple[float, float]]:
    """Outline of a spot a little outside its half height, panel coordinates."""
    major, minor, angle = mark.axes or (0.0, 0.0, 0.0)
    a, b = (max(0.75 * length * view.zoom, MIN_RING) for length in (major, minor))
    t = np.linspace(0, 2 * np.pi, 33)[:-1]
    x, y = view(mark.uv)
    xs = x + a * np.cos(t) * np.cos(angle) - b * np.sin(t) * np.sin(angle)
    ys = y + a * np.cos(t) * np.sin(angle) + b * np.sin(t) * np.cos(angle)
    return list(zip(xs.tolist(), ys.tolist(), strict=True))


def _draw_texts(
    draw: ImageDraw.ImageDraw, view: _View, marks: Sequence[_Mark], taken: Sequence[Box], wanted: Sequence[_Mark]
) -> None:
    """Write each wanted mark's text at the nearest free place, outwards from the middle of all marks first."""
    occupied = list(taken)
    wanted_ids = {id(mark) for mark in wanted}
    named: list[tuple[str, float, float]] = []
    middle = np.mean([view(m.uv) for m in marks], axis=0) if marks else np.zeros(2)
    for mark, ring in zip(marks, taken, strict=True):
        x, y = view(mark.uv)
        again = mark.small and any(
            t == mark.text and np.hypot(x - px, y - py) < SAME_REASON_APART for t, px, py in named
        )
        if not mark.text or again or id(mark) not in wanted_ids:
            continue
        named.append((mark.text, x, y))
        font = _font(FONT_SIZE - 4 if mark.small else FONT_SIZE)
        box = draw.textbbox((0, 0), mark.text, font=font)
        size = (box[2] - box[0] + 4, box[3] - box[1] + 4)
        place = _free_place((x, y), ring, size, np.array([x, y]) - middle, occupied)
        if place is None:
            continue
        occupied.append(place)
        cx, cy = (place[0] + place[2]) / 2, (place[1] + place[3]) / 2
        if not mark.small:
            nearest = (float(np.clip(x, place[0], place[2])), float(np.clip(y, place[1], place[3])))
            edge = (float(np.clip(nearest[0], ring[0], ring[2])), float(np.clip(nearest[1], ring[1], ring[3])))
            draw.line([edge, nearest], fill=mark.colour, width=1)
        draw.rectangle(place, fill=GROUND)
        draw.text((cx, cy), mark.text, fill=mark.colour, font=font, anchor="mm")


def _free_place(
    at: tuple[float, float], ring: Box, size: tuple[float, float], outwards: FloatArray, occupied: Iterable[Box]
) -> Box | None:
    """A box of ``size`` near the ring that touches nothing; None if there is none (the mark then goes without)."""
    start = float(np.arctan2(outwards[1], outwards[0]))
    reach = max(ring[2] - ring[0], ring[3] - ring[1]) / 2 + max(size) / 2
    blocked = list(occupied)
    for distance in reach + np.array([4.0, 14.0, 28.0, 46.0, 70.0]):
        for turn in np.array([0, 1, -1, 2, -2, 3, -3, 4]) * np.pi / 4:
            cx = at[0] + distance * float(np.cos(start + turn))
            cy = at[1] + distance * float(np.sin(start + turn))
            box = (cx - size[0] / 2, cy - size[1] / 2, cx + size[0] / 2, cy + size[1] / 2)
            within = min(box[:2]) >= 0 and max(box[2:]) <= PANEL
            if within and not any(_overlap(box, other) for other in blocked):
                return box
    return None


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _bounds(points: Sequence[tuple[float, float]]) -> Box:
    xs, ys = zip(*points, strict=True)
    return (min(xs), min(ys), max(xs), max(ys))


def _draw_legend(
    draw: ImageDraw.ImageDraw,
    font: ImageFont.ImageFont | ImageFont.FreeTypeFont,
    counts: Sequence[tuple[int, str, Colour]],
    y: float,
) -> None:
    x = float(MARGIN)
    for count, word, colour in counts:
        if count:
            text = f"{count} {word}"
            draw.text((x, y), text, fill=colour, font=font)
            x += draw.textlength(text, font=font) + 3 * MARGIN


def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size=size)
