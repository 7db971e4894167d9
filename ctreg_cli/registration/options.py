"""Choices of registration and tracking that a user may change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationOptions:
    """Defaults suit a scanner; every field is an option of ``ctreg pose`` and ``ctreg track``."""

    #: obey the frame file's ``mount``
    use_mount: bool = True
    #: the risk, a slice, that the true error exceeds the protection level
    integrity_risk: float = 1e-5
    #: an ``ok`` whose protection level at any target exceeds this becomes ``no_pose``/``unprotected``; None: no limit
    alert_limit_mm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingOptions:
    """How the frame is followed from slice to slice."""

    registration: RegistrationOptions = RegistrationOptions()
    jacobian: Literal["updated", "constant"] = "updated"
    #: share of the spot error taken back in one servo step, 0 < gain ≤ 1
    gain: float = 1.0
    #: where the frame is expected in the next slice: carried on by its velocity, or where it was
    prediction: Literal["velocity", "identity"] = "velocity"
