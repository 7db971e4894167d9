"""Choices of registration and tracking that a user may change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args, get_type_hints

from ctreg_cli.checks import demand, is_number


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationOptions:
    """Defaults suit a scanner; every field is an option of ``ctreg pose`` and ``ctreg track``.

    Raises:
        InputError: a value that is not allowed.
    """

    #: obey the frame file's ``mount``
    use_mount: bool = True
    #: the risk, a slice, that the true error exceeds the protection level
    integrity_risk: float = 1e-5
    #: an ``ok`` whose protection level at any target exceeds this becomes ``no_pose``/``unprotected``; None: no limit
    alert_limit_mm: float | None = None

    def __post_init__(self) -> None:
        risk, limit = self.integrity_risk, self.alert_limit_mm
        demand(is_number(risk) and 0 < risk < 1, "integrity_risk", risk, "a probability between 0 and 1")
        is_limit = limit is None or (is_number(limit) and limit > 0)
        demand(is_limit, "alert_limit_mm", limit, "a positive number of millimetres, or None for no limit")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingOptions:
    """How the frame is followed from slice to slice.

    Raises:
        InputError: a value that is not allowed.
    """

    registration: RegistrationOptions = RegistrationOptions()
    jacobian: Literal["updated", "constant"] = "updated"
    #: share of the spot error taken back in one servo step, 0 < gain ≤ 1
    gain: float = 1.0
    #: where the frame is expected in the next slice: carried on by its velocity, or where it was
    prediction: Literal["velocity", "identity"] = "velocity"

    def __post_init__(self) -> None:
        registration, gain = self.registration, self.gain
        demand(isinstance(registration, RegistrationOptions), "registration", registration, "RegistrationOptions(...)")
        demand(is_number(gain) and 0 < gain <= 1, "gain", gain, "a number with 0 < gain <= 1")
        for name in ("jacobian", "prediction"):
            value, allowed = getattr(self, name), _WORDS[name]
            demand(value in allowed, name, value, " or ".join(map(repr, allowed)))


#: the words of options that are words
_WORDS = {name: get_args(get_type_hints(TrackingOptions)[name]) for name in ("jacobian", "prediction")}
