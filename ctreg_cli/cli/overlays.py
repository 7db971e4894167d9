"""``--overlay DIR``: one PNG a slice, for a person to look at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ctreg_cli.errors import InputError
from ctreg_cli.geometry.projection import project, to_pixels
from ctreg_cli.imaging.slice import Slice
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.io.results import accepted
from ctreg_cli.io.sources import Source
from ctreg_cli.pipeline import FrameResult
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale

if TYPE_CHECKING:
    from PIL.Image import Image


class OverlayWriter:
    """Draws slices with what was found in them into a folder, which is made if need be.

    Raises:
        InputError: the input has no pixels, the folder is an input, or it cannot be made.
    """

    def __init__(
        self,
        folder: str,
        source: Source,
        inputs: Sequence[str],
        *,
        model: RodModel | None = None,
        scale: Scale | None = None,
    ) -> None:
        if source.kind != "images":
            raise InputError(f"--overlay {folder}: a spots file has no pixels to draw on; give the images")
        if Path(folder).resolve() in {Path(name).resolve() for name in inputs}:
            raise InputError(f"--overlay {folder}: is an input; pictures among slices would be taken for slices")
        self._folder, self._model, self._scale = Path(folder), model, scale
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--overlay {folder}: cannot be made ({error.strerror})") from error

    def draw_spots(self, slice_: Slice, spot_slice: SpotSlice, index: int) -> None:
        """The spots, numbered as in the table, and what was left out."""
        from ctreg_cli.report.overlay import draw_overlay

        numbers = {spot: str(spot) for spot in range(len(spot_slice.spots))}
        title = f"slice {index}  {slice_.info.source}  {len(spot_slice.spots)} spots"
        picture = draw_overlay(
            slice_, spot_slice.spots, labels=numbers, title=title, show_rejected=True, label_word="spots"
        )
        self._save(picture, index)

    def draw_result(self, slice_: Slice, result: FrameResult) -> None:
        """The matched spots with their rods' names, and where missing rods should be."""
        from ctreg_cli.report.overlay import draw_overlay

        labels: dict[int, str] = {}
        predicted_px, predicted_names = np.empty((0, 2)), []
        scale = self._scale or slice_.info.scale
        for best in accepted(result)[:1]:
            if self._model is None:
                break
            ids = self._model.ids
            labels = {int(spot): ids[rod] for spot, rod in zip(best.spot_index, best.rod_index, strict=True)}
            if scale is not None and len(best.missing_rods):
                missing = best.missing_rods
                crossing = project(best.T_slice_model, self._model.starts[missing], self._model.directions[missing])
                predicted_px = to_pixels(crossing.xy_mm, scale.mm_per_px)
                predicted_names = [ids[rod] for rod in missing]
        title = f"slice {result.index}  {slice_.info.source}  {result.status} {result.reason}".rstrip()
        self._save(
            draw_overlay(
                slice_,
                result.spots,
                labels=labels,
                predicted_px=predicted_px,
                predicted_names=predicted_names,
                title=title,
            ),
            result.index,
        )

    def _save(self, image: Image, index: int) -> None:
        path = self._folder / f"slice_{index:04d}.png"
        try:
            image.save(path, format="PNG")
        except OSError as error:
            path.unlink(missing_ok=True)
            raise InputError(f"{path}: cannot be written ({error.strerror})") from error
