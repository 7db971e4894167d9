"""Slices as small pictures for a page: the part where the spots are, the same part of every slice."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np

from ctreg_cli.imaging.slice import Slice
from ctreg_cli.io.results_document import SliceRecord

#: shown black and white: these shares of the values in view
BLACK_QUANTILE, WHITE_QUANTILE = 0.02, 0.998
#: what is left about the spots, as a share of their extent, and at least in px
BORDER, MIN_BORDER_PX = 0.35, 24.0
#: (side in picture pixels, JPEG quality), tried in order until a picture is small enough
_QUALITIES = ((448, 85), (448, 70), (384, 60), (320, 50), (256, 40), (192, 30), (128, 30))


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A square part of the slices, in pixels."""

    u0: float
    v0: float
    side_px: float


def common_view(records: tuple[SliceRecord, ...]) -> View | None:
    """The square in which all matched spots of all slices lie, with a border.

    Where nothing was matched in any slice it is that of the spots there are; None where there are none either.
    """
    spots = np.array([(match.u_px, match.v_px) for record in records for match in record.matches])
    if not len(spots):
        spots = np.concatenate([np.empty((0, 2)), *(record.unmatched_px for record in records)])
    if not len(spots):
        return None
    low, high = spots.min(axis=0), spots.max(axis=0)
    extent = float((high - low).max())
    side = extent + 2 * max(BORDER * extent, MIN_BORDER_PX)
    u0, v0 = ((low + high - side) / 2).tolist()
    return View(u0=u0, v0=v0, side_px=side)


def picture(slice_: Slice, view: View, max_bytes: int) -> str:
    """The part of a slice as a ``data:`` address: a grey JPEG, black outside the slice.

    It is made smaller and coarser until it has ``max_bytes``, or can shrink no further.
    """
    from PIL import Image

    values = slice_.values()
    rows, columns = values.shape
    u_low, v_low = max(0, int(view.u0)), max(0, int(view.v0))
    u_high, v_high = min(columns, int(view.u0 + view.side_px) + 2), min(rows, int(view.v0 + view.side_px) + 2)
    seen = values[v_low:v_high, u_low:u_high]
    known = seen[np.isfinite(seen)]
    low, high = np.quantile(known, [BLACK_QUANTILE, WHITE_QUANTILE]) if known.size else (0.0, 1.0)
    grey = 255 * np.clip((np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-6), 0, 1)
    image = Image.fromarray(grey.astype(np.uint8))
    data = b""
    for side, quality in _QUALITIES:
        zoom = view.side_px / side
        # PIL counts from the corner of the first pixel, we from its centre
        shown = image.transform(
            (side, side),
            Image.Transform.AFFINE,
            (zoom, 0, view.u0 + 0.5, 0, zoom, view.v0 + 0.5),
            resample=Image.Resampling.BICUBIC,
        )
        stream = io.BytesIO()
        shown.save(stream, format="JPEG", quality=quality, optimize=True)
        data = stream.getvalue()
        if len(data) <= max_bytes:
            break
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
