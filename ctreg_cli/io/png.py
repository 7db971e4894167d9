"""One PNG file → one record: grey values as they are, without scale, geometry or time."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.errors import UnreadableSliceError
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.io.image_record import ImageRecord, Kind, SeriesKey

if TYPE_CHECKING:
    from PIL import Image

SIGNATURE = b"\x89PNG\r\n\x1a\n"
#: Pillow's modes for 8-bit and 16-bit grey without alpha; "I" is what older versions call 16-bit grey
_GREY_MODES = ("L", "I;16", "I;16B", "I")
_COLOUR_REMEDY = "save it as 8- or 16-bit grey without alpha"


def is_png(path: Path, head: bytes) -> bool:
    """Whether a file is, or says by its name that it is, PNG."""
    return head.startswith(SIGNATURE) or path.suffix.lower() == ".png"


def read_png(path: Path, source: str) -> ImageRecord:
    """Look at the header of one PNG; the pixels are read later, by :meth:`ImageRecord.load`."""
    series = SeriesKey("PNG", Kind.SLICE, "PNG")
    try:
        with _opened(path) as image:
            info = SliceInfo(source=source, shape=(image.height, image.width))
    except UnreadableSliceError as error:
        return ImageRecord(info=SliceInfo(source=source), series=series, problem=str(error))
    return ImageRecord(info=info, series=series, pixels=PngPixels(path=str(path)))


@dataclass(frozen=True, slots=True, kw_only=True)
class PngPixels:
    """The grey values of a PNG."""

    path: str

    def load(self) -> NDArray[Any]:
        """Decode the image; the array is read-only."""
        with _opened(Path(self.path)) as image:
            stored = np.array(image)
        stored = stored.astype(np.uint8 if stored.dtype == np.uint8 else np.uint16)
        stored.flags.writeable = False
        return stored


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The image, if it is grey; Pillow's guard against decompression bombs is an error here, not a warning."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=["PNG"]) as image:
                _refuse_colour(image)
                yield image
    except UnreadableSliceError:
        raise
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise UnreadableSliceError("the PNG claims more pixels than a slice can have") from None
    except FileNotFoundError:
        raise UnreadableSliceError("the file cannot be read (no such file)") from None
    # Pillow raises OSError (with UnidentifiedImageError), SyntaxError, ValueError, EOFError, zlib.error, struct.error
    except Exception:  # noqa: BLE001
        raise UnreadableSliceError("the PNG is damaged or cut short") from None


def _refuse_colour(image: Image.Image) -> None:
    if image.mode not in _GREY_MODES:
        raise UnreadableSliceError(f"the PNG is colour, palette or 1-bit, or has alpha; {_COLOUR_REMEDY}")
    if "transparency" in image.info:
        raise UnreadableSliceError(f"the PNG has a transparent grey value; {_COLOUR_REMEDY}")
