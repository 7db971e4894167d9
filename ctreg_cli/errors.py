"""What can go wrong, as one tree.

::

    CtregError                  base; its text is one sentence for the user
    ├── InputError              something the user gave cannot be used: file, place, remedy (exit code 2)
    │   ├── RodModelError       a frame file (path:line:col: key: what is wrong, what is allowed), one line a mistake
    │   ├── CalibrationFileError
    │   ├── SpotsFileError
    │   ├── UnreadableSliceError  an image file that holds no usable slice; inside a folder it becomes a row
    │   └── MissingScaleError   no mm per pixel from anywhere
    └── EstimationError         the numbers do not determine the answer
        ├── SingularGeometryError  parallel or coplanar rods, too few spots
        └── CalibrationError    no scale fits the spots

A failure *inside a sequence of slices* is not an exception but a value: a result with ``status`` and ``reason``.
"""

from __future__ import annotations


class CtregError(Exception):
    """Base of all errors raised on purpose by ctreg."""


class InputError(CtregError):
    """A file or option the user gave cannot be used."""


class RodModelError(InputError):
    """A frame file is wrong; the text holds one line for each mistake."""


class CalibrationFileError(InputError):
    """A calibration file is wrong."""


class SpotsFileError(InputError):
    """A spots file is wrong."""


class UnreadableSliceError(InputError):
    """An image file holds no usable slice."""


class MissingScaleError(InputError):
    """A slice has no pixel scale, and none was given."""


class EstimationError(CtregError):
    """The measurements do not determine the answer."""


class SingularGeometryError(EstimationError):
    """Parallel or coplanar rods, or too few spots, leave the pose undetermined."""


class CalibrationError(EstimationError):
    """No scale explains the spots."""
