"""Options and values a caller gave, checked where they come in: one sentence with field, value and what is allowed."""

from __future__ import annotations

import math
from numbers import Real

from ctreg_cli.errors import InputError

#: mm per pixel that an image may have
SCALES_MM = (1e-6, 1e3)
#: px that a spot's place may be unsure by: less is no measurement, but would outweigh every other spot
SPOT_SDS_PX = (1e-6, 1e6)


def is_number(value: object) -> bool:
    """Whether it is a finite real number; True and False are none."""
    return not isinstance(value, bool) and isinstance(value, Real) and math.isfinite(value)


def demand(is_right: bool, field: str, value: object, allowed: str) -> None:
    """Refuse a value that is not right.

    Args:
        is_right: whether it is.
        field: its name.
        value: quoted in the message.
        allowed: what to give instead.

    Raises:
        InputError: it is not right.
    """
    if not is_right:
        raise InputError(f"{field}: {value!r} is wrong; give {allowed}")
